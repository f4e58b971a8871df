"""Pinhole cameras near projective ones, and COLMAP text models of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.io import save_colmap_model
from epigauge.multi_view.display import display
from epigauge.multi_view.pinhole import _decomposed, pinhole_model
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCENE = eg.multi_view_scene(n_points=40, noise_px=0.3, distance=4.0, seed=2, visible=0.8)
RESULT = eg.bundle_adjust(SCENE.tracks)
FRAME = display(RESULT.reconstruction, SCENE.tracks)
MODEL = pinhole_model(RESULT.reconstruction, SCENE.tracks, frame=FRAME)


def rotations(n: int, rng: np.random.Generator) -> Array:
    Q = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


def cameras(skew: float, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Return fx, fy, cx, cy and poses of 20 cameras, and the cameras at random scales."""
    intrinsics = rng.uniform([500, 500, 200, 200], [900, 900, 400, 400], (20, 4))
    K = np.zeros((20, 3, 3))
    K[:, [0, 1], [0, 1]], K[:, :2, 2], K[:, 2, 2] = intrinsics[:, :2], intrinsics[:, 2:], 1.0
    K[:, 0, 1] = skew
    R, t = rotations(20, rng), rng.standard_normal((20, 3))
    P = rng.choice([-3.0, 0.2], 20)[:, None, None] * K @ np.concatenate([R, t[..., None]], axis=2)
    return intrinsics, R, t, P


def test_camera_without_skew_is_taken_apart_exactly() -> None:
    intrinsics, R, t, P = cameras(0.0, np.random.default_rng(0))
    for found, true in zip(_decomposed(P), (intrinsics, R, t), strict=True):
        np.testing.assert_allclose(found, true, rtol=1e-10, atol=1e-10)


def projected_by(values: Array, R: Array, t: Array, X: Array) -> Array:
    """Project points (m, 3) by a camera with fx, fy, cx, cy and a pose."""
    seen = X @ R.T + t
    return values[:2] * seen[:, :2] / seen[:, 2:] + values[2:]


def test_least_of_the_skew_is_lost() -> None:
    rng = np.random.default_rng(1)
    intrinsics, R, t, P = cameras(12.0, rng)
    kept, poses, shifts = _decomposed(P)
    identity = np.tile(np.eye(3), (20, 1, 1))
    np.testing.assert_allclose(poses @ poses.swapaxes(1, 2), identity, atol=1e-12)
    assert (np.linalg.det(poses) > 0.0).all()
    rays = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), np.ones(200)]) * 5.0
    for k in range(20):
        X = (rays - t[k]) @ R[k]  # in front of the camera, within its view
        truth = np.column_stack([X, np.ones(200)]) @ P[k].T
        truth = truth[:, :2] / truth[:, 2:]
        error = projected_by(kept[k], poses[k], shifts[k], X) - truth
        dropped = projected_by(intrinsics[k], R[k], t[k], X) - truth
        # To first order in the skew, and for rays spread evenly about the axis.
        fx, fy = intrinsics[k, :2]
        share = np.linalg.norm(error) / np.linalg.norm(dropped)
        assert share == pytest.approx(fy / np.hypot(fx, fy), rel=0.1)


def test_model_is_the_reconstruction_but_for_the_skew() -> None:
    assert MODEL.ahead.all()
    assert MODEL.projective_rms_px == pytest.approx(RESULT.rms_px, rel=1e-9)
    assert MODEL.projective_rms_px <= MODEL.rms_px < 2.0 * RESULT.rms_px
    np.testing.assert_array_equal(MODEL.xy, SCENE.tracks.xy)
    assert MODEL.rms_px == pytest.approx(np.sqrt(np.mean(MODEL.residuals**2)))
    # 1000 px, and not calibrated.
    np.testing.assert_allclose(MODEL.intrinsics[:, :2], 1000.0, rtol=0.25)


def test_images_with_y_up_are_turned_over() -> None:
    t = SCENE.tracks
    tracks = eg.Tracks(t.view, t.point, t.xy * [1.0, -1.0])
    P = np.diag([1.0, -1.0, 1.0]) @ RESULT.reconstruction.P
    model = pinhole_model(eg.Reconstruction(P, RESULT.reconstruction.Q), tracks, y_up=True)
    np.testing.assert_allclose(model.xy, t.xy)
    np.testing.assert_allclose(model.rms_px, MODEL.rms_px, rtol=1e-5)
    np.testing.assert_allclose(model.intrinsics, MODEL.intrinsics, rtol=1e-4, atol=0.05)


def test_cameras_like_no_pinholes_are_refused() -> None:
    frame = dataclasses.replace(FRAME, deviation=8.6)
    with pytest.raises(ArgumentError, match=r"no basis .* pinhole cameras: .* 8\.6 .* robust loss"):
        pinhole_model(RESULT.reconstruction, SCENE.tracks, frame=frame)
    frame = dataclasses.replace(FRAME, ahead=np.arange(40) < 10)
    with pytest.raises(ArgumentError, match="pinhole cameras"):
        pinhole_model(RESULT.reconstruction, SCENE.tracks, frame=frame)


