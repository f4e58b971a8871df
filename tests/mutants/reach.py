"""Which test runs which line, and how long it takes: only tests that reach a fault are run."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from runs import OPTIONS, child
from scratch import Scratch

#: Longest run of one file of tests while its lines are recorded.
_SECONDS = 1500.0

#: Lines are known by file and text: they keep both when others above them change.
Line = tuple[str, str]


class Reach:
    """What the tests of some files reach.

    Attributes
    ----------
    seconds : dict of str to float
        How long each test takes; only those that pass without any fault.
    breadth : dict of str to int
        How many lines of the library each test runs.
    broken : list of str
        Tests that fail without any fault; they would notice everything.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.breadth: dict[str, int] = {}
        self.broken: list[str] = []
        self._lines: dict[str, dict[str, set[str]]] = {}

    def add(self, record: dict[str, Any]) -> None:
        """Take in what `recorded` found."""
        names = list(record["tests"])
        for name, (seconds, passed) in record["tests"].items():
            if passed:
                self.seconds[name] = seconds
            else:
                self.broken.append(name)
        for file, lines in record["lines"].items():
            mine = self._lines.setdefault(file, {})
            for text, tests in lines.items():
                for k in tests:
                    self.breadth[names[k]] = self.breadth.get(names[k], 0) + 1
                mine.setdefault(text, set()).update(names[k] for k in tests)

    def of_lines(self, file: str, lines: Sequence[str]) -> set[str]:
        """Return the tests that run one of the lines of a file."""
        known = self._lines.get(file, {})
        return set().union(*(known.get(line.strip(), ()) for line in lines)) & set(self.seconds)

    def of_file(self, file: str) -> set[str]:
        """Return the tests that run any line of a file."""
        return set().union(*self._lines.get(file, {}).values()) & set(self.seconds)


def recorded(scratch: Scratch, files: Sequence[str]) -> Reach:
    """Run each file of tests once with its lines recorded, unless that is known already."""
    reach = Reach()
    folder = scratch.path / "reach"
    folder.mkdir(exist_ok=True)
    for name in files:
        digest = hashlib.sha256((scratch.path / name).read_bytes()).hexdigest()[:16]
        place = folder / f"{Path(name).stem}-{digest}.json"
        if not place.exists():
            begun = time.perf_counter()
            record = child(scratch, lambda name=name: _record(scratch.path, name), _SECONDS)
            if not isinstance(record, dict):
                raise RuntimeError(f"{name} cannot be recorded: {record}")
            print(f"recorded {name}: {time.perf_counter() - begun:.0f} s", flush=True)
            place.write_text(json.dumps(record))
        reach.add(json.loads(place.read_text()))
    return reach


class _Clock:
    """Plugin that tells the recorder which test runs, and notes time and outcome."""

    def __init__(self, recorder: Any) -> None:
        self.recorder = recorder
        self.tests: dict[str, list[Any]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self.recorder.switch_context(item.nodeid)
        self.tests[item.nodeid] = [0.0, True]
        begun = time.perf_counter()
        try:
            return (yield)
        finally:
            self.tests[item.nodeid][0] = round(time.perf_counter() - begun, 4)
            self.recorder.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.tests[report.nodeid][1] = False


def _record(root: Path, name: str) -> dict[str, Any]:
    import coverage

    recorder = coverage.Coverage(
        data_file=None, config_file=False, source=[str(root / "runtime" / "epigauge")]
    )
    clock = _Clock(recorder)
    recorder.start()
    pytest.main([*OPTIONS, name], plugins=[clock])
    recorder.stop()
    number = {test: k for k, test in enumerate(clock.tests)}
    found: dict[str, dict[str, list[int]]] = {}
    data = recorder.get_data()
    for path in data.measured_files():
        text = Path(path).read_text().splitlines()
        lines = found.setdefault(Path(path).relative_to(root).as_posix(), {})
        for line, contexts in data.contexts_by_lineno(path).items():
            tests = [number[context] for context in contexts if context]
            if tests:
                key = text[line - 1].strip()
                lines[key] = sorted({*lines.get(key, ()), *tests})
    return {"tests": clock.tests, "lines": found}
