"""Cameras that begin far from their place among right ones: found anew, or told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.strayed import found_anew, strayed
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Cameras of a ring: a lens with distortion, one that looks along -z, a fisheye.
LENSES = {
    "SIMPLE_RADIAL": [800.0, 320.0, 240.0, 0.05],
    "bal": [800.0, 0.05, 0.0],
    "OPENCV_FISHEYE": [800.0, 800.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0],
}


def ring(
    n: int, seed: int, lens: str = "SIMPLE_RADIAL", *, flat: bool = False
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return cameras all around eighty points, which half of them see, and what they see."""
    rng = np.random.default_rng([seed, n])
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    centres = 6.0 * np.stack([np.sin(angle), 0.1 * np.cos(3.0 * angle), -np.cos(angle)], axis=1)
    if flat:
        centres[:, 1] -= 4.0
    z = -centres / np.linalg.norm(centres, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    t = -np.einsum("nij,nj->ni", R, centres)
    if lens == "bal":
        half_turn = np.diag([1.0, -1.0, -1.0])
        R, t = half_turn @ R, t @ half_turn
    X = rng.uniform(-1.0, 1.0, (80, 3)) * [1.0, 0.0 if flat else 1.0, 1.0]
    cameras = eg.Cameras(lens, [LENSES[lens]], np.zeros(n, int))
    scene = eg.MetricReconstruction(R, t, X, cameras)
    sees = rng.random((n, 80)) < 0.5
    sees[:2] = True
    view, point = np.nonzero(sees)
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = scene.project(blank) + rng.normal(0.0, 0.3, (len(blank), 2))
    return eg.Tracks(blank.view, blank.point, xy), scene


def with_turned(
    scene: eg.MetricReconstruction, views: Array, angle: float, rng: np.random.Generator
) -> eg.MetricReconstruction:
    """Return the scene with some cameras turned about their centres by an angle."""
    R, t = scene.R.copy(), scene.t.copy()
    for view in views:
        axis = rng.standard_normal(3)
        C = np.cross(np.eye(3), -axis / np.linalg.norm(axis))
        turn = np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C
        R[view], t[view] = turn @ R[view], turn @ t[view]
    return replace(scene, R=R, t=t)


def is_right(tracks: eg.Tracks, found: eg.BundleResult) -> bool:
    """Tell whether half of the observations of each view are within 1.5 pixels."""
    away = np.linalg.norm(found.fun, axis=1)
    return all(np.median(away[tracks.view == view]) < 1.5 for view in range(tracks.n_views))


@pytest.mark.parametrize(
    ("n", "count", "angle", "lens"),
    [
        (24, 1, 1.0, "SIMPLE_RADIAL"),
        (24, 1, 2.0, "SIMPLE_RADIAL"),
        (24, 1, 3.0, "bal"),
        (12, 1, 3.0, "SIMPLE_RADIAL"),
        (12, 2, 2.0, "OPENCV_FISHEYE"),
        (40, 2, 2.5, "SIMPLE_RADIAL"),
    ],
)
def test_turned_cameras_of_a_ring_are_found_anew(
    n: int, count: int, angle: float, lens: str
) -> None:
    for seed in range(4):
        tracks, scene = ring(n, seed, lens)
        rng = np.random.default_rng([seed, 7])
        start = with_turned(scene, rng.choice(n, count, replace=False), angle, rng)
        found = eg.bundle_adjust(tracks, start, refine="pose", robust=True)
        assert found.success
        assert is_right(tracks, found)
        assert np.mean(found.rejected) < 0.01


@pytest.mark.parametrize("flat", [False, True])
def test_proposed_cameras_are_those_of_the_scene(flat: bool) -> None:
    tracks, scene = ring(12, 1, flat=flat)
    rejected = tracks.view == 5
    assert strayed(tracks, rejected).tolist() == [5]
    start = with_turned(scene, np.array([5]), 2.0, np.random.default_rng(0))
    found = found_anew(kernels.table(), tracks, start, rejected, np.array([], int), 2.0)
    assert found is not None
    assert np.linalg.norm(found.R[5] - scene.R[5]) < 0.02
    np.testing.assert_array_equal(found.R[:5], scene.R[:5])
    # A view that is fixed stays, and so does one that others do not hold.
    assert found_anew(kernels.table(), tracks, start, rejected, np.array([5]), 2.0) is None
    everything = np.ones(len(tracks), np.bool_)
    assert found_anew(kernels.table(), tracks, start, everything, np.array([], int), 2.0) is None


@pytest.mark.parametrize("seed", range(3))
def test_projective_cameras_are_found_anew(seed: int) -> None:
    truth = many_views.cameras_and_points(10, 80, seed=seed)
    tracks = many_views.observed(truth, 0.5, seen=0.7, seed=seed)
    frame = Frame.of(tracks)
    P = frame.cameras_in(truth.P)
    P[4] = np.random.default_rng(seed).standard_normal((3, 4))
    start = eg.Reconstruction(frame.cameras_out(P), truth.Q)
    found = eg.bundle_adjust(tracks, start, robust=True)
    assert found.success
    assert is_right(tracks, found)


@pytest.mark.parametrize("kind", ["metric", "projective"])
def test_a_view_of_wrong_matches_is_told(kind: str) -> None:
    tracks, scene = ring(12, 0)
    xy, rng = tracks.xy.copy(), np.random.default_rng(1)
    own = np.flatnonzero(tracks.view == 3)
    xy[own] = xy[rng.permutation(own)]
    wrong = eg.Tracks(tracks.view, tracks.point, xy)
    start = scene if kind == "metric" else scene.to_projective()
    options = {"refine": "pose"} if kind == "metric" else {}
    found = eg.bundle_adjust(wrong, start, robust=True, **options)
    assert not found.success
    assert "strayed views" in found.flags
    assert "most of those of view 3" in found.message
    own_rejected = found.rejected[tracks.view == 3]
    assert own_rejected.mean() > 0.5
    assert found.rejected[tracks.view != 3].mean() < 0.05


def test_views_stray_where_most_of_what_counts_is_set_aside() -> None:
    tracks = many_views.observed(many_views.cameras_and_points(4, 40))
    rejected = np.zeros(len(tracks), np.bool_)
    own = np.flatnonzero(tracks.view == 2)
    rejected[own[:20]] = True
    assert not len(strayed(tracks, rejected))  # half
    rejected[own[20]] = True
    assert strayed(tracks, rejected).tolist() == [2]
    off = tracks.weighted(np.where(np.isin(np.arange(len(tracks)), own[:2]), 0.0, 1.0))
    assert not len(strayed(off, np.isin(np.arange(len(tracks)), own[:20])))  # 18 of 38


def with_one_mixed(tracks: eg.Tracks, view: int, share: float = 1.0) -> eg.Tracks:
    """Return the tracks with a share of one view's observations given to one another's points."""
    xy, rng = tracks.xy.copy(), np.random.default_rng(5)
    own = np.flatnonzero(tracks.view == view)
    own = own[rng.random(len(own)) < share]
    xy[own] = xy[rng.permutation(own)]
    return eg.Tracks(tracks.view, tracks.point, xy)


@pytest.mark.parametrize("kind", ["metric", "projective", "lines", "parts"])
@pytest.mark.parametrize("loss", ["cauchy", "huber"])
def test_a_robust_loss_that_gives_a_view_up_says_so(
    kind: str, loss: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """In every entry: the view has no part in what is called a minimum of all."""
    made = eg.line_scene(seed=3)
    for is_wrong in (False, True):
        tracks = with_one_mixed(made.tracks, 5) if is_wrong else made.tracks
        found: Any
        if kind == "parts":
            client = request.getfixturevalue("client")
            start = replace(made.true, lines=None)
            folder = eg.distributed.write_parts(tracks, tmp_path / str(is_wrong), start)
            found = eg.distributed.bundle_adjust(folder, client, refine="pose", loss=loss)
        elif kind == "projective":
            found = eg.bundle_adjust(tracks, made.true.to_projective(), loss=loss)
        else:
            lines = {"lines": made.line_tracks} if kind == "lines" else {}
            found = eg.bundle_adjust(tracks, made.true, refine="pose", loss=loss, **lines)
        assert ("strayed views" in found.flags) == is_wrong
        assert found.success != is_wrong


@pytest.mark.study
def test_an_upgrade_tells_of_a_view_of_wrong_matches() -> None:
    scene = eg.multi_view_scene(n_views=8, noise_px=0.3, focal=900.0, seed=3)
    seen, middle = scene.tracks, np.array([400.0, 300.0])
    tracks = eg.Tracks(seen.view, seen.point, seen.xy + middle)
    found = eg.metric_upgrade(with_one_mixed(tracks, 4, 0.7), image_size=(800, 600))
    assert not found.success
    assert "strayed views" in found.flags
    assert eg.metric_upgrade(tracks, image_size=(800, 600)).success
