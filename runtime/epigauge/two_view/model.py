"""Which model of two views some matches support: nothing, no motion, a rotation, a plane, F or E.

All models are fitted, and each is given the likelihood of all matches with its degrees of freedom.
Whether one of them is common geometry at all, and whether F says more than the homography does, is
decided by the tests that the flags of `estimate_fundamental` come from, so that both agree; where
too few matches are right for F, a homography may still be more than chance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_count, as_matches
from epigauge._logged import logged
from epigauge._options import Backend
from epigauge._results import Result
from epigauge.errors import ArgumentError
from epigauge.two_view.chance import SIGNIFICANT
from epigauge.two_view.conditioning import condition_raw
from epigauge.two_view.consensus import RANGE, Consensus
from epigauge.two_view.copies import earliest
from epigauge.two_view.essential import rotation_between
from epigauge.two_view.homography import plane_squares
from epigauge.two_view.homography_refine import LEAST
from epigauge.two_view.homography_result import HomographyResult
from epigauge.two_view.homography_search import PlaneMixture, estimate_homography
from epigauge.two_view.refine import calibrations
from epigauge.two_view.robust import RobustResult, estimate_fundamental
from epigauge.two_view.search import SCALES
from epigauge.verdicts import ordered

__all__ = ["TwoViewResult", "estimate_two_view", "flat_evidence"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Model = Literal["nothing", "still", "rotation", "plane", "F", "E"]

#: What the flags that a homography explains the matches are called as a model; the first counts.
_MODELS: dict[str, Model] = {
    "still camera": "still",
    "pure rotation": "rotation",
    "planar scene": "plane",
}

#: Parameters of each model; noise and share of right matches are two more of all but the first.
_PARAMETERS = {"nothing": 0, "still": 0, "rotation": 3, "plane": 8, "F": 7, "E": 5}

#: What a plane in F or E takes more.
_PLANE_IN_IT = 3

#: Steps of the maximisation of a likelihood; and the constant of the normal density.
_STEPS, _ROOT = 30, math.sqrt(2.0 * math.pi)

#: The noise of a homography over that of F beyond which there is relief.
_WIDER = 1.5

#: Relief that the few right matches of a general scene may have, as a share of the range: where F
#: is not known, those that are near a homography all the same are no plane.
_RELIEF = 0.15


@dataclass(frozen=True, kw_only=True)
class TwoViewResult(Result):
    """Which model of two views the matches support, and its fit.

    Attributes
    ----------
    model : str
        "nothing" (the matches agree no better than by chance), "still" (the camera did not move),
        "rotation" (it only turned; without calibration, as an ordinary lens would), "plane", "F",
        or "E" with calibration.
    F, E, H : ndarray, shape (3, 3), or None
        What the model has: H for a still camera, a rotation or a plane, F for "F" and "E", E for
        "E", and for a plane with calibration, where it was found.
    R, t : ndarray, shape (3, 3) and (3,), or None
        With calibration, the motion ``x2 = R x1 + t``, t of unit length; of a rotation R alone.
    evidence : dict
        For each model that was compared ``log_likelihood``, ``parameters`` and ``score``; the
        likelihood is relative to that of wrong matches alone, which is "nothing" with zero. The
        score is less by what matches gain that are fitted exactly, ``log(range / sigma)`` for each
        parameter of the geometry, range being that of the coordinates, and by ``log(m) / 2`` for
        each noise and share: so wrong matches that fit by chance hardly count.
    inliers : ndarray of bool, shape (m,)
        Which matches agree with the model, duplicates included.
    flags : tuple of str
        Of the fit of the model, names from `epigauge.verdicts.FLAGS`.
    success : bool
        Whether there is a model, and its fit may be used.
    message : str
        The same in words.

    Examples
    --------
    >>> import epigauge as eg
    >>> raw = eg.load_matches(eg.samples.path("raw_matches.csv"))
    >>> result = eg.estimate_two_view(raw.x1, raw.x2)
    >>> result.model, result.success, result.R is None
    ('F', True, True)
    """

    _shown: ClassVar[tuple[str, ...]] = ("model", "F", "E", "H", "R", "t", "message")

    model: Model
    F: Array | None
    E: Array | None
    H: Array | None
    R: Array | None
    t: Array | None
    evidence: dict[str, dict[str, float]] = field(repr=False)
    inliers: Mask = field(repr=False)
    flags: tuple[str, ...]
    success: bool
    message: str
    _fundamental: RobustResult | None = field(repr=False)
    _homography: HomographyResult | None = field(repr=False)

    @property
    def fit(self) -> RobustResult | HomographyResult | None:
        """Return the whole result of the model's fit; None for "nothing"."""
        if self.model == "nothing":
            return None
        return self._fundamental if self.model in ("F", "E") else self._homography

    def _arrays(self) -> dict[str, Any]:
        """Return the fields of NPZ, where the evidence is one number a name."""
        contents = self._contents()
        return contents | flat_evidence(contents.pop("evidence"))

    def _summary_rows(self) -> dict[str, str]:
        found = super()._summary_rows()
        count = f"{np.count_nonzero(self.inliers)} of {len(self.inliers)} matches"
        scores = {name: f"{entry['score']:.1f}" for name, entry in self.evidence.items()}
        text = ", ".join(f"{name} {score}" for name, score in scores.items())
        return {"model": found.pop("model"), "inliers": count, "scores": text} | found


