"""Many pairs in one call give what one call a pair gives."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view import batch as batch_module

SIZES = (8, 40, 5, 20, 0)


@pytest.fixture(scope="module")
def ragged():
    scenes = [eg.two_view_scene(seed=k, n_points=max(size, 1)) for k, size in enumerate(SIZES)]
    x1 = np.concatenate([s.x1[:size] for s, size in zip(scenes, SIZES, strict=True)])
    x2 = np.concatenate([s.x2[:size] for s, size in zip(scenes, SIZES, strict=True)])
    return x1, x2, np.concatenate([[0], np.cumsum(SIZES)])


@pytest.mark.parametrize("workers", [1, 3])
def test_batch_equals_single_calls_bit_by_bit(ragged, workers):
    x1, x2, offsets = ragged
    batch = eg.refine_fundamental_batch(x1, x2, offsets, workers=workers)
    assert len(batch) == len(SIZES)
    for k, size in enumerate(SIZES):
        rows = slice(offsets[k], offsets[k + 1])
        if size < 8:
            continue
        single = eg.refine_fundamental(x1[rows], x2[rows])
        np.testing.assert_array_equal(batch.F[k], single.F)
        np.testing.assert_array_equal(batch.covariance[k], single.covariance)
        np.testing.assert_array_equal(batch.distances[rows], single.fun)
        assert (batch.cost[k], batch.nfev[k]) == (single.cost, single.nfev)
        assert (batch.status[k], batch.success[k]) == (single.status, single.success)


def test_a_pair_that_cannot_be_refined_is_named_and_does_not_stop_the_others(ragged):
    batch = eg.refine_fundamental_batch(*ragged)
    assert sorted(batch.reasons) == [2, 4]
    assert "at least 8" in batch.reasons[2]
    np.testing.assert_array_equal(batch.status > 0, [True, True, False, True, False])
    assert not batch.success[[2, 4]].any()
    assert not np.isnan(batch.F).any()
    assert all(int(status) in eg.BATCH_STATUS for status in batch.status)


def test_start_values_and_weights_go_to_their_pairs(ragged):
    x1, x2, offsets = ragged
    rows = slice(offsets[1], offsets[2])
    starts = np.tile(np.eye(3), (len(SIZES), 1, 1))
    starts[1] = eg.fundamental_8point(x1[rows], x2[rows])
    weights, options = np.linspace(0.5, 1.5, len(x1)), {"max_iter": 10}
    batch = eg.refine_fundamental_batch(x1, x2, offsets, starts, weights=weights, **options)
    single = eg.refine_fundamental(x1[rows], x2[rows], starts[1], weights=weights[rows], **options)
    np.testing.assert_array_equal(batch.F[1], single.F)


def test_flags_are_those_of_single_calls_where_asked_for(ragged):
    x1, x2, offsets = ragged
    flags = eg.refine_fundamental_batch(x1, x2, offsets, flags=True).flags
    single = eg.refine_fundamental(x1[: offsets[1]], x2[: offsets[1]])
    assert flags[0] == single.flags
    assert "few matches" in flags[0]
    assert flags[2] == flags[4] == ()
    later = eg.refine_fundamental_batch(x1, x2, offsets)
    assert "flags" not in vars(later)
    assert later.flags == flags


def test_progress_counts_to_the_number_of_pairs(ragged):
    calls = []
    eg.refine_fundamental_batch(*ragged, workers=2, progress=lambda *counts: calls.append(counts))
    assert calls == [(k + 1, len(SIZES)) for k in range(len(SIZES))]


def test_a_callback_hears_of_the_given_pairs_only(ragged):
    x1, x2, offsets = ragged
    rows = []
    batch = eg.refine_fundamental_batch(x1, x2, offsets, callback=rows.append)
    assert len(rows) == batch.nfev.sum()
    assert sum(row.iteration == 0 for row in rows) == np.sum(batch.status > 0)


def test_an_empty_batch_is_legal():
    batch = eg.refine_fundamental_batch(np.zeros((0, 2)), np.zeros((0, 2)), [0])
    assert len(batch) == 0
    assert batch.covariance.shape == (0, 9, 9)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"offsets": [0, 10]}, "offsets"),
        ({"offsets": [0, 60, 50, 93]}, "offsets"),
        ({"offsets": [0.0, 93.0]}, "offsets"),
        ({"F0": np.eye(3)}, "F0"),
        ({"criterion": "samson"}, "criterion"),
        ({"covariance2": np.tile(np.eye(2), (93, 1, 1))}, "covariance2 is one a match"),
        ({"workers": 0}, "workers"),
    ],
)
def test_bad_arguments_are_named_once_for_all_pairs(ragged, change, name):
    x1, x2, offsets = ragged
    arguments = {"offsets": offsets} | change
    with pytest.raises(eg.ArgumentError, match=name):
        eg.refine_fundamental_batch(x1, x2, **arguments)


@pytest.mark.parametrize("workers", [1, 2])
def test_pairs_beyond_the_first_chunk_have_starts_weights_and_results_of_their_own(
    monkeypatch, workers
):
    # The compiled loop takes some pairs at a time: three chunks, the last of a few; pairs of
    # several sizes, and pairs that are refused on both sides of every boundary.
    monkeypatch.setattr(batch_module, "_CHUNK", 8)
    rng = np.random.default_rng(2)
    sizes = rng.integers(9, 20, 19)
    sizes[[1, 6, 9, 15]] = 5
    scenes = [eg.two_view_scene(seed=k, n_points=int(size)) for k, size in enumerate(sizes)]
    x1, x2 = (np.concatenate([getattr(s, name) for s in scenes]) for name in ("x1", "x2"))
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    weights = rng.uniform(0.3, 3.0, len(x1))
    starts = np.stack(
        [eg.fundamental_8point(s.x1[:8], s.x2[:8]) if len(s.x1) >= 8 else np.eye(3) for s in scenes]
    )
    batch = eg.refine_fundamental_batch(
        x1, x2, offsets, starts, weights=weights, workers=workers, max_iter=3
    )
    assert sorted(batch.reasons) == [1, 6, 9, 15]
    for k in range(19):
        if k in batch.reasons:
            continue
        rows = slice(offsets[k], offsets[k + 1])
        single = eg.refine_fundamental(
            x1[rows], x2[rows], starts[k], weights=weights[rows], max_iter=3
        )
        np.testing.assert_array_equal(batch.F[k], single.F)
        np.testing.assert_array_equal(batch.distances[rows], single.fun)
        np.testing.assert_array_equal(batch.covariance[k], single.covariance)
        assert batch.rms_px[k] == single.rms_px
        assert batch.noise_px[k] == single.noise_px
        assert (batch.cost[k], batch.nfev[k]) == (single.cost, single.nfev)
        assert (batch.status[k], batch.success[k]) == (single.status, single.success)
        assert batch.success[k] == (batch.status[k] > 0)
    assert not batch.success.all()


@pytest.mark.parametrize("kind", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_an_executor_gives_the_same_batch(ragged, kind, monkeypatch):
    x1, x2, offsets = ragged
    monkeypatch.setattr(batch_module, "_PART", 2)
    expected = eg.refine_fundamental_batch(x1, x2, offsets, flags=True)
    done = []
    context = {} if kind is ThreadPoolExecutor else {"mp_context": get_context("spawn")}
    with kind(2, **context) as executor:
        batch = eg.refine_fundamental_batch(
            x1, x2, offsets, executor=executor, progress=lambda *counts: done.append(counts)
        )
    for name in ("F", "covariance", "distances", "rank", "nfev", "status", "success"):
        np.testing.assert_array_equal(getattr(batch, name), getattr(expected, name), err_msg=name)
    assert batch.flags == expected.flags
    assert batch.reasons == expected.reasons
    assert done == [(k + 1, len(SIZES)) for k in range(len(SIZES))]


def test_what_is_no_executor_is_named(ragged):
    with pytest.raises(eg.ArgumentError, match="submit"):
        eg.refine_fundamental_batch(*ragged, executor=4)
    with ThreadPoolExecutor(1) as executor, pytest.raises(eg.ArgumentError, match="callback"):
        eg.refine_fundamental_batch(*ragged, executor=executor, callback=print)
