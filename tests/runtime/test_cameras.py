"""Cameras and metric reconstructions: what they hold, what they refuse, what they project to."""

from __future__ import annotations

import pickle
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.cameras import models
from metric_scenes import METRIC, looks_along, metric_scene, parameters

GOOD: dict[str, Any] = {
    "model": "SIMPLE_RADIAL",
    "params": [[800.0, 320.0, 240.0, 0.1], [900.0, 320.0, 240.0, 0.0]],
    "camera_of_view": [0, 1, 0],
}


def refused(make: Any, **arguments: Any) -> eg.ArgumentError:
    with pytest.raises(eg.ArgumentError) as caught:
        make(**arguments)
    return caught.value


@pytest.mark.parametrize(
    ("change", "argument", "told"),
    [
        ({"model": "SIMPLE_RADAIL"}, "model", "did you mean 'SIMPLE_RADIAL'?"),
        ({"model": "simple_radial"}, "model", "did you mean 'SIMPLE_RADIAL'?"),
        ({"model": "FOV"}, "model", "one of "),
        ({"model": 3}, "model", "one of "),
        ({"params": [[800.0, 320.0, 240.0]] * 2}, "params", "f cx cy k"),
        ({"params": [800.0, 320.0, 240.0, 0.1]}, "params", "shape (4,)"),
        ({"params": np.zeros((0, 4))}, "params", "no row"),
        ({"params": [[800.0, 320.0, 240.0, np.nan]] * 2}, "params", "nan in row 0"),
        ({"params": [[800.0, 1e300, 240.0, 0.0]] * 2}, "params", "1e+300"),
        ({"params": [[-800.0, 320.0, 240.0, 0.0]] * 2}, "params", "f = -800 in row 0"),
        ({"params": [[0.0, 320.0, 240.0, 0.0]] * 2}, "params", "f = 0 in row 0"),
        ({"params": [[1e12, 320.0, 240.0, 0.0]] * 2}, "params", "f = 1e+12 in row 0"),
        ({"params": [["a"] * 4] * 2}, "params", "real numbers"),
        ({"camera_of_view": [0, 1, 2]}, "camera_of_view", "is 2 for view 2; needed: 0 to 1"),
        ({"camera_of_view": [0, -1, 1]}, "camera_of_view", "is -1 for view 1"),
        ({"camera_of_view": [0, 0, 0]}, "camera_of_view", "no view of camera 1"),
        ({"camera_of_view": [0.0, 1.0]}, "camera_of_view", "integers"),
        ({"camera_of_view": []}, "camera_of_view", "integers"),
    ],
)
def test_cameras_refuse_by_name(change: dict[str, Any], argument: str, told: str) -> None:
    error = refused(eg.Cameras, **GOOD | change)
    assert error.argument == argument
    assert told in str(error)


def test_an_unknown_model_is_answered_with_all_known_ones() -> None:
    assert all(name in str(refused(eg.Cameras, **GOOD | {"model": "FOV"})) for name in models())


@pytest.mark.parametrize(
    ("change", "argument", "told"),
    [
        ({"R": np.eye(3)}, "R", "(n, 3, 3)"),
        ({"R": [2.0 * np.eye(3)] * 3}, "R", "np.linalg.svd"),
        ({"R": [np.eye(3), np.diag([1.0, 1.0, 1.0 + 1e-6]), np.eye(3)]}, "R", "in row 1"),
        ({"R": [-np.eye(3)] * 3}, "R", "reflection"),
        ({"R": [np.full((3, 3), np.nan)] * 3}, "R", "nan in row 0"),
        ({"R": [np.eye(3)] * 2}, "R", "2 rows; needed: 3"),
        ({"t": np.zeros((4, 3))}, "t", "4 rows; needed: 3"),
        ({"t": np.full((3, 3), np.inf)}, "t", "inf in row 0"),
        ({"X": np.zeros((5, 4))}, "X", "(n, 3)"),
        ({"X": np.zeros((0, 3))}, "X", "no row"),
        ({"cameras": "bal"}, "cameras", "eg.Cameras"),
    ],
)
def test_reconstructions_refuse_by_name(change: dict[str, Any], argument: str, told: str) -> None:
    good = {"R": [np.eye(3)] * 3, "t": np.zeros((3, 3)), "X": np.zeros((5, 3))}
    error = refused(eg.MetricReconstruction, **good | {"cameras": eg.Cameras(**GOOD)} | change)
    assert error.argument == argument
    assert told in str(error)


def test_projective_cameras_are_no_metric_ones() -> None:
    name = next(name for name, model in models().items() if not model.metric)
    cameras = eg.Cameras(name, np.zeros((1, len(models()[name].params))), [0, 0])
    arguments = {"R": [np.eye(3)] * 2, "t": np.zeros((2, 3)), "X": np.ones((1, 3))}
    assert "no rotation" in str(refused(eg.MetricReconstruction, **arguments, cameras=cameras))


