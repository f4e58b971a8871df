"""Standard deviations that hold where views contradict one another, and do not grow where not."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from calibration import SIZE, tracks_of
from epigauge.metric.deviation import beside_the_model
from epigauge.uncertainty.scatter import scatter_of

FOCAL = np.array([1.0, 0.0, 0.0, 0.0])


def _known(tracks: eg.Tracks, truth: eg.MetricReconstruction) -> eg.MetricCovariance:
    found = eg.bundle_adjust(tracks, truth).reconstruction
    assert isinstance(found, eg.MetricReconstruction)
    known = eg.covariance(tracks, found)
    assert isinstance(known, eg.MetricCovariance)
    return known


@pytest.mark.parametrize("n_views", [5, 20])
def test_independent_noise_scatters_as_expected(n_views: int) -> None:
    scatters = []
    for seed in range(20 if n_views < 16 else 10):  # of twenty views some are left to the others
        tracks, truth = tracks_of(seed=seed, noise_px=0.5, n_views=n_views, n_points=60)
        scatters.append(scatter_of(_known(tracks, truth), FOCAL))
    ratios = np.array([scatter.ratio for scatter in scatters])
    # Without what a view's own unknowns take up, the mean is about a half; its own deviation is
    # that of 20 * 4 or 10 * 19 numbers of chi^2 at most.
    assert ratios.mean() == pytest.approx(1.0, abs=0.35)
    assert np.mean([scatter.factor == 1.0 for scatter in scatters]) >= 0.9


def test_an_unsuitable_model_is_told_and_its_deviation_holds() -> None:
    tracks, _ = tracks_of(seed=0, noise_px=0.1, n_views=8, bend=-0.2)
    plain = eg.metric_upgrade(tracks, image_size=SIZE, camera="SIMPLE_PINHOLE")
    assert "model error" in plain.flags
    assert abs(plain.focal_px - 900.0) < 3.0 * plain.focal_std_px
    suitable = eg.metric_upgrade(tracks, image_size=SIZE)
    assert "model error" not in suitable.flags
    assert suitable.focal_std_px < 0.2 * plain.focal_std_px


def test_one_focal_length_of_two_axes_is_not_known_exactly() -> None:
    tracks, _ = tracks_of(seed=3, noise_px=0.01)
    one = eg.metric_upgrade(tracks, image_size=SIZE)
    assert one.focal_std_px / one.focal_px == pytest.approx(0.0017 / np.sqrt(12.0), rel=0.05)
    two = eg.metric_upgrade(tracks, image_size=SIZE, camera="OPENCV")
    assert two.focal_std_px < 0.5 * one.focal_std_px


def test_two_views_have_no_scatter() -> None:
    tracks, truth = tracks_of(n_views=2, seed=5, noise_px=0.2)
    found = eg.bundle_adjust(tracks, truth, refine="f").reconstruction
    assert isinstance(found, eg.MetricReconstruction)
    known = eg.covariance(tracks, found, refine="f")
    assert isinstance(known, eg.MetricCovariance)
    assert scatter_of(known, FOCAL).factor == 1.0


def _seen_by(params: list[float], seed: int, noise_px: float = 0.1) -> eg.Tracks:
    """Return tracks of a made-up walk with another lens."""
    tracks, scene = tracks_of(seed=seed, n_views=10, n_points=400)
    cameras = eg.Cameras("OPENCV", [params], np.zeros(10, dtype=int))
    xy = eg.MetricReconstruction(scene.R, scene.t, scene.X, cameras).project(tracks)
    noise = np.random.default_rng(seed).normal(0.0, noise_px, xy.shape)
    return eg.Tracks(tracks.view, tracks.point, xy + noise)


def test_what_a_richer_model_says_otherwise_counts() -> None:
    # Residuals of two radial terms taken for one do not contradict one another between views.
    tracks = _seen_by([900.0, 900.0, 399.5, 299.5, -0.3, 0.3, 0.0, 0.0], seed=2)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert isinstance(found.covariance, eg.MetricCovariance)
    beside = beside_the_model(tracks, found.covariance, None)
    assert beside[0] > 0.5 * abs(found.focal_px - 900.0) > 0.5
    assert abs(found.focal_px - 900.0) < 3.0 * found.focal_std_px
    # The model itself, and what contains it, have nothing beside.
    right = eg.metric_upgrade(tracks, image_size=SIZE, camera="OPENCV")
    assert isinstance(right.covariance, eg.MetricCovariance)
    assert beside_the_model(tracks, right.covariance, None)[0] == 0.0


def test_a_richer_model_of_a_plain_lens_moves_by_noise_alone() -> None:
    beside, noise = [], []
    for seed in range(6):
        tracks = _seen_by([900.0, 900.0, 399.5, 299.5, -0.05, 0.0, 0.0, 0.0], seed, noise_px=0.5)
        found = eg.metric_upgrade(tracks, image_size=SIZE)
        assert isinstance(found.covariance, eg.MetricCovariance)
        noise.append(np.sqrt(found.covariance.intrinsics(0)[0, 0]))
        beside.append(beside_the_model(tracks, found.covariance, None)[0])
    # A chi^2 of one number exceeds its mean in a third of the cases, and seldom by much.
    assert np.mean(np.array(beside) == 0.0) >= 0.5
    assert np.median(beside) < np.median(noise)


def test_noise_alone_decides_what_is_undetermined(monkeypatch: pytest.MonkeyPatch) -> None:
    # A lens far from its model widens the deviation, and the flag says it is weak; nothing is open.
    tracks, _ = tracks_of(seed=0, noise_px=0.3, n_views=8)
    monkeypatch.setattr(
        "epigauge.metric.verdict.known_to", lambda known, unit: (np.array([400.0]), 300.0, True)
    )
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.focal_std_px >= 400.0
    assert {"weak focal length", "model error"} <= set(found.flags)
    assert not {"undetermined", "pure translation", "pure rotation"} & set(found.flags)
    assert found.success
