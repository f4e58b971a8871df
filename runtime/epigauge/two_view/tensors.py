"""Many pairs at once over any array namespace: the exact Newton loop, differentiable at its end.

What `epigauge.two_view.solve` does for one pair is done here for all of them together, in the
library and on the device of the arrays that are given. Pairs are padded to the size of the largest
with matches of weight zero. Everything up to the minimum works on values; one more Newton step
there, with the gradient as a function of the matches, carries their derivatives to F (implicit
function theorem).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import arrays, lm
from epigauge._arguments import as_weights, check_general_position
from epigauge.errors import ArgumentError
from epigauge.linear import BENT, LAM_FLOOR, LIFT, Levenberg
from epigauge.two_view.conditioning import OFFSET, RMS
from epigauge.two_view.copies import counted_once
from epigauge.two_view.criteria import settled

__all__ = ["REFUSED", "Minimum", "like", "refine_pairs", "refined"]

Tensor = Any
Indices = NDArray[np.intp]

#: Status of a pair that could not be refined, beside those of `epigauge.lm.STATUS`.
REFUSED = -9

#: Where the upper triangle of a symmetric 9x9 matrix stands in its packed form.
_PLACES: Indices = np.zeros((9, 9), np.intp)
_PLACES[np.triu_indices(9)] = np.arange(45)
_PLACES = np.maximum(_PLACES, _PLACES.T)


@dataclass(frozen=True)
class Minimum:
    """What the loop ends at; a row a pair, tensors but for the counts.

    Attributes
    ----------
    F, sigma, cost, rms_px : tensor, shape (n, 3, 3) and (n,)
        In pixels.
    distances : tensor, shape (n, m)
        Signed, in pixels; of padding, anything.
    nfev, status : ndarray of int, shape (n,)
        Evaluations, and the reason of stopping as in `epigauge.lm.STATUS`.
    """

    F: Tensor
    sigma: Tensor
    cost: Tensor
    rms_px: Tensor
    distances: Tensor
    nfev: NDArray[np.intp]
    status: NDArray[np.intp]


def like(array: Tensor) -> Callable[[Any], Tensor]:
    """Return what turns NumPy arrays into arrays of the kind, type and place of `array`."""
    xp = arrays.namespace(array)
    return lambda values: xp.asarray(values, dtype=array.dtype, device=arrays.device(array))


def refined(
    x1: Tensor,
    x2: Tensor,
    values: tuple[NDArray[np.float64], NDArray[np.float64]],
    bounds: Indices,
    F0: Tensor | None,
    weights: Any,
    options: dict[str, Any],
) -> dict[str, Any]:
    """Return the fields of a `FundamentalBatch` that the loop gives.

    Parameters
    ----------
    x1, x2 : tensor, shape (m, 2)
        Matches of all pairs.
    values : tuple of ndarray
        The same in NumPy, checked.
    bounds : ndarray of int, shape (n + 1,)
        Where the pairs begin.
    F0 : tensor, shape (n, 3, 3), optional
        Start values.
    weights : tensor, shape (m,), optional
        Weights of the matches.
    options : dict
        Tolerances.

    Raises
    ------
    ArgumentError
        On other options, other types than floats, and bad shapes or weights.
    """
    unknown = sorted(set(options) - {"ftol", "xtol", "gtol", "max_iter", "backend"})
    if unknown:
        remedy = "NumPy arrays without backend='array', or the default"
        raise ArgumentError(unknown[0], "is no option for arrays of other libraries", remedy)
    stopping = lm.Stopping(**{k: v for k, v in options.items() if k != "backend"})
    xp, convert = arrays.namespace(x1, x2), like(x1)
    if not xp.isdtype(x1.dtype, "real floating") or x1.dtype != x2.dtype:
        raise ArgumentError("x1, x2", f"have types {x1.dtype}, {x2.dtype}", "one floating type")
    count = len(bounds) - 1
    if F0 is not None and tuple(F0.shape) != (count, 3, 3):
        raise ArgumentError("F0", f"has shape {tuple(F0.shape)}", f"({count}, 3, 3)")
    given = None if weights is None else as_weights(arrays.host(weights), len(values[0]))
    once = counted_once(*values, given, bounds)
    once = np.ones(len(values[0])) if once is None else once
    reasons = refusals(*values, once, bounds)
    kept = np.array([k for k in range(count) if k not in reasons], np.intp)
    rows, own = packed(bounds, x1)
    nfev, status = np.zeros(count, np.intp), np.full(count, REFUSED, np.intp)
    fields = {"F": (3, 3), "sigma": (), "cost": (), "rms_px": ()}
    found: dict[str, Any] = {
        name: convert(np.zeros((count, *shape))) for name, shape in fields.items()
    }
    found["distances"] = convert(np.zeros(len(values[0])))
    if len(kept):
        # Pairs that fill up a bucket repeat the last: nobody reads them.
        filling = arrays.bucket(x1, len(kept)) - len(kept)
        refining = np.concatenate([kept, np.full(filling, kept[-1])])
        rows, own = rows[refining], own[refining]
        place = xp.asarray(rows.ravel(), device=arrays.device(x1))
        own1, own2 = (xp.reshape(xp.take(x, place, axis=0), (*rows.shape, 2)) for x in (x1, x2))
        starts = (
            None
            if F0 is None
            else xp.take(F0, xp.asarray(refining, device=arrays.device(x1)), axis=0)
        )
        minimum = refine_pairs(
            xp, own1, own2, convert(np.where(own, once[rows], 0.0)), starts, stopping
        )
        # Refused pairs, and their matches, read the zero that is appended.
        pick = np.full(count, len(refining), np.intp)
        pick[kept] = np.arange(len(kept))
        for name in fields:
            value = getattr(minimum, name)
            found[name] = _taken(xp, value, pick)
        where = np.full(len(values[0]), rows.size, np.intp)
        own[len(kept) :] = False
        where[rows[own]] = np.flatnonzero(own)
        found["distances"] = _taken(xp, xp.reshape(minimum.distances, (-1,)), where)
        nfev[kept], status[kept] = minimum.nfev[: len(kept)], minimum.status[: len(kept)]
    return found | {
        "nfev": nfev,
        "njev": nfev.copy(),
        "nit": np.maximum(nfev - 1, 0),
        "status": status,
        "reasons": reasons,
    }


def _taken(xp: Any, value: Tensor, places: Indices) -> Tensor:
    """Return rows of a tensor, where the place after the last is a row of zeros."""
    zero = xp.zeros_like(value[:1, ...])
    index = xp.asarray(places, device=arrays.device(value))
    return xp.take(xp.concat([value, zero], axis=0), index, axis=0)


def refusals(
    x1: NDArray[np.float64],
    x2: NDArray[np.float64],
    weights: NDArray[np.float64],
    bounds: Indices,
) -> dict[int, str]:
    """Tell which pairs cannot determine F, and why."""
    reasons = {}
    for k, (begin, end) in enumerate(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
        counts = weights[begin:end] > 0.0
        try:
            if counts.sum() < 8:
                needed = "at least 8"
                raise ArgumentError("x1, x2", f"hold {counts.sum()} different matches", needed)
            check_general_position("x1", x1[begin:end][counts])
            check_general_position("x2", x2[begin:end][counts])
        except ArgumentError as error:
            reasons[k] = str(error)
    return reasons


def packed(bounds: Indices, x: Tensor) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the rows of each pair, (n, m), padded by row 0, and which of them are its own.

    What `x` is of may ask for more padding.
    """
    sizes = np.diff(bounds)
    place = np.arange(arrays.bucket(x, int(sizes.max(initial=1))))
    own = place < sizes[:, None]
    return np.where(own, bounds[:-1, None] + place, 0), own


