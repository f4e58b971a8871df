"""Maximum-likelihood refinement of a fundamental matrix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels, lm
from epigauge._arguments import (
    as_choice,
    as_fundamental,
    as_matches,
    as_positive,
    as_weights,
)
from epigauge.errors import ArgumentError
from epigauge.linear import Levenberg, Seber
from epigauge.two_view.conditioning import Conditioning, condition, displaced
from epigauge.two_view.covariance import fundamental_covariance
from epigauge.two_view.eliminated import EliminatedProblem, foot_points
from epigauge.two_view.geometry import canonical_cameras
from epigauge.two_view.initial import fundamental_8point
from epigauge.two_view.joint import JointProblem, intersect
from epigauge.two_view.parameterizations import PARAMETERIZATIONS, Ortho, factorize
from epigauge.two_view.result import FundamentalResult

__all__ = ["refine_fundamental"]

Array = NDArray[np.float64]

_DAMPINGS: dict[str, type[Levenberg] | type[Seber]] = {"levenberg": Levenberg, "seber": Seber}
_STRUCTURES = ("eliminated", "joint")
_HESSIANS = ("exact", "gauss-newton")
_CRITERIA = ("reprojection",)


def refine_fundamental(
    x1: ArrayLike,
    x2: ArrayLike,
    F0: ArrayLike | None = None,
    *,
    parameterization: str = "ortho",
    criterion: str = "reprojection",
    structure: str = "eliminated",
    damping: str = "levenberg",
    hessian: str = "exact",
    noise_px: float | None = 1.0,
    weights: ArrayLike | None = None,
    ftol: float = 1e-10,
    xtol: float = 1e-12,
    gtol: float = 1e-14,
    max_iter: int = 100,
    backend: str | None = None,
    callback: Callable[[lm.Row], object] | None = None,
) -> FundamentalResult:
    """Find the fundamental matrix that minimises the reprojection error of point matches.

    This is two-view projective bundle adjustment, the maximum-likelihood estimate for Gaussian
    noise of equal size on all coordinates.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least eight matches in pixels without gross errors; also (m, 1, 2), any real type.
    F0 : array_like, shape (3, 3), optional
        Start value with ``x2^T F0 x1 = 0``, of any scale; by default `fundamental_8point`.
    parameterization : {"ortho"}
        How F is represented: "ortho" is the 7-parameter orthonormal representation of B&S.
    criterion : {"reprojection"}
        What is minimised: the exact reprojection error.
    structure : {"eliminated", "joint"}
        "eliminated" optimises over F alone, each match being at its exact foot point; "joint"
        optimises F and one point a match (B&S Table 1).
    damping : {"levenberg", "seber"}
        lambda I, or lambda diag(J^T J).
    hessian : {"exact", "gauss-newton"}
        Second derivatives for the eliminated structure; "joint" always uses Gauss-Newton.
    noise_px : float or None
        Standard deviation of a coordinate in pixels, which scales the covariance only; None
        estimates it from the residuals, as sqrt(2 cost / (m - 7)).
    weights : array_like, shape (m,), optional
        Factor of each match's squared distance.
    ftol, xtol, gtol : float
        Stop when the cost decreases by less than `ftol` times itself or is known to, when a step
        is shorter than `xtol`, when no entry of the gradient exceeds `gtol` (the last two in
        conditioned coordinates); the inequalities are those of `epigauge.lm.minimize`.
    max_iter : int
        Trial steps allowed.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formulas are computed; by default `epigauge.backend()`.
    callback : callable, optional
        Called with each row of the history; a true return value stops (status -2).

    Returns
    -------
    FundamentalResult
        F, its factors, cameras, points and covariance, and how it was found.

    Raises
    ------
    ArgumentError
        On bad shapes or values, fewer than eight matches, NaN or infinity, points all equal or on
        one line, and unknown names of options.
    BackendError
        If the backend cannot be used.

    Notes
    -----
    Coordinates are conditioned inside: centred, scaled by one factor for both images, which leaves
    the minimum where it is, and the second origin moved off the centroid, which keeps sigma away
    from 1 (B&S section 3.2).

    References
    ----------
    .. [BS04] A. Bartoli, P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal
       parameters", PAMI 26(3), 2004.
    """
    x1, x2 = as_matches(x1, x2, general_position=True)
    as_choice("criterion", criterion, _CRITERIA)
    as_choice("structure", structure, _STRUCTURES)
    as_choice("hessian", hessian, _HESSIANS)
    as_choice("parameterization", parameterization, PARAMETERIZATIONS)
    as_choice("damping", damping, _DAMPINGS)
    if noise_px is not None:
        noise_px = as_positive("noise_px", noise_px)
    stopping = lm.Stopping(ftol=ftol, xtol=xtol, gtol=gtol, max_iter=max_iter)
    w = np.ones(len(x1)) if weights is None else as_weights(weights, len(x1))
    start = as_fundamental(_start(x1, x2, w) if F0 is None else F0)
    setup = _Setup.of(x1, x2, w, start, kernels.table(backend))
    chart = PARAMETERIZATIONS[parameterization](setup.table)
    problem: JointProblem | EliminatedProblem
    if structure == "joint":
        problem = JointProblem(setup.table, chart, setup.q1, setup.q2, w)
    else:
        exact = hessian == "exact"
        problem = EliminatedProblem(setup.table, chart, setup.q1, setup.q2, w, exact)
    outcome: lm.Outcome[Any] = lm.minimize(
        problem,
        problem.start(setup.frame.from_pixels(start)),
        _DAMPINGS[damping](),
        lm.Classic(),
        stopping,
        callback,
        setup.frame.scale**2,
    )
    return _result(outcome, chart, setup, noise_px)


@dataclass(frozen=True)
class _Setup:
    """The matches in the coordinates that are computed in."""

    table: kernels.Table
    frame: Conditioning
    q1: Array
    q2: Array
    weights: Array

    @staticmethod
    def of(x1: Array, x2: Array, weights: Array, F: Array, table: kernels.Table) -> _Setup:
        frame = condition(x1, x2)
        frame = displaced(frame, frame.from_pixels(F))
        return _Setup(table, frame, *frame.forward(x1, x2), weights)


def _start(x1: Array, x2: Array, weights: Array) -> Array:
    """Return the 8-point estimate of the matches that count."""
    counts = weights > 0.0
    if np.count_nonzero(counts) < 8:
        raise ArgumentError("weights", "leave fewer than 8 matches", "8 positive ones, or F0")
    return fundamental_8point(x1[counts], x2[counts])


def _result(
    outcome: lm.Outcome[Any], chart: Ortho, setup: _Setup, noise_px: float | None
) -> FundamentalResult:
    """Bring the outcome back to pixels and add what follows from it."""
    motion, frame, weights = outcome.state.motion, setup.frame, setup.weights
    F_inside = chart.fundamental(motion)
    norm = float(np.linalg.norm(F_inside))
    feet = foot_points(setup.table, F_inside, setup.q1, setup.q2)
    matches = (setup.q1, setup.q2, feet.multiplier)
    q1_hat, q2_hat, derivative = setup.table.foot_point_derivative(*feet.frame, *matches)
    x1_hat, x2_hat = frame.backward(q1_hat, q2_hat)
    F = frame.to_pixels(F_inside)
    P1, P2 = canonical_cameras(F)
    abc = intersect(P2, np.ascontiguousarray(x1_hat.T), np.ascontiguousarray(x2_hat.T))
    cost = outcome.state.cost * frame.scale**2
    count = len(weights)
    if noise_px is None:
        noise_px = float(np.sqrt(2.0 * cost / max(count - 7, 1)))
    # Derivatives are by F of the norm it has inside; those by the unit-norm F are `norm` times as
    # large.
    by_entries = norm * derivative
    uncertainty = fundamental_covariance(
        F_inside / norm,
        (by_entries * weights) @ by_entries.T,
        (noise_px / frame.scale) ** 2,
        frame.entry_map(),
    )
    jac = frame.scale * derivative.T @ chart.derivatives(motion)[0]
    fun = frame.scale * feet.d
    grad = jac.T @ (weights * fun)
    factors = factorize(F)
    return FundamentalResult(
        F=F,
        U=factors.U,
        V=factors.V,
        sigma=float(factors.sigma),
        P1=P1,
        P2=P2,
        points=np.stack([abc[0], abc[1], np.ones(count), abc[2]], axis=1),
        covariance=uncertainty.covariance,
        rank=uncertainty.rank,
        condition=uncertainty.condition,
        noise_px=noise_px,
        rms_px=float(np.sqrt(np.sum(fun**2) / (4 * count))),
        x=F.ravel(),
        cost=cost,
        fun=fun,
        jac=jac,
        grad=grad,
        optimality=float(np.max(np.abs(grad))),
        nfev=outcome.nfev,
        njev=outcome.njev,
        nit=outcome.nit,
        status=outcome.status,
        message=lm.STATUS[outcome.status],
        success=outcome.status > 0,
        history=outcome.history,
    )
