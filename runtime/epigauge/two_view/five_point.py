"""Essential matrices of five matches, and starts for an essential matrix from many."""

from __future__ import annotations

import itertools
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.two_view.essential import Calibrated

__all__ = ["essential_5point", "essential_starts", "log_cost"]

Array = NDArray[np.float64]

#: Exponents of (x, y, z, w) in the cubic monomials of E = x E1 + y E2 + z E3 + w E4: ten of degree
#: three in x, y, z, then the ten others, which are a basis of the quotient ring.
_MONOMIALS = sorted(
    (e for e in itertools.product(range(4), repeat=4) if sum(e) == 3),
    key=lambda e: (e[3], *(-k for k in e)),
)
_BASIS = _MONOMIALS[10:]

#: A root is real when its imaginary part is below this (relative); the root of a double precision.
_REAL = 1e-6

#: Gauss-Newton steps on the ten equations of a root: digits that eigenvectors lose.
_POLISH = 1

#: Share of the trace that is added to the diagonal of their normal equations.
_RIDGE = 1e-13

#: Subsets of five that starts are taken from, matches that judge them; starts differ by more than
#: this (unit norm, conditioned). Of the solutions, so many times the number of starts are looked at
#: closely; with eight matches, the linear estimate is one of them.
_SUBSETS = 56
_JUDGES = 200
_DISTINCT = 1e-2
_CANDIDATES = 5
_LINEAR_LEAST = 8
_SEED = 20040601

#: Median of the square of a standard normal variable.
_MEDIAN2 = 0.455

#: A distance below this, in conditioned coordinates, is rounding.
_ROUNDING = 1e-12


def essential_5point(rays1: Array, rays2: Array) -> tuple[Array, NDArray[np.intp]]:
    """Find the essential matrices that five matches satisfy exactly.

    The five equations rays2^T E rays1 = 0 leave E = x E1 + y E2 + z E3 + w E4. Ten cubic equations
    say that E is essential; in the quotient ring they leave ten monomials, and x, y, z at w = 1 are
    read from the eigenvectors of the multiplication by x [1]_, [2]_. The coefficients are values of
    the derived symmetric trilinear form of the equations.

    Parameters
    ----------
    rays1, rays2 : ndarray, shape (k, 5, 3)
        Sets of five matches as directions in the camera frames.

    Returns
    -------
    E : ndarray, shape (n, 3, 3)
        Up to ten matrices a set, of unit norm. Sets in degenerate position may have none.
    origin : ndarray of int, shape (n,)
        The set that each belongs to.

    References
    ----------
    .. [1] D. Nister, "An efficient solution to the five-point relative pose problem", PAMI 26(6),
       2004.
    .. [2] H. Stewenius, C. Engels, D. Nister, "Recent developments on direct relative orientation",
       ISPRS Journal 60, 2006.
    """
    count = len(rays1)
    products = (rays2[:, :, :, None] * rays1[:, :, None, :]).reshape(count, 5, 9)
    null = np.linalg.svd(products)[2][:, 5:].reshape(count, 4, 3, 3)
    form = kernels.table().essential_constraints
    members = np.moveaxis(null, 0, -1)  # (4, 3, 3, k)
    equations = np.empty((count, 10, 20))
    for column, exponents in enumerate(_MONOMIALS):
        A, B, C = (members[i] for i, e in enumerate(exponents) for _ in range(e))
        multiplicity = 6 // int(np.prod([factorial(e) for e in exponents]))
        equations[:, :, column] = multiplicity * form(A, B, C).T
    regular = np.linalg.cond(equations[:, :, :10]) < 1e14
    origin = np.flatnonzero(regular)
    reduced = np.linalg.solve(equations[origin, :, :10], equations[origin, :, 10:])
    action = np.zeros((len(origin), 10, 10))
    for row, exponents in enumerate(_BASIS):
        times_x = (exponents[0] + 1, *exponents[1:3], exponents[3] - 1)
        place = _MONOMIALS.index(times_x)
        if place < 10:
            action[:, row] = -reduced[:, place]
        else:
            action[:, row, place - 10] = 1.0
    values, vectors = np.linalg.eig(action)
    # (x, y, z, 1) w^2 are entries of the eigenvector: monomials are of degree two in w
    last = vectors[:, [_BASIS.index(e) for e in _LINEAR]]
    with np.errstate(all="ignore"):
        roots = last[:, :3] / last[:, 3:]
    real = np.isfinite(roots).all(axis=1)
    real &= np.abs(roots.imag).max(axis=1) <= _REAL * (1.0 + np.abs(roots.real).max(axis=1))
    real &= np.abs(values.imag) <= _REAL * (1.0 + np.abs(values.real))
    which, number = np.nonzero(real)
    xyz = roots.real[which, :, number]
    null = null[origin[which]]
    E = _polished(np.column_stack([xyz, np.ones(len(xyz))]), null)
    return E, origin[which]


_LINEAR = [(1, 0, 0, 2), (0, 1, 0, 2), (0, 0, 1, 2), (0, 0, 0, 3)]


