"""Two-view estimates by epigauge and by its peers, all from the same start.

Each function here takes a `Pair` and returns what to call: no argument, F and the number of trial
steps come back. Peers run with their default tolerances. Where a peer has no function for the job,
the criterion is written in NumPy with analytic derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Found = tuple[Array, int | None]
Method = Callable[[], Found]


@dataclass(frozen=True)
class Pair:
    """Matches and the start of every method."""

    x1: Array
    x2: Array
    F0: Array

    @cached_property
    def sampson(self) -> Sampson:
        return Sampson(self)


def _rotation(angles: Array) -> tuple[Array, list[Array]]:
    """Return Rx Ry Rz and its derivatives by the three angles."""
    turns, slopes = [], []
    for axis, angle in enumerate(angles):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn, slope = np.eye(3), np.zeros((3, 3))
        turn[i, i] = turn[j, j] = slope[j, i] = np.cos(angle)
        turn[j, i] = np.sin(angle)
        turn[i, j] = slope[i, i] = slope[j, j] = -np.sin(angle)
        slope[i, j] = -slope[j, i]
        turns.append(turn)
        slopes.append(slope)
    x, y, z = turns
    dx, dy, dz = slopes
    return x @ y @ z, [dx @ y @ z, x @ dy @ z, x @ y @ dz]


class Sampson:
    """The Sampson distances over seven parameters: U R(p[:3]), V R(p[3:6]), sigma p[6].

    In coordinates of unit size, which is what makes seven parameters well scaled.
    """

    def __init__(self, pair: Pair) -> None:
        self.scale = float(np.std(pair.x1))
        self.T1, self.T2 = (
            np.array([[1, 0, -x.mean(0)[0]], [0, 1, -x.mean(0)[1]], [0, 0, self.scale]])
            for x in (pair.x1, pair.x2)
        )
        self.h1, self.h2 = (
            np.column_stack([(x - x.mean(0)) / self.scale, np.ones(len(x))])
            for x in (pair.x1, pair.x2)
        )
        F = np.linalg.inv(self.T2).T @ pair.F0 @ np.linalg.inv(self.T1)
        self.U, values, Vt = np.linalg.svd(F)
        self.V = Vt.T
        self.start = np.array([0, 0, 0, 0, 0, 0, values[1] / values[0]])

    def fundamental(self, p: Array) -> tuple[Array, Array]:
        """Return F and its derivatives, shape (7, 3, 3)."""
        (R, dR), (S, dS) = _rotation(p[:3]), _rotation(p[3:6])
        U, V, D = self.U @ R, self.V @ S, np.diag([1.0, p[6], 0.0])
        by_angles = [self.U @ d @ D @ V.T for d in dR] + [U @ D @ (self.V @ d).T for d in dS]
        return U @ D @ V.T, np.array([*by_angles, np.outer(U[:, 1], V[:, 1])])

    def in_pixels(self, p: Array) -> Array:
        return np.asarray(self.T2.T @ self.fundamental(p)[0] @ self.T1)

    def residuals(self, p: Array) -> Array:
        F, _ = self.fundamental(p)
        line2, line1 = self.h1 @ F.T, self.h2 @ F
        C = np.einsum("mi,mi->m", self.h2, line2)
        return C / np.sqrt((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1))

    def jacobian(self, p: Array) -> Array:
        F, dF = self.fundamental(p)
        line2, line1 = self.h1 @ F.T, self.h2 @ F
        C = np.einsum("mi,mi->m", self.h2, line2)
        length = np.sqrt((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1))
        J = np.empty((len(C), 7))
        for k, d in enumerate(dF):
            d2, d1 = self.h1 @ d[:2].T, self.h2 @ d[:, :2]
            dC = np.einsum("mi,ij,mj->m", self.h2, d, self.h1, optimize=True)
            slope = (line2[:, :2] * d2).sum(1) + (line1[:, :2] * d1).sum(1)
            J[:, k] = dC / length - C * slope / length**3
        return J


def epigauge(pair: Pair) -> Method:
    def run() -> Found:
        result = eg.refine_fundamental(pair.x1, pair.x2, pair.F0)
        return result.F, result.nit

    return run


def epigauge_gauss_newton(pair: Pair) -> Method:
    def run() -> Found:
        result = eg.refine_fundamental(pair.x1, pair.x2, pair.F0, hessian="gauss-newton")
        return result.F, result.nit

    return run


def epigauge_alone(pair: Pair) -> Method:
    def run() -> Found:
        result = eg.refine_fundamental(pair.x1, pair.x2)
        return result.F, result.nit

    return run


def _poselib(options: dict[str, object]) -> Callable[[Pair], Method]:
    def method(pair: Pair) -> Method:
        import poselib

        def run() -> Found:
            F, info = poselib.refine_fundamental(pair.x1, pair.x2, pair.F0, options)
            return F, info["iterations"]

        return run

    return method


def _pycolmap(trials: int | None) -> Callable[[Pair], Method]:
    def method(pair: Pair) -> Method:
        import pycolmap

        options = pycolmap.RANSACOptions()
        if trials is not None:
            options.min_num_trials = options.max_num_trials = trials
        estimate = pycolmap.estimate_fundamental_matrix
        return lambda: (estimate(pair.x1, pair.x2, options)["F"], None)

    return method


def opencv(pair: Pair) -> Method:
    import cv2

    cv2.setNumThreads(1)
    return lambda: (cv2.findFundamentalMat(pair.x1, pair.x2, cv2.FM_8POINT)[0], None)


def scipy(pair: Pair) -> Method:
    from scipy.optimize import least_squares

    problem = pair.sampson

    def run() -> Found:
        found = least_squares(problem.residuals, problem.start, problem.jacobian, method="lm")
        return problem.in_pixels(found.x), found.nfev - 1

    return run


def scipy_bundle(pair: Pair) -> Method:
    """Return bundle adjustment over the second camera [A | e] and Q = (a, b, 1, c) for each."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_array

    problem = pair.sampson
    h1, h2, m = problem.h1, problem.h2, len(pair.x1)
    F, _ = problem.fundamental(problem.start)
    e = problem.U[:, 2]
    A = np.cross(e, F.T).T
    across, along = np.cross(h2, h1 @ A.T), np.cross(h2, e)
    c = -(across * along).sum(1) / (along**2).sum(1)
    start = np.concatenate([np.column_stack([A, e]).ravel(), h1[:, 0], h1[:, 1], c])
    rows, columns = np.arange(2 * m), np.arange(m)
    own = 12 + np.stack([columns, m + columns, 2 * m + columns])
    # Rows: x and y of the first image, then of the second.
    row_index = np.concatenate(
        [rows, np.repeat(2 * m + columns, 11), np.repeat(3 * m + columns, 11)]
    )
    cameras = [np.tile(np.r_[4 * i : 4 * i + 4, 8:12], (m, 1)) for i in (0, 1)]
    column_index = np.concatenate(
        [12 + rows, *(np.column_stack([camera, own.T]).ravel() for camera in cameras)]
    )

    def project(p: Array) -> tuple[Array, Array, Array]:
        P, (a, b, c) = p[:12].reshape(3, 4), p[12:].reshape(3, m)
        Q = np.stack([a, b, np.ones(m), c])
        return P, Q, P @ Q

    def residuals(p: Array) -> Array:
        _, Q, q = project(p)
        return np.concatenate([*(Q[:2] - h1.T[:2]), *(q[:2] / q[2] - h2.T[:2])])

    def jacobian(p: Array) -> csr_array:
        P, Q, q = project(p)
        values = [np.ones(2 * m)]
        for i in (0, 1):
            ratio = q[i] / q[2]
            by_P = np.concatenate([Q / q[2], -ratio * Q / q[2]])
            by_Q = (P[i, [0, 1, 3], None] - ratio * P[2, [0, 1, 3], None]) / q[2]
            values.append(np.concatenate([by_P, by_Q]).T.ravel())
        entries = (np.concatenate(values), (row_index, column_index))
        return csr_array(entries, shape=(4 * m, 12 + 3 * m))

    def run() -> Found:
        found = least_squares(residuals, start, jacobian, x_scale="jac", tr_solver="lsmr")
        P = found.x[:12].reshape(3, 4)
        F = np.cross(P[:, 3], P[:, :3].T).T
        return problem.T2.T @ F @ problem.T1, found.nfev - 1

    return run


