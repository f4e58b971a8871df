"""Inliers that stand still: fitted to by least squares before the refinement."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.two_view.conditioning import condition
from epigauge.two_view.consensus import Consensus


def among_wrong(backend: str | None = None):
    """Return raw matches, the third of them wrong, and their agreement with the true F."""
    scene = eg.two_view_scene(4.0, n_points=200, noise_px=1.0, seed=3)
    rng = np.random.default_rng(3)
    x1, x2 = scene.x1.copy(), scene.x2.copy()
    x2[::3] = rng.uniform(x2.min(axis=0), x2.max(axis=0), x2[::3].shape)
    frame = condition(x1, x2)
    consensus = Consensus(kernels.table(backend), *frame.forward(x1, x2))
    return consensus, consensus.judge(frame.from_pixels(scene.F_true), 0.05)


def test_inliers_stand_still_within_three_deviations_of_their_noise():
    consensus, start = among_wrong()
    found, limit, fits = consensus.settle(start, np.ones(200), 0.5, 3.0, 8)
    inlier = found.inliers(limit)
    assert 1 < fits < 20
    assert limit < 0.5
    again, same, more = consensus.settle(found, np.ones(200), limit, 3.0, 8)
    assert more <= 2
    assert same == pytest.approx(limit, rel=1e-3)
    np.testing.assert_array_equal(again.inliers(same), inlier)
    best = consensus.fitted(found.F, inlier.astype(float))
    np.testing.assert_allclose(best * np.sign(np.sum(best * found.F)), found.F, atol=1e-6)


def test_a_limit_that_is_given_stays():
    consensus, start = among_wrong()
    found, limit, fits = consensus.settle(start, np.ones(200), 0.05, 0.0, 8)
    assert fits >= 1
    assert limit == 0.05
    assert np.abs(found.signed[found.inliers(limit)]).max() <= 0.05


def test_too_few_that_agree_are_not_fitted_to():
    consensus, start = among_wrong()
    found, limit, fits = consensus.settle(start, np.ones(200), 0.5, 3.0, 201)
    assert fits == 0
    assert limit == 0.5
    np.testing.assert_array_equal(found.F, start.F)


def test_compiled_and_numpy_inliers_are_the_same():
    if kernels.available()["c"]:
        pytest.skip("no compiled library")
    weights = np.linspace(0.0, 2.0, 200)
    weights[::7] = 0.0
    found = []
    for name in ("c", "numpy"):
        consensus, start = among_wrong(name)
        found.append(consensus.settle(start, weights, 0.5, 3.0, 8))
    (one, limit, fits), (other, same, many) = found
    assert fits == many > 1
    assert limit == pytest.approx(same, rel=1e-6)
    np.testing.assert_allclose(one.signed, other.signed, atol=1e-6)
    np.testing.assert_array_equal(one.inliers(limit), other.inliers(same))
