"""A camera model is one file: the tutorial's, added to a copy, is derived and adjusted with."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import documents
import pytest

pytest.importorskip("sympy")

from epigauge_derive import __main__ as generator

CHECKOUT = Path(__file__).resolve().parents[2]
TUTORIAL = CHECKOUT / "docs" / "tutorials"

#: Runs a module or a file; PYTHONPATH goes first also where an editable install redirects imports.
_RUN = """
import runpy, sys
sys.meta_path[:] = [f for f in sys.meta_path if "Redirecting" not in type(f).__name__]
sys.argv[:] = sys.argv[1:]
run = runpy.run_path if sys.argv[0].endswith(".py") else runpy.run_module
run(sys.argv[0], run_name="__main__")
"""


def run(*arguments, paths):
    """Run a module or a file with folders before all others; return what it prints."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_camera_model_is_one_file(tmp_path):
    derive, generated = tmp_path / "derive", tmp_path / "generated"
    shutil.copytree(CHECKOUT / "derive", derive)
    model, *_ = documents.blocks(TUTORIAL / "camera.md")
    added = derive / "epigauge_derive" / "models" / "cameras" / "division.py"
    added.write_text(model.code)
    assert len(model.code.splitlines()) <= 40
    run("epigauge_derive", "--output", generated, paths=[derive])

    old = CHECKOUT / "generated"
    changed = {
        name
        for name in generator.existing(generated)
        if not (old / name).exists() or (old / name).read_bytes() != (generated / name).read_bytes()
    }
    backends = {
        f"epigauge_generated/{name}_backend/cameras_division.py" for name in ("numpy", "casadi")
    }
    tables = {
        "epigauge_generated/c_backend/__init__.py",
        "c/camera_models.c",
        "c/digest.c",
        "c/epigauge_kernels.h",
    }
    assert backends | tables | {"c/cameras_division.c", "latex/division_observe.tex"} <= changed
    assert {name for name in changed if "division" not in name} == tables | {
        "epigauge_generated/signatures.py"
    }
    if compiler := shutil.which("cc"):
        for name in ("camera_models.c", "cameras_division.c"):
            command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror"]
            command += ["-fopenmp-simd", "-fsyntax-only"]
            subprocess.run([*command, str(generated / "c" / name)], check=True)

    printed = run(TUTORIAL / "adjust_division.py", paths=[generated, CHECKOUT / "runtime"])
    said = (TUTORIAL / "camera.md").read_text().split("This prints `")[1].split("`")[0]
    documents.compare(printed, said, "adjust_division.py")
