"""Scenes held by satellite positions or control points: against dense algebra by complex steps."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.cameras import camera_model
from numpy.typing import NDArray

from tests.metric_dense import turned
from tests.metric_scenes import metric_scene

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: Complex steps need no differences: they can be as small as one likes.
STEP = 1e-40
NAMES = ("fx", "fy", "k1")


class Reference:
    """The scene as one vector, with projections of the model OPENCV written out once more."""

    def __init__(self, tracks: eg.Tracks, scene: eg.MetricReconstruction) -> None:
        known = camera_model("OPENCV").params
        self.tracks, self.names = tracks, known
        self.free = [known.index(name) for name in NAMES]
        self.R, self.C, self.X = scene.R, scene.centres, scene.X
        self.params, self.of_view = scene.cameras.params.copy(), scene.cameras.camera_of_view
        n, c = len(self.R), len(self.params)
        self.ends = np.cumsum([3 * n, 3 * n, len(self.free) * c, 3 * len(self.X)])

    def residuals(self, delta: Complex, priors: list[Any]) -> Complex:
        """Return whitened residuals after small changes, to first order in turns."""
        w, move, p, x = np.split(delta, self.ends[:-1])
        w, C = w.reshape(-1, 3), self.C + move.reshape(-1, 3)
        X = self.X + x.reshape(-1, 3)
        params = self.params.astype(complex)
        params[:, self.free] += p.reshape(-1, len(self.free))
        view, point = self.tracks.view, self.tracks.point
        apart = X[point] - C[view]
        seen = np.einsum("nij,nj->ni", self.R[view], apart - np.cross(w[view], apart))
        x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
        fx, fy, cx, cy, k1, k2, p1, p2 = (
            params[self.of_view[view], self.names.index(name)]
            for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        )
        r = x * x + y * y
        grown = 1.0 + k1 * r + k2 * r * r
        u = fx * (x * grown + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x)) + cx
        v = fy * (y * grown + 2.0 * p2 * x * y + p1 * (r + 2.0 * y * y)) + cy
        parts = [(np.stack([u, v], axis=1) - self.tracks.xy).ravel()]
        for prior in priors:
            if isinstance(prior, eg.PositionPrior):
                off = C[prior.view] - np.asarray(prior.position)
            else:
                off = X[prior.point] - np.asarray(prior.position)
            parts.append(off / np.broadcast_to(prior.sigma, 3))
        return np.concatenate(parts)

    def jacobian(self, priors: list[Any]) -> Array:
        """Return derivatives to the last digit."""
        steps = 1j * STEP * np.eye(self.ends[-1])
        return np.stack([self.residuals(s, priors).imag for s in steps], axis=1) / STEP

    def step(self, priors: list[Any]) -> float:
        """Make a step of Gauss-Newton; return its size relative to the deviations."""
        r = self.residuals(np.zeros(self.ends[-1], complex), priors).real
        J = self.jacobian(priors)
        delta = -np.linalg.lstsq(J, r, rcond=None)[0]
        w, move, p, x = np.split(delta, self.ends[:-1])
        turns = [R @ turned(k).T for R, k in zip(self.R, w.reshape(-1, 3), strict=True)]
        self.R, self.C = np.stack(turns), self.C + move.reshape(-1, 3)
        self.params[:, self.free] += p.reshape(-1, len(self.free))
        self.X = self.X + x.reshape(-1, 3)
        return float(np.linalg.norm(J @ delta))

    def covariance(self, priors: list[Any]) -> Array:
        """Return the inverse of the normal matrix, from the singular values of its root."""
        J = self.jacobian(priors)
        scale = np.linalg.norm(J, axis=0)
        half = np.linalg.svd(J / scale, full_matrices=False)
        root = half[2].T / half[1] / scale[:, None]
        return np.asarray(root @ root.T)


def _positions(scene: eg.MetricReconstruction, rng: np.random.Generator) -> list[Any]:
    return [
        eg.PositionPrior(i, c + rng.normal(0.0, 2.0, 3), sigma=2.0)
        for i, c in enumerate(scene.centres)
    ]


def _control(scene: eg.MetricReconstruction, rng: np.random.Generator) -> list[Any]:
    sigma = np.array([0.02, 0.02, 0.05])
    return [eg.PointPrior(j, scene.X[j] + rng.normal(0.0, sigma), sigma=sigma) for j in (0, 4, 9)]


@pytest.mark.parametrize("seed", [3, 8])
@pytest.mark.parametrize("known", [_positions, _control], ids=["positions", "control points"])
def test_positions_and_covariance_are_those_of_dense_algebra(known: Any, seed: int) -> None:
    """To 1e-8: the same minimum, and the same matrix there."""
    tracks, scene = metric_scene("OPENCV", seed, n_views=6, n_points=40, noise_px=0.5)
    turn = turned(np.array([0.4, -0.2, 0.9]))
    scene = eg.gauge.transform(scene, eg.gauge.similarity(12.0, turn, [40.0, -75.0, 20.0]))
    priors = known(scene, np.random.default_rng(seed))
    options: dict[str, Any] = {"refine": NAMES, "priors": priors}
    result = eg.bundle_adjust(tracks, scene, ftol=1e-16, gtol=1e-14, max_iter=60, **options)
    found = result.reconstruction
    dense = Reference(tracks, scene)
    assert any(dense.step(priors) < 1e-9 for _ in range(15))
    expected = dense.covariance(priors)
    std = np.sqrt(np.diagonal(expected))
    of_centres, of_points = std[dense.ends[0] : dense.ends[1]], std[dense.ends[2] :]
    for a, b, sigma in ((found.centres, dense.C, of_centres), (found.X, dense.X, of_points)):
        assert np.abs(a - b).max() < 1e-8 * np.abs(b).max()
        # The cost tells no more: a step of 1e-7 deviations changes it in its last digit.
        assert np.abs((a - b).ravel() / sigma).max() < 1e-7
    of_params = std[dense.ends[1] : dense.ends[2]].reshape(len(dense.params), -1)
    off = (found.cameras.params - dense.params)[:, dense.free]
    assert np.abs(off / of_params).max() < 1e-7

    at = eg.MetricReconstruction(
        dense.R,
        -np.einsum("nij,nj->ni", dense.R, dense.C),
        dense.X,
        eg.Cameras("OPENCV", dense.params, dense.of_view),
    )
    cov = eg.covariance(tracks, at, None, 1.0, **options)
    assert cov.open == 0
    own = [camera_model("OPENCV").adjusted.index(name) for name in NAMES]

    def rows(kind: str, k: int) -> NDArray[np.intp]:
        first, n, width = dense.ends, 3 * len(dense.R), len(NAMES)
        if kind == "camera":
            return np.r_[3 * k : 3 * k + 3, n + 3 * k : n + 3 * k + 3]
        if kind == "intrinsics":
            return np.arange(first[1] + width * k, first[1] + width * (k + 1))
        return np.arange(first[2] + 3 * k, first[2] + 3 * k + 3)

    parts = [("camera", 0), ("camera", 5), ("intrinsics", 1), ("point", 4), ("point", 17)]
    for a in parts:
        for b in parts:
            block = cov.between(a, b)
            block = block[own] if a[0] == "intrinsics" else block
            block = block[:, own] if b[0] == "intrinsics" else block
            i, j = rows(*a), rows(*b)
            unit = np.outer(std[i], std[j])
            assert (np.abs(block - expected[np.ix_(i, j)]) <= 1e-8 * unit).all(), (a, b)
    np.testing.assert_allclose(cov.std.points.ravel(), of_points, rtol=1e-8)
    np.testing.assert_allclose(cov.std.centres.ravel(), of_centres, rtol=1e-8)
