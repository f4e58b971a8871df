"""Conversion and checks of arguments: done once, at the border of the library.

Each function returns the value in the one form that the rest of the library works with, or raises
`ArgumentError`, which names the argument, what it was and what is needed. No input is ever changed.
"""

from epigauge._arguments.convert import (
    MAX_PX,
    MIN_PX,
    as_array,
    as_calibration,
    as_double,
    as_fundamental,
    as_real,
    on_host,
    rescaled,
)
from epigauge._arguments.matches import (
    MAX_WEIGHT,
    as_covariances,
    as_matches,
    as_score,
    as_weights,
    check_general_position,
)
from epigauge._arguments.options import as_choice, as_count, as_positive

__all__ = [
    "MAX_PX",
    "MAX_WEIGHT",
    "MIN_PX",
    "as_array",
    "as_calibration",
    "as_choice",
    "as_count",
    "as_covariances",
    "as_double",
    "as_fundamental",
    "as_matches",
    "as_positive",
    "as_real",
    "as_score",
    "as_weights",
    "check_general_position",
    "on_host",
    "rescaled",
]
