"""Scenes and tracks of Bundler and OpenSfM, and for viewers: by independent small programs."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError, FileFormatError
from metric_scenes import metric_scene

NAMES = [f"photo{k}.jpg" for k in range(4)]
SIZES = np.tile([640, 480], (4, 1))


def scene(model: str, seed: int = 2, **options: Any) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return a scene with names, sizes and colours."""
    tracks, found = metric_scene(model, seed, noise_px=0.2, **options)
    rng = np.random.default_rng(seed)
    named = eg.Tracks(
        tracks.view,
        tracks.point,
        tracks.xy,
        names=NAMES,
        sizes=SIZES,
        colours=rng.integers(0, 256, (tracks.n_points, 3)),
    )
    return named, found


# Bundler


def bundler(tracks: eg.Tracks, found: eg.MetricReconstruction, lost: int | None = None) -> str:
    """Write a scene of BAL's cameras as the manual says; one camera may be lost."""
    lines = ["# Bundle file v0.3", f"{tracks.n_views + (lost is not None)} {tracks.n_points}"]
    numbers = list(range(tracks.n_views))
    for i, (own, R, t) in enumerate(zip(found.cameras.of_views, found.R, found.t, strict=True)):
        if i == lost:
            lines += ["0 0 0"] * 5
        if lost is not None and i >= lost:
            numbers[i] = i + 1
        for row in (own, *R, t):
            lines.append(" ".join(f"{value:.10e}" for value in row))
    for j, X in enumerate(found.X):
        lines += [" ".join(f"{value:.17g}" for value in X), "10 20 30"]
        rows = np.flatnonzero(tracks.point == j)
        quadruples = [
            f"{numbers[tracks.view[k]]} {k} {tracks.xy[k, 0]:.6f} {tracks.xy[k, 1]:.6f}"
            for k in rows
        ]
        lines.append(" ".join([str(len(rows)), *quadruples]))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("lost", [None, 1])
def test_a_bundle_file_is_read(lost: int | None, tmp_path: Path) -> None:
    tracks, truth = scene("bal", n_cameras=4)
    (tmp_path / "bundle.out").write_text(bundler(tracks, truth, lost))
    names = NAMES if lost is None else [NAMES[0], "lost.jpg", *NAMES[1:]]
    (tmp_path / "list.txt").write_text("".join(f"{name} 0 700\n" for name in names))
    read, found = eg.load_scene(tmp_path / "bundle.out")
    np.testing.assert_allclose(read.xy, tracks.xy, atol=1e-6)
    np.testing.assert_array_equal(read.view, tracks.view)
    assert list(read.names or ()) == NAMES
    assert (np.asarray(read.colours) == [10, 20, 30]).all()
    np.testing.assert_allclose(found.project(read), truth.project(tracks), atol=1e-5)
    assert read.source.notes == (() if lost is None else ("cameras not registered: 1",))
    assert eg.bundle_adjust(read, found).success


@pytest.mark.parametrize("model", ["bal", "RADIAL", "SIMPLE_RADIAL"])
def test_a_bundle_file_is_written(model: str, tmp_path: Path) -> None:
    tracks, truth = scene(model, n_cameras=4)
    eg.save_scene(tmp_path / "bundle.out", tracks, truth)
    read, found = eg.load_scene(tmp_path / "bundle.out")
    assert list(read.names or ()) == NAMES
    np.testing.assert_array_equal(read.colours, tracks.colours)
    np.testing.assert_allclose(found.rms_px(read), truth.rms_px(tracks), rtol=1e-9)
    np.testing.assert_allclose(found.X, truth.X, rtol=1e-15)


@pytest.mark.parametrize(
    ("line", "text", "reason"),
    [
        (1, "# Bundle file v0.2", "line 1: is '# Bundle file v0.2', needed"),
        (2, "4", "line 2: holds 1 values, needed: 2"),
        (2, "4 -1", "line 2: says"),
        (4, "1 0", "line 4: holds 2 values, needed: 3: a row of R"),
        (4, "2 0 0", "line 6: ends a matrix R that is no rotation"),
        (7, "0 0 nan", "line 7: holds a number that is not finite"),
        (7, "0 0 zero", "line 7: is '0 0 zero', needed: t"),
        (24, "10 20 300", "line 24: is no colour"),
        (25, "2 0 0 1 1", "line 25: says 2 views, but holds 1"),
        (25, "1 9 0 1 1", "line 25: says camera 9, needed: one of 4"),
    ],
)
def test_a_bad_bundle_file_is_refused_by_its_line(
    line: int, text: str, reason: str, tmp_path: Path
) -> None:
    lines = bundler(*scene("bal", n_cameras=4)).splitlines()
    lines[line - 1] = text
    (tmp_path / "bundle.out").write_text("\n".join(lines))
    with pytest.raises(FileFormatError, match=reason):
        eg.load_scene(tmp_path / "bundle.out")