def gtsam(pair: Pair) -> Method:
    import gtsam

    problem = pair.sampson

    def error(_factor: object, values: gtsam.Values, H: list[Array] | None) -> Array:
        p = values.atVector(0)
        if H is not None:
            H[0] = problem.jacobian(p)
        return problem.residuals(p)

    noise = gtsam.noiseModel.Unit.Create(len(pair.x1))

    def run() -> Found:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.CustomFactor(noise, [0], error))
        values.insert(0, problem.start)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
        p = optimizer.optimize().atVector(0)
        return problem.in_pixels(p), optimizer.iterations()

    return run


def pyceres(pair: Pair) -> Method:
    import pyceres

    problem = pair.sampson

    class Cost(pyceres.CostFunction):
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(len(pair.x1))
            self.set_parameter_block_sizes([7])

        def Evaluate(
            self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None
        ) -> bool:
            residuals[:] = problem.residuals(parameters[0])
            if jacobians is not None:
                jacobians[0][:] = problem.jacobian(parameters[0]).ravel()
            return True

    def run() -> Found:
        p, own = problem.start.copy(), pyceres.Problem()
        own.add_residual_block(Cost(), None, [p])
        options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
        options.num_threads = 1
        options.logging_type = pyceres.LoggingType.SILENT
        pyceres.solve(options, own, summary)
        steps = summary.num_successful_steps + summary.num_unsuccessful_steps
        return problem.in_pixels(p), steps

    return run


