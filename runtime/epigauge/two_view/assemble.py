"""The result of a refinement: back to pixels, with everything that follows from F."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.two_view.bias import bias_corrected
from epigauge.two_view.covariance import (
    fundamental_covariance,
    influence,
    residual_noise,
    restricted_basis,
    tangent_basis,
)
from epigauge.two_view.joint import intersect
from epigauge.two_view.minima import Search
from epigauge.two_view.parameterizations import (
    OrthonormalF,
    factorize,
)
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.solve import Matches, Options, Solution

__all__ = ["assembled"]

Array = NDArray[np.float64]


def assembled(
    found: Search, options: Options, matches: Matches, noise_px: float | None
) -> FundamentalResult:
    """Bring the solution back to pixels and add what follows from it."""
    solution, frame, weights = found.solution, matches.frame, matches.weights
    if options.bias_correction:
        noise = found.evidence.noise_of_weight_one if noise_px is None else noise_px / frame.scale
        solution = _corrected(solution, matches, noise)
    outcome, chart = solution.outcome, solution.chart
    reprojection = matches.reprojection()
    feet = reprojection.evaluate(solution.F)
    q1_hat, q2_hat, feet_by_entries = reprojection.corrected(feet)
    squared = feet.squared
    if matches.covariances is not None:
        squared = np.sum((q1_hat - matches.q1) ** 2 + (q2_hat - matches.q2) ** 2, axis=0)
    x1_hat, x2_hat = frame.backward(q1_hat, q2_hat)
    F = frame.to_pixels(solution.F)
    factors = factorize(F)
    if options.fix:
        factors = _with_frozen(factors, solution, options)
        F = (factors.U[:, :2] * [1.0, factors.sigma]) @ factors.V[:, :2].T
        F = F / np.linalg.norm(F)
    P2 = np.asarray(matches.table.canonical_camera(*factors))
    abc = intersect(P2, np.ascontiguousarray(x1_hat.T), np.ascontiguousarray(x2_hat.T))
    points = np.stack([abc[0], abc[1], np.ones(abc.shape[1]), abc[2]], axis=1)
    criterion = matches.criterion(options.criterion)
    distances = criterion.evaluate(solution.F)
    loss = options.scaled_loss(solution.loss_scale_px / frame.scale)
    rho, slope, _ = loss(distances.squared)
    cost = outcome.state.cost
    if options.bias_correction:
        cost = 0.5 * float(np.sum(weights * rho))
    weight = weights * slope
    derivatives = chart.derivatives(solution.motion)[0]
    residual = residual_noise(distances.signed, weights, loss, chart.dimension)
    if noise_px is None:
        own = found.evidence.noise_of_weight_one
        noise = own if matches.covariances is None else residual
        redundant = int(np.count_nonzero(weights > 0.0)) > chart.dimension
        noise_px = noise * frame.scale if redundant else float("inf")
    a, b = influence(distances.signed, weights, loss, chart.dimension, residual)
    # Derivatives are by F of the norm it has inside; those by F of unit norm are so much larger.
    norm = float(np.linalg.norm(solution.F))
    unit = solution.F / norm
    restricted = chart.dimension < 7
    known_noise = noise_px / frame.scale if np.isfinite(noise_px) else 1.0
    uncertainty = fundamental_covariance(
        unit,
        norm**2 * (feet_by_entries * a) @ feet_by_entries.T,
        norm**2 * known_noise**2 * (feet_by_entries * b) @ feet_by_entries.T,
        frame.maps_from_pixels(),
        restricted_basis(unit, derivatives) if restricted else tangent_basis(unit),
    )
    if not np.isfinite(noise_px):
        uncertainty = uncertainty.of_unknown_noise()
    jac = frame.scale * criterion.derivative(solution.F, distances) @ derivatives
    fun = frame.scale * distances.signed
    grad = jac.T @ (weight * fun)
    motion, E = found.motion, _essential(F, options.calibration)
    known = dict(  # noqa: C408
        F=F,
        U=factors.U,
        V=factors.V,
        sigma=float(factors.sigma),
        P1=np.eye(3, 4),
        P2=P2,
        points=points / np.linalg.norm(points, axis=1, keepdims=True),
        covariance=uncertainty.of_fundamental(),
        rank=uncertainty.rank,
        condition=uncertainty.condition,
        noise_px=noise_px,
        rms_px=float(frame.scale * np.sqrt(np.mean(squared[weights > 0.0]) / 4.0)),
        loss_scale_px=solution.loss_scale_px,
        x=F.ravel(),
        cost=cost * frame.scale**2,
        fun=fun,
        jac=jac,
        grad=grad,
        optimality=float(np.max(np.abs(grad))),
        nfev=outcome.nfev,
        njev=outcome.njev,
        nit=outcome.nit,
        status=outcome.status,
        message=lm.STATUS[outcome.status],
        history=outcome.history,
        minima=found.minima,
        ambiguous=found.ambiguous,
        E=E,
        R=None if motion is None else motion.R,
        t=None if motion is None else motion.t,
        in_front=None if motion is None else len(found.evidence.squared) - found.evidence.n_behind,
        _uncertainty=uncertainty,
        _evidence=found.evidence,
    )
    return FundamentalResult.partial(known, partial(_judged, known))


def _judged(known: dict[str, Any]) -> SimpleNamespace:
    """Return flags and success of a result of which all else is known."""
    return FundamentalResult.partial(known, SimpleNamespace).judged(known["_evidence"])


def _corrected(solution: Solution, matches: Matches, noise: float) -> Solution:
    """Return the solution moved by its estimated bias."""
    reprojection = matches.reprojection()
    feet = reprojection.evaluate(solution.F)
    F = bias_corrected(reprojection, solution.F, feet, matches.weights, noise**2)
    motion = solution.chart.start(F)
    return replace(solution, F=solution.chart.fundamental(motion), motion=motion)


def _with_frozen(factors: OrthonormalF, solution: Solution, options: Options) -> OrthonormalF:
    """Return the factors in pixels with the frozen parts exactly as they were, not as rounded."""
    if "epipolar_transformation" in options.fix:
        return OrthonormalF(*solution.motion)
    assert options.anchor is not None
    U, V = factors.U.copy(), factors.V.copy()
    start = factorize(options.anchor)
    if "epipole1" in options.fix:
        V[:, 2] = start.V[:, 2]
    if "epipole2" in options.fix:
        U[:, 2] = start.U[:, 2]
    return OrthonormalF(U, V, factors.sigma)


def _essential(F: Array, calibration: tuple[Array, Array] | None) -> Array | None:
    """Return E of unit norm, None where the cameras are not calibrated."""
    if calibration is None:
        return None
    K1, K2 = calibration
    E = K2.T @ F @ K1
    return np.asarray(E / np.linalg.norm(E))
