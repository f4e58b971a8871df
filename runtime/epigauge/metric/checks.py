"""Checks of what `metric_upgrade` is given."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array, as_real
from epigauge.bundle.prior_kinds import IntrinsicPrior
from epigauge.cameras import camera_model
from epigauge.errors import ArgumentError
from epigauge.metric.scene import Images
from epigauge.multi_view.tracks import Tracks

__all__ = ["images_of", "outside", "priors_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Share of width plus height that points may lie beside their images, as lenses and their
#: corrections bring about, and share of the points that may lie farther off, as gross errors.
_BESIDE, _OUTSIDE = 0.01, 0.15


def images_of(tracks: Tracks, image_size: ArrayLike, shared: bool | ArrayLike) -> Images:
    """Check sizes and cameras."""
    n = tracks.n_views
    sizes = as_real("image_size", image_size, "(width, height), or a row a view")
    if sizes.shape not in ((2,), (n, 2)):
        raise ArgumentError("image_size", f"has shape {sizes.shape}", f"(2,) or ({n}, 2)")
    if not (np.isfinite(sizes) & (sizes >= 1.0)).all():
        raise ArgumentError("image_size", "is not positive everywhere", "pixels")
    sizes = np.broadcast_to(sizes, (n, 2)).astype(np.float64)
    away = np.any(tracks.xy < -0.5 * sizes[tracks.view], axis=1)
    away |= np.any(tracks.xy > 1.5 * sizes[tracks.view], axis=1)
    if away.mean() > 0.5:
        was = "does not fit the tracks: most are far outside the images"
        raise ArgumentError("image_size", was, "width, height in the pixels of the tracks")
    if isinstance(shared, bool | np.bool_):
        group = np.zeros(n, dtype=np.intp) if shared else np.arange(n)
    else:
        group = _groups(shared, n)
    for c in range(int(group.max()) + 1):
        if len(np.unique(sizes[group == c], axis=0)) > 1:
            was = f"gives camera {c} images of different sizes"
            raise ArgumentError("shared", was, "one size a camera; False for a camera a view")
    return Images(sizes, group)


def outside(tracks: Tracks, images: Images) -> bool:
    """Tell whether tracks are not in the pixels of the images, from their top left corner."""
    margin = _BESIDE * images.unit[tracks.view, None]
    beside = (tracks.xy < -0.5 - margin) | (tracks.xy > images.sizes[tracks.view] - 0.5 + margin)
    return bool(np.mean(beside.any(axis=1)[tracks.weights > 0.0]) > _OUTSIDE)


def priors_of(
    priors: Iterable[IntrinsicPrior] | None, camera: str, count: int
) -> tuple[IntrinsicPrior, ...]:
    """Check what is known of the cameras."""
    found, names = tuple(priors or ()), camera_model(camera).adjusted
    for prior in found:
        if not isinstance(prior, IntrinsicPrior):
            raise ArgumentError("priors", f"holds a {type(prior).__name__}", "eg.IntrinsicPrior")
        if prior.name not in names or not 0 <= prior.camera < count:
            was = f"names {prior.name!r:.40} of camera {prior.camera}"
            raise ArgumentError("priors", was, f"{', '.join(names)} of cameras 0 to {count - 1}")
        if not (np.isfinite(prior.value) and np.isfinite(prior.sigma) and prior.sigma > 0.0):
            was = f"gives {prior.name} as {prior.value} +- {prior.sigma}"
            raise ArgumentError("priors", was, "finite numbers, the deviation positive")
    return found


def _groups(shared: ArrayLike, n: int) -> Indices:
    group = as_array("shared", shared, "True, False or a number a view")
    if group.shape != (n,) or group.dtype.kind not in "iu":
        was = f"is {group.dtype} {group.shape}"
        raise ArgumentError("shared", was, f"True, False, or integers ({n},)")
    if (group < 0).any() or len(np.unique(group)) != int(group.max()) + 1:
        raise ArgumentError("shared", "leaves numbers out", "cameras numbered from 0 without gaps")
    return group.astype(np.intp)
