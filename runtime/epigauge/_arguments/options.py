"""Checks of options: one of some strings, a number, a count."""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable

import numpy as np

from epigauge.errors import ArgumentError

__all__ = ["as_choice", "as_count", "as_positive"]


def as_choice(name: str, value: object, choices: Iterable[str]) -> str:
    """Check that an option is one of the strings allowed.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    value : object
        What the caller gave.
    choices : iterable of str
        What is allowed.

    Returns
    -------
    str
        The value.

    Raises
    ------
    ArgumentError
        If the value is not among the choices; the message suggests a similar one.
    """
    allowed = list(choices)
    if isinstance(value, str) and value in allowed:
        return value
    listed = ", ".join(repr(choice) for choice in allowed)
    needed = listed if len(allowed) == 1 else f"one of {listed}"
    if isinstance(value, str):
        close = difflib.get_close_matches(value.lower(), allowed, n=1)
        if close:
            needed += f" (did you mean {close[0]!r}?)"
    raise ArgumentError(name, f"is {_shown(value)}", needed)


def as_positive(name: str, value: object, *, zero: bool = False) -> float:
    """Check a positive finite number.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    value : object
        What the caller gave; any real scalar type but bool.
    zero : bool
        Accept zero as well.

    Returns
    -------
    float
        The number.

    Raises
    ------
    ArgumentError
        If it is not a number, not finite, or not positive.
    """
    needed = "a finite number >= 0" if zero else "a finite number > 0"
    try:
        scalar = np.asarray(value)
        if scalar.ndim != 0 or scalar.dtype.kind not in "iuf":
            raise TypeError
        number = float(scalar)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(name, f"is {_shown(value)}", needed) from None
    if not np.isfinite(number) or number < 0.0 or (number == 0.0 and not zero):
        raise ArgumentError(name, f"is {number!r}", needed)
    return number


def as_count(name: str, value: object, *, at_least: int = 1) -> int:
    """Check a whole number with a lower bound.

    Parameters
    ----------
    name : str
        Name of the argument for the message.
    value : object
        What the caller gave; any integer type but bool.
    at_least : int
        Smallest number accepted.

    Returns
    -------
    int
        The number.

    Raises
    ------
    ArgumentError
        If it is not an integer, or too small.
    """
    needed = f"an integer >= {at_least}"
    if isinstance(value, bool | np.bool_):
        raise ArgumentError(name, f"is {_shown(value)}", needed)
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise ArgumentError(name, f"is {_shown(value)}", needed) from None
    if number < at_least:
        raise ArgumentError(name, f"is {number}", needed)
    return number


def _shown(value: object) -> str:
    """Print a caller's value, cut to a readable length."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
