"""Conversion of arrays, and of matrices, to the one form that the library works with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.errors import ArgumentError

__all__ = [
    "MAX_PX",
    "MIN_PX",
    "as_array",
    "as_calibration",
    "as_double",
    "as_fundamental",
    "as_real",
    "on_host",
    "rescaled",
]

Array = NDArray[np.float64]

#: Pixel coordinates are accepted up to MAX_PX, and sets of them whose largest is zero or at least
#: MIN_PX: fourth powers of others overflow or vanish.
MIN_PX, MAX_PX = 1e-70, 1e70

#: Binary exponent from which a matrix of free scale is rescaled, which is exact.
_EXPONENT = 200

#: Between these sums of squares nine numbers have no exponent of that size.
_SQUARES = (2.0 ** (2 - 2 * _EXPONENT) * 9, 2.0 ** (2 * _EXPONENT - 2))


def on_host(name: str, value: Any) -> Any:
    """Return a tensor of PyTorch or CuPy, or a nullable table of pandas, as an array.

    Everything else, JAX, TensorFlow, xarray, polars among it, NumPy converts itself. None of them
    is imported.
    """
    if isinstance(value, np.ndarray | list | tuple | int | float):
        return value
    try:
        if hasattr(value, "detach") and hasattr(value, "cpu"):
            return value.detach().cpu().numpy()
        if hasattr(value, "__cuda_array_interface__") and hasattr(value, "get"):
            return value.get()
        if hasattr(value, "to_numpy") and np.asarray(value).dtype.hasobject:
            return _nullable(value)
    except (TypeError, ValueError, RuntimeError) as error:
        was = f"is a {type(value).__name__} that is no array"
        raise ArgumentError(name, was, f"numbers of a usual type ({error})") from None
    return value


def _nullable(value: Any) -> Any:
    """Return a table or column of pandas that has a mask; any other as it is, to be refused.

    Text that reads as numbers is text, as in an array.
    """
    types = np.asarray(getattr(value, "dtypes", getattr(value, "dtype", None)), dtype=object)
    kinds = {getattr(of_column, "kind", "O") for of_column in types.flat}
    if not kinds <= set("iuf"):
        return value
    whole = kinds <= set("iu") and not np.any(value.isna())
    return value.to_numpy(dtype=np.int64 if whole else np.float64, na_value=np.nan)


def as_array(name: str, value: ArrayLike, needed: str) -> NDArray[Any]:
    """Convert to an array of whatever type, refusing ragged lists and masked entries."""
    value = on_host(name, value)
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ArgumentError(name, "is a masked array", f"{needed} without masked entries")
    try:
        return np.asarray(value)
    except (ValueError, TypeError) as error:
        raise ArgumentError(name, "is not a regular array", f"{needed} ({error})") from None


def as_real(name: str, value: ArrayLike, needed: str) -> Array:
    """Convert to float64, refusing every type that is not a real number."""
    array = as_array(name, value, needed)
    if array.dtype.kind not in "iuf":
        raise ArgumentError(name, f"has type {array.dtype}", f"{needed} of real numbers")
    return as_double(array)


def as_double(array: NDArray[Any]) -> Array:
    """Convert to float64, at addresses where C may read it.

    A long double beyond its range becomes infinite and a signalling NaN a quiet one, to be
    refused later.
    """
    if array.dtype == np.float64 and array.dtype.isnative and array.flags.aligned:
        return array
    with np.errstate(over="ignore", invalid="ignore"):
        return array.astype(np.float64, copy=not array.flags.aligned)


def rescaled(array: Array) -> Array:
    """Return an array of free scale, times a power of two if its products could overflow."""
    exponent = int(np.frexp(np.abs(array).max())[1])
    return array if abs(exponent) < _EXPONENT else np.ldexp(array, -exponent)


def as_fundamental(F0: ArrayLike, name: str = "F0") -> Array:
    """Check a fundamental matrix: real, finite, not zero.

    Parameters
    ----------
    F0 : array_like, shape (3, 3)
        The matrix. Its rank and scale are the business of the caller.
    name : str
        Name of the argument for the message.

    Returns
    -------
    ndarray, shape (3, 3), float64
        A matrix that may share memory with the input: do not write into it. One whose largest
        entry is not between 2^-200 and 2^200 is rescaled, so that products do not overflow.

    Raises
    ------
    ArgumentError
        On another shape or type, NaN, infinity, or a matrix of zeros.
    """
    F = as_real(name, F0, "a (3, 3) matrix")
    if F.shape != (3, 3):
        raise ArgumentError(name, f"has shape {F.shape}", "a (3, 3) matrix")
    # Neither NaN, infinite, zero nor to be rescaled: one number tells it of the usual ones.
    if _SQUARES[0] < np.vdot(F, F) < _SQUARES[1]:
        return F
    if not np.isfinite(F).all():
        row, column = np.argwhere(~np.isfinite(F))[0]
        raise ArgumentError(name, f"has {F[row, column]} at [{row}, {column}]", "finite entries")
    if not F.any():
        raise ArgumentError(name, "is the zero matrix", "a matrix of rank 2")
    return rescaled(F)


def as_calibration(name: str, K: ArrayLike) -> Array:
    """Check a calibration matrix: real, finite, upper triangular with a positive diagonal.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    K : array_like, shape (3, 3)
        Maps coordinates on the retina to pixels.

    Returns
    -------
    ndarray, shape (3, 3), float64
        The matrix, scaled to ``K[2, 2] = 1``.

    Raises
    ------
    ArgumentError
        If it is not such a matrix.
    """
    matrix = as_fundamental(K, name)
    if np.any(np.tril(matrix, -1)) or not np.all(np.diag(matrix) / matrix[2, 2] > 0.0):
        raise ArgumentError(
            name, "is no calibration matrix", "[[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
        )
    scaled = np.asarray(matrix / matrix[2, 2])
    if not np.abs(scaled).max() <= MAX_PX:
        raise ArgumentError(
            name, f"has an entry of {np.abs(scaled).max():g}", f"pixels, up to {MAX_PX:g}"
        )
    if not np.diag(scaled).min() >= MIN_PX:
        was = f"has a focal length of {np.diag(scaled).min():g}"
        raise ArgumentError(name, was, f"pixels, at least {MIN_PX:g}")
    return scaled
