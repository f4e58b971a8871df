"""The benchmarks run, with whatever peers are installed. What they measure is not tested here."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER.is_dir(), reason="the benchmarks are not beside the tests"),
]


def run(script: str, *arguments: object) -> str:
    """Return what a benchmark prints."""
    command = [sys.executable, FOLDER / script, *arguments]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_two_views(tmp_path: Path) -> None:
    printed = run("two_views.py", "--quick", "--json", tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert "| epigauge, workers=2 |" in printed
    for rows in found["single"].values():
        assert {"epigauge", "epigauge, 8-point start included"} <= rows.keys()
        for name, row in rows.items():
            assert 0.0 < row["min_s"] <= row["median_s"], name
        # Whatever the others minimise, none finds less than the minimum, up to `ftol`.
        assert rows["epigauge"]["above_best"] <= 1e-9


def test_kernels(tmp_path: Path) -> None:
    printed = run("kernels.py", "--quick", "--json", tmp_path / "found.json")
    if "No compiled kernels" in printed:
        pytest.skip("the C library is not there")
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["limits"].keys() == {"dgemm", "triad"}
    for sizes in found["seconds"].values():
        assert all(min(times) > 0.0 for kernels in sizes.values() for times in kernels.values())
    assert "**Gauss-Newton evaluation**" in printed


def test_evaluations_has_rows_that_differ() -> None:
    """Other coordinates and another schedule reach the solver, compiled loop or not."""
    lines = run("evaluations.py", "--trials", 2).splitlines()[2:]
    rows = dict(line.strip("| ").split(" | ", 1) for line in lines)
    default = rows.pop("default")
    for name in ("schedule Nielsen", "origin at the centroid", "RMS 0.5", "RMS 4"):
        assert rows[name] != default, name


def test_many_views(tmp_path: Path) -> None:
    printed = run("many_views.py", "--quick", "--json", tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert "| n = 5, m = 100, Bartoli 2003 |" in printed
    for own in found["problems"].values():
        assert 0.0 < own["ms"] <= own["total_ms"]
        assert 0.0 < sum(own["shares"].values()) < 1.0
    small, large = found["growth"]
    assert small["mb"] < large["mb"]


def test_sequences(tmp_path: Path) -> None:
    run("sequences.py", "--quick", "--json", tmp_path / "found.json")
    for own in json.loads((tmp_path / "found.json").read_text()).values():
        assert own["nfev"] <= 25


def test_confidence() -> None:
    pytest.importorskip("scipy", reason="the constants are fitted by SciPy")
    printed = run("confidence.py", "--trials", 12)
    assert "| simulated, all kinds | 12 |" in printed
    assert "Fitted to all:" in printed


def test_cluster() -> None:
    pytest.importorskip("distributed")
    printed = run("cluster.py", "--observations", 4000, "--steps", 2, "--rounds", 1)
    assert "| 2 workers |" in printed
    printed = run("cluster.py", "--parts", "--observations", 4000, "--steps", 2)
    assert "peak memory" in printed
