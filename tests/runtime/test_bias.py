"""Kanatani's bias correction: a small, consistent move that grows with the variance."""

import epigauge as eg
import numpy as np
import pytest


@pytest.fixture(scope="module")
def scene():
    return eg.two_view_scene(6.0, seed=1)


def moved_by(scene, noise_px):
    """Return the change of F by the correction."""
    plain = eg.refine_fundamental(scene.x1, scene.x2)
    moved = eg.refine_fundamental(scene.x1, scene.x2, noise_px=noise_px, bias_correction=True)
    return moved.F * np.sign(np.sum(moved.F * plain.F)) - plain.F


def test_result_is_consistent_and_near_the_minimum(scene):
    plain = eg.refine_fundamental(scene.x1, scene.x2, noise_px=None)
    moved = eg.refine_fundamental(scene.x1, scene.x2, noise_px=None, bias_correction=True)
    assert np.linalg.svd(moved.F, compute_uv=False)[2] < 1e-15
    assert moved.cost == pytest.approx(0.5 * np.sum(moved.fun**2), rel=1e-12)
    assert plain.cost < moved.cost < 1.01 * plain.cost


def test_move_grows_with_the_variance_and_vanishes_without_noise(scene):
    ratio = np.linalg.norm(moved_by(scene, 0.02)) / np.linalg.norm(moved_by(scene, 0.01))
    assert ratio == pytest.approx(4.0, rel=0.01)  # second order in the noise
    assert np.linalg.norm(moved_by(scene, 1e-9)) < 1e-12


def test_weights_are_inverse_variances(scene):
    # Weight 4 with noise 2 is weight 1 with noise 1.
    options = {"bias_correction": True}
    heavy = eg.refine_fundamental(
        scene.x1, scene.x2, weights=np.full(len(scene.x1), 4.0), noise_px=2.0, **options
    )
    plain = eg.refine_fundamental(scene.x1, scene.x2, noise_px=1.0, **options)
    np.testing.assert_allclose(heavy.F, plain.F, atol=1e-9)


def test_restricted_matrices_are_refused(scene):
    with pytest.raises(eg.ArgumentError, match="bias_correction"):
        eg.refine_fundamental(scene.x1, scene.x2, fix="epipole1", bias_correction=True)


def test_correction_lowers_the_bias_where_noise_is_strong():
    # The mean of many estimates of one scene, against the truth: sideways motion, few points.
    bias = {False: [], True: []}
    truth = eg.two_view_scene(6.0, n_points=20, noise_px=0.0, seed=4)
    rng = np.random.default_rng(0)
    for _ in range(120):
        x1, x2 = (x + 2.0 * rng.standard_normal(x.shape) for x in (truth.x1_true, truth.x2_true))
        for corrected in bias:
            F = eg.refine_fundamental(x1, x2, noise_px=2.0, bias_correction=corrected).F
            d, *_ = eg.reprojection_distances(F, truth.x1_true, truth.x2_true)
            bias[corrected].append(d * np.sign(np.sum(F * truth.F_true)))
    plain, moved = (float(np.sum(np.mean(bias[k], axis=0) ** 2)) for k in (False, True))
    assert moved < plain
