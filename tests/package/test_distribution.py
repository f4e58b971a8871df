"""Contents of the source distribution, and of the wheels built from it."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import epigauge
import pytest

pytestmark = pytest.mark.slow

CHECKOUT = Path(__file__).resolve().parents[2]
#: What manylinux2014 promises: any Linux since 2014 can load the libraries.
GLIBC = (2, 17)
PACKAGES = {"epigauge", "epigauge_generated", "epigauge_derive"}
LIBRARIES = {
    f"libepigauge_kernels{level}{suffix}"
    for level in ("", "_v3", "_v4")
    for suffix in (".so", ".dylib", ".dll")
}


def build(what: str, source: Path, target: Path, **environment: str) -> Path:
    """Build one distribution of `source` in its own environment and return it."""
    clean = {name: v for name, v in os.environ.items() if not name.startswith("EPIGAUGE_")}
    run = subprocess.run(
        [sys.executable, "-m", "build", f"--{what}", "--outdir", target, source],
        env=clean | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    (result,) = target.iterdir()
    return result


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("sdist", CHECKOUT, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def unpacked(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as archive:
        archive.extractall(target, filter="data")
    (folder,) = target.iterdir()
    return folder


def newest_glibc(wheel: Path) -> tuple[int, int]:
    """Return the newest version of glibc that a library in a wheel asks for."""
    with zipfile.ZipFile(wheel) as archive:
        found = [
            re.findall(rb"\bGLIBC_(\d+)\.(\d+)", archive.read(name))
            for name in archive.namelist()
            if name.endswith(".so")
        ]
    return max(((int(a), int(b)) for versions in found for a, b in versions), default=(0, 0))


def sources(folder: str) -> set[str]:
    """Files below a folder of the checkout, caches left out."""
    return {
        path.relative_to(CHECKOUT).as_posix()
        for path in (CHECKOUT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def wheel_names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def modules() -> set[str]:
    """Files of the three packages as they should lie in a wheel."""
    return {
        path.split("/", 1)[1]
        for folder in ("derive", "generated", "runtime")
        for path in sources(folder)
        if path.split("/")[1] in PACKAGES
    }


def test_sdist_holds_all_sources_and_no_results(unpacked: Path) -> None:
    names = {p.relative_to(unpacked).as_posix() for p in unpacked.rglob("*") if p.is_file()}
    expected = {"pyproject.toml", "CMakeLists.txt", "Makefile", "tox.ini", "LICENSE", "README.md"}
    for folder in ("derive", "generated", "runtime", "tests", "docs", "benchmarks"):
        expected |= sources(folder)
    ignored = {name for name in expected if name.startswith("docs/_build/")}
    assert not expected - ignored - names
    tops = {name.split("/")[0] for name in names}
    assert not {name for name in tops if name.startswith(".")}
    assert not tops & {"build", "demo", "dist"}


def test_wheel_from_sdist_holds_the_packages_and_the_libraries(
    unpacked: Path, tmp_path: Path
) -> None:
    wheel = build("wheel", unpacked, tmp_path)
    names = wheel_names(wheel)
    plain = {name for name in names if ".dist-info/" not in name}
    libraries = {name for name in plain if Path(name).name in LIBRARIES}
    assert plain - libraries == modules()
    if epigauge.backend() == "c":  # then the compiler that built it is at hand here, too
        assert {str(Path(name).parent) for name in libraries} == {"epigauge_generated/c_backend"}
        assert any(Path(name).stem == "libepigauge_kernels" for name in libraries)
        if platform.machine() in ("x86_64", "AMD64") and os.name == "posix":
            assert len(libraries) == 3
        assert wheel.name.startswith(f"epigauge-{epigauge.__version__}-py3-none-")
        assert not wheel.name.endswith("-any.whl")
        assert newest_glibc(wheel) <= GLIBC


@pytest.mark.parametrize(
    "environment",
    [{"EPIGAUGE_NO_C": "1"}, {"CC": str(Path(os.devnull) / "cc")}],
    ids=["asked for", "no compiler"],
)
def test_wheel_without_compiler_is_pure_python(
    unpacked: Path, tmp_path: Path, environment: dict[str, str]
) -> None:
    wheel = build("wheel", unpacked, tmp_path, **environment)
    assert wheel.name.endswith("-py3-none-any.whl")
    plain = {name for name in wheel_names(wheel) if ".dist-info/" not in name}
    note = {"epigauge_generated/c_backend/not_compiled.txt"} if "CC" in environment else set()
    assert plain == modules() | note
