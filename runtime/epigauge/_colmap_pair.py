"""What the two images of a pair of a COLMAP database have in common, by their raw matches."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.errors import ArgumentError
from epigauge.two_view.conditioning import condition
from epigauge.two_view.consensus import Consensus
from epigauge.two_view.copies import earliest
from epigauge.two_view.essential import Calibrated
from epigauge.two_view.homography import fit_homography, robust_homography
from epigauge.two_view.refine import plan_of
from epigauge.two_view.robust import RobustResult, estimated
from epigauge.two_view.solve import Matches, minimize

if TYPE_CHECKING:
    from epigauge.io.colmap_raw import Geometry, RawPair

__all__ = ["Verified", "verified"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: COLMAP's codes, as in `CONFIGS`.
_DEGENERATE, _CALIBRATED, _UNCALIBRATED, _PLANAR, _PANORAMIC, _EITHER, _WATERMARK = range(1, 8)

#: The share of the inliers of F that E must explain, as by COLMAP's default.
_BY_E = 0.95

#: A rotation explains matches as well as a homography up to this ratio of the variances.
_AS_WELL = 1.5

#: A watermark: at least this share of the inliers lie in the border, as wide as this share of the
#: image's diagonal, and moved together within so many pixels; the defaults of COLMAP.
_AT_BORDER, _BORDER, _TOGETHER_PX = 0.7, 0.1, 4.0

#: A lens bends the points when it moves them by more than this many deviations of their noise, and
#: by more than so many pixels.
_BENT, _BENT_PX = 1.0, 0.5

#: Flags that say that the inliers determine neither F nor a homography.
_NOTHING = frozenset({"no common geometry", "undetermined"})

#: Ratio of the two singular values of E below which it has rank one.
_RANK_ONE = 16.0 * np.finfo(float).eps


class Verified(NamedTuple):
    """What was found of a pair, and how many raw matches it has."""

    geometry: Geometry
    matches: int
    noise_px: float
    note: str


def verified(pairs: list[RawPair], options: dict[str, Any]) -> list[Verified]:
    """Verify some pairs, here or wherever an executor takes this."""
    return [_verified(pair, **options) for pair in pairs]


def _verified(
    pair: RawPair, min_inliers: int, threshold_px: float | str, seed: int, backend: str
) -> Verified:
    from epigauge.io.colmap_raw import Geometry

    def told(
        config: int, inlier: Mask | None = None, noise: float = np.nan, note: str = "", **more: Any
    ) -> Verified:
        inliers = pair.matches[np.zeros(len(pair.matches), np.bool_) if inlier is None else inlier]
        geometry = Geometry(pair.pair_id, config, inliers, **more)
        return Verified(geometry, len(pair.matches), noise, note)

    if pair.reason:
        return told(-1, note=pair.reason)
    # Copies tell nothing more.
    first = earliest(np.ascontiguousarray(pair.x1), np.ascontiguousarray(pair.x2))
    different = int(np.count_nonzero(first == np.arange(len(first))))
    if different < min_inliers:
        return told(_DEGENERATE, note=f"{different} matches")
    try:
        result = estimated(
            pair.x1, pair.x2, "auto", threshold_px, None, seed, {"backend": backend}
        ).result
    except ArgumentError as error:  # too few different ones, or all on a line
        return told(_DEGENERATE, note=str(error))
    flags, inlier, noise = result.flags, result.inlier, result.rms_px * _per_coordinate(result)
    note = ", ".join(flags)
    count = min(int(np.count_nonzero(inlier)), len(result.used))
    if not _NOTHING.isdisjoint(flags) or count < min_inliers:
        return told(_DEGENERATE, note=note or f"{count} inliers")
    if pair.bend_px > max(_BENT * noise, _BENT_PX):
        return told(-1, note=", ".join(filter(None, (note, "distorted cameras"))))
    if _is_watermark(pair, inlier):
        return told(_WATERMARK, inlier, noise, note)
    if not {"planar scene", "still camera", "pure rotation"}.isdisjoint(flags):
        config, H, on = _homography(pair, result)
        return told(config, on, noise, note, F=result.F, H=H)
    E = _essential(pair, result, backend)
    if E is not None:
        return told(_CALIBRATED, E[2], noise, note, F=E[0], E=E[1])
    return told(_UNCALIBRATED, inlier, noise, note, F=result.F)


def _per_coordinate(result: RobustResult) -> float:
    """Return the noise of a coordinate over the RMS of the residual coordinates."""
    n = len(result.used)
    return 2.0 * float(np.sqrt(n / max(n - 7.0, 1.0)))


def _is_watermark(pair: RawPair, inlier: Mask) -> bool:
    """Tell whether most inliers lie at the borders of both images and moved together."""
    at_border = np.ones(np.count_nonzero(inlier), np.bool_)
    for raw, size in zip((pair.raw1, pair.raw2), pair.sizes, strict=True):
        if size is None:
            return False
        border = _BORDER * np.hypot(*size)
        x = raw[inlier]
        at_border &= ((x < border) | (x > np.array(size) - border)).any(axis=1)
        if np.count_nonzero(at_border) < _AT_BORDER * len(at_border):
            return False
    moved = (pair.raw2 - pair.raw1)[inlier]
    together = np.linalg.norm(moved - np.median(moved, axis=0), axis=1) <= _TOGETHER_PX
    return bool(np.mean(together) >= _AT_BORDER)


def _homography(pair: RawPair, result: RobustResult) -> tuple[int, Array, Mask]:
    """Return the code of a pair that a homography explains, the homography and its inliers."""
    x1, x2 = pair.x1[result.inlier], pair.x2[result.inlier]
    frame = condition(x1, x2)
    q1, q2 = (np.ascontiguousarray(q) for q in frame.forward(x1, x2))
    to_units1, to_units2 = frame.maps_from_pixels()
    # Distances in both images; F has left one of their two directions free
    limit2 = 2.0 * (result.threshold_px / frame.scale) ** 2
    near = robust_homography(q1, q2, np.ones(len(x1)))[1] <= limit2
    H, squared, _ = fit_homography(q1, q2, near.astype(np.float64))
    on = squared <= limit2
    inlier = result.inlier.copy()
    inlier[inlier] = on
    code = _EITHER
    if pair.K1 is not None and pair.K2 is not None:
        code = _PANORAMIC if {"still camera", "pure rotation"} & set(result.flags) else _PLANAR
        cameras = Calibrated(q1[:, on], q2[:, on], to_units1 @ pair.K1, to_units2 @ pair.K2)
        n = int(np.count_nonzero(on))
        rotation = np.sum(cameras.from_rotation(np.ones(n))) / max(2 * n - 3, 1)
        if rotation <= _AS_WELL * np.sum(squared[on]) / max(2 * n - 8, 1):
            code = _PANORAMIC
    H = np.linalg.inv(to_units2) @ H @ to_units1
    return code, H / np.linalg.norm(H), inlier


def _essential(
    pair: RawPair, result: RobustResult, backend: str
) -> tuple[Array, Array, Mask] | None:
    """Return F, E and inliers of calibrated cameras; None where E does not explain them."""
    if pair.K1 is None or pair.K2 is None:
        return None
    F0, x1, x2 = result.F, pair.x1[result.used], pair.x2[result.used]
    matches = Matches.of(x1, x2, np.ones(len(x1)), F0, kernels.table(backend))
    E0 = pair.K2.T @ F0 @ pair.K1
    values = np.linalg.svd(E0, compute_uv=False)
    if not values[1] > _RANK_ONE * values[0]:
        return None  # points so far off for these cameras that E has rank 1 in double precision
    options = replace(plan_of({"backend": backend}).options, calibration=(pair.K1, pair.K2))
    found = minimize(matches, options, matches.frame.from_pixels(F0)).F
    q1, q2 = matches.frame.forward(pair.x1, pair.x2)
    signed = Consensus(matches.table, q1, q2).measured(found)[0]
    with np.errstate(invalid="ignore"):
        inlier = result.inlier & (matches.frame.scale * np.abs(signed) <= result.threshold_px)
    if np.count_nonzero(inlier) < _BY_E * np.count_nonzero(result.inlier):
        return None
    F = matches.frame.to_pixels(found)
    E = pair.K2.T @ F @ pair.K1
    return F, E / np.linalg.norm(E), inlier
