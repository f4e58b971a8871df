"""A copy of the checkout in which faults are planted, and in which the tests run.

Python is imported from the copy (a `sitecustomize` takes editable installs out of the way), and the
C library is compiled there, one variant, file by file.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
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

#: What a run of the tests can say.
PASSED, FAILED, SLOW = "passed", "failed", "too slow"


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
        """Copy the checkout and build its C library; a library there already is kept up to date."""
        scratch = Scratch(path)
        for name in FOLDERS:
            _mirror(ROOT / name, path / name)
        for name in ("CMakeLists.txt", "pyproject.toml", "CHANGELOG.md", "README.md", "LICENSE"):
            _refresh(ROOT / name, path / name)
        (path / "runtime" / "sitecustomize.py").write_text(_SITE)
        build = path / "build"
        if not (build / "CMakeCache.txt").exists():
            launcher = shutil.which("ccache")
            options = [f"-DCMAKE_C_COMPILER_LAUNCHER={launcher}"] if launcher else []
            _checked(["cmake", "-S", path, "-B", build, "-DCMAKE_BUILD_TYPE=Release", *options])
        scratch.build()
        probe = "import epigauge, epigauge_generated as g; print(epigauge.__file__, g.__file__)"
        environment = scratch.environment()
        command = [sys.executable, "-c", probe]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        for name in done.stdout.split():
            if not Path(name).is_relative_to(path):
                raise RuntimeError(f"the tests would import {name}, not the copy in {path}")
        return scratch

    def build(self) -> None:
        """Compile what has changed, and put the library where the modules look for it."""
        build = self.path / "build"
        _checked(["cmake", "--build", build, "--target", "epigauge_kernels"], "the compiler")
        for library in build.glob("libepigauge_kernels.*"):
            target = self.path / "generated" / "epigauge_generated" / "c_backend" / library.name
            shutil.copyfile(library, target.with_name("new"))
            target.with_name("new").replace(target)

    def remake(self, name: str) -> None:
        """Bring up to date what a changed file is the source of."""
        if name.startswith("derive/"):
            generated = self.path / "generated"
            libraries = {path: path.read_bytes() for path in generated.rglob("lib*")}
            command = [sys.executable, "-m", "epigauge_derive", "--output", generated]
            _checked(command, "the derivation", self.environment())
            for path, content in libraries.items():
                path.write_bytes(content)
        if name.startswith("derive/") or name.endswith((".c", ".h")):
            self.build()

    def restore(self, name: str) -> None:
        """Undo `remake`, the file being as it was."""
        if name.startswith("derive/"):
            _mirror(ROOT / "generated", self.path / "generated")
        if name.startswith("derive/") or name.endswith((".c", ".h")):
            self.build()

    def test(self, tests: list[str], seconds: float) -> tuple[str, str]:
        """Run tests until the first failure: the first file, two more, then the rest.

        Files are collected before the first test runs, which takes longer than most faults live.

        Returns
        -------
        verdict : {"passed", "failed", "too slow"}
            A fault that is not noticed has passed.
        detail : str
            Name of the test that failed.
        """
        verdict = PASSED, ""
        for stage in (tests[:1], tests[1:3], tests[3:]):
            if stage and verdict[0] == PASSED:
                verdict = self._run(stage, seconds)
        return verdict

    def _run(self, tests: list[str], seconds: float) -> tuple[str, str]:
        options = ["-q", "-x", "-p", "no:cacheprovider", "--tb=no", "-m", "not slow"]
        command = [sys.executable, "-m", "pytest", *options, *tests]
        with subprocess.Popen(
            command,
            cwd=self.path,
            env=self.environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                text, _ = process.communicate(timeout=seconds)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
                return SLOW, f"more than {seconds:.0f} s"
        if process.returncode in (0, 5):
            return PASSED, text.strip().splitlines()[-1] if text.strip() else ""
        failed = [line for line in text.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return FAILED, failed[0].split(" - ")[0] if failed else f"exit code {process.returncode}"

    def environment(self) -> dict[str, str]:
        """Return the environment in which Python finds the copy."""
        folders = (self.path / name for name in ("runtime", "generated", "derive"))
        return os.environ | {
            "PYTHONPATH": os.pathsep.join(map(str, folders)),
            "PYTHONDONTWRITEBYTECODE": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
            "MPLBACKEND": "Agg",
            "EPIGAUGE_DATA": os.environ.get("EPIGAUGE_DATA", str(ROOT.parent / "shared/data")),
        }


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
        stale = path.is_file() and path not in wanted and path.suffix != ".so"
        if stale and path.name != "sitecustomize.py":
            path.unlink()