def refine_pairs(
    xp: Any, x1: Tensor, x2: Tensor, weights: Tensor, F0: Tensor | None, stopping: lm.Stopping
) -> Minimum:
    """Minimise the exact reprojection error of pairs.

    Parameters
    ----------
    xp : module
        Their namespace.
    x1, x2 : tensor, shape (n, m, 2)
        Matches in pixels.
    weights : tensor, shape (n, m)
        Factor of each squared distance; zero for padding.
    F0 : tensor, shape (n, 3, 3), optional
        Start values in pixels; by default the 8-point estimates.
    stopping : epigauge.lm.Stopping
        Tolerances.

    Returns
    -------
    Minimum
        Where each pair ended.
    """
    frame = _Frame.of(xp, arrays.constant(x1), arrays.constant(x2), weights)
    if F0 is None:
        start = _eight_point(xp, *frame.forward(arrays.constant(x1), arrays.constant(x2)), weights)
    else:
        start = frame.from_pixels(arrays.constant(F0))
    frame, start = frame.displaced(start)
    problem = _Problem(xp, *frame.forward(arrays.constant(x1), arrays.constant(x2)), weights)
    factors, nfev, status = _minimize(problem, problem.factorize(start), stopping)
    tracked = _Problem(xp, *frame.forward(x1, x2), weights)
    factors = tracked.polished(problem, factors)
    F = tracked.fundamental(factors)
    signed = frame.scale[:, None] * tracked.distances(F)[1]
    squares = xp.sum(weights * signed**2, axis=-1)
    F = frame.to_pixels(xp.permute_dims(F[..., 0], (2, 0, 1)))
    values = xp.linalg.svdvals(F)
    return Minimum(
        F,
        values[:, 1] / values[:, 0],
        0.5 * squares,
        xp.sqrt(squares / (4.0 * xp.sum(xp.astype(weights > 0.0, weights.dtype), axis=-1))),
        signed,
        nfev,
        status,
    )