def test_a_bundle_file_that_ends_early_is_refused(tmp_path: Path) -> None:
    text = bundler(*scene("bal", n_cameras=4))
    (tmp_path / "bundle.out").write_text(text[: len(text) // 2])
    with pytest.raises(FileFormatError, match=r"line \d+: "):
        eg.load_scene(tmp_path / "bundle.out")


# OpenSfM


def opensfm(tracks: eg.Tracks, version: int) -> str:
    """Write tracks as OpenSfM does: in units of the longer side from the middle, with tabs."""
    lines = [f"OPENSFM_TRACKS_VERSION_v{version}"]
    for view, point, (x, y) in zip(tracks.view, tracks.point, tracks.xy, strict=True):
        u, v = (x + 0.5 - 320.0) / 640.0, (y + 0.5 - 240.0) / 640.0
        colour = [int(c) for c in tracks.colours[point]]
        fields = [NAMES[view], f"t{point:03d}", 7, repr(float(u)), repr(float(v)), 0.004, *colour]
        lines.append("\t".join(map(str, [*fields, *([-1, -1] if version == 2 else [])])))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("known", ["exif", "argument"])
def test_tracks_of_opensfm_are_read(version: int, known: str, tmp_path: Path) -> None:
    tracks, _ = scene("PINHOLE", n_points=40)
    path = tmp_path / "tracks.csv"
    path.write_text(opensfm(tracks, version))
    options: dict[str, Any] = {"image_size": (640, 480)}
    if known == "exif":
        options = {}
        (tmp_path / "exif").mkdir()
        for name in NAMES:
            exif = {"width": 640, "height": 480, "camera": "v2 unknown"}
            (tmp_path / "exif" / f"{name}.exif").write_text(json.dumps(exif))
    read = eg.load_tracks(path, **options)
    np.testing.assert_allclose(read.xy, tracks.xy, atol=1e-9)
    np.testing.assert_array_equal(read.view, tracks.view)
    np.testing.assert_array_equal(read.colours, tracks.colours)
    np.testing.assert_array_equal(read.sizes, SIZES)
    assert list(read.names or ()) == NAMES


def test_tracks_of_opensfm_without_a_size_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text(opensfm(scene("PINHOLE")[0], 2))
    with pytest.raises(ArgumentError, match=r"image_size is not known for photo0\.jpg"):
        eg.load_tracks(path)
    (tmp_path / "exif").mkdir()
    for name in NAMES:
        (tmp_path / "exif" / f"{name}.exif").write_text('{"width": 640}')
    with pytest.raises(FileFormatError, match="tells no width and height"):
        eg.load_tracks(path)
    with pytest.raises(ArgumentError, match="two positive integers"):
        eg.load_tracks(path, image_size=(640, 0))
    eg.multi_view_scene().tracks.save(tmp_path / "own.csv")
    with pytest.raises(ArgumentError, match="image_size is given for"):
        eg.load_tracks(tmp_path / "own.csv", image_size=(640, 480))


@pytest.mark.parametrize(
    ("line", "text", "reason"),
    [
        (1, "OPENSFM_TRACKS_VERSION_v3", "line 1: is of version '_v3'"),
        (3, "photo0.jpg\tt1\t7\t0.1", "line 3: holds 4 fields, needed: 11"),
        (3, "photo0.jpg\tt1\t7\tx\t0\t1\t1\t1\t1\t-1\t-1", "line 3: holds something"),
        (4, "photo0.jpg\tt1\t7\tinf\t0\t1\t1\t1\t1\t-1\t-1", "line 4: holds no finite"),
    ],
)
def test_bad_tracks_of_opensfm_are_refused_by_their_line(
    line: int, text: str, reason: str, tmp_path: Path
) -> None:
    lines = opensfm(scene("PINHOLE")[0], 2).splitlines()
    lines[line - 1] = text
    (tmp_path / "tracks.csv").write_text("\n".join(lines))
    with pytest.raises(FileFormatError, match=reason):
        eg.load_tracks(tmp_path / "tracks.csv", image_size=(640, 480))


# For viewers


def seen_by_opengl(pose: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return points in a camera that looks along -z with y up, from its pose."""
    return (np.linalg.inv(pose) @ np.column_stack([X, np.ones(len(X))]).T).T[:, :3]


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV"])
@pytest.mark.parametrize("n_cameras", [1, 2])
def test_transforms_project_to_the_same_pixels(model: str, n_cameras: int, tmp_path: Path) -> None:
    tracks, truth = scene(model, n_cameras=n_cameras)
    eg.save_scene(tmp_path / "transforms.json", tracks, truth)
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert document["camera_model"] == "OPENCV"
    assert [frame["file_path"] for frame in document["frames"]] == NAMES
    predicted = truth.project(tracks)
    for i, frame in enumerate(document["frames"]):
        own = document | frame
        assert (own["w"], own["h"]) == (640, 480)
        seen = seen_by_opengl(np.array(own["transform_matrix"]), truth.X[tracks.point])
        x, y = seen[:, 0] / -seen[:, 2], -seen[:, 1] / -seen[:, 2]
        r2 = x * x + y * y
        k1, k2, p1, p2 = (own.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
        radial = 1.0 + k1 * r2 + k2 * r2 * r2
        dx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        dy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        pixels = np.column_stack([own["fl_x"] * dx + own["cx"], own["fl_y"] * dy + own["cy"]])
        mine = tracks.view == i
        np.testing.assert_allclose(pixels[mine], predicted[mine], atol=1e-8)


def test_transforms_say_what_is_missing(tmp_path: Path) -> None:
    tracks, truth = metric_scene("PINHOLE")
    with pytest.raises(ArgumentError, match=r"tracks\.names are not known"):
        eg.save_scene(tmp_path / "transforms.json", tracks, truth)
    with pytest.raises(ArgumentError, match="has cameras of the model 'bal'"):
        eg.save_scene(tmp_path / "transforms.json", *scene("bal"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("model", ["PINHOLE", "bal"])
def test_gltf_holds_points_and_cameras_that_see_them(model: str, tmp_path: Path) -> None:
    tracks, truth = scene(model, n_cameras=4)
    eg.save_scene(tmp_path / "scene.glb", tracks, truth)
    data = (tmp_path / "scene.glb").read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert (kind, size % 4) == (b"JSON", 0)
    document = json.loads(data[20 : 20 + size])
    count, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    binary = data[28 + size :]
    assert (kind, count % 4, len(binary)) == (b"BIN\0", 0, count)
    roots = document["scenes"][document["scene"]]["nodes"]
    reached = [child for root in roots for child in (root, *document["nodes"][root]["children"])]
    assert sorted(reached) == list(range(len(document["nodes"])))
    position, colour = document["accessors"]
    X = np.frombuffer(binary, "<f4", 3 * position["count"]).reshape(-1, 3)
    np.testing.assert_allclose(X, truth.X, rtol=1e-6)
    np.testing.assert_allclose(position["max"], X.max(axis=0))
    rgba = np.frombuffer(binary, "u1", 4 * colour["count"], X.nbytes).reshape(-1, 4)
    np.testing.assert_array_equal(rgba[:, :3], tracks.colours)
    cameras = [node for node in document["nodes"] if "camera" in node]
    assert [node["name"] for node in cameras] == NAMES
    for i, node in enumerate(cameras):
        pose = np.array(node["matrix"]).reshape(4, 4).T
        seen = seen_by_opengl(pose, truth.X)
        lens = document["cameras"][node["camera"]]["perspective"]
        half = np.tan(0.5 * lens["yfov"]) * np.array([lens["aspectRatio"], 1.0])
        assert (seen[:, 2] < 0.0).all()  # in front
        shown = seen[:, :2] / -seen[:, 2:] / half * [320.0, 240.0]
        if model == "PINHOLE":
            fx, fy, cx, cy = truth.cameras.of_views[i]
            expected = (tracks.xy[tracks.view == i] - [cx, cy]) * [1.0, -1.0]
            expected[:, 0] *= fy / fx  # glTF has one focal length
        else:
            expected = tracks.xy[tracks.view == i]
        rows = tracks.point[tracks.view == i]
        np.testing.assert_allclose(shown[rows], expected, atol=8.0)  # noise and distortion


def test_gltf_frames_images_of_unknown_size_by_what_was_seen(tmp_path: Path) -> None:
    tracks, truth = metric_scene("PINHOLE", 2, noise_px=0.2)
    eg.save_scene(tmp_path / "scene.glb", tracks, truth)
    data = (tmp_path / "scene.glb").read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    for i, camera in enumerate(document["cameras"]):
        width, height = np.ptp(tracks.xy[tracks.view == i], axis=0)
        assert camera["perspective"]["aspectRatio"] == pytest.approx(width / height)


def test_colmap_folders_keep_names_and_sizes(tmp_path: Path) -> None:
    tracks, truth = scene("PINHOLE")
    eg.save_scene(tmp_path / "sparse", tracks, truth, text=True)
    text = (tmp_path / "sparse" / "images.txt").read_text()
    assert all(name in text for name in NAMES)
    assert " PINHOLE 640 480 " in (tmp_path / "sparse" / "cameras.txt").read_text()
