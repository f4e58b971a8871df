"""Runs of pytest in forked children: what all tests import is imported once, the library anew."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import select
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from scratch import Scratch

#: What a run of the tests can say.
PASSED, FAILED, SLOW = "passed", "failed", "too slow"

#: Write nothing, rewrite no assertions: a verdict is all that is wanted.
OPTIONS = ("-q", "--assert=plain", "--tb=no", "-p", "no:cacheprovider", "-m", "not slow")

#: Slow to import, and used by tests of many files. The library itself is imported by each child.
_COMMON = (
    *("numpy", "scipy.optimize", "scipy.stats", "scipy.sparse.linalg", "hypothesis.extra.numpy"),
    *("cv2", "casadi", "matplotlib.figure", "typer", "rich.table", "xdist", "sqlite3"),
)


def prepare() -> None:
    """Import what children share; threads of linear algebra would not survive the fork."""
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    for name in _COMMON:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


class _First:
    """Plugin that keeps the name of the first test that fails."""

    def __init__(self) -> None:
        self.name = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.name:
            self.name = report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed and not self.name:
            self.name = report.nodeid


def first_failure(scratch: Scratch, tests: Sequence[str], seconds: float) -> tuple[str, str]:
    """Run tests until one fails.

    Returns
    -------
    verdict : {"passed", "failed", "too slow"}
        A fault that is not noticed has passed.
    detail : str
        Name of the test that failed.
    """

    def run() -> Any:
        plugin = _First()
        code = pytest.main([*OPTIONS, "-x", *tests], plugins=[plugin])
        return int(code), plugin.name

    answer = child(scratch, run, seconds)
    if answer is None:
        return SLOW, f"more than {seconds:.0f} s"
    code, name = answer
    return (PASSED, "") if code in (0, 5) else (FAILED, name or f"exit code {code}")


def child(scratch: Scratch, run: Callable[[], Any], seconds: float) -> Any:
    """Return what a function says (as JSON) in a child that sees the copy; None if too slow.

    A child that dies, for example by a fault in C, says (exit code, "").
    """
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _inside(scratch, run, writer)
    os.close(writer)
    text = b""
    slow = False
    with open(reader, "rb", buffering=0) as pipe:  # noqa: PTH123
        while not slow:
            ready = select.select([pipe], [], [], seconds)[0]
            slow = not ready
            part = pipe.read(1 << 20) if ready else b""
            if not part:
                break
            text += part
    if slow:
        os.killpg(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    if slow:
        return None
    return json.loads(text) if text else (os.waitstatus_to_exitcode(status), "")


def _inside(scratch: Scratch, run: Callable[[], Any], writer: int) -> None:
    try:
        os.setsid()
        log = os.open(scratch.path / "log.txt", os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.environ |= scratch.environment()
        os.chdir(scratch.path)
        sys.meta_path[:] = [
            finder
            for finder in sys.meta_path
            if "editable" not in f"{type(finder).__module__} {type(finder).__name__}".lower()
        ]
        sys.path[:0] = scratch.folders()
        importlib.invalidate_caches()
        answer = json.dumps(run()).encode()
        with open(writer, "wb") as pipe:
            pipe.write(answer)
    except BaseException:
        traceback.print_exc()
        os._exit(70)
    os._exit(0)
