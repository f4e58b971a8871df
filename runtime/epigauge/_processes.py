"""Processes that compute side by side what threads of one Python wait for each other with.

Those of `multiprocessing` run the caller's script again where they do not fork, and a fork of a
program with threads may hang. These are fresh Pythons that know this package only.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

__all__ = ["Processes", "serve"]

P = ParamSpec("P")
R = TypeVar("R")

#: What a process runs: it finds modules where this one does.
_PROGRAM = "import sys; sys.path[:] = {path!r}; from epigauge._processes import serve; serve()"


class Processes(Executor):
    """Executor of so many processes, for functions that can be imported.

    A thread hands each call to a process that is free, and waits for its answer.

    Parameters
    ----------
    count : int
        How many.

    Raises
    ------
    OSError
        If no process can be started here.
    """

    def __init__(self, count: int) -> None:
        if not sys.executable or getattr(sys, "frozen", False):
            raise OSError("this Python cannot start another")
        program = _PROGRAM.format(path=[str(Path(entry).absolute()) for entry in sys.path])
        self._all: list[subprocess.Popen[bytes]] = []
        self._free: queue.SimpleQueue[subprocess.Popen[bytes]] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(count)
        try:
            for _ in range(count):
                command = [sys.executable, "-c", program]
                pipe = subprocess.PIPE
                self._all.append(subprocess.Popen(command, stdin=pipe, stdout=pipe))
                self._free.put(self._all[-1])
        except OSError:
            self.shutdown()
            raise

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Call a function in a process."""
        return self._threads.submit(self._called, fn, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes once they have answered."""
        self._threads.shutdown(wait=True, cancel_futures=cancel_futures)
        for process in self._all:
            process.communicate()  # they end where nobody calls any more

    def _called(self, fn: Callable[..., R], args: Any, kwargs: Any) -> R:
        process = self._free.get()
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            try:
                pickle.dump((fn, args, kwargs), process.stdin)
                process.stdin.flush()
                done, value = pickle.load(process.stdout)  # noqa: S301 - of its own process
            except (EOFError, OSError) as error:
                raise BrokenExecutor("a process that computed has ended") from error
        finally:
            self._free.put(process)
        if not done:
            raise value
        found: R = value
        return found


def serve() -> None:
    """Answer calls from the standard input until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who calls
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)  # what is printed must not come between the answers
        while True:
            try:
                fn, args, kwargs = pickle.load(sys.stdin.buffer)  # noqa: S301 - of its parent
            except EOFError:
                return
            try:
                answer = pickle.dumps((True, fn(*args, **kwargs)))
            except BaseException as error:
                answer = pickle.dumps((False, error))
            answers.write(answer)
            answers.flush()