TRIVIAL = {"loss_type": "TRIVIAL"}
#: Row: module it needs, its distribution, method, most matches that it is run on. All but epigauge
#: itself are left out where they are not installed.
METHODS: dict[str, tuple[str, str, Callable[[Pair], Method], float]] = {
    "epigauge": ("epigauge", "epigauge", epigauge, np.inf),
    "epigauge, 8-point start included": ("epigauge", "epigauge", epigauge_alone, np.inf),
    "epigauge, Gauss-Newton": ("epigauge", "epigauge", epigauge_gauss_newton, np.inf),
    "PoseLib, no robust loss": ("poselib", "poselib", _poselib(TRIVIAL), np.inf),
    "PoseLib, no robust loss, step_tol 1e-4": (
        *("poselib", "poselib"),
        _poselib({**TRIVIAL, "step_tol": 1e-4}),
        np.inf,
    ),
    "PoseLib, all options default": ("poselib", "poselib", _poselib({}), np.inf),
    "pycolmap, LO-RANSAC": ("pycolmap", "pycolmap", _pycolmap(None), 1e4),
    "pycolmap, LO-RANSAC, one trial": ("pycolmap", "pycolmap", _pycolmap(1), np.inf),
    "OpenCV, FM_8POINT": ("cv2", "opencv-python-headless", opencv, np.inf),
    "SciPy, Sampson": ("scipy", "scipy", scipy, np.inf),
    "SciPy, bundle adjustment": ("scipy", "scipy", scipy_bundle, 1e4),
    "GTSAM, Sampson in one Python factor": ("gtsam", "gtsam", gtsam, np.inf),
    "pyceres, Sampson in one Python block": ("pyceres", "pyceres", pyceres, np.inf),
}
