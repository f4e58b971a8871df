"""Ctrl-C while a command works: exit code 130, one line, and no file that is half-written."""

from __future__ import annotations

import csv
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from colmap_databases import Project
from epigauge.io import Matches, save_matches

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal"),
]

#: Seconds that a command may take to begin, and to end when it is told to.
PATIENCE_S = 60.0


def interrupt(folder: Path, arguments: str, ready: Callable[[], bool]) -> str:
    """Run a command in a folder, press Ctrl-C as soon as it is `ready`; return its stderr."""
    command = [sys.executable, "-m", "epigauge", *arguments.split()]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=folder, **pipes) as process:
        try:
            last = time.monotonic() + PATIENCE_S
            while not ready():
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < last, "has not begun"
                time.sleep(0.002)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 130, (process.returncode, errors)
    assert "Traceback" not in errors
    assert "interrupted" in errors
    return errors


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def half_written(folder: Path) -> Callable[[], bool]:
    """Return whether a file is just being written."""
    return lambda: any(path.suffix == ".tmp" for path in folder.iterdir())


@pytest.mark.parametrize("output", ["result.npz", "result.json"])
def test_refine_interrupted_while_saving_leaves_the_old_file(tmp_path, output) -> None:
    scene = eg.two_view_scene(n_points=20_000)
    save_matches(tmp_path / "m.npz", Matches(scene.x1, scene.x2))
    (tmp_path / output).write_text("old")
    before = content(tmp_path)
    interrupt(tmp_path, f"refine m.npz -o {output}", half_written(tmp_path))
    assert content(tmp_path) == before


def test_bundle_interrupted_while_saving_leaves_nothing(tmp_path) -> None:
    scene = eg.multi_view_scene(n_views=10, n_points=5_000, noise_px=0.1, seed=1)
    eg.save_tracks(tmp_path / "t.npz", scene.tracks, scene.true)
    before = content(tmp_path)
    interrupt(tmp_path, "bundle t.npz --start t.npz --max-iter 1 -o r.npz", half_written(tmp_path))
    assert content(tmp_path) == before


def test_colmap_interrupted_leaves_the_database_as_it_was(tmp_path) -> None:
    path = Project(n_views=16, n_points=40).write(tmp_path / "d.db")
    before = content(tmp_path)

    def locked() -> bool:
        connection = sqlite3.connect(path, timeout=0, isolation_level=None)
        try:
            connection.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            return True
        else:
            return False
        finally:
            connection.close()

    # NumPy, for which 120 pairs take seconds
    interrupt(tmp_path, "colmap d.db --write --workers 2 --backend numpy", locked)
    assert content(tmp_path) == before


def test_reproduce_interrupted_leaves_whole_files(tmp_path) -> None:
    folder = tmp_path / "bs2004"
    interrupt(
        tmp_path,
        "reproduce bs2004 --trials 1 --only minima,dampings",
        lambda: any(folder.glob("*.csv")),
    )
    assert not list(tmp_path.rglob("*.tmp"))
    assert not (tmp_path / "bs2004.md").exists()
    for path in folder.glob("*.csv"):
        assert len({len(row) for row in csv.reader(path.read_text().splitlines())}) == 1
        assert path.read_bytes().endswith(b"\n")


def test_interrupt_while_starting_ends_quietly(tmp_path) -> None:
    begun = time.monotonic()
    np.savetxt(tmp_path / "m.csv", np.zeros((8, 4)), delimiter=",")
    command = [sys.executable, "-m", "epigauge", "refine", "m.csv"]
    for delay in (0.15, 0.3, 0.45):
        with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
            time.sleep(delay)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=PATIENCE_S)
        # Before `main` is reached, it is Python that is interrupted.
        assert process.returncode in (-signal.SIGINT, 130, 2), errors
        if process.returncode == 130:
            assert "Traceback" not in errors
    assert time.monotonic() - begun < PATIENCE_S
