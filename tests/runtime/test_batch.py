"""Many pairs in one call give what one call a pair gives."""

import epigauge as eg
import numpy as np
import pytest

SIZES = (8, 50, 5, 30, 0)


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
    np.testing.assert_array_equal(batch.success, [True, True, False, True, False])
    assert not np.isnan(batch.F).any()
    assert all(int(status) in eg.BATCH_STATUS for status in batch.status)


def test_start_values_and_weights_go_to_their_pairs(ragged):
    x1, x2, offsets = ragged
    rows = slice(offsets[1], offsets[2])
    starts = np.tile(np.eye(3), (len(SIZES), 1, 1))
    starts[1] = eg.fundamental_8point(x1[rows], x2[rows])
    weights = np.linspace(0.5, 1.5, len(x1))
    batch = eg.refine_fundamental_batch(x1, x2, offsets, starts, weights=weights)
    single = eg.refine_fundamental(x1[rows], x2[rows], starts[1], weights=weights[rows])
    np.testing.assert_array_equal(batch.F[1], single.F)


def test_flags_are_those_of_single_calls_where_asked_for(ragged):
    x1, x2, offsets = ragged
    flags = eg.refine_fundamental_batch(x1, x2, offsets, flags=True).flags
    single = eg.refine_fundamental(x1[: offsets[1]], x2[: offsets[1]])
    assert flags[0] == single.flags
    assert "few matches" in flags[0]
    assert flags[2] == flags[4] == ()
    assert eg.refine_fundamental_batch(x1, x2, offsets).flags == ((),) * len(SIZES)


def test_progress_counts_to_the_number_of_pairs(ragged):
    calls = []
    eg.refine_fundamental_batch(*ragged, workers=2, progress=lambda *counts: calls.append(counts))
    assert calls == [(k + 1, len(SIZES)) for k in range(len(SIZES))]


def test_a_callback_hears_of_the_given_pairs_only(ragged):
    x1, x2, offsets = ragged
    rows = []
    batch = eg.refine_fundamental_batch(x1, x2, offsets, callback=rows.append)
    assert len(rows) == batch.nfev.sum()
    assert sum(row.iteration == 0 for row in rows) == batch.success.sum()


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
        ({"workers": 0}, "workers"),
    ],
)
def test_bad_arguments_are_named_once_for_all_pairs(ragged, change, name):
    x1, x2, offsets = ragged
    arguments = {"offsets": offsets} | change
    with pytest.raises(eg.ArgumentError, match=name):
        eg.refine_fundamental_batch(x1, x2, **arguments)
