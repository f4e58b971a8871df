"""Peers that can adjust 3x4 cameras when told how: Ceres by pyceres, and SciPy."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import epigauge as eg
import numpy as np
from epigauge import kernels

#: Most observations that a cost function in Python is given: one takes 10 us an evaluation.
MOST = 1000

#: Ceres 2.1 and 2.2 with an analytic projective cost written in C++, best of both: milliseconds an
#: iteration, iterations, peak memory in MB; one core of an AMD EPYC with dgemm at 53 GFLOP/s.
RECORDED = {
    "paper": (0.49, 5, 30),
    "sparse": (75.7, 4, 50),
    "bal49": (44.1, 8, 40),
    "bal16": (121.0, 5, 83),
    "banded": (995.0, 9, 424),
}
RECORDED_GFLOPS = 53.0


def by_pyceres(tracks: eg.Tracks, start: eg.Reconstruction) -> tuple[float, int, float]:
    """Return seconds, iterations and final cost of Ceres with a cost function in Python."""
    import pyceres

    project = kernels.table().project

    class Reprojection(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self, xy: np.ndarray) -> None:
            super().__init__()
            self.xy = xy
            self.set_num_residuals(2)
            self.set_parameter_block_sizes([12, 4])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            P, Q = parameters
            q_hat, J_P, J_Q, _ = project(P.reshape(3, 4), Q)
            residuals[:] = q_hat - self.xy
            if jacobians is not None:
                for jacobian, values in zip(jacobians, (J_P, J_Q), strict=True):
                    if jacobian is not None:
                        jacobian[:] = values.ravel()
            return True

    P, Q = start.P.reshape(-1, 12).copy(), start.Q.copy()
    problem = pyceres.Problem()
    costs = [Reprojection(xy) for xy in tracks.xy]
    for cost, i, j in zip(costs, tracks.view, tracks.point, strict=True):
        problem.add_residual_block(cost, None, [P[i], Q[j]])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.num_threads, options.max_num_iterations = 1, 100
    options.function_tolerance = 1e-8
    summary = pyceres.SolverSummary()
    begun = time.perf_counter()
    pyceres.solve(options, problem, summary)
    seconds = time.perf_counter() - begun
    steps = summary.num_successful_steps + summary.num_unsuccessful_steps
    return seconds, int(steps), float(summary.final_cost)


def by_scipy(tracks: eg.Tracks, start: eg.Reconstruction) -> tuple[float, int, float]:
    """Return seconds, evaluations and final cost of SciPy, analytic sparse Jacobian, lsmr."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix

    table = kernels.table()
    n, m, count = tracks.n_views, tracks.n_points, len(tracks)
    at_camera = 12 * tracks.view[:, None] + np.arange(12)
    at_point = 12 * n + 4 * tracks.point[:, None] + np.arange(4)
    columns = np.repeat(np.hstack([at_camera, at_point])[:, None], 2, axis=1)

    def projected(x: np.ndarray) -> Any:
        P, Q = x[: 12 * n].reshape(n, 3, 4), x[12 * n :].reshape(m, 4)
        return table.project(
            np.ascontiguousarray(P.transpose(1, 2, 0)[:, :, tracks.view]),
            np.ascontiguousarray(Q.T[:, tracks.point]),
        )

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.asarray((projected(x)[0].T - tracks.xy).ravel())

    def jacobian(x: np.ndarray) -> Any:
        _, J_P, J_Q, _ = projected(x)
        values = np.concatenate([J_P, J_Q], axis=1).transpose(2, 0, 1)
        rows = np.arange(0, values.size + 1, 16)
        return csr_matrix((values.ravel(), columns.ravel(), rows), (2 * count, 12 * n + 4 * m))

    x0 = np.concatenate([start.P.ravel(), start.Q.ravel()])
    begun = time.perf_counter()
    found = least_squares(residuals, x0, jacobian, x_scale="jac", ftol=1e-8, xtol=1e-15, gtol=1e-15)
    return time.perf_counter() - begun, int(found.nfev), float(found.cost)


#: Packages by the name to import, and what runs them.
PEERS: dict[str, tuple[str, Callable[..., tuple[float, int, float]]]] = {
    "Ceres (pyceres, cost in Python)": ("pyceres", by_pyceres),
    "SciPy least_squares": ("scipy", by_scipy),
}
