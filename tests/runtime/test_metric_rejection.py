"""Gross errors among the tracks of calibrated scenes: they end where what is kept wants it."""

from __future__ import annotations

from dataclasses import replace

import epigauge as eg
import numpy as np
import pytest
from epigauge.bundle.observations import ObservationGraph
from epigauge.kernels import table
from epigauge.multi_view.agreement import agreed_positions
from epigauge.rotations import from_rodrigues
from numpy.typing import NDArray

from tests.metric_scenes import metric_scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MODELS = ("SIMPLE_PINHOLE", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "bal", "spherical")


def spoiled(tracks: eg.Tracks, share: float, seed: int) -> tuple[eg.Tracks, Mask]:
    """Return tracks with a share of uniform ones anywhere in the image, and which are right."""
    rng = np.random.default_rng([5, seed])
    right = rng.random(len(tracks)) >= share
    xy = tracks.xy.copy()
    xy[~right] = rng.uniform(xy.min(axis=0), xy.max(axis=0), (int(np.sum(~right)), 2))
    return eg.Tracks(tracks.view, tracks.point, xy), right


def shaken(scene: eg.MetricReconstruction, size: float, seed: int) -> eg.MetricReconstruction:
    """Return the scene with noise in its cameras and points."""
    rng = np.random.default_rng([6, seed])
    turns = np.array([from_rodrigues(w) for w in rng.normal(0.0, 0.6 * size, (scene.n_views, 3))])
    t, X = (part + rng.normal(0.0, size, part.shape) for part in (scene.t, scene.X))
    return replace(scene, R=turns @ scene.R, t=t, X=X)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("seed", [21, 22])
def test_shaken_scenes_end_at_the_minimum_beside_the_truth(model: str, seed: int) -> None:
    clean, true = metric_scene(
        model, seed, n_views=8, n_points=80, n_cameras=1, noise_px=0.5, visible=1.0
    )
    tracks, right = spoiled(clean, 0.2, seed)
    refine = "pose" if model == "spherical" else "all"
    found = eg.bundle_adjust(tracks, shaken(true, 0.05, seed), refine=refine, robust=True)
    assert found.success
    assert "behind the cameras" not in found.flags
    kept = tracks.weighted((~found.rejected).astype(float))
    least = eg.bundle_adjust(kept, true, refine=refine)
    assert found.cost == pytest.approx(least.cost, rel=1e-6)
    assert found.rejected[~right].mean() > 0.9
    assert found.rejected[right].mean() < 0.08


def sideways(seed: int) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return what cameras on a line, which look the same way, see of points in front of them."""
    rng = np.random.default_rng([8, seed])
    X = rng.uniform(-1.0, 1.0, (100, 3))
    C = np.column_stack([np.linspace(-1.5, 1.3, 8), rng.normal(0.0, 0.05, 8), np.full(8, -4.0)])
    R = np.array([from_rodrigues(w) for w in rng.uniform(-0.2, 0.2, (8, 3))])
    cameras = eg.Cameras("PINHOLE", [[900.0, 910.0, 640.0, 480.0]], np.zeros(8, int))
    scene = eg.MetricReconstruction(R, -np.einsum("nij,nj->ni", R, C), X, cameras)
    blank = eg.Tracks(np.repeat(np.arange(8), 100), np.tile(np.arange(100), 8), np.zeros((800, 2)))
    xy = scene.project(blank) + rng.normal(0.0, 0.5, (800, 2))
    return eg.Tracks(blank.view, blank.point, xy), scene


@pytest.mark.parametrize("seed", range(5))
def test_points_that_a_poor_start_drives_away_come_back(seed: int) -> None:
    """A robust loss gives them up behind the cameras, where no step brings them back from."""
    clean, true = sideways(seed)
    tracks, right = spoiled(clean, 0.2, seed)
    longer = replace(
        true, cameras=replace(true.cameras, params=true.cameras.params * [1.1, 1.1, 1, 1])
    )
    found = eg.bundle_adjust(tracks, shaken(longer, 0.06, seed), robust=True)
    assert found.success
    assert found.flags == ()
    assert np.median(np.linalg.norm(found.fun[right], axis=1)) < 0.7
    assert found.rejected[right].mean() < 0.08


@pytest.mark.parametrize("model", MODELS)
def test_positions_that_most_lines_of_sight_agree_on(model: str) -> None:
    clean, true = metric_scene(model, 3, n_views=6, n_points=40, visible=1.0)
    xy = clean.xy.copy()
    xy[np.arange(len(xy)) % 6 == 2] += [90.0, -70.0]
    tracks = eg.Tracks(clean.view, clean.point, xy)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    far = replace(true, X=true.X + 0.3)
    X = agreed_positions(table(), tracks, graph, far, 1.0)
    if model == "spherical":  # of half of what it sees only, that in front, there are rays
        moved = (far.X != X).any(axis=1)
        assert np.linalg.norm(X - true.X, axis=1)[moved].max(initial=0.0) < 1e-3
    else:
        np.testing.assert_allclose(X, true.X, atol=1e-3)
    assert (replace(true, X=X).depths(tracks) > 0.0).all()


@pytest.mark.parametrize("kind", ["metric", "projective"])
def test_fixed_points_stay_among_gross_errors(kind: str) -> None:
    clean, true = metric_scene("PINHOLE", 4, n_views=6, n_points=60, noise_px=0.3)
    tracks, _ = spoiled(clean, 0.1, 4)
    start = shaken(true, 0.01, 4) if kind == "metric" else true.to_projective()
    stay = [3, 4, 5, 6, 7, 8, 9]
    found = eg.bundle_adjust(tracks, start, fixed_points=stay, robust=True).reconstruction
    before, after = (s.X if kind == "metric" else s.Q for s in (start, found))
    np.testing.assert_array_equal(after[stay], before[stay])
    assert (after[10:] != before[10:]).any()


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy", "truncated"])
def test_what_a_robust_loss_gives_up_is_no_noise(loss: str) -> None:
    clean, true = metric_scene("SIMPLE_RADIAL", 1, n_views=8, n_points=80, noise_px=0.5)
    xy = clean.xy.copy()
    xy[::17] += [300.0, -300.0]
    found = eg.bundle_adjust(eg.Tracks(clean.view, clean.point, xy), true, loss=loss)
    assert found.success
    assert found.flags == ()