def _polished(weights: Array, null: Array) -> Array:
    """Return the essential matrices near sums of the null vectors, by Gauss-Newton steps.

    The derivative of the cubic c(E) along A is 3 c(E, E, A).
    """
    form = kernels.table().essential_constraints
    for step in range(_POLISH + 1):
        weights = weights / np.linalg.norm(weights, axis=1, keepdims=True)
        E = np.einsum("ni,nijk->njk", weights, null)
        if step == _POLISH or not len(E):
            break
        at = np.moveaxis(E, 0, -1)
        value = form(at, at, at).T
        columns = [3.0 * form(at, at, np.moveaxis(null[:, i], 0, -1)).T for i in range(4)]
        J = np.stack(columns, axis=2)
        # The scale of E is free: its direction is filled up
        normal = np.swapaxes(J, 1, 2) @ J + weights[:, :, None] * weights[:, None]
        # At a double root J^T J is singular: a ridge that does not move where the steps end
        ridge = _RIDGE * np.einsum("nii->n", normal)
        normal = normal + ridge[:, None, None] * np.eye(4)
        right = np.einsum("nij,ni->nj", J, value)
        weights = weights - np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return np.asarray(E)


def essential_starts(
    matches: Calibrated, weights: Array, count: int, *, robust: bool = False
) -> list[Array]:
    """Return starts for an essential matrix, best first: solutions of subsets of five matches.

    Parameters
    ----------
    matches : Calibrated
        At least five.
    weights : ndarray, shape (m,)
        Matches of weight zero are left out.
    count : int
        How many to return at most.
    robust : bool
        Whether to expect gross errors.

    Returns
    -------
    list of ndarray, shape (3, 3)
        F in the coordinates of the matches, of unit norm; judged by the squared distances to points
        in front of both cameras, and different from one another. The same at every call.
    """
    counts = np.flatnonzero(weights > 0.0)
    rng = np.random.default_rng(_SEED)
    if len(counts) > _JUDGES:
        counts = np.sort(rng.choice(counts, _JUDGES, replace=False))
    few = matches.some(counts)
    rays1, rays2 = few.rays(few.q1, few.q2)
    sets = _subsets(len(counts), rng)
    E, _ = essential_5point(rays1[sets], rays2[sets])
    if len(counts) >= _LINEAR_LEAST:
        E = np.concatenate([E, _linear(rays1, rays2)[None]])
    if not len(E):
        return []  # all subsets degenerate, and too few for the linear start
    F = few.fundamental(E)
    squared = _sampson(F, few.q1, few.q2)
    scale2 = max(float(np.min(np.median(squared, axis=1))), np.finfo(float).tiny)

    def cost(squared: Array) -> Array:
        if robust:
            with np.errstate(over="ignore"):  # beside a start that fits exactly
                return np.asarray(np.sum(np.log1p(squared / scale2), axis=1))
        return log_cost(np.sum(squared, axis=1), len(counts))

    # Sampson's distances, and depths of the matches as measured, are good enough to choose starts
    best = np.argsort(cost(squared))[: _CANDIDATES * count]
    F, squared = F[best], squared[best]
    noise2 = np.sum(squared, axis=1) / max(len(counts) - 5, 1)
    if robust:
        noise2 = np.median(squared, axis=1) / _MEDIAN2
    motion = few.motion(F, (few.q1, few.q2), squared, np.ones(len(counts)), noise2)
    order = np.argsort(cost(squared) + motion.doubt)
    found: list[Array] = []
    for candidate in F[order]:
        near = (min(np.linalg.norm(candidate - f), np.linalg.norm(candidate + f)) for f in found)
        if len(found) < count and all(distance > _DISTINCT for distance in near):
            found.append(candidate)
    return found


def log_cost(squares: Array, m: int) -> Array:
    """Return -log(likelihood) of an essential matrix with a sum of squares of m matches.

    The noise is not known: log(squares) (m - 5) / 2, comparable with `Motion.doubt`.
    """
    return np.asarray(0.5 * (m - 5) * np.log(np.maximum(squares, m * _ROUNDING**2)))


def _subsets(m: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return sets of five of m matches: all of them, or random ones."""
    if comb(m, 5) <= _SUBSETS:
        return np.array(list(itertools.combinations(range(m), 5)))
    return np.argsort(rng.random((_SUBSETS, m)), axis=1)[:, :5]


def _linear(rays1: Array, rays2: Array) -> Array:
    """Return the essential matrix nearest to the linear estimate from eight matches or more."""
    products = (rays2[:, :, None] * rays1[:, None, :]).reshape(-1, 9)
    U, _, Vt = np.linalg.svd(np.linalg.svd(products)[2][-1].reshape(3, 3))
    return np.asarray(U[:, :2] @ Vt[:2])


def _sampson(F: Array, q1: Array, q2: Array) -> Array:
    """Return squared Sampson distances (k, m) to many F (k, 3, 3)."""
    lines2 = F[:, :, :2] @ q1 + F[:, :, 2:]
    lines1 = np.swapaxes(F[:, :2], 1, 2) @ q2 + F[:, 2, :, None]
    C = np.sum(lines2[:, :2] * q2, axis=1) + lines2[:, 2]
    gradient2 = np.sum(lines1[:, :2] ** 2, axis=1) + np.sum(lines2[:, :2] ** 2, axis=1)
    return np.asarray(C**2 / np.maximum(gradient2, np.finfo(float).tiny))
