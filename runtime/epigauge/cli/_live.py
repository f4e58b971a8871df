"""What people see of an adjustment while it runs, and how they stop it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from epigauge import lm

__all__ = ["Watch", "watching"]


class Watch:
    """Callback of `bundle_adjust` that tells each evaluation and stops it after an interrupt.

    Parameters
    ----------
    observations : int
        Their number, which makes an RMS of a cost (robust and weighted, if the cost is).
    tell : callable, optional
        Where to tell in a line what is being done.

    Attributes
    ----------
    interrupted : bool
        Whether the user has asked to stop.
    """

    def __init__(self, observations: int, tell: Callable[[str], object] | None = None) -> None:
        self.interrupted = False
        self._estimate = False
        self._observations, self._tell = observations, tell
        self._what = ""
        self._best: float | None = None

    def begin(self, what: str = "") -> bool:
        """Say what comes next; return whether it should not."""
        self._what, self._best = f"{what}: " if what else "", None
        if self._tell is not None:
            self._tell(f"{self._what}evaluation 1")
        return self.interrupted

    def __call__(self, row: lm.Row) -> bool:
        """Take a row of the history; return whether to stop."""
        self._estimate = True
        before, self._best = self._best, row.cost if row.accepted else self._best
        if self._tell is not None and self._best is not None:
            rms = float(np.sqrt(self._best / self._observations))
            words = [
                f"{self._what}evaluation {row.iteration + 1}",
                f"RMS {rms:.6f} px",
                f"cost {self._best:.8g} px\N{SUPERSCRIPT TWO}",
            ]
            if before is not None:
                words.append(
                    f"{1.0 - self._best / before:.0e} less" if row.accepted else "rejected"
                )
            self._tell("  ".join(words))
        return self.interrupted

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle Ctrl-C: stop after this evaluation, or at once where there is nothing to save."""
        if self.interrupted or not self._estimate:
            raise KeyboardInterrupt
        self.interrupted = True
        if self._tell is not None:
            self._tell("stopping after this evaluation; Ctrl-C again: at once, without a result")


@contextmanager
def watching(out: Console, observations: int, what: str, wanted: bool = True) -> Iterator[Watch]:
    """Show on one line of a terminal what is being done, and let Ctrl-C end it with a result.

    Parameters
    ----------
    out : Console
        For people; where it is no terminal nothing is shown.
    observations : int
        Number of observations.
    what : str
        What is done first.
    wanted : bool
        Whether to show anything.

    Yields
    ------
    Watch
        Callback of `bundle_adjust`. Until it is called first, and when pressed twice, Ctrl-C
        raises KeyboardInterrupt as ever.
    """
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    hidden = not (wanted and out.is_terminal)
    with Progress(*columns, console=out, transient=True, disable=hidden) as line:
        task = line.add_task(what)

        def tell(text: str) -> None:
            line.update(task, description=escape(text))

        watch = Watch(observations, None if hidden else tell)
        with _handled(watch.interrupt):
            yield watch


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle interrupts by a function; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
