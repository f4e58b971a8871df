"""What the experiments of every report are run with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

__all__ = ["Experiments", "Track", "tracked"]

T = TypeVar("T")
Track = Callable[[Sequence[Any], str], Iterable[Any]]


def tracked(items: Sequence[T], _label: str) -> Iterable[T]:
    """Show no progress."""
    return items


@dataclass
class Experiments:
    """Trials, seeds and data.

    Parameters
    ----------
    trials : int
        Trials a configuration; trial k has the seed `seed` + k.
    seed : int
        First seed.
    data : path, optional
        Directory of measured data, or None where there is none.
    track : callable
        Wraps the items of a loop, given its label, to show progress.
    """

    trials: int = 10
    seed: int = 0
    data: Path | None = None
    track: Track = tracked

    def file(self, *names: str) -> Path | None:
        """Return a file of the measured data, or None where it is not there."""
        path = None if self.data is None else self.data.joinpath(*names)
        return path if path is not None and path.is_file() else None