# COLMAP's text format


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def read(directory: Path) -> tuple[Array, Array, Array]:
    """Return observed and projected image points, and points' errors, from a text model alone."""
    K = {row[0]: np.array(row[4:], dtype=float) for row in rows(directory / "cameras.txt")}
    X = {row[0]: np.array(row[1:4], dtype=float) for row in rows(directory / "points3D.txt")}
    images = rows(directory / "images.txt")
    observed, projected, of_point = [], [], []
    for head, points in zip(images[::2], images[1::2], strict=True):
        w, x, y, z, *t = map(float, head[1:8])
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        for u, v, point in zip(points[::3], points[1::3], points[2::3], strict=True):
            seen = R @ X[point] + t
            values = K[head[8]]
            observed.append([float(u), float(v)])
            projected.append(values[:2] * seen[:2] / seen[2] + values[2:])
            of_point.append(int(point))
    return np.array(observed), np.array(projected), np.array(of_point)


def test_text_model_holds_the_cameras_and_points(tmp_path) -> None:
    save_colmap_model(tmp_path / "model", MODEL, SCENE.tracks)
    observed, projected, of_point = read(tmp_path / "model")
    residuals = observed - projected
    assert len(observed) == len(SCENE.tracks)
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(MODEL.rms_px, rel=1e-9)
    # The scene has its origin amid the image: no coordinate may be outside of COLMAP's image.
    assert observed.min() >= 0.0
    for row in rows(tmp_path / "model" / "cameras.txt"):
        assert row[1] == "PINHOLE"
        assert observed.max(axis=0)[0] <= int(row[2])
        assert observed.max(axis=0)[1] <= int(row[3])
    images = rows(tmp_path / "model" / "images.txt")
    for row in rows(tmp_path / "model" / "points3D.txt"):
        lengths = np.linalg.norm(residuals[of_point == int(row[0])], axis=1)
        assert float(row[7]) == pytest.approx(lengths.mean(), rel=1e-4)
        # The track leads back to the point.
        for image, index in zip(row[8::2], row[9::2], strict=True):
            assert images[2 * int(image) - 1][3 * int(index) + 2] == row[0]
        assert len(row[8::2]) == len(lengths)
    head = (tmp_path / "model" / "images.txt").read_text().splitlines()[:3]
    assert "no calibration" in " ".join(head)
    assert f"{MODEL.rms_px:.6g} px" in head[2]


def test_points_behind_are_left_out(tmp_path) -> None:
    model = dataclasses.replace(MODEL, ahead=np.arange(40) != 7)
    save_colmap_model(tmp_path, model, SCENE.tracks, names=[f"{k}.jpg" for k in range(5)])
    assert 8 not in read(tmp_path)[2]
    assert len(rows(tmp_path / "points3D.txt")) == 39
    assert [row[9] for row in rows(tmp_path / "images.txt")[::2]] == [f"{k}.jpg" for k in range(5)]


def test_colmap_reads_the_model(tmp_path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the reader compared with is pycolmap's")
    save_colmap_model(tmp_path, MODEL, SCENE.tracks)
    model = pycolmap.Reconstruction(tmp_path)
    assert model.num_images() == 5
    assert model.num_points3D() == 40
    residuals = [
        image.project_point(model.points3D[p.point3D_id].xyz) - p.xy
        for image in model.images.values()
        for p in image.points2D
    ]
    assert np.sqrt(np.mean(np.square(residuals))) == pytest.approx(MODEL.rms_px, rel=1e-6)


@pytest.mark.parametrize(
    "names", [["a", "b", "c", "d"], ["a", "b", "c", "d", "d"], [*"abcd", "e f"]]
)
def test_names_that_colmap_cannot_tell_apart_are_refused(tmp_path, names) -> None:
    with pytest.raises(ArgumentError, match="5 different ones without white space"):
        save_colmap_model(tmp_path / "model", MODEL, SCENE.tracks, names=names)
    assert not (tmp_path / "model").exists()


def test_model_that_fails_half_way_leaves_the_old_one(tmp_path, monkeypatch) -> None:
    save_colmap_model(tmp_path, MODEL, SCENE.tracks)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("epigauge.io._colmap_text._point_lines", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_colmap_model(tmp_path, dataclasses.replace(MODEL, t=2.0 * MODEL.t), SCENE.tracks)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_with_a_binary_model_is_refused(tmp_path) -> None:
    (tmp_path / "cameras.bin").write_bytes(b"old")
    with pytest.raises(ArgumentError, match=r"holds cameras\.bin of another"):
        save_colmap_model(tmp_path, MODEL, SCENE.tracks)
    assert [path.name for path in tmp_path.iterdir()] == ["cameras.bin"]
