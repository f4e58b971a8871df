"""Whether perspective shows: else an affine model explains the images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.parallax import partners
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.verdicts.evidence import Evidence

__all__ = ["affine_pairs", "affine_views"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Points that a view, or a pair of views, needs to be asked.
_LEAST = 8

#: Misfit of an affine epipolar geometry, over the noise, below which perspective does not show in a
#: pair: of a measured set that perspective helps (a long lens) it is up to 0.6.
_PAIR = 0.3


def affine_views(evidence: Evidence, X: Array, noise_px: float) -> bool:
    """Tell whether each view's images are an affine function of the points, within the noise.

    Parameters
    ----------
    evidence : Evidence
        Observations; those of weight zero do not count.
    X : ndarray, shape (m, 3)
        The points.
    noise_px : float
        Standard deviation of a coordinate.
    """
    counts = evidence.of_views
    asked = 0
    # The first that shows perspective ends it: those with the most points are asked first.
    for i in np.argsort(-counts, kind="stable"):
        if counts[i] < _LEAST:
            break
        points, images = evidence.images(int(i))
        if not np.isfinite(images).all():
            return False
        own = X[points]
        a = own - own.mean(axis=0)
        a = np.column_stack([a / max(float(np.abs(a).max()), 1e-300), np.ones(len(a))])
        off = images - a @ np.linalg.lstsq(a, images, rcond=None)[0]
        if float(np.mean(off**2)) > noise_px**2:
            return False
        asked += 1
    return asked > 0


def affine_pairs(seen: Seen, images: Array, noise_px: float) -> bool:
    """Tell whether an affine epipolar geometry holds for pairs of views, within the noise.

    Parameters
    ----------
    seen : Seen
        The observations that count.
    images : ndarray, shape (N, 2)
        Where the cameras project the points to.
    noise_px : float
        Standard deviation of a coordinate.
    """
    asked = 0
    for i in np.unique(np.linspace(0, seen.n - 1, min(seen.n, 10)).astype(np.intp)):
        for k in partners(seen, int(i)):
            rows = np.full((2, seen.m), -1)
            for side, one in enumerate((i, k)):
                own = np.flatnonzero(seen.view == one)
                rows[side, seen.point[own]] = own
            both = rows[:, (rows >= 0).all(axis=0)]
            four = np.column_stack([images[both[0]], images[both[1]]])
            least = np.linalg.svd(four - four.mean(axis=0), compute_uv=False)[-1]
            if least > _PAIR * noise_px * np.sqrt(len(four)):
                return False
            asked += 1
    return asked > 0
