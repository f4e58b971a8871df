"""What solvers tell by `logging`, under the name "epigauge": nothing unless it is asked for.

INFO has a line a result, DEBUG a line an evaluation of the cost as well:

>>> import logging
>>> logging.basicConfig(level=logging.INFO)  # doctest: +SKIP
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

__all__ = ["logged", "logger"]

P = ParamSpec("P")
R = TypeVar("R")

logger = logging.getLogger("epigauge")
logger.addHandler(logging.NullHandler())


def logged(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function log what it returns; where nobody listens that costs nothing."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if not logger.isEnabledFor(logging.INFO):
            return function(*args, **kwargs)
        begin = time.perf_counter()
        result = function(*args, **kwargs)
        _tell(function.__name__, result, time.perf_counter() - begin)
        return result

    return run


def _tell(name: str, result: Any, seconds: float) -> None:
    if logger.isEnabledFor(logging.DEBUG):
        for row in getattr(result, "history", ()):
            what = "accepted" if row.accepted else "rejected"
            form = "%s: step %d %s, cost %.8g px^2, lambda %.1e, length %.2e"
            logger.debug(form, name, row.iteration, what, row.cost, row.lam, row.step_norm)
    facts = [f"{seconds:.3g} s"]
    if hasattr(result, "nfev") and isinstance(result.nfev, int):
        facts = [f"RMS {result.rms_px:.6g} px", f"{result.nfev} evaluations", *facts]
    flags = getattr(result, "flags", ())
    if flags and all(isinstance(flag, str) for flag in flags):
        facts.append(f"flags: {', '.join(flags)}")
    logger.info("%s: %s, %s", name, result._heading(), ", ".join(facts))
