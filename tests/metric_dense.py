"""Covariances of calibrated scenes by dense algebra: one vector of all numbers, and borders."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
from epigauge.cameras import camera_model
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Fourth-order differences: step and weights.
STEP, WEIGHTS = 1e-3, {-2: 1.0 / 12.0, -1: -2.0 / 3.0, 1: 2.0 / 3.0, 2: -1.0 / 12.0}


def turned(w: Array) -> Array:
    """Return exp([w]_x)."""
    angle = float(np.linalg.norm(w))
    if angle == 0.0:
        return np.eye(3)
    K = np.cross(w / angle, np.eye(3)).T
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


class Dense:
    """All numbers of a scene as one vector: rotations and centres, intrinsics, points."""

    def __init__(self, scene: eg.MetricReconstruction, names: tuple[str, ...]) -> None:
        self.scene = scene
        known = camera_model(scene.cameras.model).params
        self.columns = [known.index(name) for name in names]
        self.sizes = 6 * scene.n_views, len(names) * len(scene.cameras), 3 * scene.n_points
        self.size = sum(self.sizes)

    def moved(self, delta: Array) -> eg.MetricReconstruction:
        """Return the scene after small rotations of the views about the axes of space and so on."""
        scene, (a, b, _) = self.scene, self.sizes
        pose = delta[:a].reshape(-1, 6)
        R = np.stack([R @ turned(w).T for R, w in zip(scene.R, pose[:, :3], strict=True)])
        centres = scene.centres + pose[:, 3:]
        params = scene.cameras.params.copy()
        params[:, self.columns] += delta[a : a + b].reshape(len(params), -1)
        cameras = eg.Cameras(scene.cameras.model, params, scene.cameras.camera_of_view)
        t = -np.einsum("nij,nj->ni", R, centres)
        return eg.MetricReconstruction(R, t, scene.X + delta[a + b :].reshape(-1, 3), cameras)

    def jacobian(self, function: Any) -> Array:
        """Return derivatives of a vector of a scene."""
        columns = []
        for k in range(self.size):
            values = [
                w * function(self.moved(s * STEP * np.eye(self.size)[k]))
                for s, w in WEIGHTS.items()
            ]
            columns.append(np.sum(values, axis=0) / STEP)
        return np.stack(columns, axis=1)

    def view(self, i: int) -> slice:
        return slice(6 * i, 6 * i + 6)

    def camera(self, c: int) -> slice:
        k = len(self.columns)
        return slice(self.sizes[0] + k * c, self.sizes[0] + k * (c + 1))

    def point(self, j: int) -> slice:
        first = self.sizes[0] + self.sizes[1] + 3 * j
        return slice(first, first + 3)

    def similarities(self) -> Array:
        """Return motions of all: turns, shifts and the scale of space, (size, 7)."""
        scene, G = self.scene, np.zeros((self.size, 7))
        for k in range(3):
            for i, centre in enumerate(scene.centres):
                G[self.view(i), k] = np.r_[np.eye(3)[k], np.cross(np.eye(3)[k], centre)]
                G[self.view(i), 3 + k] = np.r_[np.zeros(3), np.eye(3)[k]]
                G[self.view(i), 6] = np.r_[np.zeros(3), centre]
            for j, X in enumerate(scene.X):
                G[self.point(j), k] = np.cross(np.eye(3)[k], X)
                G[self.point(j), 3 + k] = np.eye(3)[k]
                G[self.point(j), 6] = X
        return G

    def covariance(self, N: Array, C: Array) -> Array:
        """Return the covariance under conditions C^T delta = 0, by the bordered matrix."""
        scale = 1.0 / np.sqrt(np.diagonal(N))
        C = scale[:, None] * C / np.linalg.norm(scale[:, None] * C, axis=0)
        k = C.shape[1]
        whole = np.block([[scale[:, None] * N * scale, C], [C.T, np.zeros((k, k))]])
        inverse = np.linalg.inv(whole)[: self.size, : self.size]
        return np.asarray(scale[:, None] * inverse * scale)


def conditions(dense: Dense, name: str) -> tuple[Any, Array]:
    """Return a datum and its conditions, written out."""
    G, scene = dense.similarities(), dense.scene
    C = np.zeros((dense.size, 7))
    some = [1, 4, 5, 9, 11]
    if name == "all points":
        C[dense.point(0).start :] = G[dense.point(0).start :]
        return "inner", C
    if name == "some points and views":
        for j in some:
            C[dense.point(j)] = G[dense.point(j)]
        for i in (0, 2):
            C[dense.view(i)][3:] = G[dense.view(i)][3:]
        return eg.gauge.inner(points=some, views=[0, 2]), C
    if name == "two cameras":
        C[dense.view(1), :6] = np.eye(6)
        C[dense.view(3), 6] = np.r_[np.zeros(3), scene.centres[3] - scene.centres[1]]
        return eg.gauge.two_cameras(1, 3), C
    C[dense.point(2), :3] = np.eye(3)
    C[dense.point(7), 3:6] = np.eye(3)
    C[dense.point(8), 6] = np.cross(scene.X[7] - scene.X[2], scene.X[8] - scene.X[2])
    return eg.gauge.five_points([2, 7, 8]), C


DATUMS = ("all points", "some points and views", "two cameras", "three points")


def assert_same(cov: eg.MetricCovariance, dense: Dense, expected: Array, rtol: float) -> None:
    """Assert that blocks and standard deviations are those of a dense matrix."""
    parts = {
        ("camera", 0): dense.view(0),
        ("camera", 3): dense.view(3),
        ("intrinsics", 0): dense.camera(0),
        ("point", 2): dense.point(2),
        ("point", 9): dense.point(9),
    }
    std = np.sqrt(np.maximum(np.diagonal(expected), 0.0))
    size = np.maximum(std, 1e-7 * std.max())
    names = camera_model(dense.scene.cameras.model).adjusted
    known = [names.index(camera_model(dense.scene.cameras.model).params[k]) for k in dense.columns]
    for a, rows in parts.items():
        for b, columns in parts.items():
            found = cov.between(a, b)
            found = found[known] if a[0] == "intrinsics" else found
            found = found[:, known] if b[0] == "intrinsics" else found
            unit = np.outer(size[rows], size[columns])
            assert (np.abs(found - expected[rows, columns]) <= rtol * unit).all(), (a, b)
    n = dense.scene.n_views
    poses = std[: 6 * n].reshape(n, 6)
    np.testing.assert_allclose(cov.std.rotations, poses[:, :3], rtol, rtol * poses[:, :3].max())
    np.testing.assert_allclose(cov.std.centres, poses[:, 3:], rtol, rtol * poses[:, 3:].max())
    points = std[dense.point(0).start :].reshape(-1, 3)
    np.testing.assert_allclose(cov.std.points, points, rtol, rtol * points.max())
    params = std[dense.camera(0).start : dense.point(0).start].reshape(len(dense.scene.cameras), -1)
    np.testing.assert_allclose(cov.std.intrinsics[:, known], params, rtol)
