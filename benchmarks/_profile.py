"""Where the time of many views goes, by function of the C library."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from epigauge import _native


@contextmanager
def profiled() -> Iterator[Counter[str]]:
    """Count the seconds within every function of the C library that many views call."""
    spent: Counter[str] = Counter()

    def timed(name: str) -> Callable[..., Any]:
        call = original(name)

        def run(*arguments: Any) -> Any:
            begun = time.perf_counter()
            try:
                return call(*arguments)
            finally:
                spent[name] += time.perf_counter() - begun

        return run

    original = _native.function
    users = [m for m in list(sys.modules.values()) if getattr(m, "function", None) is original]
    for module in users:
        module.function = timed  # type: ignore[attr-defined]
    try:
        yield spent
    finally:
        for module in users:
            module.function = original  # type: ignore[attr-defined]
