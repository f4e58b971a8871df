"""Databases by executors of every kind: the same rows, and whole whatever ends the run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from colmap_databases import Project
from epigauge.two_view import batch


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a database of 210 pairs."""
    return Project(n_views=21).write(tmp_path_factory.mktemp("many") / "database.db")


@pytest.fixture(scope="module")
def expected(many: Path) -> Any:
    return eg.colmap.refine_database(many)


def executor_of(kind: str, request: pytest.FixtureRequest) -> AbstractContextManager[Executor]:
    if kind == "threads":
        return ThreadPoolExecutor(3)
    if kind == "processes":
        return ProcessPoolExecutor(2, mp_context=get_context("spawn"))
    return nullcontext(request.getfixturevalue("client").get_executor())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["threads", "processes", "Dask"])
def test_every_executor_gives_the_same_rows(
    kind: str,
    many: Path,
    expected: Any,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(batch, "_PART", 16)  # 14 calls
    told: list[tuple[int, int]] = []
    with executor_of(kind, request) as executor:
        found = eg.colmap.refine_database(
            many, executor=executor, progress=lambda *counts: told.append(counts)
        )
    assert len(found) == 210
    assert told[-1] == (210, 210)
    for own in fields(expected):
        values = [getattr(one, own.name) for one in (found, expected)]
        if own.name != "seconds":
            np.testing.assert_array_equal(*values, err_msg=own.name)


KILLED = """
import os, signal, sys
from concurrent.futures import ThreadPoolExecutor
import epigauge as eg
from epigauge.io.colmap import ColmapDatabase

store = ColmapDatabase.store

def killed(self, pairs):
    self._connection.execute("PRAGMA cache_size = 1")  # changed pages go to the disk at once
    def some():
        for k, pair in enumerate(pairs):
            if k == 150:
                os.kill(os.getpid(), signal.SIGKILL)
            yield pair
    store(self, some())

ColmapDatabase.store = killed
with ThreadPoolExecutor(2) as executor:
    eg.colmap.refine_database(sys.argv[1], write=True, backup=False, executor=executor)
"""


@pytest.mark.slow
def test_the_command_line_computes_by_a_scheduler(many: Path, client: Any, run: Any) -> None:
    pytest.importorskip("typer", reason="the command line needs typer")
    there = "--scheduler", client.scheduler.address
    for options in ([], ["--from-matches"]):
        here = run("colmap", many, *options)
        assert run("colmap", many, *options, *there)[:2] == here[:2]
    code, _, told = run("colmap", many, *there, "--workers", "2")
    assert code == 2
    assert "--workers is given beside --scheduler" in told


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_killed_while_it_writes_what_executors_found_the_database_is_whole(
    tmp_path: Path, expected: Any
) -> None:
    path = Project(n_views=21).write(tmp_path / "database.db")
    search = os.pathsep.join([str(Path(eg.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(path)], env=os.environ | {"PYTHONPATH": search}
    )
    assert done.returncode == -signal.SIGKILL
    # Whoever may write takes back what was begun, and finds what was there before.
    found = eg.colmap.refine_database(path, write=True, backup=False)
    np.testing.assert_array_equal(found.F_before, expected.F_before)
    np.testing.assert_array_equal(found.F, expected.F)
    assert found.stored.all()