class _Frame:
    """Conditioned coordinates of each pair, as `epigauge.two_view.conditioning`."""

    def __init__(self, xp: Any, origin1: Tensor, origin2: Tensor, scale: Tensor) -> None:
        self.xp, self.origin1, self.origin2, self.scale = xp, origin1, origin2, scale

    @staticmethod
    def of(xp: Any, x1: Tensor, x2: Tensor, weights: Tensor) -> _Frame:
        """Return centroids and one scale of the matches that count."""
        counts = xp.astype(weights > 0.0, x1.dtype)[..., None]
        number = xp.sum(counts, axis=1)
        origin1, origin2 = (xp.sum(counts * x, axis=1) / number for x in (x1, x2))
        squares = sum(
            xp.sum(counts * (x - origin[:, None, :]) ** 2, axis=(1, 2)) / (2.0 * number[:, 0])
            for x, origin in ((x1, origin1), (x2, origin2))
        )
        return _Frame(xp, origin1, origin2, xp.sqrt(0.5 * squares) / RMS)

    def forward(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        """Return both point sets conditioned, shape (2, n, m)."""
        scale = self.scale[:, None, None]
        q1, q2 = (x1 - self.origin1[:, None, :]) / scale, (x2 - self.origin2[:, None, :]) / scale
        return self.xp.permute_dims(q1, (2, 0, 1)), self.xp.permute_dims(q2, (2, 0, 1))

    def displaced(self, F: Tensor) -> tuple[_Frame, Tensor]:
        """Return the frame with the second origin off the centroid, and F there."""
        xp = self.xp
        normal = F[:, :2, 2]
        length = xp.sqrt(xp.sum(normal**2, axis=-1))[:, None]
        known = length > 0.0
        axis = xp.asarray([1.0, 0.0], dtype=F.dtype, device=arrays.device(F))
        direction = xp.where(known, normal / xp.where(known, length, 1.0), axis)
        first = xp.abs(direction[:, :1]) >= xp.abs(direction[:, 1:])
        leading = xp.where(first, direction[:, :1], direction[:, 1:])
        shift = OFFSET * direction * _signs(xp, leading)
        moved = _Frame(xp, self.origin1, self.origin2 - self.scale[:, None] * shift, self.scale)
        # q2_old = q2_new - shift: F_new = T^T F with T the map from new to old coordinates.
        last = F[:, 2, :] - xp.sum(shift[:, :, None] * F[:, :2, :], axis=1)
        F = xp.stack([F[:, 0, :], F[:, 1, :], last], axis=1)
        return moved, _unit(xp, F)

    def from_pixels(self, F: Tensor) -> Tensor:
        """Return the conditioned F of unit norm."""
        return self._mapped(F, self.scale, (self.origin1, self.origin2))

    def to_pixels(self, F: Tensor) -> Tensor:
        """Return F for pixels, of unit norm."""
        back = -self.origin1 / self.scale[:, None], -self.origin2 / self.scale[:, None]
        return self._mapped(F, 1.0 / self.scale, back)

    def _mapped(self, F: Tensor, scale: Tensor, origins: tuple[Tensor, Tensor]) -> Tensor:
        """Return T2^T F T1 of unit norm, T = [[scale I, origin], [0, 1]]."""
        xp = self.xp
        for origin in origins:  # the columns by the first origin, then the rows by the second
            last = F[:, :, 2] + xp.sum(F[:, :, :2] * origin[:, None, :], axis=-1)
            F = xp.concat([F[:, :, :2] * scale[:, None, None], last[..., None]], axis=-1)
            F = xp.permute_dims(F, (0, 2, 1))
        return _unit(xp, F)


class _Problem:
    """Costs and Newton systems of all pairs; batch axes (n, m), one F a pair."""

    def __init__(self, xp: Any, q1: Tensor, q2: Tensor, weights: Tensor) -> None:
        self.xp, self.kernels = xp, arrays.table(xp)
        self.q1, self.q2, self.weights = q1, q2, weights
        self.floor = 0.5e-30 * xp.sum(weights, axis=-1)
        self.places = xp.asarray(_PLACES.ravel(), device=arrays.device(q1))

    def factorize(self, F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return U, V (3, 3, n, 1) and sigma (n, 1) of F (n, 3, 3)."""
        xp = self.xp
        U, values, Vt = xp.linalg.svd(F)
        first = xp.permute_dims(U, (1, 2, 0))[..., None]
        return first, xp.permute_dims(Vt, (2, 1, 0))[..., None], (values[:, 1:2] / values[:, :1])

    def fundamental(self, factors: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Return F (3, 3, n, 1)."""
        return self.kernels.fundamental_from_factors(*factors)

    def distances(self, F: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Return multipliers and signed distances (n, m), and the frame of F."""
        xp, feet = self.xp, self.kernels
        frame = feet.bilinear_frame(F)
        with np.errstate(all="ignore"):  # Newton may step onto a pole
            multiplier, change, d = feet.foot_point(*frame, self.q1, self.q2)
            good = settled(multiplier, change, d)
        if not bool(xp.all(good)):
            safe, _, safe_d = feet.foot_point_safe(*frame, self.q1, self.q2)
            multiplier = xp.where(good, multiplier, safe)
            d = xp.where(good, d, safe_d)
        return multiplier, d, frame

    def cost(self, factors: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Return the cost of each pair, infinite where it is not a number."""
        d = self.distances(self.fundamental(factors))[1]
        cost = 0.5 * self.xp.sum(self.weights * d**2, axis=-1)
        return self.xp.where(self.xp.isfinite(cost), cost, math.inf)

    def gradient(
        self, factors: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return gradient, J^T J and Hessian by vect(F), and the two derivatives of vect(F)."""
        xp, n = self.xp, self.weights.shape[0]
        F, dF, d2F = self.kernels.fundamental_derivatives(*factors)
        multiplier, _, frame = self.distances(F)
        g, N, H = self.kernels.reprojection_newton(
            *(*frame, self.q1, self.q2, multiplier, self.weights, xp.zeros_like(self.weights))
        )
        turn = _kron(xp, _padded(xp, frame[1]), _padded(xp, frame[0]))
        g = xp.matmul(turn, xp.permute_dims(g, (1, 0))[..., None])[..., 0]
        N, H = (
            turn
            @ xp.reshape(xp.take(xp.permute_dims(packed, (1, 0)), self.places, axis=1), (n, 9, 9))
            @ xp.matrix_transpose(turn)
            for packed in (N, H)
        )
        dF = xp.permute_dims(dF[..., 0], (2, 0, 1))
        d2F = xp.reshape(xp.permute_dims(d2F[..., 0], (3, 0, 1, 2)), (n, 9, 49))
        return g, N, H, dF, d2F

    def linearize(self, factors: tuple[Tensor, Tensor, Tensor]) -> _System:
        """Return the Newton system by the seven update parameters."""
        xp, n = self.xp, self.weights.shape[0]
        g, N, H, dF, d2F = self.gradient(factors)
        across = xp.matrix_transpose(dF)
        hessian = across @ H @ dF + xp.reshape(g[:, None, :] @ d2F, (n, 7, 7))
        normal = across @ N @ dF
        diagonal = xp.stack([normal[:, i, i] for i in range(7)], axis=-1)
        bend = xp.reshape(across @ N @ d2F, (n, 7, 7, 7))
        values, vectors = xp.linalg.eigh(0.5 * (hessian + xp.matrix_transpose(hessian)))
        return _System(xp, (across @ g[..., None])[..., 0], values, vectors, diagonal, bend)

    def retract(
        self, factors: tuple[Tensor, Tensor, Tensor], step: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the factors moved by steps (n, 7)."""
        delta = self.xp.permute_dims(step, (1, 0))[..., None]
        return tuple(self.kernels.retract_factors(*factors, delta))

    def polished(
        self, values: _Problem, factors: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return factors after one Newton step: the gradient is ours, the Hessian of `values`."""
        xp = self.xp
        system = values.linearize(factors)
        g, _, _, dF, _ = self.gradient(factors)
        gradient = (xp.matrix_transpose(arrays.constant(dF)) @ g[..., None])[..., 0]
        step = system.along(gradient, xp.where(system.values > 0.0, system.values, math.inf))
        # A long step is no step at a minimum: the pair did not converge, and stays.
        short = xp.sqrt(xp.sum(arrays.constant(step) ** 2, axis=-1)) <= _SHORT
        return self.retract(factors, xp.where(short[:, None], step, 0.0))


#: Longest Newton step of a pair at its minimum.
_SHORT = 1e-3


@dataclass(frozen=True)
class _System:
    """Newton systems in their eigenbases, as `epigauge.linear.Dense`."""

    xp: Any
    gradient: Tensor
    values: Tensor
    vectors: Tensor
    diagonal: Tensor
    bend: Tensor

    def along(self, right: Tensor, damped: Tensor) -> Tensor:
        """Return -(damped Hessian)^-1 right."""
        xp = self.xp
        inside = xp.matrix_transpose(self.vectors) @ right[..., None]
        return -(self.vectors @ (inside / damped[..., None]))[..., 0]

    def step(self, lam: Tensor) -> Tensor:
        """Return the damped steps, bent like the valley where that is short against them."""
        xp = self.xp
        lowest = self.values[:, 0]
        shift = xp.where(lowest + lam > 0.0, lam, lam - (1.0 + LIFT) * lowest)
        least = float(xp.finfo(self.values.dtype).smallest_normal)
        damped = xp.clip(self.values + shift[:, None], least)
        step = self.along(self.gradient, damped)
        curved = xp.sum(self.bend * step[:, None, None, :], axis=-1)
        bent = 0.5 * self.along(xp.sum(curved * step[:, None, :], axis=-1), damped)
        mild = xp.sum(bent**2, axis=-1) <= BENT * xp.sum(step**2, axis=-1)
        return step + xp.where(mild[:, None], bent, 0.0)

    def decrement(self) -> Tensor:
        """Return what the undamped step promises; infinity where H is not positive definite."""
        xp = self.xp
        eps = float(xp.finfo(self.values.dtype).eps)
        definite = self.values[:, 0] > eps * self.values[:, -1]
        inside = (xp.matrix_transpose(self.vectors) @ self.gradient[..., None])[..., 0]
        safe = xp.where(definite[:, None], self.values, 1.0)
        return xp.where(definite, 0.5 * xp.sum(inside**2 / safe, axis=-1), math.inf)


def _minimize(
    problem: _Problem, factors: tuple[Tensor, Tensor, Tensor], stopping: lm.Stopping
) -> tuple[tuple[Tensor, Tensor, Tensor], NDArray[np.intp], NDArray[np.intp]]:
    """Run `epigauge.lm.minimize` with the classic schedule on all pairs, until the last stops."""
    xp = problem.xp
    cost = problem.cost(factors)
    system = problem.linearize(factors)
    lam = Levenberg.relative * xp.max(system.diagonal, axis=-1)
    least, ceiling = LAM_FLOOR * lam, 1e16 * lam
    count = cost.shape[0]
    nfev, status = np.ones(count, np.intp), np.zeros(count, np.intp)
    running = np.ones(count, bool)

    def stop(which: Tensor, reason: int) -> None:
        found = arrays.host(which) & running
        status[found] = reason
        running[found] = False

    stop(~xp.isfinite(cost), -3)
    for _ in range(stopping.max_iter):
        stop(cost <= problem.floor, 5)
        stop(xp.max(xp.abs(system.gradient), axis=-1) <= stopping.gtol, 1)
        stop(system.decrement() <= stopping.ftol * cost, 4)
        if not running.any():
            break
        step = system.step(lam)
        trial = problem.retract(factors, step)
        after = problem.cost(trial)
        moving = xp.asarray(running, device=arrays.device(cost))
        nfev[running] += 1
        decrease = cost - after
        better = moving & (decrease > 0.0)
        norm = xp.sqrt(xp.sum(step**2, axis=-1))
        factors = tuple(
            xp.where(better[:, None], new, old) for new, old in zip(trial, factors, strict=True)
        )
        stop(~better & (xp.abs(decrease) <= 1e-15 * cost), 2)
        stop(better & (decrease <= stopping.ftol * after), 2)
        stop(better & (norm <= stopping.xtol), 3)
        cost = xp.where(better, after, cost)
        lam = xp.where(better, xp.maximum(0.1 * lam, least), 10.0 * lam)
        stop(lam > ceiling, -1)
        if bool(xp.any(better)):
            system = problem.linearize(factors)
    return factors, nfev, status


def _eight_point(xp: Any, q1: Tensor, q2: Tensor, weights: Tensor) -> Tensor:
    """Return normalised 8-point estimates (n, 3, 3) in the coordinates of q1 and q2."""
    counts = xp.astype(weights > 0.0, q1.dtype)
    number = xp.sum(counts, axis=-1)
    scales, rows = [], []
    for q in (q1, q2):  # centred; one scale an image
        scale = xp.sqrt(xp.sum(counts * q**2, axis=(0, 2)) / (2.0 * number))
        scales.append(scale)
        rows.append(
            [q[0, ...] / scale[:, None], q[1, ...] / scale[:, None], xp.ones_like(q[0, ...])]
        )
    products = xp.stack([counts * b * a for b in rows[1] for a in rows[0]], axis=-1)
    f = xp.linalg.eigh(xp.matrix_transpose(products) @ products)[1][:, :, 0]
    f = f * _signs(xp, _first_large(xp, f))[:, None]
    U, values, Vt = xp.linalg.svd(xp.reshape(f, (-1, 3, 3)))
    F = (U[:, :, :2] * values[:, None, :2]) @ Vt[:, :2, :]
    one = xp.ones_like(scales[0])
    left = xp.stack([one / scales[1], one / scales[1], one], axis=-1)
    right = xp.stack([one / scales[0], one / scales[0], one], axis=-1)
    return _unit(xp, left[:, :, None] * F * right[:, None, :])


def _first_large(xp: Any, f: Tensor) -> Tensor:
    """Return of each row the first entry above half of the largest: its sign is made positive."""
    found = f[:, 8]
    large = xp.abs(f) > 0.5 * xp.max(xp.abs(f), axis=-1)[:, None]
    for k in range(7, -1, -1):
        found = xp.where(large[:, k], f[:, k], found)
    return found


def _signs(xp: Any, values: Tensor) -> Tensor:
    """Return -1 or 1, which is that of zero."""
    one = xp.ones_like(values)
    return xp.where(values < 0.0, -one, one)


def _unit(xp: Any, F: Tensor) -> Tensor:
    return F / xp.sqrt(xp.sum(F**2, axis=(1, 2)))[:, None, None]


def _padded(xp: Any, R: Tensor) -> Tensor:
    """Return rotations of the image plane (2, 2, n, 1) as matrices (n, 3, 3)."""
    a, b, c, d = R[0, 0, :, 0], R[0, 1, :, 0], R[1, 0, :, 0], R[1, 1, :, 0]
    zero, one = xp.zeros_like(a), xp.ones_like(a)
    rows = [xp.stack(row, axis=-1) for row in ((a, b, zero), (c, d, zero), (zero, zero, one))]
    return xp.stack(rows, axis=1)


def _kron(xp: Any, A: Tensor, B: Tensor) -> Tensor:
    """Return Kronecker products (n, 9, 9) of 3x3 matrices."""
    product = A[:, :, None, :, None] * B[:, None, :, None, :]
    return xp.reshape(product, (A.shape[0], 9, 9))
