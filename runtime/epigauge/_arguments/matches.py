"""Checks of matches: their points, weights, scores and covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments.convert import MAX_PX, MIN_PX, as_double, as_real, on_host
from epigauge.errors import ArgumentError

__all__ = [
    "MAX_WEIGHT",
    "as_covariances",
    "as_matches",
    "as_score",
    "as_weights",
    "check_general_position",
]

Array = NDArray[np.float64]

_POINTS = "an (m, 2) array of pixel coordinates"

#: Largest weight accepted.
MAX_WEIGHT = 1e100

#: A point set is collinear when its thickness is below this fraction of its length. Image points
#: are never measured to 1e-7 of an image, and text files round there.
_THIN = 1e-7


def as_matches(
    x1: ArrayLike,
    x2: ArrayLike,
    *,
    at_least: int = 8,
    general_position: bool = False,
) -> tuple[Array, Array]:
    """Check point matches and bring them into the form used inside.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2) or (m, 1, 2)
        Matching points in image 1 and 2, in pixels; any integer or floating type, or lists.
    at_least : int
        Smallest number of matches accepted.
    general_position : bool
        Refuse points that are all equal or all on one line of an image.

    Returns
    -------
    x1, x2 : ndarray, shape (m, 2), float64, C-contiguous
        The caller's own array where that is already in this form: do not write into it.

    Raises
    ------
    ArgumentError
        On another shape, unequal lengths, NaN, infinity or coordinates beyond 1e70 (the first such
        row is named), none beyond 1e-70, a type that is not a real number, fewer than `at_least`
        matches and, with `general_position`, points without extent in two dimensions.
    """
    x1, x2 = on_host("x1", x1), on_host("x2", x2)
    a1, a2 = _points("x1", x1), _points("x2", x2)
    if len(a1) != len(a2):
        raise ArgumentError(
            "x2", f"has {len(a2)} points but x1 has {len(a1)}", "one row in each for every match"
        )
    if len(a1) < at_least:
        raise ArgumentError("x1, x2", f"hold {_number(len(a1), 'match')}", f"at least {at_least}")
    if general_position:
        for name, given, points in (("x1", x1, a1), ("x2", x2, a2)):
            check_general_position(name, points, eps=_resolution(given))
    return a1, a2


def check_general_position(name: str, points: Array, *, eps: float = 2.0**-52) -> None:
    """Refuse points that are all equal or all on one line.

    With s1 the root mean square distance from the first point, s2 that from the line through the
    first point and the one farthest from it, and r = 4 * eps * (largest coordinate) the rounding
    of the input, the points count as equal when ``s1 <= r`` and as collinear when
    ``s2 <= max(r, 1e-7 * s1)``. Differences come first, so that a large offset of the coordinates
    does not hide the extent of the points.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    points : ndarray, shape (m, 2)
        Finite points of one image.
    eps : float
        Relative rounding of the coordinates as the caller gave them.

    Raises
    ------
    ArgumentError
        If the points have no extent, or extent in one direction only.
    """
    if _is_spread(points, eps):
        return
    size = float(np.max(np.abs(points), initial=0.0))
    equal = collinear = True
    if size > 0.0:
        # Dividing by a power of two is exact and keeps squares from overflowing.
        scaled = np.ldexp(points, -int(np.frexp(size)[1]))
        x, y = (scaled - scaled[0]).T
        squared = x * x + y * y
        far = np.argmax(squared)
        s1, rounding = np.sqrt(squared.mean()), 4.0 * eps
        equal = bool(s1 <= rounding)
        if not equal:
            off_line = (x * y[far] - y * x[far]) / np.sqrt(squared[far])
            collinear = bool(np.sqrt(np.mean(off_line**2)) <= max(rounding, _THIN * s1))
    if equal or collinear:
        image = {"x1": " of image 1", "x2": " of image 2"}.get(name, "")
        raise ArgumentError(
            name,
            f"has all its points{image} {'equal' if equal else 'on one line'}",
            "points spread over two dimensions in both images, else F is not determined",
        )


def as_weights(weights: ArrayLike, m: int) -> Array:
    """Check the weights of matches.

    Parameters
    ----------
    weights : array_like, shape (m,)
        One weight a match.
    m : int
        Number of matches.

    Returns
    -------
    ndarray, shape (m,), float64, contiguous
        Weights that may share memory with the input: do not write into them.

    Raises
    ------
    ArgumentError
        On another shape or type, a negative or NaN weight or one beyond 1e100 (the first is named),
        or weights that are all zero.
    """
    w = as_real("weights", weights, f"an ({m},) array")
    if w.shape != (m,):
        raise ArgumentError("weights", f"has shape {w.shape}", f"({m},): one weight a match")
    bad = np.flatnonzero(~((w >= 0.0) & (w <= MAX_WEIGHT)))
    if len(bad):
        needed = f"finite numbers >= 0, at most {MAX_WEIGHT:g}"
        raise ArgumentError("weights", f"has {w[bad[0]]} in row {bad[0]}", needed)
    if m and not w.any():
        raise ArgumentError("weights", "is zero for every match", "some positive weights")
    return np.ascontiguousarray(w)


def as_score(score: ArrayLike, m: int) -> Array:
    """Check how promising each match is: finite numbers, the highest first.

    Parameters
    ----------
    score : array_like, shape (m,)
        One number a match.
    m : int
        Number of matches.

    Returns
    -------
    ndarray, shape (m,), float64
        The numbers.

    Raises
    ------
    ArgumentError
        On another shape or type, NaN or infinity (the first is named).
    """
    values = as_real("score", score, f"an ({m},) array")
    if values.shape != (m,):
        raise ArgumentError("score", f"has shape {values.shape}", f"({m},): one number a match")
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise ArgumentError("score", f"holds {values[bad[0]]} at {bad[0]}", "finite numbers")
    return as_double(values)


def as_covariances(name: str, value: ArrayLike, m: int) -> Array:
    """Check 2x2 covariances of image points: symmetric positive definite, for all or for each.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    value : array_like, shape (2, 2) or (m, 2, 2)
        One for all points, or one for each.
    m : int
        Number of points.

    Returns
    -------
    ndarray, shape (m, 2, 2), float64
        A matrix for each point: do not write into it.

    Raises
    ------
    ArgumentError
        On another shape or type, NaN or infinity, or a matrix that is not symmetric (to 1e-12 of
        its largest entry) or not positive definite (the first such row is named).
    """
    needed = f"a (2, 2) or ({m}, 2, 2) array"
    covariances = as_real(name, value, needed)
    if covariances.shape not in ((2, 2), (m, 2, 2)):
        raise ArgumentError(name, f"has shape {covariances.shape}", needed)
    covariances = np.broadcast_to(covariances, (m, 2, 2))
    a, b, c, d = covariances.reshape(m, 4).T
    with np.errstate(over="ignore", invalid="ignore"):
        symmetric = np.abs(b - c) <= 1e-12 * np.maximum(np.abs(b), np.abs(c))
        good = symmetric & (a > 0.0) & (d > 0.0) & (a * d - b * c > 1e-14 * a * d)
    bad = np.flatnonzero(~(good & np.isfinite(covariances).all(axis=(1, 2))))
    if len(bad):
        raise ArgumentError(
            name, f"has {covariances[bad[0]].tolist()} in row {bad[0]}", "positive definite ones"
        )
    return covariances


def _points(name: str, value: ArrayLike) -> Array:
    """Convert one image's points to (m, 2), float64, C-contiguous."""
    points = as_real(name, value, _POINTS)
    if points.ndim == 3 and points.shape[1:] == (1, 2):
        points = points[:, 0, :]
    if points.ndim != 2 or points.shape[1] != 2:
        raise ArgumentError(name, f"has shape {points.shape}", _POINTS + _hint(points.shape))
    size = np.abs(points)
    good = size <= MAX_PX  # false for NaN
    if not good.all():
        row = int(np.flatnonzero(~good.all(axis=1))[0])
        x, y = points[row]
        needed = f"finite coordinates below {MAX_PX:g}: drop such matches"
        raise ArgumentError(name, f"has a point ({x}, {y}) in row {row}", needed)
    if 0.0 < size.max(initial=0.0) < MIN_PX:
        raise ArgumentError(name, f"has no coordinate beyond {MIN_PX:g}", "another unit of length")
    return np.ascontiguousarray(points)


