"""Scenes in files: what is read is what was written, and what cannot be kept or read is named."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.cameras import models
from metric_scenes import COLMAP, METRIC, metric_scene

Scene = tuple[eg.Tracks, eg.MetricReconstruction]

#: Rotation matrices pass through quaternions or Rodrigues vectors.
ROUNDING = 4e-15


def labelled(model: str, seed: int = 0, **more: Any) -> Scene:
    """Return a scene with everything that COLMAP has a place for."""
    tracks, scene = metric_scene(model, seed)
    rng = np.random.default_rng(seed)
    n, m = tracks.n_views, tracks.n_points
    again = rng.choice(len(tracks), 5)  # second sightings
    rows = np.concatenate([np.arange(len(tracks)), again])
    xy = tracks.xy[rows] + rng.normal(0.0, 0.5, (len(rows), 2))
    labels = {
        "names": [f"bild {k}.jpg" for k in range(n)] if more.pop("blank", False) else None,
        "sizes": [(640, 480)] * n,
        "colours": rng.integers(0, 256, (m, 3)),
    }
    labels["names"] = labels["names"] or [f"é/{k}.jpg" for k in range(n)]
    return eg.Tracks(
        tracks.view[rows], tracks.point[rows], xy, repeated=True, **labels | more
    ), scene


def check_same(a: Scene, b: Scene, rounding: float = 0.0) -> None:
    """Check that two scenes are the same, to the last bit but for R."""
    for name in ("view", "point", "xy", "weights", "sizes", "colours"):
        np.testing.assert_array_equal(getattr(a[0], name), getattr(b[0], name), name)
    assert a[0].names == b[0].names
    for name in ("t", "X"):
        np.testing.assert_array_equal(getattr(a[1], name), getattr(b[1], name), name)
    np.testing.assert_allclose(a[1].R, b[1].R, rtol=0.0, atol=rounding)
    cameras = a[1].cameras, b[1].cameras
    assert cameras[0].model == cameras[1].model
    for name in ("params", "camera_of_view"):
        np.testing.assert_array_equal(getattr(cameras[0], name), getattr(cameras[1], name), name)


def contents(path: Path) -> dict[str, bytes]:
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return {file.name.removeprefix("again"): file.read_bytes() for file in files}


def refusal(call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    with pytest.raises((eg.ArgumentError, eg.FileFormatError)) as caught:
        call(*arguments, **options)
    return str(caught.value)


@pytest.mark.parametrize("model", METRIC)
def test_npz_holds_every_scene(tmp_path: Path, model: str) -> None:
    weights = np.linspace(0.5, 2.0, len(labelled(model)[0]))
    for k, scene in enumerate((labelled(model, weights=weights), metric_scene(model))):
        path = tmp_path / f"{k}.npz"
        eg.save_scene(path, *scene)
        check_same(scene, eg.load_scene(path))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", COLMAP)
def test_colmap_folders_hold_scenes_of_colmaps_cameras(
    tmp_path: Path, model: str, text: bool
) -> None:
    scene = labelled(model, blank=not text)
    eg.save_scene(tmp_path / "a", *scene, text=text)
    found = eg.load_scene(tmp_path / "a")
    check_same(scene, found, ROUNDING)
    # From file to file nothing is rounded, whatever is between.
    for name in ("b", "c.npz", "d"):
        eg.save_scene(tmp_path / name, *found, text=text)
        found = eg.load_scene(tmp_path / name)
    assert contents(tmp_path / "b") == contents(tmp_path / "d")


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", COLMAP)
def test_colmap_reads_what_is_written(tmp_path: Path, model: str, text: bool) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    if model not in pycolmap.CameraModelId.__members__:
        pytest.skip("this COLMAP has no such model")
    tracks, scene = labelled(model)
    eg.save_scene(tmp_path, tracks, scene, text=text)
    read = pycolmap.Reconstruction(tmp_path)
    assert read.num_reg_images() == tracks.n_views
    assert read.compute_num_observations() == len(tracks)
    for i, name in enumerate(tracks.names):
        image = read.find_image_with_name(name)
        pose = np.column_stack([scene.R[i], scene.t[i]])
        np.testing.assert_allclose(image.cam_from_world().matrix(), pose, rtol=0, atol=ROUNDING)
        camera = read.cameras[image.camera_id]
        assert (camera.model.name, camera.width, camera.height) == (model.upper(), 640, 480)
        np.testing.assert_array_equal(camera.params, scene.cameras.of_views[i])
        seen = sorted((p.point3D_id - 1, *p.xy.tolist()) for p in image.points2D if p.has_point3D())
        rows = tracks.view == i
        xy = tracks.xy[rows].tolist()
        assert seen == sorted(
            (j, *at) for j, at in zip(tracks.point[rows].tolist(), xy, strict=True)
        )
    for j, point in read.points3D.items():
        np.testing.assert_array_equal(point.xyz, scene.X[j - 1])
        np.testing.assert_array_equal(point.color, tracks.colours[j - 1])
        assert point.track.length() == np.count_nonzero(tracks.point == j - 1)
    errors = {j: point.error for j, point in read.points3D.items()}
    read.update_point_3d_errors()
    # COLMAP measures spherical images by angles, to which the stored pixels are near.
    limit = 0.02 if model == "EQUIRECTANGULAR" else 1e-9
    assert all(abs(read.points3D[j].error - error) < limit for j, error in errors.items())


@pytest.mark.parametrize("name", ["p.txt", "p.txt.gz", "p.txt.bz2", "p.bal"])
def test_bal_files_hold_scenes_of_their_cameras(tmp_path: Path, name: str) -> None:
    scene = metric_scene("bal", n_cameras=4, noise_px=0.5)
    eg.save_scene(tmp_path / name, *scene)
    found = eg.load_scene(tmp_path / name)
    check_same(scene, found, ROUNDING)
    for again in (f"again{name}", "n.npz", f"again{name}"):
        eg.save_scene(tmp_path / again, *found)
        found = eg.load_scene(tmp_path / again)
    assert contents(tmp_path / f"again{name}") == contents(tmp_path / name)


@pytest.mark.parametrize(("problem", "cost"), [("49-7776", 8.509125e05), ("16-22106", 4.185660e06)])
def test_bal_problems_cost_what_is_published(data_dir: Path, problem: str, cost: float) -> None:
    tracks, scene = eg.load_scene(data_dir / "bal" / f"problem-{problem}-pre.txt.bz2")
    assert 0.5 * np.sum((tracks.xy - scene.project(tracks)) ** 2) == pytest.approx(cost, rel=1e-6)


def test_a_model_of_colmap_with_its_quirks(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "colmap_model"
    tracks, scene = eg.load_scene(folder)
    assert (tracks.n_views, tracks.n_points, len(tracks)) == (177, 4217, 129186)
    assert tracks.n_repeated == 9743
    cost = 0.5 * np.sum((tracks.xy - scene.project(tracks)) ** 2)
    assert cost == pytest.approx(2.375024e05, rel=1e-6)
    assert len(eg.load_scene(folder, repeated="first")[0]) == 129186 - 9743
    assert "9743 second sightings" in refusal(eg.load_scene, folder, repeated="refuse")
    pycolmap = pytest.importorskip("pycolmap")
    eg.save_scene(tmp_path, tracks, scene)
    a, b = pycolmap.Reconstruction(folder), pycolmap.Reconstruction(tmp_path)
    for what in ("cameras", "images", "points3D"):
        assert sorted(getattr(a, what)) == sorted(getattr(b, what))
    for k, image in a.images.items():
        other = b.images[k]
        assert (image.name, image.camera_id) == (other.name, other.camera_id)
        assert (image.cam_from_world().matrix() == other.cam_from_world().matrix()).all()
        for own, its in zip(image.points2D, other.points2D, strict=True):
            assert own.point3D_id == its.point3D_id
            assert (own.xy == its.xy).all()
    for k, point in a.points3D.items():
        assert (point.xyz == b.points3D[k].xyz).all()
        assert (point.color == b.points3D[k].color).all()


def synthetic(tmp_path: Path, **options: Any) -> Any:
    """Return a reconstruction made up by COLMAP, also written to files of both forms."""
    pycolmap = pytest.importorskip("pycolmap")
    wanted = pycolmap.SyntheticDatasetOptions()
    for name, value in ({"num_points3D": 20, "num_frames_per_rig": 3} | options).items():
        setattr(wanted, name, value)
    pycolmap.set_random_seed(3)
    made = pycolmap.synthesize_dataset(wanted)
    for form, write in (("text", made.write_text), ("binary", made.write_binary)):
        (tmp_path / form).mkdir()
        write(tmp_path / form)
    return made


@pytest.mark.parametrize("form", ["text", "binary"])
def test_rigs_have_the_poses_and_are_kept(tmp_path: Path, form: str) -> None:
    made = synthetic(tmp_path, num_rigs=2, num_cameras_per_rig=3)
    images = tmp_path / form / ("images.txt" if form == "text" else "images.bin")
    tracks, scene = eg.load_scene(images.parent)
    by_name = {name: i for i, name in enumerate(tracks.names)}
    for image in made.images.values():
        i = by_name[image.name]
        pose = np.column_stack([scene.R[i], scene.t[i]])
        np.testing.assert_allclose(pose, image.cam_from_world().matrix(), atol=1e-13)
    assert np.abs(tracks.xy - scene.project(tracks)).max() < 1e-9
    eg.save_scene(tmp_path / "o", tracks, scene)
    pycolmap = pytest.importorskip("pycolmap")
    kept = pycolmap.Reconstruction(tmp_path / "o")
    assert str(kept.rigs) == str(made.rigs)
    assert sorted(kept.frames) == sorted(made.frames)
    for k, frame in made.frames.items():
        pose = kept.frames[k].rig_from_world.matrix()
        np.testing.assert_array_equal(pose, frame.rig_from_world.matrix())
    # Moved as a whole the rigs keep their poses; image by image they do not.
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    Q *= np.sign(np.linalg.det(Q))
    turned = eg.MetricReconstruction(scene.R @ Q.T, scene.t, scene.X @ Q.T, scene.cameras)
    eg.save_scene(tmp_path / "o", tracks, turned)
    assert pycolmap.Reconstruction(tmp_path / "o").compute_mean_reprojection_error() < 1e-9
    t = scene.t + np.random.default_rng(1).normal(0.0, 1e-3, scene.t.shape)
    loose = eg.MetricReconstruction(scene.R, t, scene.X, scene.cameras)
    assert "rigs='drop'" in refusal(eg.save_scene, tmp_path / "o", tracks, loose)
    eg.save_scene(tmp_path / "o", tracks, loose, rigs="drop")
    assert pycolmap.Reconstruction(tmp_path / "o").num_frames() == tracks.n_views
    np.testing.assert_array_equal(eg.load_scene(tmp_path / "o")[1].t, t)


@pytest.mark.skipif("OPENCV" not in models(), reason="no camera model that holds several")
def test_cameras_of_several_models_become_one_that_holds_all(tmp_path: Path) -> None:
    made = synthetic(tmp_path, num_rigs=3)
    pycolmap = pytest.importorskip("pycolmap")
    kinds = {1: "SIMPLE_PINHOLE", 2: "RADIAL", 3: "PINHOLE"}
    params = {1: [900.0, 512, 384], 2: [900.0, 512, 384, 0.1, -0.02], 3: [900.0, 910, 512, 384]}
    for k, kind in kinds.items():
        made.cameras[k].model = getattr(pycolmap.CameraModelId, kind)
        made.cameras[k].params = params[k]
    made.write_text(tmp_path / "text")
    tracks, scene = eg.load_scene(tmp_path / "text")
    assert scene.cameras.model == "OPENCV"
    assert "all made OPENCV, exactly" in tracks.source.notes[0]
    images = scene.project(tracks)
    for i, name in enumerate(tracks.names):
        image = made.find_image_with_name(name)
        seen = tracks.view == i
        h = image.cam_from_world() * scene.X[tracks.point[seen]]
        own = made.cameras[image.camera_id].img_from_cam(h)
        np.testing.assert_allclose(own, images[seen], atol=1e-10)
    cameras = tmp_path / "text" / "cameras.txt"
    text = cameras.read_text()
    mixed = re.sub(r"RADIAL.*", "OPENCV_FISHEYE 1024 768 900 900 512 384 0 0 0 0", text)
    cameras.write_text(mixed)
    assert "which no model known here joins" in refusal(eg.load_scene, tmp_path / "text")


def weakened(tmp_path: Path) -> Path:
    """Write a scene in which view 3 sees nothing, point 4 is seen once and point 5 never."""
    tracks, scene = metric_scene("SIMPLE_RADIAL", 2, visible=1.0)
    sees = (tracks.view < 3) & ((tracks.point != 4) | (tracks.view == 0)) & (tracks.point != 5)
    eg.save_scene(tmp_path, tracks, scene, text=True)
    images, points = tmp_path / "images.txt", tmp_path / "points3D.txt"
    lost = {
        (i + 1, j + 1)
        for i, j in zip(*(a[~sees].tolist() for a in (tracks.view, tracks.point)), strict=True)
    }
    lines = images.read_text().splitlines()
    for k, line in enumerate(lines):
        if line.endswith(tuple("0123")) and "view" in line:
            words = lines[k + 1].split()
            number = int(line.split()[0])
            for at in range(2, len(words), 3):
                words[at] = "-1" if (number, int(words[at])) in lost else words[at]
            lines[k + 1] = " ".join(words)
    images.write_text("\n".join(lines) + "\n")
    lines = points.read_text().splitlines()
    for k, line in enumerate(lines):
        words = line.split()
        if not line.startswith("#"):
            pairs = [
                p
                for p in zip(words[8::2], words[9::2], strict=True)
                if (int(p[0]), int(words[0])) not in lost
            ]
            lines[k] = " ".join([*words[:8], *(word for pair in pairs for word in pair)])
    points.write_text("\n".join(lines) + "\n")
    return tmp_path


def test_what_cannot_be_determined_is_left_out_and_told_or_refused(tmp_path: Path) -> None:
    folder = weakened(tmp_path)
    tracks, scene = eg.load_scene(folder)
    assert (tracks.n_views, tracks.n_points) == (3, 28)
    assert len(tracks.source.notes) == 3
    assert "points that one view sees: 1" in " ".join(tracks.source.notes)
    np.testing.assert_array_equal(tracks.source.colmap.point_ids, [*range(1, 5), *range(7, 31)])
    assert np.abs(tracks.xy - scene.project(tracks)).max() < 1e-9
    assert "weak='drop'" in refusal(eg.load_scene, folder, weak="refuse")
    eg.save_scene(folder / "o", tracks, scene)
    check_same((tracks, scene), eg.load_scene(folder / "o"))


def test_what_a_form_has_no_place_for_is_named(tmp_path: Path) -> None:
    tracks, scene = metric_scene("bal", n_cameras=4)
    radial = metric_scene("SIMPLE_RADIAL")
    weighted = eg.Tracks(tracks.view, tracks.point, tracks.xy, weights=np.full(len(tracks), 2.0))
    sized = eg.Tracks(
        radial[0].view, radial[0].point, radial[0].xy, sizes=[(640 + i, 480) for i in range(4)]
    )
    named = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=list("abcd"))
    blank = eg.Tracks(radial[0].view, radial[0].point, radial[0].xy, names=["a b", *"bcd"])
    shared = metric_scene("bal", n_cameras=2)
    heavy = eg.Tracks(sized.view, sized.point, sized.xy, weights=np.linspace(0.5, 1.0, len(sized)))
    for told, name, given, options in (
        ("'bal', which COLMAP does not know", "o", (tracks, scene), {}),
        ("images of 2 sizes by camera 0", "o", (sized, radial[1]), {}),
        ("tracks.weights", "o", (heavy, radial[1]), {}),
        ("white space", "o", (blank, radial[1]), {"text": True}),
        ("'SIMPLE_RADIAL'; needed: eg.interop.colmap_to_bal", "o.txt", radial, {}),
        ("2 cameras for 4 views", "o.txt", shared, {}),
        ("tracks.weights", "o.txt", (weighted, scene), {}),
        ("tracks.names", "o.txt", (named, scene), {}),
        ("as the tracks", "o.npz", (tracks, metric_scene("bal", n_points=31)[1]), {}),
        ("rigs", "o", radial, {"rigs": "loose"}),
    ):
        assert told in refusal(eg.save_scene, tmp_path / name, *given, **options)
        assert list(tmp_path.rglob("*.*")) == []


def test_a_folder_with_a_model_of_the_other_form_is_not_mixed_up(tmp_path: Path) -> None:
    scene = metric_scene("SIMPLE_RADIAL")
    eg.save_scene(tmp_path, *scene, text=True)
    told = refusal(eg.save_scene, tmp_path, *scene)
    assert "cameras.txt of another model; needed: an empty folder, or text=True" in told
    eg.save_scene(tmp_path, *scene, text=True)


#: File, pattern, replacement, what the refusal says; the lines are those of the made-up scene.
BAD = (
    ("cameras", "SIMPLE_RADIAL", "RADAIL", "cameras.txt, line 2: model 'RADAIL' is unknown"),
    ("cameras", "SIMPLE_RADIAL 640", "FOV 640", "line 2"),
    ("cameras", r"640 480 \S+", "640 480 -700.0", "line 2: params has f = -700"),
    ("cameras", r"640 480 \S+", "640 480 1e30", "line 2: params has 1e+30"),
    ("cameras", r"640 480 \S+", "640 480 nan", "line 2: 'nan' is not finite"),
    ("cameras", r"640 480 \S+", "640 480", "line 2: has 3 of the 4 numbers"),
    ("cameras", r"640 480", "640 480 1.0", "line 2: has"),
    ("cameras", r"\n1 ", "\n7 ", "camera 1 does not exist"),
    ("cameras", r"\n1 ", "\n2 ", "holds camera 2 twice"),
    ("cameras", r"\n1 ", "\n-1 ", "line 2: id is -1"),
    ("cameras", r"\n1 ", "\none ", "line 2: id is 'one'"),
    (
        "images",
        r"\n1 (\S+) (\S+) (\S+) (\S+)",
        "\n1 0 0 0 0",
        "line 2: has a quaternion of size 0",
    ),
    ("images", r"\n1 \S+", "\n1 1e_1", "line 2: '1e_1' is not a number"),
    ("images", r" a.jpg", "", "line 2: ends before its name"),
    ("images", r" b.jpg", " a.jpg", "holds image name a.jpg twice"),
    ("images", r"jpg\n\S+", "jpg\n", "line 3: holds"),
    ("images", r" 30\n", " 31\n", "belongs to point 31, which does not exist"),
    ("images", r" 30\n", " -1\n", "which does not name this point"),
    ("images", r" 30\n", " 1.5\n", "line 3: a feature's point is '1.5'"),
    ("points3D", r"\n30 .*", "", "belongs to point 30, which does not exist"),
    ("points3D", r"\n1 ", "\n2 ", "holds 3D point 2 twice"),
    ("points3D", r" 128 ", " 256 ", "line 2: colour is 256"),
    ("points3D", r" 1 0 2 0", " 1 0", "not in the track of its point 1"),
    ("points3D", r" 1 0 2 0", " 1 0 1 0", "named twice"),
    ("points3D", r" 1 0 2 0", " 1 0 9 0", "image 9"),
    ("points3D", r" 1 0 2 0", " 1 0 2 99", "feature 99 of image 2"),
    ("points3D", r" 1 0 2 0", " 1 0 2", "line 2: has a track that is not pairs"),
    ("rigs", r"\n1 1 CAMERA", "\n1 1 LIDAR", "line 2: sensor of kind 'LIDAR'"),
    ("rigs", r"\n1 1 CAMERA 1", "\n1 1 CAMERA 9", "camera 1 is not in rig 1"),
    ("rigs", r"\n1 1 CAMERA 1", "\n5 1 CAMERA 1", "rig 1 does not exist"),
    ("frames", r"\n1 1", "\n1 2", "camera 1 is not in rig 2"),
    ("frames", r"\n1 .*", "", "holds image 1 in no frame"),
    ("frames", r" 1 CAMERA 1 1\n", " 1 CAMERA 2 1\n", "image 1 is not of camera 2"),
    ("frames", r" 1 CAMERA 1 1\n", " 1 CAMERA 1 3\n", "image 3 is in two frames"),
    ("frames", r" 1 CAMERA 1 1\n", " 2 CAMERA 1 1\n", "line 2: ends before its kind of sensor"),
)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tracks, scene = metric_scene("SIMPLE_RADIAL", visible=1.0)
    tracks = eg.Tracks(
        tracks.view,
        tracks.point,
        tracks.xy,
        names=[f"{c}.jpg" for c in "abcd"],
        sizes=[(640, 480)] * 4,
    )
    folder = tmp_path_factory.mktemp("good")
    eg.save_scene(folder, tracks, scene, text=True)
    eg.save_scene(folder / "binary", tracks, scene)
    return folder


@pytest.mark.parametrize(("name", "pattern", "replacement", "told"), BAD)
def test_bad_text_is_refused_with_its_line(
    tmp_path: Path, good: Path, name: str, pattern: str, replacement: str, told: str
) -> None:
    for file in good.glob("*.txt"):
        # One line of comments is enough.
        (tmp_path / file.name).write_text(file.read_text())
    path = tmp_path / f"{name}.txt"
    text, count = re.subn(pattern, replacement, path.read_text(), count=1)
    assert count
    path.write_text(text)
    assert told in refusal(eg.load_scene, tmp_path)


def test_text_with_more_features_than_are_read_is_refused(
    good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracks, _ = eg.load_scene(good)
    monkeypatch.setattr("epigauge.io._colmap_text.MAX_MATCHES", len(tracks) - 1)
    told = f"brings the features to {len(tracks)}, more than {len(tracks) - 1}"
    assert told in refusal(eg.load_scene, good)
    monkeypatch.setattr("epigauge.io._colmap_text.MAX_MATCHES", len(tracks))
    eg.load_scene(good)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_binary_file_cut_anywhere_is_refused(tmp_path: Path, good: Path, name: str) -> None:
    shutil.copytree(good / "binary", tmp_path, dirs_exist_ok=True)
    path = tmp_path / f"{name}.bin"
    whole = path.read_bytes()
    cuts = range(0, len(whole), max(1, len(whole) // 150))
    for data in (*(whole[:cut] for cut in cuts), whole + b"\0"):
        path.write_bytes(data)
        assert f"{name}.bin" in refusal(eg.load_scene, tmp_path)
    path.write_bytes(b"\xff" * 8 + whole[8:])  # a count beyond all memory
    assert "announces" in refusal(eg.load_scene, tmp_path)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("lacks", ["rigs", "frames"])
def test_rigs_without_frames_are_refused(tmp_path: Path, lacks: str, text: bool) -> None:
    tracks, scene = metric_scene("PINHOLE", visible=1.0)
    eg.save_scene(tmp_path, tracks, scene, text=text)
    (tmp_path / f"{lacks}{'.txt' if text else '.bin'}").unlink()
    assert f"without {lacks}" in refusal(eg.load_scene, tmp_path)


def test_folders_and_names_that_are_no_scene_are_refused(tmp_path: Path, good: Path) -> None:
    assert "neither cameras.bin nor cameras.txt" in refusal(eg.load_scene, tmp_path)
    assert "a COLMAP folder, or" in refusal(eg.load_scene, tmp_path / "a.png")
    with pytest.raises(FileNotFoundError):
        eg.load_scene(tmp_path / "a.txt")
    shutil.copytree(good / "binary", tmp_path, dirs_exist_ok=True)
    (tmp_path / "images.bin").unlink()
    with pytest.raises(FileNotFoundError):
        eg.load_scene(tmp_path)
    np.savez(tmp_path / "t.npz", view=[0], point=[0], xy=[[0.0, 0.0]])
    assert "needs arrays view and point" in refusal(eg.load_scene, tmp_path / "t.npz")


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("R", np.zeros((4, 3, 3)), "R^T R"),
        ("R", np.zeros((4, 9)), "needed: floats (4, 3, 3)"),
        ("t", np.zeros((3, 3)), "needed: floats (4, 3)"),
        ("model", np.frombuffer(b"FOV\0", np.uint8), "model is 'FOV'"),
        ("model", np.frombuffer(b"\xff\0", np.uint8), "no text"),
        ("params", np.full((2, 4), -1.0), "f = -1"),
        ("camera_of_view", np.array([0, 1, 2, 0]), "camera_of_view is 2 in row 2"),
        ("view", np.full(120, 7), "view is 7"),
        ("names", np.frombuffer(b"a\0b\0", np.uint8), "2 names, needed: 4"),
        ("sizes", np.zeros((4, 2), int), "sizes"),
        ("colmap_feature_of", np.full(120, 99), "no feature"),
        ("colmap_image_ids", np.zeros(4, int), "not different"),
        ("colmap_cameras", np.frombuffer(b"1 FOO\0", np.uint8), "FOO"),
    ],
)
def test_bad_arrays_are_refused_by_name(
    tmp_path: Path, good: Path, name: str, value: Any, told: str
) -> None:
    path = tmp_path / "s.npz"
    eg.save_scene(path, *eg.load_scene(good))
    with np.load(path) as arrays:
        changed = dict(arrays) | {name: value}
    np.savez(path, **changed)
    assert told in refusal(eg.load_scene, path)


@pytest.mark.parametrize("given", [(1024, 768), [(1024, 768), (800, 600), (1024, 768), (64, 48)]])
def test_bal_scenes_become_colmap_s_and_back(tmp_path: Path, given: Any) -> None:
    tracks, scene = metric_scene("bal", 2, noise_px=0.5)
    moved, same = eg.interop.bal_to_colmap(tracks, scene, given)
    residuals, expected = moved.xy - same.project(moved), tracks.xy - scene.project(tracks)
    assert np.abs(residuals - expected * np.array([1.0, -1.0])).max() < 1e-10
    assert np.array_equal(same.depths(moved) > 0.0, scene.depths(tracks) > 0.0)
    eg.save_scene(tmp_path / "folder", moved, same)
    read, found = eg.load_scene(tmp_path / "folder")
    assert found.cameras.model == "RADIAL"
    assert np.array_equal(read.sizes, np.broadcast_to(given, (4, 2)))
    back, last = eg.interop.colmap_to_bal(read, found)
    assert np.abs(back.xy - tracks.xy).max() < 1e-9
    assert np.abs(last.project(back) - scene.project(tracks)).max() < 1e-9
    eg.save_scene(tmp_path / "again.txt", back, last)
    assert eg.load_scene(tmp_path / "again.txt")[0].n_views == 4


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"])
def test_radial_scenes_become_bal_s(model: str) -> None:
    tracks, scene = metric_scene(model, 2, noise_px=0.5)
    moved, same = eg.interop.colmap_to_bal(tracks, scene)
    residuals, expected = moved.xy - same.project(moved), tracks.xy - scene.project(tracks)
    assert np.abs(residuals - expected * np.array([1.0, -1.0])).max() < 1e-10


def test_scenes_that_cannot_change_sides_are_told_how(tmp_path: Path) -> None:
    tracks, scene = metric_scene("bal", 2)
    with pytest.raises(eg.ArgumentError, match="bal_to_colmap"):
        eg.save_scene(tmp_path / "folder", tracks, scene)
    with pytest.raises(eg.ArgumentError, match="image_size is not known"):
        eg.interop.bal_to_colmap(tracks, scene)
    for size in ((0, 5), (1.5, 2.0), (1, 2, 3)):
        with pytest.raises(eg.ArgumentError, match="image_size"):
            eg.interop.bal_to_colmap(tracks, scene, size)
    radial, other = metric_scene("SIMPLE_RADIAL", 2), metric_scene("OPENCV", 2)
    with pytest.raises(eg.ArgumentError, match="colmap_to_bal"):
        eg.save_scene(tmp_path / "s.txt", *radial)
    with pytest.raises(eg.ArgumentError, match="OPENCV"):
        eg.interop.colmap_to_bal(*other)
    with pytest.raises(eg.ArgumentError, match="SIMPLE_RADIAL"):
        eg.interop.bal_to_colmap(*radial, (640, 480))
