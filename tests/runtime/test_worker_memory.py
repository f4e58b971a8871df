"""The memory of a worker: kept while problems are there, given back with the last."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import resource
import numpy as np
from epigauge.distributed import memory

if memory._library() is None:
    raise SystemExit(77)

def faults():
    begin = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(100_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - begin

faults()
found = [faults()]
memory.keep()
faults()  # fetches what is kept from then on
found.append(faults())
memory.give_back()
found.append(faults())
print(*found)
"""


def test_a_worker_keeps_what_a_step_frees_and_gives_it_back() -> None:
    pytest.importorskip("distributed")
    environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}
    environment.pop("MALLOC_MMAP_THRESHOLD_", None)
    parts = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(parts, env=environment, capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip("needs the GNU C library")
    assert done.returncode == 0, done.stderr
    before, kept, after = map(int, done.stdout.split())
    # Twenty arrays of 195 pages.
    assert before > 2000
    assert kept < before / 4
    assert after > before / 2


def test_what_is_said_of_memory_otherwise_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    from epigauge.distributed import memory

    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "65536")
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "131072")
    assert memory._library() is None
    monkeypatch.delenv("MALLOC_MMAP_THRESHOLD_")
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_")
    assert memory._library() is None
