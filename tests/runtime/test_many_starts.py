"""Starts without two strong views: from random cameras, all views at once."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest


def simulated(n_views, n_points, seed):
    return eg.multi_view_scene(n_views=n_views, n_points=n_points, seed=seed).tracks


@pytest.mark.parametrize("seed", [0, 1])
def test_random_cameras_lead_to_the_optimum(seed):
    tracks = simulated(6, 60, 3)
    best = eg.bundle_adjust(tracks)
    start = eg.initialize(tracks, method="factorization", seed=seed)
    found = eg.bundle_adjust(tracks, start)
    assert found.cost == pytest.approx(best.cost, rel=1e-6)


def test_seed_decides_and_the_same_one_gives_the_same_start():
    tracks = simulated(5, 40, 1)
    first, again, other = (
        eg.initialize(tracks, method="factorization", seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.P, again.P)
    assert not np.array_equal(first.P, other.P)


def test_registration_is_what_auto_does_where_it_succeeds():
    tracks = simulated(5, 40, 1)
    auto = eg.initialize(tracks)
    np.testing.assert_array_equal(auto.P, eg.initialize(tracks, method="registration").P)


@pytest.mark.parametrize(("name", "value"), [("method", "magic"), ("seed", -1), ("seed", 1.5)])
def test_bad_options_are_refused(name, value):
    tracks = simulated(5, 40, 1)
    with pytest.raises(eg.ArgumentError, match=name):
        eg.initialize(tracks, **{name: value})
