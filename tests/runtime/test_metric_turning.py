"""Cameras that only turned, or hardly moved, through lenses with strong distortion."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.metric.scene import Images
from epigauge.metric.turning import turned
from epigauge.rotations import from_rodrigues

SIZE = np.array([1600, 1200])
FOCAL, CENTRE = 1600.0, (839.5, 579.5)


def _tracks(
    seed: int, bend: float, baseline: float, n_views: int = 8, turn: float = 0.25
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return raw tracks of points 3 to 10 away, from places a `baseline` apart (RMS)."""
    rng = np.random.default_rng(seed)
    R = np.stack([from_rodrigues(rng.normal(0.0, [0.4 * turn, turn, 0.1])) for _ in range(n_views)])
    C = baseline * rng.normal(size=(n_views, 3))
    X = rng.normal(size=(2400, 3))
    X[:, 2] = np.abs(X[:, 2]) + 0.3
    X *= (rng.uniform(3.0, 10.0, len(X)) / np.linalg.norm(X, axis=1))[:, None]
    t = -np.einsum("nij,nj->ni", R, C)

    def seen(k: float) -> eg.MetricReconstruction:
        cameras = eg.Cameras("SIMPLE_RADIAL", [[FOCAL, *CENTRE, k]], np.zeros(n_views, dtype=int))
        return eg.MetricReconstruction(R, t, X, cameras)

    view, point = np.divmod(np.arange(n_views * len(X)), len(X))
    every = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy, straight = seen(bend).project(every), seen(0.0).project(every)
    # A lens that bends inwards folds far outside of the image.
    inside = (xy > 0.0).all(axis=1) & (xy < SIZE - 1).all(axis=1)
    inside &= (np.abs(straight - CENTRE) < 1040.0).all(axis=1) & (seen(0.0).depths(every) > 0.0)
    inside &= rng.random(len(xy)) < 0.8
    xy = xy[inside] + rng.normal(0.0, 0.5, (int(inside.sum()), 2))
    wrong = rng.random(len(xy)) < 0.02
    xy[wrong] += rng.normal(0.0, 20.0, (int(wrong.sum()), 2))
    return eg.Tracks.pruned(every.view[inside], every.point[inside], xy)[0], seen(bend)


@pytest.mark.parametrize("bend", [-0.3, -0.1, 0.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_turn_is_named_through_any_lens(bend: float, seed: int) -> None:
    tracks, _ = _tracks(seed, bend, 0.0)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.flags == ("pure rotation",)
    assert not found.success


@pytest.mark.parametrize("baseline", [0.01, 0.02])
@pytest.mark.parametrize("seed", [0, 1])
def test_small_parallax_is_not_taken_for_distortion(baseline: float, seed: int) -> None:
    # A scene of 6,500 px nearly explains these, with success, where it is the only one tried.
    tracks, _ = _tracks(seed, -0.3, baseline)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.success
    assert abs(found.focal_px - FOCAL) < 4.0 * found.focal_std_px
    assert found.focal_std_px < 0.01 * FOCAL
    np.testing.assert_allclose(found.reconstruction.cameras.params[0, 3], -0.3, atol=0.01)


def test_cameras_in_one_place_have_the_true_turns() -> None:
    tracks, truth = _tracks(3, -0.2, 0.0)
    images = Images(np.tile(SIZE, (8, 1)).astype(float), np.zeros(8, dtype=np.intp))
    options = {"workers": 1, "backend": None}
    found = turned(tracks, images, "SIMPLE_RADIAL", (), options)
    assert found is not None
    assert found.explains_as_well(tracks.xy - found.moving.project(tracks))
    np.testing.assert_allclose(found.moving.cameras.params[0, 0], FOCAL, rtol=0.02)
    turns = [scene.R @ scene.R[0].T for scene in (truth, found.moving)]
    np.testing.assert_allclose(turns[1], turns[0], atol=0.01)
    # Nothing of the kind where they stood still, which is another fault.
    still, _ = _tracks(3, -0.2, 0.0, turn=0.0)
    near = eg.Tracks(
        still.view,
        still.point,
        still.xy[np.unique(still.point, return_index=True)[1]][still.point],
    )
    assert turned(near, images, "SIMPLE_RADIAL", (), options) is None
