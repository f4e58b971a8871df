"""Every metric camera model is adjusted by the one engine, without a line of its own."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.cameras import models
from laws import distance, orthonormal

METRIC = [name for name, model in models().items() if model.metric]
#: Sizes of parameters in a network of unit focal length; what is not here is weak.
SIZES = {"f": 1.1, "fx": 1.1, "fy": 1.05, "c": 1.2, "R0": 0.4, "width": 6.0, "height": 3.0}


def network(name, seed, n=7, m=60):
    """Return exact tracks and the scene: views all around a cloud of points."""
    rng = np.random.default_rng(seed)
    model = models()[name]
    k = np.array([SIZES.get(p, 0.03 * rng.standard_normal()) for p in model.params])
    X = rng.uniform(-1.0, 1.0, (m, 3))
    R = np.array([orthonormal(rng) for _ in range(n)])
    t = rng.uniform(-0.3, 0.3, (n, 3))
    t[:, 2] += -4.0 if name in ("bal", "brown", "brown_measured") else 4.0
    scene = eg.MetricReconstruction(R, t, X, eg.Cameras(name, [k], [0] * n))
    view, point = np.divmod(np.arange(n * m), m)
    blank = eg.Tracks(view, point, np.zeros((n * m, 2)))
    assert (scene.depths(blank) > 0.0).all()
    return eg.Tracks(blank.view, blank.point, scene.project(blank)), scene


def disturbed(scene, rng, refined):
    """Return a start away from a scene: poses, points, and the parameters that are refined."""
    turn = np.array(
        [np.linalg.qr(np.eye(3) + 0.02 * rng.standard_normal((3, 3)))[0] for _ in scene.R]
    )
    turn *= np.sign(np.einsum("nii->ni", turn))[:, None, :]
    params = scene.cameras.params.copy()
    params[:, :refined] += 0.01 * rng.standard_normal(refined)
    return eg.MetricReconstruction(
        turn @ scene.R,
        scene.t + 0.05 * rng.standard_normal(scene.t.shape),
        scene.X + 0.05 * rng.standard_normal(scene.X.shape),
        eg.Cameras(scene.cameras.model, params, scene.cameras.camera_of_view),
    )


@pytest.mark.parametrize("name", METRIC)
def test_exact_images_lead_back_to_the_scene(name):
    tracks, scene = network(name, 1)
    refined = models()[name].adjusted
    if name == "FULL_OPENCV":  # whose last coefficients nearly replace the others
        refined = tuple(p for p in refined if p not in ("k3", "k4", "k5", "k6"))
    start = disturbed(scene, np.random.default_rng(2), len(refined))
    result = eg.bundle_adjust(tracks, start, refine=refined or "pose")
    assert result.success, result.message
    assert result.reconstruction.rms_px(tracks) <= 1e-9 < 1e-3 < start.rms_px(tracks)
    found = result.reconstruction.cameras.params
    constant = len(models()[name].adjusted)
    np.testing.assert_array_equal(found[:, constant:], scene.cameras.params[:, constant:])
    if not name.startswith("brown"):  # whose A1 to A3 nearly replace each other
        assert distance(found, scene.cameras.params) <= 1e-5


def test_coefficients_that_replace_others_are_undetermined_but_fit():
    tracks, scene = network("FULL_OPENCV", 1)
    refined = models()["FULL_OPENCV"].adjusted
    start = disturbed(scene, np.random.default_rng(2), len(refined))
    result = eg.bundle_adjust(tracks, start, refine=refined, max_iter=30)
    assert result.reconstruction.rms_px(tracks) <= 1e-9 < 1e-3 < start.rms_px(tracks)
    assert result.success or "undetermined" in result.flags


@pytest.mark.parametrize("name", [name for name in METRIC if models()[name].constants])
def test_constants_cannot_be_refined(name):
    tracks, scene = network(name, 3)
    constant = models()[name].constants[0]
    with pytest.raises(eg.errors.ArgumentError, match=constant):
        eg.bundle_adjust(tracks, scene, refine=(constant,))


#: Its correction folds at an ideal radius of 385 pixels.
FOLDED = [1000.0, 500.0, 400.0, -1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("backend", [None, "numpy"])
def test_what_a_correction_folds_away_has_no_image(backend):
    cameras = eg.Cameras("brown_measured", [FOLDED], [0, 0])
    radius = np.array([0.05, 0.2, 0.384, 0.386, 0.5, 0.6, 2.0])
    X = np.column_stack([-0.8 * radius, 0.6 * radius, np.full(7, -1.0)])
    scene = eg.MetricReconstruction([np.eye(3)] * 2, np.zeros((2, 3)), X, cameras)
    point, view = np.divmod(np.arange(14), 2)
    xy = scene.project(eg.Tracks(view, point, np.zeros((14, 2))), backend).reshape(7, 2, 2)
    assert np.isposinf(xy[3:]).all()
    # The corrections of the others are the images of an ideal lens.
    away = xy[:3, 0] - FOLDED[1:3]
    corrected = away * (1.0 + FOLDED[3] * np.sum(away**2, axis=1, keepdims=True))
    np.testing.assert_allclose(corrected, -1000.0 * X[:3, :2] / X[:3, 2:], rtol=1e-6)


@pytest.mark.parametrize("covariance", [None, [[1.0, 0.3], [0.3, 1.0]]])
def test_a_measurement_beyond_the_fold_is_a_gross_error(covariance):
    rng = np.random.default_rng(1)
    n, m = 4, 30
    X = np.column_stack([rng.uniform(-1.0, 1.0, (m, 2)), rng.uniform(-7.0, -5.0, m)])
    t = np.column_stack([rng.uniform(-0.5, 0.5, (n, 3))])
    cameras = eg.Cameras("brown_measured", [FOLDED], [0] * n)
    scene = eg.MetricReconstruction([np.eye(3)] * n, t, X, cameras)
    point, view = np.divmod(np.arange(n * m), n)
    xy = scene.project(eg.Tracks(view, point, np.zeros((n * m, 2))))
    xy += 0.3 * rng.standard_normal(xy.shape)
    xy[17] = 2500.0, 400.0
    tracks = eg.Tracks(view, point, xy, covariance=covariance)
    bent = eg.bundle_adjust(tracks, scene, refine="pose")
    assert "gross errors" in bent.flags
    assert not bent.success
    assert not np.isnan(bent.fun).any()
    found = eg.bundle_adjust(tracks, scene, refine="pose", robust=True)
    assert found.success
    assert found.rms_px < 0.4
    np.testing.assert_array_equal(np.flatnonzero(found.rejected), [17])
    begin = X.copy()
    begin[3, 0] += 6.0  # where it has no image
    away = eg.MetricReconstruction(scene.R, t, begin, cameras)
    assert np.isinf(away.project(tracks)).any()
    assert eg.bundle_adjust(tracks, away, refine="pose", robust=True).rms_px < 0.4
