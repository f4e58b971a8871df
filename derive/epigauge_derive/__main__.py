"""`python -m epigauge_derive`: write generated/, or with --check compare it byte by byte."""

from __future__ import annotations

import argparse
import difflib
import importlib
import pkgutil
import sys
from pathlib import Path

from epigauge_derive import emitters
from epigauge_derive.camera_model import camera_models
from epigauge_derive.kernel import kernels
from epigauge_derive.program import compile_kernel

_DEFAULT = Path(__file__).resolve().parents[2] / "generated"
#: What Python, and a library compiled in place, leave there.
_NOT_OURS, _COMPILED = ("__pycache__",), (".so", ".dylib", ".dll")


def generate() -> dict[str, str]:
    """Return the text of every generated file by its path below generated/."""
    programs = [compile_kernel(kernel) for kernel in kernels()]
    models = list(camera_models())
    files: dict[str, str] = {}
    for module in sorted(m.name for m in pkgutil.iter_modules(emitters.__path__)):
        if not module.startswith("_"):
            emitter = importlib.import_module(f"epigauge_derive.emitters.{module}")
            files |= emitter.emit(programs, models)
    return files


def existing(root: Path) -> set[str]:
    """Return the files that stand below `root` now."""
    return {
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.is_file()
        and path.suffix not in _COMPILED
        and not any(part in _NOT_OURS for part in path.parts)
    }


def write(root: Path, files: dict[str, str]) -> None:
    """Make `root` hold exactly `files`."""
    for stale in existing(root) - set(files):
        (root / stale).unlink()
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode())


def differences(root: Path, files: dict[str, str]) -> str:
    """Return a unified diff from what stands below `root` to what should."""
    lines: list[str] = []
    for name in sorted(existing(root) | set(files)):
        path = root / name
        # A byte that is no text shows as an escape.
        old = path.read_bytes().decode(errors="backslashreplace") if path.is_file() else None
        new = files.get(name)
        if old == new:
            continue
        diff = difflib.unified_diff(
            (old or "").splitlines(keepends=True),
            (new or "").splitlines(keepends=True),
            f"{name} (as it stands)" if old is not None else "missing",
            f"{name} (as derived)" if new is not None else "not derived any more",
        )
        lines += list(diff) or [f"{name}: empty file missing or left over\n"]
    return "".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the generator; return 1 when a check finds a difference."""
    parser = argparse.ArgumentParser(prog="python -m epigauge_derive", description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare only, write nothing")
    parser.add_argument("--output", type=Path, default=_DEFAULT, help="folder to write to")
    options = parser.parse_args(arguments)
    files = generate()
    if not options.check:
        write(options.output, files)
        print(f"{len(files)} files written to {options.output.name}/")
        return 0
    diff = differences(options.output, files)
    if diff:
        print(diff, end="")
        print("\ngenerated/ is not what derive/ derives. Repair it with: make derive")
        return 1
    print(f"{len(files)} generated files are up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
