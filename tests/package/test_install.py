"""The package as it is installed here: its back end and its console script.

tox says what to expect: EPIGAUGE_TEST_BACKEND and EPIGAUGE_REQUIRE_C (see tox.ini).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import epigauge
import pytest

BACKEND = os.environ.get("EPIGAUGE_TEST_BACKEND")
if not BACKEND and os.environ.get("EPIGAUGE_REQUIRE_C") == "1":
    BACKEND = "c"


@pytest.mark.skipif(not BACKEND, reason="the environment does not say what to expect")
def test_backend_is_the_installed_one() -> None:
    code = "import epigauge; print(epigauge.backend())"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == BACKEND


@pytest.mark.skipif(BACKEND != "numpy", reason="needs an install without the C library")
def test_absent_library_is_an_error_with_a_remedy() -> None:
    with pytest.raises(ValueError, match="compiler"):
        epigauge.set_backend("c")


def test_a_failed_compile_is_told_at_first_use() -> None:
    """By the note that the build leaves then; see test_distribution.py."""
    patched = "from epigauge import _library, kernels; _library._files = dict; "
    patched += "_library.failed = kernels.failed = lambda: True; "
    code = patched + "import epigauge; print(epigauge.backend(), epigauge.backend())"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["numpy", "numpy"]
    assert run.stderr.count("could not be compiled") == 1
    quiet = patched + "import epigauge; epigauge.set_backend('numpy'); epigauge.backend()"
    run = subprocess.run([sys.executable, "-c", quiet], capture_output=True, text=True, check=True)
    assert run.stderr == ""


def test_program_of_a_user_runs() -> None:
    """What `tox -e types` checks the types of."""
    program = Path(__file__).with_name("consumer.py")
    run = subprocess.run([sys.executable, program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def run_without(package: str, *command: str) -> subprocess.CompletedProcess[str]:
    """Run the command line with arguments `command` where `package` cannot be imported."""
    code = (
        f"import sys; sys.modules[{package!r}] = None; sys.argv = {['epigauge', *command]!r}\n"
        "from epigauge.__main__ import main; sys.exit(main())"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("package", ["typer", "rich"])
def test_console_script_without_its_packages_names_the_remedy(package: str) -> None:
    run = run_without(package, "info")
    assert run.returncode == 2
    assert "epigauge[cli]" in run.stderr
    assert "Traceback" not in run.stderr
    assert run.stdout == ""


def test_console_script_is_installed() -> None:
    script = shutil.which("epigauge", path=str(Path(sys.executable).parent))
    assert script
    run = subprocess.run([script, "--help"], capture_output=True, text=True, check=False)
    if os.environ.get("EPIGAUGE_TEST_EXTRAS") == "none":
        assert run.returncode == 2
        assert "epigauge[cli]" in run.stderr
    else:
        assert run.returncode == 0, run.stderr
        assert "refine" in run.stdout + run.stderr