def flat_evidence(evidence: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return each number of the evidence by a name of its own: evidence_F_score."""
    return {
        f"evidence_{model}_{name}": value
        for model, entry in evidence.items()
        for name, value in entry.items()
    }


@logged
def estimate_two_view(
    x1: ArrayLike,
    x2: ArrayLike,
    K1: ArrayLike | None = None,
    K2: ArrayLike | None = None,
    *,
    seed: int = 0,
    backend: Backend | None = None,
) -> TwoViewResult:
    """Tell which model of two views raw matches support, and fit it.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least eight different matches in pixels, wrong ones among them.
    K1, K2 : array_like, shape (3, 3), optional
        Calibration matrices: the general model is then the essential matrix. `K2` is `K1` by
        default.
    seed : int
        Of everything random.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed.

    Returns
    -------
    TwoViewResult
        The model, its fit, and the evidence for all models.

    Raises
    ------
    ArgumentError
        On bad arguments.

    Notes
    -----
    A right match has normal noise across its epipolar line and may be anywhere along it; of a
    homography it has normal noise in both directions; a wrong one may be anywhere. That F also
    explains a plane is counted: under F matches have a relief along their epipolar lines, off the
    plane, the deviation of which is fitted; it is no more than the noise where all are on it.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(n_points=200, noise_px=0.3, seed=1)
    >>> result = eg.estimate_two_view(scene.x1, scene.x2)
    >>> result.model, result.success
    ('F', True)
    >>> eg.estimate_two_view(scene.x1, scene.x1).model
    'still'
    """
    if K1 is None and K2 is not None:
        raise ArgumentError("K1", "is None, but K2 is given", "both calibrations, or neither")
    calibration = calibrations(K1 is not None, K1, K2)
    x1, x2 = as_matches(x1, x2, at_least=8, general_position=True)
    seed = as_count("seed", seed, at_least=0)
    plane: HomographyResult | None = estimate_homography(x1, x2, seed=seed, backend=backend)
    if plane is not None and "undetermined" in plane.flags:
        plane = None
    options: dict[str, Any] = {}
    if calibration is not None:
        options = {"essential": True, "K1": calibration[0], "K2": calibration[1]}
    general = estimate_fundamental(x1, x2, seed=seed, backend=backend, **options)
    name: Model = "F" if calibration is None else "E"
    evidence, R, flat = _evidence(name, x1, x2, general, plane, calibration, backend)
    known = "no common geometry" not in general.flags
    flat_enough = plane if known or not _may_have_relief(plane, x1, x2) else None
    model = _model(name, general, flat_enough, flat, evidence)
    usable = model != "nothing" and (general if model == name else plane).status > 0  # type: ignore[union-attr]
    with_motion = model == "E" or (calibration is not None and model == "plane" and known)
    if model == name:
        flags, inliers = general.flags, general.inlier
        usable = usable and general.success
    elif model == "nothing" or plane is None:
        flags, inliers = ("no common geometry",), np.zeros(len(x1), np.bool_)
    else:
        told = {"no common geometry", *_MODELS}  # the model says what it is
        own = [flag for flag in plane.flags if flag not in told]
        flags, inliers = ordered((*own, *_words(model))), plane.inlier
    return TwoViewResult(
        model=model,
        F=general.F if model == name else None,
        E=general.E if with_motion else None,
        H=plane.H if plane is not None and model in _MODELS.values() else None,
        R=R if model == "rotation" else general.R if with_motion else None,
        t=general.t if with_motion else None,
        evidence=evidence,
        inliers=inliers,
        flags=flags,
        success=usable,
        message=_message(model, evidence),
        _fundamental=general,
        _homography=plane,
    )


def _words(model: Model) -> list[str]:
    """Return the flags that a model is told by."""
    if model == "rotation":
        return ["planar scene", "pure rotation"]
    return [flag for flag, name in _MODELS.items() if name == model]


def _message(model: Model, evidence: dict[str, dict[str, float]]) -> str:
    if model == "nothing":
        return "the matches agree no better than wrong ones do by chance"
    # Without calibration a rotation is any homography
    ahead = evidence[model if model in evidence else "plane"]["score"]
    return f"{model}: the logarithm of its likelihood is {ahead:.1f} above that of wrong matches"


def _model(
    name: Model,
    general: RobustResult,
    plane: HomographyResult | None,
    flat: bool,
    evidence: dict[str, dict[str, float]],
) -> Model:
    """Return the model by the flags of both fits, and whether F explains no more than H."""
    if plane is None or "no common geometry" in plane.flags:
        return "nothing" if "no common geometry" in general.flags else name
    told = {"no common geometry", *_MODELS}
    if not flat and told.isdisjoint(general.flags):
        return name
    flags = {*general.flags, *plane.flags, "planar scene"}
    if "rotation" not in evidence:  # without calibration H knows best whether it is a camera's
        flags -= {"pure rotation"} - {*plane.flags}
    # H may be that of a rotation with some calibration, but not with this one
    if "rotation" in evidence:
        turned, free = (evidence[model] for model in ("rotation", "plane"))
        fewer = 0.5 * (free["parameters"] - turned["parameters"]) * math.log(len(plane.inlier))
        if turned["log_likelihood"] + fewer < free["log_likelihood"]:
            flags -= {"pure rotation"} - {*general.flags}
    return next(model for flag, model in _MODELS.items() if flag in flags)


def _may_have_relief(plane: HomographyResult | None, x1: Array, x2: Array) -> bool:
    """Tell whether matches of a general scene may be as near a homography by chance.

    Those that are right anywhere in it move alike but for their relief along epipolar lines: of a
    range of it, each is within a distance of the homography of any four with a chance that grows as
    the distance. Of so many fours some are expected to have all others near.
    """
    if plane is None:
        return False
    agreed, extent = len(plane.used), RANGE * condition_raw(x1, x2, LEAST)[0].scale
    near = min(2.0 * plane.threshold_px / (_RELIEF * extent), 1.0)
    expected = math.log10(math.comb(agreed, 4)) + (agreed - 4) * math.log10(max(near, 1e-300))
    return expected > SIGNIFICANT


def _evidence(
    name: Model,
    x1: Array,
    x2: Array,
    general: RobustResult,
    plane: HomographyResult | None,
    calibration: tuple[Array, Array] | None,
    backend: str | None,
) -> tuple[dict[str, dict[str, float]], Array | None, bool]:
    """Return the likelihoods of all models, the rotation, and whether F explains no more than H."""
    rows = np.flatnonzero(earliest(x1, x2) == np.arange(len(x1)))
    y1, y2 = x1[rows], x2[rows]
    frame, _ = condition_raw(y1, y2, LEAST)
    table, (q1, q2) = kernels.table(backend), frame.forward(y1, y2)
    m = len(rows)
    wrong = -2.0 * m * math.log(RANGE)
    found = {"nothing": {"log_likelihood": 0.0, "parameters": 0.0, "score": 0.0}}

    def add(model: str, logarithm: float, sigma: float, plane_in_it: bool = False) -> None:
        parameters = _PARAMETERS[model] + plane_in_it * _PLANE_IN_IT
        others = 2 + 2 * plane_in_it  # noise and share; of the plane, relief and share
        exact = parameters * math.log(RANGE / sigma)
        gain = logarithm - wrong
        score = gain - exact - 0.5 * others * math.log(m)
        if score > found.get(model, {}).get("score", -math.inf):
            entry = {"log_likelihood": gain, "parameters": float(parameters + others)}
            found[model] = entry | {"score": score}

    def add_plane(model: str, H: Array) -> tuple[PlaneMixture, Array]:
        squares = plane_squares(table, frame.homography_from_pixels(H), q1, q2)
        mixture = PlaneMixture.of(squares, SCALES[0], parameters=_PARAMETERS[model])
        add(model, mixture.logarithm, mixture.sigma)
        return mixture, squares

    add_plane("still", np.eye(3))
    R, squared, widest, simpler = None, np.full(m, np.inf), 0.0, -math.inf
    if plane is not None:
        mixture, squared = add_plane("plane", plane.H)
        widest, simpler = mixture.sigma, mixture.logarithm - wrong
        if calibration is not None:
            K1, K2 = calibration
            R = rotation_between(*(_rays(x[plane.inlier], K) for x, K in ((x1, K1), (x2, K2))))
            add_plane("rotation", K2 @ R @ np.linalg.inv(K1))
    agreed = Consensus(table, q1, q2).judge(frame.from_pixels(general.F), SCALES[0])
    # Of the same noise; a plane that needs more of it has relief
    sigma = max(agreed.sigma, min(widest, _WIDER * agreed.sigma))
    with_plane = _general(agreed.signed, agreed.oriented, sigma, squared)
    add(name, _general(agreed.signed, agreed.oriented, sigma), sigma)
    add(name, with_plane, sigma, plane_in_it=True)
    # The epipole can be put on the lines of any two of the matches off the plane
    chosen = 0.5 * 5.0 * math.log(m) + 2.0 * math.log(m)
    flat = widest <= _WIDER * agreed.sigma and with_plane - wrong - chosen <= simpler
    return found, R, flat


def _rays(x: Array, K: Array) -> Array:
    """Return points as directions of unit length."""
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(K).T
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def _general(signed: Array, oriented: Mask, sigma: float, from_plane: Array | None = None) -> float:
    """Return the logarithm of the likelihood of F, shares being fitted.

    By squared distances from a plane, some matches are off it by a relief along their epipolar
    lines, normal with a deviation that is fitted, too; others are anywhere on their lines.
    """
    m = len(signed)
    squared = np.minimum(signed**2, 1e6 * sigma**2)
    across = np.where(oriented, -0.5 * squared / sigma**2 - math.log(_ROOT * sigma), -np.inf)
    logs = np.full((3, m), -2.0 * math.log(RANGE))
    logs[1] = across - math.log(RANGE)
    shares, relief = np.array([0.3, 0.4, 0.3]), sigma
    along = np.full(m, np.inf) if from_plane is None else np.maximum(from_plane - squared, 0.0)
    if from_plane is None:
        shares[2] = 0.0
    for step in range(_STEPS + 1):
        with np.errstate(over="ignore"):
            logs[2] = across - 0.5 * np.minimum(along / relief**2, 1e6) - math.log(_ROOT * relief)
        highest = np.max(logs, axis=0)
        parts = shares[:, None] * np.exp(logs - highest)
        total = np.sum(parts, axis=0)
        if step == _STEPS:
            break
        shares = np.mean(parts / total, axis=1)
        on = parts[2] / total
        if np.sum(on) > 0.0:
            away = float(on @ np.where(on > 0.0, along, 0.0)) / float(np.sum(on))
            relief = min(max(math.sqrt(away), sigma), RANGE)
    return float(np.sum(highest + np.log(total)))
