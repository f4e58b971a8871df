"""Many pairs of raw matches in one call give what one call a pair gives."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view import robust_batch

SIZES = (60, 5, 200, 0, 90)


@pytest.fixture(scope="module")
def raw():
    """Return pairs, a third of their matches wrong; two of them have too few."""
    rng = np.random.default_rng(3)
    views = []
    for k, size in enumerate(SIZES):
        scene = eg.two_view_scene(seed=k, n_points=max(size, 1), noise_px=0.2)
        x1, x2 = scene.x1[:size].copy(), scene.x2[:size].copy()
        x2[::3] = rng.uniform(0.0, 500.0, x2[::3].shape)
        views.append((x1, x2))
    x1, x2 = (np.concatenate(x) for x in zip(*views, strict=True))
    return x1, x2, np.concatenate([[0], np.cumsum(SIZES)])


def the_same(one: eg.RobustBatch, other: eg.RobustBatch) -> None:
    for name in one.__dataclass_fields__:
        if name in ("flags", "reasons"):
            assert getattr(one, name) == getattr(other, name)
        else:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("workers", [1, 3])
def test_batch_equals_single_calls_bit_by_bit(raw, workers) -> None:
    x1, x2, offsets = raw
    score, weights = np.linspace(0.0, 1.0, len(x1)), np.linspace(0.5, 1.5, len(x1))
    more = {"score": score, "weights": weights}
    batch = eg.estimate_fundamental_batch(x1, x2, offsets, workers=workers, seed=4, **more)
    assert sorted(batch.reasons) == [1, 3]
    for k in (0, 2, 4):
        rows = slice(offsets[k], offsets[k + 1])
        own = {name: value[rows] for name, value in more.items()}
        single = eg.estimate_fundamental(x1[rows], x2[rows], seed=4, **own)
        for name in ("F", "sigma", "covariance", "condition"):
            np.testing.assert_array_equal(getattr(batch, name)[k], getattr(single, name))
        for name in ("cost", "noise_px", "rms_px", "threshold_px", "rank", "nfev", "status"):
            assert getattr(batch, name)[k] == getattr(single, name)
        np.testing.assert_array_equal(batch.inlier[rows], single.inlier)
        assert (batch.flags[k], batch.success[k]) == (single.flags, single.success)
        exact = eg.reprojection_distances(single.F, x1[rows], x2[rows])[0]
        np.testing.assert_allclose(np.abs(batch.distances[rows]), np.abs(exact), atol=1e-9)
        assert (np.abs(batch.distances[rows][single.inlier]) <= single.threshold_px).all()


def test_a_pair_that_cannot_be_estimated_is_named_and_does_not_stop_the_others(raw) -> None:
    batch = eg.estimate_fundamental_batch(*raw, flags=True)
    assert "at least 8" in batch.reasons[1]
    np.testing.assert_array_equal(batch.success, [True, False, True, False, True])
    assert not batch.F[[1, 3]].any()
    assert not batch.inlier[raw[2][1] : raw[2][2]].any()
    assert batch.flags[1] == batch.flags[3] == ()
    assert (batch.status[[1, 3]] == -9).all()
    assert "-9" not in str(batch)


@pytest.mark.study
@pytest.mark.parametrize("kind", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_an_executor_gives_the_same_batch(raw, kind, monkeypatch) -> None:
    monkeypatch.setattr(robust_batch, "_PART", 2)
    done: list[tuple[int, int]] = []
    context = {} if kind is ThreadPoolExecutor else {"mp_context": get_context("spawn")}
    with kind(2, **context) as executor:
        batch = eg.estimate_fundamental_batch(
            *raw, executor=executor, progress=lambda *counts: done.append(counts)
        )
    the_same(batch, eg.estimate_fundamental_batch(*raw))
    assert done == [(k + 1, len(SIZES)) for k in range(len(SIZES))]


def test_pairs_do_not_depend_on_each_other(raw) -> None:
    x1, x2, offsets = raw
    last = slice(offsets[4], offsets[5])
    alone = eg.estimate_fundamental_batch(x1[last], x2[last], [0, SIZES[4]])
    np.testing.assert_array_equal(alone.F[0], eg.estimate_fundamental_batch(*raw).F[4])


def test_an_empty_batch_is_legal() -> None:
    batch = eg.estimate_fundamental_batch(np.zeros((0, 2)), np.zeros((0, 2)), [0])
    assert len(batch) == len(batch.flags) == 0
    assert batch.covariance.shape == (0, 9, 9)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"offsets": [0, 10]}, "offsets"),
        ({"robust": "ransac"}, "robust"),
        ({"threshold_px": -1.0}, "threshold_px"),
        ({"score": [1.0]}, "score"),
        ({"weights": [1.0]}, "weights"),
        ({"seed": -1}, "seed"),
        ({"workers": 0}, "workers"),
        ({"executor": 4}, "submit"),
        ({"criterion": "samson"}, "criterion"),
        ({"covariance1": np.tile(np.eye(2), (9, 1, 1))}, "covariance1 is one a match"),
    ],
)
def test_bad_arguments_are_named_once_for_all_pairs(raw, change, name) -> None:
    x1, x2, offsets = raw
    with pytest.raises(eg.ArgumentError, match=name):
        eg.estimate_fundamental_batch(x1, x2, **({"offsets": offsets} | change))