def _is_spread(points: Array, eps: float) -> bool:
    """Recognise plainly two-dimensional points in a few microseconds; False means: look closer.

    The determinant and trace of the scatter matrix show a thickness above a thousandth of the
    length and far above rounding. Coordinates outside [1e-70, 1e70] are left to the close look.
    """
    m = len(points)
    with np.errstate(over="ignore", invalid="ignore"):
        mean = np.add.reduce(points) / max(m, 1)
        centred = points - mean
        scatter = centred.T @ centred
    mx, my, a, b, c = map(float, (*mean, scatter[0, 0], scatter[0, 1], scatter[1, 1]))
    trace, determinant = a + c, a * c - b * b
    return (
        1e-140 < trace < 1e140
        and determinant > 1e-6 * trace * trace
        and determinant > (1e3 * eps) ** 2 * m * trace * (mx * mx + my * my + trace)
    )


def _resolution(value: Any) -> float:
    """Relative rounding of the caller's numbers: that of their floating type."""
    dtype = getattr(value, "dtype", None)
    if not isinstance(dtype, np.dtype) or dtype.kind != "f":
        return 2.0**-52
    return max(2.0**-52, float(np.finfo(dtype).eps))


def _hint(shape: tuple[int, ...]) -> str:
    """Say how a common wrong shape is repaired."""
    if len(shape) == 2 and shape[0] == 2:
        return " (transpose it)"
    if len(shape) == 2 and shape[1] == 3:
        return " (divide homogeneous points by their third coordinate and drop it)"
    if len(shape) == 2 and shape[1] == 4:
        return " (pass columns 0, 1 as x1 and columns 2, 3 as x2)"
    return ""


def _number(count: int, noun: str) -> str:
    """Count with the right plural: 1 match, 2 matches."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}es"
