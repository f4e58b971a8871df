"""`python tests/mutants planted|random`: plant faults one at a time, and say which no test notices.

Works on a copy of the checkout (build/mutants). Only tests that run the changed line are run, the
quickest first. Results are appended to a file of JSON lines; faults that it holds already are not
planted again, so that a long run can be done in pieces.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from faults import Fault, area, areas, planted_faults
from operators import drawn
from reach import Reach, recorded
from report import printed
from runs import PASSED, first_failure, prepare
from scratch import ROOT, CannotBuild, Scratch

#: Longest run of a stage: in seconds, and by what its tests take without the fault. An endless loop
#: is noticed.
_SECONDS, _TIMES = 60.0, 6.0

#: Tests of the stages take together at most so many seconds without the fault; those that would
#: take longer are not run, which can make survivors, but no faults noticed.
_STAGES = 2.0, 12.0, 60.0

#: A test of a file that the area does not name is run as if it took so many times as long.
_FAR = 5.0


def main() -> int:
    """Return 1 when a fault survives that is not named as equivalent."""
    parser = argparse.ArgumentParser(prog="python tests/mutants", description=__doc__)
    parser.add_argument("what", choices=["planted", "random", "report"])
    parser.add_argument("--only", nargs="*", help="names of planted faults")
    parser.add_argument("--area", nargs="*", help="areas of areas.toml (random)")
    parser.add_argument("--count", type=int, default=30, help="random faults of each area")
    parser.add_argument("--lines", default="", help="random faults in lines with this pattern only")
    parser.add_argument("--near", action="store_true", help="only tests that the areas name")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="plant survivors once more")
    parser.add_argument("--scratch", type=Path, default=ROOT / "build" / "mutants")
    parser.add_argument("--results", type=Path, default=None, help="JSON lines")
    options = parser.parse_args()
    options.scratch.mkdir(parents=True, exist_ok=True)
    if options.what == "report":
        files = [options.results] if options.results else sorted(options.scratch.glob("*.jsonl"))
        return max(printed(f"## {path.stem}", list(_done(path).values())) for path in files)
    results = options.results or options.scratch / f"{options.what}.jsonl"
    prepare()
    scratch = Scratch.made(options.scratch)
    if options.what == "planted":
        faults = _planted(scratch.path, options.only)
    else:
        faults = _random(scratch.path, options)
    of = {str(area(fault.file)["name"]) for fault in faults}
    reach = recorded(scratch, _test_files(scratch.path, of if options.near else None))
    for name in reach.broken:
        print(f"left out, since it fails without any fault: {name}")
    done = _done(results)
    if options.again or options.only:
        done = {key: row for key, row in done.items() if row["verdict"] == "killed"}
    rows = []
    sound: set[str] = set()
    for number, fault in enumerate(faults, 1):
        text = (scratch.path / fault.file).read_text()
        row = done.get((fault.file, *fault.lines(text), _before(fault, text)))
        if row is None:
            row = _noticed(scratch, fault, text, reach, sound)
            with results.open("a") as file:
                file.write(json.dumps(row) + "\n")
        rows.append(row)
        print(
            f"{number}/{len(faults)} {row['verdict']:9} {row['seconds']:5.1f} s {fault.name} "
            f"{fault.file}:{row['line']} {fault.what} [{str(row['detail'])[-90:]}]",
            flush=True,
        )
    return printed(f"## {options.what}", rows)


def _planted(root: Path, only: list[str] | None) -> list[Fault]:
    found = list(planted_faults(root))
    for sentence in (entry for entry in found if isinstance(entry, str)):
        print(sentence)
    faults = [fault for fault in found if isinstance(fault, Fault)]
    return [fault for fault in faults if not only or fault.name in only]


def _random(root: Path, options: argparse.Namespace) -> list[Fault]:
    paths = sorted((root / "runtime").rglob("*.*"))
    names = [
        path.relative_to(root).as_posix() for path in paths if path.suffix in (".py", ".c", ".h")
    ]
    faults = []
    for entry in areas():
        if entry["name"] in options.area if options.area else entry.get("random", True):
            files = {
                name: (root / name).read_text()
                for name in names
                if name.split("/")[1] in ("epigauge", "c") and _is_of(name, entry["name"])
            }
            for k, (name, change) in enumerate(
                drawn(files, options.count, options.seed, re.compile(options.lines))
            ):
                old = files[name][change.begin : change.end]
                what = f"{change.kind}: {old!r} -> {change.new!r}"
                label = f"R{options.seed}.{k}"
                faults.append(Fault(label, what, name, change.begin, change.end, change.new))
    return faults


def _is_of(file: str, name: str) -> bool:
    try:
        return bool(area(file)["name"] == name)
    except ValueError:
        return False


def _test_files(root: Path, of: set[str] | None) -> list[str]:
    """Return the files of tests that some areas name, or all."""
    chosen = [entry for entry in areas() if of is None or entry["name"] in of]
    named = {f"tests/{test}" for entry in chosen for test in entry["tests"]}
    return sorted(name for name in named if (root / name).is_file())


def _noticed(
    scratch: Scratch, fault: Fault, text: str, reach: Reach, sound: set[str]
) -> dict[str, object]:
    """Return what comes of a fault; a test that fails without it, too, does not count."""
    while True:
        row = _tried(scratch, fault, text, reach)
        test = str(row["detail"])
        if row["verdict"] != "killed" or test not in reach.seconds or test in sound:
            return row
        if first_failure(scratch, [test], _SECONDS)[0] == PASSED:
            sound.add(test)
            return row
        print(f"left out, since it fails without any fault: {test}", flush=True)
        del reach.seconds[test]


def _tried(scratch: Scratch, fault: Fault, text: str, reach: Reach) -> dict[str, object]:
    begun = time.perf_counter()
    old, new = fault.lines(text)
    row = {
        "name": fault.name,
        "what": fault.what,
        "file": fault.file,
        "line": text.count("\n", 0, fault.begin) + 1,
        "old": old,
        "new": new,
        "before": _before(fault, text),
    }
    try:
        scratch.write(fault.file, fault.planted(text))
        verdict, detail = PASSED, ""
        stages = _stages(scratch.path, fault, text, reach)
        for tests in stages:
            if verdict == PASSED:
                expected = sum(reach.seconds.get(test, _SECONDS) for test in tests)
                verdict, detail = first_failure(scratch, tests, _SECONDS + _TIMES * expected)
        if verdict == PASSED:
            detail = f"{sum(map(len, stages))} tests"
        row |= {"verdict": "survived" if verdict == PASSED else "killed", "detail": detail}
    except CannotBuild as error:
        row |= {"verdict": "invalid", "detail": str(error)}
    finally:
        scratch.write(fault.file, text)
    return row | {"seconds": round(time.perf_counter() - begun, 1)}


def _stages(root: Path, fault: Fault, text: str, reach: Reach) -> list[list[str]]:
    """Return the tests for a fault in the order in which they are run."""
    here = area(fault.file)
    whole = [f"tests/{name}" for name in here["tests"]]
    if fault.file.endswith(".py") and (lines := _statement(fault, text)):
        tests = reach.of_lines(fault.file, lines) or reach.of_file(fault.file)
    else:  # what is done at import, or in C
        tests = {test for test in reach.seconds if test.split("::")[0] in whole}
        for module in here.get("through", [fault.file]):
            tests |= reach.of_file(module)
    if fault.file.startswith("derive/"):
        return [[name] for name in whole if (root / name).exists()]

    def price(test: str) -> float:
        near = 1.0 if test.split("::")[0] in whole else _FAR
        return reach.seconds[test] * reach.breadth.get(test, 1) * near  # small ones aim best

    stages: list[list[str]] = [[] for _ in _STAGES]
    total = 0.0
    for test in sorted(tests, key=price):
        total += reach.seconds[test]
        if total <= _STAGES[-1]:
            stages[sum(total > limit for limit in _STAGES)].append(test)
    return [sorted(stage) for stage in stages if stage]


def _statement(fault: Fault, text: str) -> list[str]:
    """Return the lines of the statement that a fault stands in; none at the level of a module.

    Of a compound statement (if, for, with) only its heading counts; a default of an argument runs
    when a module is imported.
    """
    first = text.count("\n", 0, fault.begin) + 1
    last = text.count("\n", 0, fault.end) + 1
    found: list[str] = []
    lines = text.splitlines()

    def visit(node: ast.AST, inside: bool) -> None:
        nonlocal found
        inside = inside or isinstance(node, ast.FunctionDef)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt):
                body = getattr(child, "body", None)
                end = body[0].lineno - 1 if body else child.end_lineno
                if inside and child.lineno <= first and last <= max(end, child.lineno):
                    function = isinstance(child, ast.FunctionDef | ast.ClassDef)
                    found = [] if function else lines[child.lineno - 1 : max(end, child.lineno)]
            visit(child, inside)

    visit(ast.parse(text), False)
    alone = [line for line in found if text.count(line) == 1]
    return alone or found


def _done(results: Path) -> dict[tuple[object, ...], dict[str, object]]:
    if not results.exists():
        return {}
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    return {(row["file"], row["old"], row["new"], row.get("before", 0)): row for row in rows}


def _before(fault: Fault, text: str) -> int:
    """Return how often the line of a fault stands above it: a name that other changes leave."""
    return text.count(fault.lines(text)[0], 0, text.rfind("\n", 0, fault.begin) + 1)


if __name__ == "__main__":
    sys.exit(main())
