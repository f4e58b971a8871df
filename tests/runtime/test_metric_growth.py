"""Metric scenes that grow from a guess of the focal length: poses from three points, planes."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from calibration import CENTRE, SIZE, poses, tracks_of
from epigauge import kernels
from epigauge.metric.growth import grown
from epigauge.metric.samples import sampled
from epigauge.metric.scene import Images
from epigauge.metric.search import Search
from epigauge.multi_view.three_points import agreed_pose

OPTIONS = {"workers": 1, "backend": None}


@pytest.mark.parametrize("backend", ["numpy", None])
def test_the_quartic_has_the_true_ratio_as_a_root(backend: str | None) -> None:
    rng = np.random.default_rng(0)
    Y = rng.uniform(-1.0, 1.0, (3, 3, 50)) + np.array([0.0, 0.0, 4.0])[:, None]
    s = np.linalg.norm(Y, axis=1)
    rays = Y / s[:, None]
    pairs = ([0, 0, 1], [1, 2, 2])
    cosines = np.sum(rays[pairs[0]] * rays[pairs[1]], axis=1)
    squares = np.sum((Y[pairs[0]] - Y[pairs[1]]) ** 2, axis=1)
    quartic, above, below = kernels.table(backend).three_points(cosines, squares)
    u, v = s[1] / s[0], s[2] / s[0]
    size = np.polyval(np.abs(quartic), v)
    assert np.max(np.abs(np.polyval(quartic, v)) / size) < 1e-11
    np.testing.assert_allclose(np.polyval(above, v), u * np.polyval(below, v), atol=1e-9)


def test_three_points_give_pose_and_focal_length() -> None:
    tracks, scene = tracks_of(seed=1)
    own = tracks.view == 2
    x, X = tracks.xy[own] - CENTRE, scene.X[tracks.point[own]]
    rng = np.random.default_rng(0)
    wrong = rng.random(len(x)) < 0.4
    x[wrong] = rng.uniform(-300.0, 300.0, (int(wrong.sum()), 2))
    table = kernels.table()
    pose = agreed_pose(table, x, X, np.array([500.0, 900.0, 1500.0]), 3.0)
    assert pose is not None
    assert pose.focal == 900.0
    np.testing.assert_allclose(pose.R, scene.R[2], atol=1e-6)
    np.testing.assert_allclose(pose.t, scene.t[2], atol=1e-5)
    assert pose.inlier[~wrong].all()
    assert pose.inlier[wrong].mean() < 0.1
    assert agreed_pose(table, x[:3], X[:3], np.array([900.0]), 3.0) is None


@pytest.mark.study
@pytest.mark.parametrize("guess", [600.0, 1400.0])
def test_a_scene_grows_from_a_wrong_focal_length(guess: float) -> None:
    tracks, _ = tracks_of(seed=3, noise_px=0.3, wrong=0.05)
    images = Images(np.tile(SIZE, (6, 1)).astype(float), np.zeros(6, dtype=np.intp))
    scene = grown(tracks, images, "SIMPLE_RADIAL", np.full(6, guess), OPTIONS)
    assert scene is not None
    assert scene.cameras.params[0, 0] == pytest.approx(900.0, rel=0.03)
    assert np.median(np.linalg.norm(tracks.xy - scene.project(tracks), axis=1)) < 1.0


def _tied_by_a_plane(seed: int) -> tuple[eg.Tracks, Images]:
    """Return tracks of two parts of a scene, whose views share points of one wall only."""
    rng = np.random.default_rng(seed)
    R, C = poses("general", 10, rng)
    X = rng.uniform(-1.3, 1.3, (360, 3))
    X[:120, 2] = 0.3 * X[:120, 0]
    camera = eg.Cameras("SIMPLE_RADIAL", [[900.0, *CENTRE, 0.0]], np.zeros(10, dtype=np.intp))
    scene = eg.MetricReconstruction(R, -np.einsum("nij,nj->ni", R, C), X, camera)
    view, point = np.divmod(np.arange(3600), 360)
    # The wall is in all views; what else there is in those of one half.
    sees = (point < 120) | ((point < 240) == (view < 5))
    view, point = view[sees], point[sees]
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = scene.project(blank) + rng.normal(0.0, 0.3, (len(view), 2))
    wrong = rng.random(len(xy)) < 0.03
    xy[wrong] = rng.uniform(0.0, 1.0, (int(wrong.sum()), 2)) * SIZE
    images = Images(np.tile(SIZE, (10, 1)).astype(float), np.zeros(10, dtype=np.intp))
    return eg.Tracks(blank.view, blank.point, xy), images


@pytest.mark.study
@pytest.mark.parametrize("seed", [3])  # no projective scene of all its views is found
def test_parts_that_share_a_wall_become_one_scene(seed: int) -> None:
    tracks, _ = _tied_by_a_plane(seed)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.success
    assert abs(found.focal_px - 900.0) < 5.0 * found.focal_std_px
    assert found.rms_px < 0.4


@pytest.mark.study
def test_what_does_not_hang_together_does_not_grow() -> None:
    tracks, _ = tracks_of(seed=4)
    rng = np.random.default_rng(0)
    random = eg.Tracks(tracks.view, tracks.point, rng.uniform(0.0, 1.0, (len(tracks), 2)) * SIZE)
    images = Images(np.tile(SIZE, (6, 1)).astype(float), np.zeros(6, dtype=np.intp))
    assert grown(random, images, "SIMPLE_RADIAL", np.full(6, 900.0), OPTIONS) is None


def test_searches_take_a_scene_that_grew_only_where_it_is_better() -> None:
    tracks, _ = tracks_of(seed=5, noise_px=0.3)
    images = Images(np.tile(SIZE, (6, 1)).astype(float), np.zeros(6, dtype=np.intp))
    search = Search(sampled(tracks), images, "SIMPLE_RADIAL", 1, None)
    fit = search.run(None)
    assert fit is not None
    assert search._grown(fit).typical <= fit.typical
