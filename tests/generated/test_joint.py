"""Factors of the equations with points eliminated, against Jacobians multiplied out."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from epigauge import kernels
from laws import distance

K = kernels.table("c" if kernels.available()["c"] is None else "numpy")
PROBLEMS = ("canonic", "free", "normalized")
#: plain, relative, floor, bind; the floor is above some diagonal entries and below others.
DAMPINGS = {"levenberg": (0.3, 0.0, 0.0, 0.0), "seber": (0.0, 0.2, 1.0, 0.0)}
CASES = [*itertools.product(PROBLEMS, DAMPINGS)]
COUNT = 9


class Dense:
    """One point's residual and Jacobians by kernels whose derivatives are checked."""

    def __init__(self, problem: str, damping: str) -> None:
        rng = np.random.default_rng(3)
        self.canonic = problem == "canonic"
        self.plain, self.relative, self.floor, _ = DAMPINGS[damping]
        self.bind = 0.4 if problem == "normalized" else 0.0
        self.damping = np.array([self.plain, self.relative, self.floor, self.bind])
        self.cameras = rng.standard_normal((3 if self.canonic else 6, 4))
        self.points = rng.standard_normal((3 if self.canonic else 4, COUNT))
        self.q, self.weight = rng.standard_normal((4, COUNT)), rng.uniform(0.5, 2.0, COUNT)
        self.weight[3] = 0.0
        self.known = (self.cameras, self.points, self.q)
        self.rows = {"canonic": 3, "free": 6, "normalized": 10}[problem]
        self.move = rng.standard_normal((3 if self.canonic else 10, 4))
        if problem == "free":
            self.move[6:] = 0.0

    def jacobians(self, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return r (4,), J by the cameras (4, 12 v) and J by the point (4, k)."""
        if self.canonic:
            q1, q2 = self.q[:2, j], self.q[2:, j]
            r, J_S, J_P2 = K.two_view_structure(self.cameras, self.points[:, j], q1, q2)
            return r, np.vstack([np.zeros((2, 12)), J_P2]), J_S
        views = [K.project(P, self.points[:, j]) for P in (self.cameras[:3], self.cameras[3:])]
        J_P, J_Q = np.zeros((4, 24)), np.vstack([view[2] for view in views])
        J_P[:2, :12], J_P[2:, 12:] = views[0][1], views[1][1]
        return self.q[:, j] - np.concatenate([view[0] for view in views]), -J_P, -J_Q

    def blocks(self, j: int) -> tuple[np.ndarray, ...]:
        """Return U, W, V with its damping, gradient by cameras (and multipliers) and by point."""
        r, J_P, J_S = self.jacobians(j)
        w, Q = self.weight[j], self.homogeneous(j)
        V = w * J_S.T @ J_S + (self.bind * np.outer(Q, Q) if self.bind else 0.0)
        scale = np.maximum(np.diag(V), self.floor)
        V = V + np.diag(self.plain + self.relative * scale)
        U, W, g = w * J_P.T @ J_P, w * J_P.T @ J_S, w * J_P.T @ r
        if self.rows == 10:
            W = np.vstack([W, np.kron(np.eye(4), Q[:, None])])
            U = np.pad(U, (0, 16))
            g = np.append(g, np.zeros(16))
        return U, W, V, g, w * J_S.T @ r

    def homogeneous(self, j: int) -> np.ndarray:
        """Return the point."""
        return np.insert(self.points[:, j], 2, 1.0) if self.canonic else self.points[:, j]

    def multiplied(self, left: np.ndarray, right: np.ndarray, j: int, rows: int):
        """Return L x Q Q^T and e x Q of a point."""
        L, size = np.zeros((rows, rows)), rows * (rows + 1) // 2
        L[np.triu_indices(rows)] = left[:size, j]
        moments = np.zeros((4, 4))
        moments[np.triu_indices(4)] = right[:10, j]
        L, moments = (M + np.triu(M, 1).T for M in (L, moments))
        return np.kron(L, moments), np.kron(left[size:, j], right[10:, j])


@pytest.mark.parametrize("problem", ["canonic", "free"])
def test_normal_equations_of_a_point(problem):
    dense = Dense(problem, "levenberg")
    squared = getattr(K, f"{problem}_squared")(*dense.known)
    gradient, diagonal, left, right = getattr(K, f"{problem}_normal")(*dense.known, dense.weight)
    for j in range(COUNT):
        U, _, V, g, g_point = dense.blocks(j)
        assert distance(squared[j], np.sum(dense.jacobians(j)[0] ** 2)) <= 1e-13
        assert distance(gradient[:, j], g_point) <= 1e-13
        assert distance(diagonal[:, j] + dense.plain, np.diag(V)) <= 1e-13
        for view in range(dense.rows // 3):
            own = slice(12 * view, 12 * view + 12)
            six, three = slice(6 * view, 6 * view + 6), slice(-3 * (dense.rows // 3 - view), None)
            factors = np.concatenate([left[six], left[three][:3]])
            matrix, vector = dense.multiplied(factors, right, j, 3)
            assert distance(matrix, U[own, own]) <= 1e-13
            assert distance(vector, g[own]) <= 1e-13


@pytest.mark.parametrize(("problem", "damping"), CASES)
def test_reduced_equations_are_the_schur_complement(problem, damping):
    dense = Dense(problem, damping)
    name = f"{problem}_reduced"
    left, right = getattr(K, name)(*dense.known, dense.weight, dense.damping)
    for j in range(COUNT):
        U, W, V, g, g_point = dense.blocks(j)
        matrix, vector = dense.multiplied(left, right, j, dense.rows)
        # Blocks of a condition of a few thousand.
        assert distance(matrix, U - W @ np.linalg.solve(V, W.T)) <= 1e-11
        assert distance(vector, g - W @ np.linalg.solve(V, g_point)) <= 1e-11


@pytest.mark.parametrize(("problem", "damping"), CASES)
def test_step_and_curvature_of_a_point(problem, damping):
    dense = Dense(problem, damping)
    kind = "canonic" if problem == "canonic" else "free"
    step = getattr(K, f"{kind}_step")(*dense.known, dense.weight, dense.damping, dense.move)
    total = 0.0
    for j in range(COUNT):
        _, W, V, _, g_point = dense.blocks(j)
        move = dense.move.ravel()[: len(W)]
        assert distance(step[:, j], -np.linalg.solve(V, g_point + W.T @ move)) <= 1e-11
        _, J_P, J_S = dense.jacobians(j)
        change = J_P @ move[: J_P.shape[1]] + J_S @ step[:, j]
        total += dense.weight[j] * change @ change
    arguments = (dense.cameras, dense.points, dense.weight, dense.move, step)
    assert distance(getattr(K, f"{kind}_change")(*arguments), total) <= 1e-12
