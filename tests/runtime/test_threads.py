"""Threads that call at once get what one after the other gets, from the first call on."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.two_view.batch import _Work

PAIRS = [eg.two_view_scene(distance=6.0, noise_px=1.0, n_points=40, seed=k) for k in range(6)]
MANY = eg.multi_view_scene(n_views=5, n_points=30, distance=5.0, seed=1)
X1, X2 = (np.concatenate([getattr(pair, name) for pair in PAIRS]) for name in ("x1", "x2"))
OFFSETS = np.arange(0, 241, 40)

BACKENDS = [name for name, reason in kernels.available().items() if reason is None]


def jobs(backend: str) -> list[Callable[[], Any]]:
    """Return calls of every kind; none depends on another."""
    variants = ({}, {"loss": "huber"}, {"structure": "joint", "max_iter": 3})
    adjust = partial(eg.bundle_adjust, MANY.tracks, max_iter=4, backend=backend)
    return [
        *(
            partial(eg.refine_fundamental, pair.x1, pair.x2, backend=backend, **options)
            for pair in PAIRS[:2]
            for options in variants
        ),
        partial(eg.refine_fundamental_batch, X1, X2, OFFSETS, workers=3, backend=backend),
        *(partial(adjust, method=method) for method in ("covariant", "free")),
        partial(eg.reprojection_distances, PAIRS[0].F_true, PAIRS[0].x1, PAIRS[0].x2),
    ]


def numbers(result: Any) -> Iterator[Any]:
    """Yield the arrays and numbers of a result that do not tell the time."""
    if isinstance(result, tuple):
        yield from result
        return
    for field in dataclasses.fields(result):
        value = getattr(result, field.name)
        if isinstance(value, eg.Reconstruction):
            yield from (value.P, value.Q)
        elif isinstance(value, np.ndarray | float | int | np.generic):
            yield value


def assert_same(one: Any, other: Any) -> None:
    for a, b in zip(numbers(one), numbers(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.fixture
def hurried() -> Iterator[None]:
    """Let threads take turns far more often than usual."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("backend", BACKENDS)
def test_threads_at_once_give_the_bits_of_one(hurried, backend) -> None:
    work = jobs(backend)
    expected = [job() for job in work]
    with ThreadPoolExecutor(8) as pool:
        for one, other in zip(expected, pool.map(lambda job: job(), work), strict=True):
            assert_same(one, other)


FIRST = """
import sys, threading
import numpy as np
sys.setswitchinterval(1e-5)
scene = dict(np.load(sys.argv[1]))  # read now: an archive is for one thread
barrier, found = threading.Barrier(8), [None] * 8
import epigauge as eg

def call(k):
    barrier.wait()
    found[k] = eg.refine_fundamental(scene["x1"], scene["x2"], backend=sys.argv[2]).F

threads = [threading.Thread(target=call, args=(k,)) for k in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert all(np.array_equal(F, found[0]) for F in found), found
print(" ".join(map(repr, found[0].ravel().tolist())))
"""


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_first_call_may_be_made_by_several_threads(tmp_path, backend) -> None:
    np.savez(tmp_path / "scene.npz", x1=PAIRS[0].x1, x2=PAIRS[0].x2)
    command = [sys.executable, "-c", FIRST, str(tmp_path / "scene.npz"), backend]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    F = np.array(run.stdout.split(), float).reshape(3, 3)
    expected = eg.refine_fundamental(PAIRS[0].x1, PAIRS[0].x2, backend=backend).F
    np.testing.assert_array_equal(F, expected)


def test_an_interrupted_batch_does_not_finish_the_rest(monkeypatch) -> None:
    done: list[range] = []
    refine = _Work.refine
    monkeypatch.setattr(
        _Work, "refine", lambda self, chunk: (done.append(chunk), refine(self, chunk))
    )

    def interrupt(*_: int) -> None:
        raise KeyboardInterrupt

    bounds = np.arange(0, 40 * 200 + 1, 40)
    x1, x2 = (np.tile(x[:40], (200, 1)) for x in (X1, X2))
    with pytest.raises(KeyboardInterrupt):
        eg.refine_fundamental_batch(x1, x2, bounds, backend="numpy", progress=interrupt)
    assert len(done) < 100
