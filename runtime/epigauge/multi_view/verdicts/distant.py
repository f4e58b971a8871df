"""Whether points of calibrated cameras are nearer than infinity: parallax against the noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.point_blocks import Triangle
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.multi_view.parallax import partners
from epigauge.multi_view.verdicts.evidence import Evidence

__all__ = ["distance_flags", "relative_depths"]

Array = NDArray[np.float64]

#: A depth whose standard deviation is this share of it does not keep the point from infinity.
_OPEN = 0.5

#: Share of such points that is told.
_MANY = 0.1

#: Parallax of the rays of two views, a coordinate, in standard deviations: what noise feigns.
_PARALLAX = 1.5

#: A point stays where it was within so many standard deviations; share of others by chance.
_STAYS, _CHANCE = 4.0, 0.05


def relative_depths(system: BundleSystem, noise_px: float, free: NDArray[np.bool_]) -> Array:
    """Return the standard deviation of free points along their rays, over their distance.

    By their own observations and priors, cameras being known.
    """
    pose = system.cameras[:, :12].reshape(-1, 3, 4)
    middle = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3]).mean(axis=0)
    ray = (system.points - middle)[free].T
    V = system.normal.V[free]
    distance = np.maximum(np.sqrt(np.sum(ray**2, axis=0)), 1e-300)
    variance = Triangle.of(V, 1e-14).energy(ray / distance)
    return np.asarray(noise_px * np.sqrt(np.maximum(variance, 0.0)) / distance)


def distance_flags(
    evidence: Evidence, found: MetricReconstruction, depths: Array, noise_px: float
) -> tuple[str, ...]:
    """Return "still camera", "pure rotation", "points at infinity" or nothing.

    Parameters
    ----------
    evidence : Evidence
        Observations.
    found : MetricReconstruction
        Cameras and points.
    depths : ndarray, shape (k,)
        What `relative_depths` returned.
    noise_px : float
        Standard deviation of a coordinate.
    """
    if _turned(evidence, found, noise_px):
        still = evidence.moved(_STAYS * noise_px) <= _CHANCE
        return ("still camera",) if still else ("pure rotation",)
    far = len(depths) > 0 and float(np.mean(depths > _OPEN)) > _MANY
    return ("points at infinity",) if far else ()


def _turned(evidence: Evidence, found: MetricReconstruction, noise_px: float) -> bool:
    """Tell whether a rotation takes the rays of each view to those of others, within the noise.

    The rays are those to the reconstructed points, whose own parallax the noise has made then.
    """
    n, centres = found.n_views, found.centres
    limit = _PARALLAX * noise_px / _pixels_a_radian(found)
    asked = 0
    for i in np.unique(np.linspace(0, n - 1, min(n, 10)).astype(np.intp)):
        seen = evidence.around(int(i))
        X = found.X[seen.points]
        for k in partners(seen, int(i)):
            both = np.zeros((2, seen.m), np.bool_)
            for side, one in enumerate((i, k)):
                both[side, seen.point[seen.view == one]] = True
            common = np.flatnonzero(both[0] & both[1])
            a, b = (X[common] - centres[one] for one in (i, k))
            a, b = (
                v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300) for v in (a, b)
            )
            U, _, Vt = np.linalg.svd(b.T @ a)
            turn = (U * [1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
            off = b - a @ turn.T
            if float(np.mean(np.sum(off**2, axis=1))) > 2.0 * limit**2:
                return False
            asked += 1
    return asked > 0


def _pixels_a_radian(found: MetricReconstruction) -> float:
    """Return how far images move with a ray, about."""
    model, params = camera_model(found.cameras.model), found.cameras.params
    if model.focal:
        return float(np.median(np.abs(params[:, list(model.focal)])))
    return float(np.median(params[:, model.positive[0]])) / (2.0 * np.pi)
