"""`python tests/mutants planted|random`: plant faults one at a time, and say which no test notices.

Works on a copy of the checkout (build/mutants). Results are appended to a JSON-lines file; faults
that it holds already are not planted again, so that a long run can be done in pieces.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import tomllib
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from faults import HERE, Fault, files_tests, planted_faults
from operators import drawn
from scratch import PASSED, ROOT, CannotBuild, Scratch

#: Longest run of the tests of an area with a fault; an endless loop is noticed.
_SECONDS = 300.0


def main() -> int:
    """Return 1 when a fault survives that is not named as equivalent."""
    parser = argparse.ArgumentParser(prog="python tests/mutants", description=__doc__)
    parser.add_argument("what", choices=["planted", "random", "report"])
    parser.add_argument("--only", nargs="*", help="names of planted faults")
    parser.add_argument("--area", nargs="*", help="areas of areas.toml (random)")
    parser.add_argument("--count", type=int, default=200, help="random faults to draw")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="plant survivors once more")
    parser.add_argument("--scratch", type=Path, default=ROOT / "build" / "mutants")
    parser.add_argument("--results", type=Path, default=None, help="JSON lines")
    options = parser.parse_args()
    results = options.results or options.scratch / f"{options.what}.jsonl"
    if options.what == "report":
        return _report([json.loads(line) for line in results.read_text().splitlines()])
    scratch = Scratch.made(options.scratch)
    if options.what == "planted":
        found = list(planted_faults(scratch.path))
        for sentence in (entry for entry in found if isinstance(entry, str)):
            print(sentence)
        faults = [fault for fault in found if isinstance(fault, Fault)]
        faults = [fault for fault in faults if not options.only or fault.name in options.only]
    else:
        faults = _random(scratch.path, options.area, options.count, options.seed)
    done = _done(results) if options.what == "random" else {}
    if options.again:
        done = {key: row for key, row in done.items() if row["verdict"] != "survived"}
    rows = []
    sound: dict[str, bool] = {}
    for number, fault in enumerate(faults, 1):
        row = done.get(_identity(scratch.path, fault))
        if row is None:
            tests = _sound(scratch, fault.tests, sound)
            row = _tried(scratch, replace(fault, tests=tests))
        rows.append(row)
        if _identity(scratch.path, fault) not in done:
            with results.open("a") as file:
                file.write(json.dumps(row) + "\n")
        print(
            f"{number}/{len(faults)} {row['verdict']:9} {row['seconds']:5.1f} s {row['name']} "
            f"{row['file']}:{row['line']} {row['what']} [{row['detail'][-90:]}]",
            flush=True,
        )
    return _report(rows)


def _random(root: Path, areas: list[str] | None, count: int, seed: int) -> list[Fault]:
    known = tomllib.loads((HERE / "areas.toml").read_text())
    chosen = [a for a in known["area"] if (a["name"] in areas if areas else a.get("random", True))]
    files = {}
    for path in sorted((root / "runtime").rglob("*.*")):
        name = path.relative_to(root).as_posix()
        first = next((a for a in known["area"] if any(fnmatch(name, p) for p in a["files"])), None)
        if first in chosen and path.suffix in (".py", ".c", ".h") and "sitecustomize" not in name:
            files[name] = path.read_text()
    return [
        Fault(
            f"R{seed}.{k}",
            change.kind,
            name,
            change.begin,
            change.end,
            change.new,
            files_tests(root, name, ()),
        )
        for k, (name, change) in enumerate(drawn(files, count, seed))
    ]


def _sound(scratch: Scratch, tests: list[str], known: dict[str, bool]) -> list[str]:
    """Return the tests that pass without any fault; the others would notice everything."""
    for test in tests:
        if test not in known:
            verdict, detail = scratch.test([test], 4.0 * _SECONDS)
            known[test] = verdict == PASSED
            if not known[test]:
                print(f"left out, since it fails without any fault: {detail}", flush=True)
    return [test for test in tests if known[test]]


def _tried(scratch: Scratch, fault: Fault) -> dict[str, object]:
    path = scratch.path / fault.file
    text = path.read_text()
    begun = time.perf_counter()
    row = _identity_row(text, fault)
    try:
        path.write_text(fault.planted(text))
        scratch.remake(fault.file)
        verdict, detail = scratch.test(fault.tests, _SECONDS)
        row |= {"verdict": "survived" if verdict == PASSED else "killed", "detail": detail}
    except CannotBuild as error:
        row |= {"verdict": "invalid", "detail": str(error)}
    finally:
        path.write_text(text)
        scratch.restore(fault.file)
    return row | {"seconds": round(time.perf_counter() - begun, 1)}


def _identity_row(text: str, fault: Fault) -> dict[str, object]:
    old = text[fault.begin : fault.end]
    first = text.rfind("\n", 0, fault.begin) + 1
    last = text.find("\n", fault.end)
    return {
        "name": fault.name,
        "what": f"{fault.what}: {old!r} -> {fault.new!r}",
        "file": fault.file,
        "line": text.count("\n", 0, fault.begin) + 1,
        "old": text[first:last].strip(),
        "new": (text[first : fault.begin] + fault.new + text[fault.end : last]).strip(),
    }


def _identity(root: Path, fault: Fault) -> tuple[object, ...]:
    row = _identity_row((root / fault.file).read_text(), fault)
    return row["file"], row["old"], row["new"]


def _done(results: Path) -> dict[tuple[object, ...], dict[str, object]]:
    if not results.exists():
        return {}
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    return {(row["file"], row["old"], row["new"]): row for row in rows}


def _report(rows: list[dict[str, object]]) -> int:
    """Print counts by area, and the survivors; return 1 where one is not equivalent."""
    areas = tomllib.loads((HERE / "areas.toml").read_text())["area"]
    equivalent = {
        (entry["old"], entry["new"]): entry["reason"]
        for entry in tomllib.loads((HERE / "equivalent.toml").read_text()).get("equivalent", [])
    }
    table: dict[str, list[int]] = {}
    survivors = []
    for row in rows:
        name = next(
            a["name"] for a in areas if any(fnmatch(str(row["file"]), p) for p in a["files"])
        )
        counts = table.setdefault(name, [0, 0, 0, 0])
        if row["verdict"] == "invalid":
            continue
        counts[0] += 1
        counts[1] += row["verdict"] == "killed"
        if row["verdict"] == "survived":
            same = (row["old"], row["new"]) in equivalent
            counts[2 if same else 3] += 1
            survivors += [] if same else [row]
    table["all"] = (
        [sum(column) for column in zip(*table.values(), strict=True)] if table else [0] * 4
    )
    print("\n| area | faults | noticed | equivalent | survived |\n|---|---:|---:|---:|---:|")
    for name, counts in table.items():
        print(f"| {name} | " + " | ".join(map(str, counts)) + " |")
    for row in survivors:
        print(f"\n{row['name']} {row['file']}:{row['line']}\n- {row['old']}\n+ {row['new']}")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main())