def test_arrays_are_read_only_copies_here_and_after_pickling() -> None:
    X = np.zeros((5, 3))
    scene = eg.MetricReconstruction([np.eye(3)] * 3, np.ones((3, 3)), X, eg.Cameras(**GOOD))
    X[:] = 7.0
    assert not scene.X.any()
    copy = pickle.loads(pickle.dumps(scene))  # noqa: S301 - its own bytes
    for each in (scene, copy):
        for array in (each.R, each.t, each.X, each.cameras.params, each.cameras.camera_of_view):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
        np.testing.assert_array_equal(each.vectors, scene.vectors)
    with pytest.raises(AttributeError):
        scene.X = X  # type: ignore[misc]
    assert repr(scene) == (
        "MetricReconstruction(3 views, 5 points, "
        "Cameras('SIMPLE_RADIAL', 2 cameras of 3 views, f 800 to 900))"
    )


@pytest.mark.parametrize("model", METRIC)
def test_images_do_not_change_with_the_similarity_of_space(model: str) -> None:
    tracks, scene = metric_scene(model, seed=3)
    rng = np.random.default_rng(4)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    s, b = 37.0, rng.normal(size=3)
    # X' = s Q X + b
    moved = eg.MetricReconstruction(
        scene.R @ Q.T, s * scene.t - scene.R @ Q.T @ b, s * scene.X @ Q.T + b, scene.cameras
    )
    np.testing.assert_allclose(moved.project(tracks), tracks.xy, atol=1e-9)
    np.testing.assert_allclose(moved.depths(tracks), s * scene.depths(tracks), rtol=1e-11)
    np.testing.assert_allclose(moved.centres, s * scene.centres @ Q.T + b, rtol=1e-11)
    assert (scene.depths(tracks) > 0.0).all()


@pytest.mark.parametrize("model", [name for name in METRIC if models()[name].focal])
def test_the_projective_scene_is_the_scene_near_the_optical_axes(model: str) -> None:
    tracks, scene = metric_scene(model, seed=5)
    # A point on each axis, at any distance, and one beside it.
    sign = looks_along(model)
    for aside, atol in ((0.0, 1e-9), (1e-4, 1e-7)):
        h = sign * np.array([aside, -aside, 1.0]) * 3.0
        X = np.einsum("nji,nj->ni", scene.R, h - scene.t)
        near = eg.MetricReconstruction(scene.R, scene.t, X, scene.cameras)
        same = np.arange(scene.n_views)
        images = near.project(
            eg.Tracks(
                *(a.ravel() for a in np.meshgrid(same, same)), np.zeros((16, 2)), min_points=1
            )
        )
        at = near.to_projective().P @ np.column_stack([X, np.ones(len(X))]).T
        own = np.array([P[:2, i] / P[2, i] for i, P in enumerate(at)])
        np.testing.assert_allclose(own, images[:: scene.n_views + 1], atol=atol)
    assert tracks.n_views == len(scene.to_projective().P)


@pytest.mark.parametrize("model", METRIC)
def test_images_agree_with_colmap(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    if model not in pycolmap.CameraModelId.__members__:
        pytest.skip("not a model of COLMAP")
    tracks, scene = metric_scene(model, seed=6, n_points=200)
    for i, params in enumerate(scene.cameras.of_views):
        camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
        seen = tracks.view == i
        h = scene.X[tracks.point[seen]] @ scene.R[i].T + scene.t[i]
        np.testing.assert_allclose(camera.img_from_cam(h), tracks.xy[seen], atol=1e-9)


def test_other_tracks_are_refused() -> None:
    tracks, _ = metric_scene("bal", seed=1)
    other = metric_scene("bal", seed=1, n_points=31)[1]
    for use in (other.project, other.depths):
        assert refused(use, tracks=tracks).argument == "tracks"


@pytest.mark.parametrize("model", METRIC)
def test_every_parameter_moves_some_image(model: str) -> None:
    tracks, scene = metric_scene(model, seed=7)
    known = models()[model]
    params = parameters(model, 2, np.random.default_rng(8))
    fixed = eg.Cameras(model, params, scene.cameras.camera_of_view)
    first = eg.MetricReconstruction(scene.R, scene.t, scene.X, fixed).project(tracks)
    for k, name in enumerate(known.params):
        if name in known.constants:
            continue
        moved = params.copy()
        moved[:, k] += 1e-3
        cameras = eg.Cameras(model, moved, scene.cameras.camera_of_view)
        images = eg.MetricReconstruction(scene.R, scene.t, scene.X, cameras).project(tracks)
        assert np.abs(images - first).max() > 1e-9, name
