"""A copy of the checkout in which faults are planted, with the variant of the C library it loads.

Python is imported from the copy (a `sitecustomize` takes editable installs out of the way). After a
fault in C only the files that it changes are compiled, with little optimisation.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

#: The folders copied; modules are found in their second level.
FOLDERS = ("derive", "generated", "runtime", "tests")

_SITE = """import sys
sys.meta_path[:] = [
    finder for finder in sys.meta_path
    if "editable" not in f"{type(finder).__module__} {type(finder).__name__}".lower()
]
"""


class CannotBuild(Exception):
    """A fault that does not compile or cannot be derived; it is no fault a test could miss."""


@dataclass(frozen=True)
class Scratch:
    """The copy, built and ready.

    Attributes
    ----------
    path : Path
        Its folder.
    """

    path: Path

    @staticmethod
    def made(path: Path) -> Scratch:
        """Copy the checkout and build its C library; objects there already are kept up to date."""
        scratch = Scratch(path)
        for name in FOLDERS:
            _mirror(ROOT / name, path / name)
        for name in ("CMakeLists.txt", "pyproject.toml", "CHANGELOG.md", "README.md", "LICENSE"):
            _refresh(ROOT / name, path / name)
        (path / "runtime" / "sitecustomize.py").write_text(_SITE)
        build = path / "build"
        _checked(["cmake", "-S", path, "-B", build, "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON"])
        scratch._link()
        # Without it the library does not ask whether it was built from the sources beside it.
        (path / "CMakeLists.txt").unlink()
        probe = "import epigauge, epigauge_generated as g; print(epigauge.__file__, g.__file__)"
        command = [sys.executable, "-c", probe]
        environment = os.environ | scratch.environment()
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        for name in done.stdout.split():
            if not Path(name).is_relative_to(path):
                raise RuntimeError(f"the tests would import {name}, not the copy in {path}")
        return scratch

    def write(self, name: str, text: str) -> None:
        """Write a source so that no cache takes it for what it was; bring up what it is for."""
        path = self.path / name
        path.write_text(text)
        Path(cache_from_source(str(path))).unlink(missing_ok=True)
        if name.startswith("derive/"):
            generated = self.path / "generated"
            command = [sys.executable, "-m", "epigauge_derive", "--output", generated]
            keep = {path: path.read_bytes() for path in generated.rglob("*.so")}
            _checked(command, "the derivation", os.environ | self.environment())
            for library, content in keep.items():
                library.write_bytes(content)
        if name.startswith("derive/") or name.endswith((".c", ".h")):
            self._link()

    def _link(self) -> None:
        """Compile what has changed since it was compiled last, with little optimisation; link."""
        build = self.path / "build"
        objects = []
        for command, source in self._commands():
            digest = hashlib.sha256()
            for path in _included(source, self.path):
                digest.update(path.read_bytes())
            made = build / f"{source.stem}-{digest.hexdigest()[:16]}.o"
            if not made.exists():
                _checked([*command, "-o", made, "-c", source], "the compiler")
            objects.append(made)
        folder = self.path / "generated" / "epigauge_generated" / "c_backend"
        # A new file each time: the one that is there may be in use.
        _checked([command[0], "-shared", "-o", folder / "new", *objects, "-lm"], "the linker")
        (folder / "new").replace(folder / "libepigauge_kernels.so")

    def _commands(self) -> Iterator[tuple[list[str], Path]]:
        """Yield how each file of the variant of this machine is compiled: AVX2 where it can."""
        known = json.loads((self.path / "build" / "compile_commands.json").read_text())
        cpu = Path("/proc/cpuinfo")
        avx2 = cpu.exists() and " avx2 " in cpu.read_text()
        by_target: dict[str, list[tuple[list[str], Path]]] = {}
        for entry in known:
            words = shlex.split(entry["command"])
            place = words.index("-o")
            target = words[place + 1].split("/")[1].removesuffix(".dir")
            options = [word if word != "-O3" else "-O1" for word in words[:place]]
            by_target.setdefault(target, []).append((options, Path(entry["file"])))
        wanted = "epigauge_kernels_v3" if avx2 else "epigauge_kernels"
        yield from by_target.get(wanted, by_target["epigauge_kernels"])
        yield from by_target["epigauge_digest"]

    def environment(self) -> dict[str, str]:
        """Return what has to be set so that Python finds the copy."""
        return {
            "PYTHONPATH": os.pathsep.join(self.folders()),
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
            "MPLBACKEND": "Agg",
            "EPIGAUGE_DATA": os.environ.get("EPIGAUGE_DATA", str(ROOT.parent / "shared/data")),
        }

    def folders(self) -> list[str]:
        """Return the folders in which the modules of the copy lie."""
        return [str(self.path / name) for name in ("runtime", "generated", "derive")]


def _included(source: Path, root: Path) -> list[Path]:
    """Return a C file and the headers that it includes, and those include."""
    found = [source]
    for path in found:
        for name in re.findall(r'#include "([\w.]+)"', path.read_text()):
            here = (root / folder / "c" / name for folder in ("runtime", "generated"))
            found += [header for header in here if header.exists() and header not in found]
    return found


def _checked(
    command: list[str | Path], what: str = "cmake", environment: dict[str, str] | None = None
) -> None:
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, env=environment
    )
    if done.returncode:
        raise CannotBuild(f"{what}: {(done.stderr or done.stdout).strip()[-300:]}")


def _refresh(source: Path, target: Path) -> None:
    """Copy a file where its content differs, so that builds see what has changed."""
    content = source.read_bytes()
    if not target.exists() or target.read_bytes() != content:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)


def _mirror(source: Path, target: Path) -> None:
    """Make a folder like another, but for libraries and bytecode."""
    wanted = set()
    for path in source.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".so":
            wanted.add(target / path.relative_to(source))
            _refresh(path, target / path.relative_to(source))
    for path in target.rglob("*"):
        stale = path.is_file() and path not in wanted and path.suffix not in (".so", ".pyc")
        if stale and path.name != "sitecustomize.py":
            path.unlink()
