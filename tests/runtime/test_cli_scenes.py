"""``epigauge bundle`` and ``epigauge compare`` on scenes of calibrated cameras."""

from __future__ import annotations

import json
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

from epigauge.bundle.run import PROJECTIVE_ONLY
from epigauge.bundle.strategies import STRATEGIES
from metric_scenes import metric_scene


def started(model: str, **options: object) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return a scene that is not at its minimum."""
    tracks, scene = metric_scene(model, 3, noise_px=0.5, n_points=40, **options)
    rng = np.random.default_rng(0)
    t, X = (a + rng.normal(0.0, 0.02, a.shape) for a in (scene.t, scene.X))
    named = {"names": [f"{k}.jpg" for k in "abcd"]} if model != "bal" else {}
    tracks = eg.Tracks(tracks.view, tracks.point, tracks.xy, **named)
    return tracks, eg.MetricReconstruction(scene.R, t, X, scene.cameras)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    eg.save_scene(tmp_path / "sparse", *started("SIMPLE_RADIAL"))
    return tmp_path / "sparse"


def test_a_folder_is_adjusted_to_every_form(run, folder, tmp_path) -> None:
    tracks, start = eg.load_scene(folder)
    wanted = eg.bundle_adjust(tracks, start, refine=("f", "k"), fixed_views=[1])
    outputs = [tmp_path / name for name in ("o", "o.npz", "o.ply")]
    options = [part for path in outputs for part in ("-o", path)]
    code, out, err = run("bundle", folder, "--refine", "f,k", "--fix-view", "b.jpg", *options)
    assert code == 0
    rows = np.loadtxt(out.splitlines())
    np.testing.assert_array_equal(rows, wanted.reconstruction.vectors)
    for word in ("SIMPLE_RADIAL", "f, k", f"{wanted.rms_px:.6g}"):
        assert word in err
    np.testing.assert_array_equal(wanted.reconstruction.t[1], start.t[1])
    for path in outputs[:2]:
        found = eg.load_scene(path)
        np.testing.assert_array_equal(found[1].X, wanted.reconstruction.X)
        assert found[0].names == tracks.names
    with np.load(tmp_path / "o.npz") as arrays:
        assert float(arrays["cost"]) == wanted.cost
    assert (tmp_path / "o.ply").read_bytes().startswith(b"ply\n")


def test_json_is_one_document_with_everything(run, folder) -> None:
    code, out, err = run("bundle", folder, "--json")
    found = json.loads(out, parse_constant=pytest.fail)
    assert (code, err) == (0, "")
    tracks, start = eg.load_scene(folder)
    wanted = eg.bundle_adjust(tracks, start)
    for name in ("R", "t", "X"):
        np.testing.assert_array_equal(found[name], getattr(wanted.reconstruction, name))
    assert found["model"] == "SIMPLE_RADIAL"
    assert found["cost"] == wanted.cost
    assert found["names"] == list(tracks.names)
    assert {"params", "camera_of_view", "flags", "n_behind", "notes", "success"} <= set(found)


def test_a_bal_file_is_a_scene_with_refine_and_tracks_without(run, tmp_path) -> None:
    tracks, start = started("bal", n_cameras=4)
    path = tmp_path / "p.txt"
    eg.save_scene(path, tracks, start)
    code, out, _ = run("bundle", path, "--refine", "all", "-o", tmp_path / "o.txt.gz")
    assert code == 0
    assert len(out.split()) == 4 * 15
    assert eg.load_scene(tmp_path / "o.txt.gz")[1].rms_px(tracks) < start.rms_px(tracks)
    code, out, _ = run("bundle", path)
    assert (code, len(out.split())) == (0, 4 * 12)
    code, _, told = run("bundle", path, "-o", tmp_path / "o.txt.gz")
    assert code == 2
    assert "or --refine" in told


def test_a_bal_file_becomes_a_folder_with_the_size_of_its_images(run, tmp_path) -> None:
    tracks, start = started("bal", n_cameras=4)
    path = tmp_path / "p.txt"
    eg.save_scene(path, tracks, start)
    outputs = "-o", tmp_path / "sparse", "-o", tmp_path / "o.npz"
    assert run("bundle", path, "--image-size", 1000, 800, *outputs)[0] == 0
    wanted, found = eg.load_scene(tmp_path / "o.npz"), eg.load_scene(tmp_path / "sparse")
    assert (wanted[1].cameras.model, found[1].cameras.model) == ("bal", "RADIAL")
    np.testing.assert_array_equal(found[0].sizes, [[1000, 800]] * 4)
    np.testing.assert_allclose(found[1].rms_px(found[0]), wanted[1].rms_px(wanted[0]), rtol=1e-9)


def test_the_residuals_of_a_scene_are_a_table(run, folder, tmp_path) -> None:
    assert run("bundle", folder, "-o", tmp_path / "r.csv")[0] == 0
    tracks, start = eg.load_scene(folder)
    wanted = eg.bundle_adjust(tracks, start)
    names, *lines = (tmp_path / "r.csv").read_text().splitlines()
    assert names == "view,point,x,y,residual_x,residual_y,rejected"
    rows = [line.split(",") for line in lines]
    assert [row[0] for row in rows] == [tracks.names[k] for k in tracks.view]
    numbers = np.array([row[1:6] for row in rows], dtype=float)
    np.testing.assert_array_equal(numbers[:, 0], tracks.point)
    np.testing.assert_array_equal(numbers[:, 3:], wanted.fun)


@pytest.mark.parametrize("command", ["bundle", "compare"])
def test_what_does_not_exist_is_said_with_what_may_be_given(run, tmp_path, command) -> None:
    code, out, err = run(command, tmp_path / "nothere")
    assert (code, out) == (2, "")
    for word in ("nothere", "does not exist", ".npz", "COLMAP folder"):
        assert word in err


def test_pictures_show_the_scene_in_its_own_shape(run, folder, tmp_path) -> None:
    pytest.importorskip("matplotlib")
    from epigauge.multi_view.display import display

    plots = [tmp_path / "p.png", tmp_path / "p.html"]
    assert run("bundle", folder, *(part for path in plots for part in ("--plot", path)))[0] == 0
    assert all(path.stat().st_size > 1000 for path in plots)
    for model in ("SIMPLE_RADIAL", "bal"):
        tracks, scene = metric_scene(model, 3, n_cameras=4)
        shown = display(scene, tracks, y_up=model == "bal")
        # A similarity without a mirror: X = s Q x + b.
        A = np.column_stack([shown.points, np.ones(len(scene.X))])
        M, residual, _, _ = np.linalg.lstsq(A, scene.X, rcond=None)
        assert np.abs(residual).max(initial=0.0) < 1e-20
        s = np.linalg.det(M[:3]) ** (1.0 / 3.0)
        assert s > 0.0
        np.testing.assert_allclose(M[:3] @ M[:3].T, s**2 * np.eye(3), atol=1e-9)
        assert shown.ahead.all()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--gauge", "normalized"), "--gauge is given with a scene"),
        (("--start", "x.npz"), "--start is given with a scene"),
        (("--clean",), "--clean is given with a scene"),
        (("--prune",), "--prune is given with a scene"),
        (("--init", "registration"), "--init is given with a scene"),
        (("-o", "o.html"), "the name of a picture"),
        (("--precision", "p.gif"), "p.gif"),
        (("--precision", "-", "--json"), "one of them alone"),
        (("--fix-view", "e.jpg"), "--fix-view is 'e.jpg'"),
        (("--fix-view", "4"), "0 to 3"),
        (("--refine", "focal"), "names 'focal'"),
        (("-o", "nowhere/o"), "nowhere"),
        (("-o", "o.txt"), "colmap_to_bal"),
        (("--rigs", "bent", "-o", "o"), "rigs is 'bent'"),
        (("--image-size", "640", "480"), "--image-size is given with cameras of the model SIMPLE"),
    ],
)
def test_what_a_scene_cannot_have_is_refused_before_the_run(run, folder, options, told) -> None:
    code, out, err = run("bundle", folder, *options)
    assert (code, out) == (2, "")
    assert told in err


def test_a_folder_of_a_bal_file_needs_the_size_of_its_images(run, tmp_path) -> None:
    eg.save_scene(tmp_path / "p.txt", *started("bal", n_cameras=4))
    code, out, err = run("bundle", tmp_path / "p.txt", "--refine", "pose", "-o", tmp_path / "o")
    assert (code, out) == (2, "")
    assert "--image-size is not given" in err


def test_a_bad_folder_is_refused_with_file_and_line(run, tmp_path) -> None:
    eg.save_scene(tmp_path, *started("SIMPLE_RADIAL"), text=True)
    text = (tmp_path / "cameras.txt").read_text()
    (tmp_path / "cameras.txt").write_text(text.replace(" SIMPLE_RADIAL", " SIMPLE", 1))
    for command in ("bundle", "compare"):
        code, out, err = run(command, tmp_path)
        assert (code, out) == (2, "")
        assert "cameras.txt, line 2" in err


def test_compare_puts_methods_side_by_side(run, folder) -> None:
    code, out, _ = run("compare", folder, "--methods", "covariant", "--refine", "f", "--json")
    found = json.loads(out)
    assert code == 0
    tracks, start = eg.load_scene(folder)
    assert found["start_rms_px"] == start.rms_px(tracks)
    wanted = eg.bundle_adjust(tracks, start, refine=("f",))
    assert [row["cost"] for row in found["rows"]] == [wanted.cost]
    code, out, _ = run("compare", folder, "--max-iter", "1", "--json")
    methods = [row["method"] for row in json.loads(out)["rows"]]
    assert methods == [name for name in STRATEGIES if name not in PROJECTIVE_ONLY]


def test_rigs_are_given_up_only_on_request(run, tmp_path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    wanted = pycolmap.SyntheticDatasetOptions()
    wanted.num_rigs, wanted.num_cameras_per_rig, wanted.num_points3D = 1, 2, 20
    wanted.num_frames_per_rig = 3
    pycolmap.synthesize_dataset(wanted).write_binary(tmp_path)
    code, _, err = run("bundle", tmp_path, "--refine", "pose", "-o", tmp_path / "o")
    assert code == 2
    assert "--rigs is 'keep'" in err
    options = ("--refine", "pose", "-o", tmp_path / "o")
    assert run("bundle", tmp_path, *options, "--rigs", "drop")[0] == 0
    assert pycolmap.Reconstruction(tmp_path / "o").num_frames() == 6


def test_precision_is_told_in_a_table_in_json_and_in_pictures(run, folder, tmp_path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    page, picture = tmp_path / "x.html", tmp_path / "p.png"
    options = ["--refine", "f,k", "--plot", page, "--precision", picture]
    code, _, err = run("bundle", folder, *options)
    assert code == 0
    lines = err.splitlines()
    head = next(k for k, line in enumerate(lines) if line.split()[:2] == ["camera", "parameter"])
    told = [line.split() for line in lines[head + 1 :]]
    tracks, start = eg.load_scene(folder)
    found = eg.bundle_adjust(tracks, start, refine=("f", "k")).reconstruction
    spread = eg.covariance(tracks, found, refine=("f", "k"))
    rows = spread.intrinsic_rows()
    assert [row[1] for row in rows] == ["f", "k", "f", "k"]
    for line, (camera, name, value, sigma, unit) in zip(told, rows, strict=False):
        assert line[:2] == [str(camera), name]
        assert float(line[2]) == pytest.approx(value, rel=1e-6)
        assert float(line[3]) == pytest.approx(sigma, rel=1e-2)
        assert line[4:] == ([unit] if unit != "1" else [])
    assert '"spread":{' in page.read_text(encoding="utf-8")
    assert picture.read_bytes()[:4] == b"\x89PNG"
    both = [tmp_path / "q.svg", tmp_path / "q.html"]
    assert run("bundle", folder, *(f"--precision={path}" for path in both))[0] == 0
    assert all(path.stat().st_size > 1000 for path in both)
    document = json.loads(run("bundle", folder, "--refine", "f,k", "--json")[1])
    for entry, row in zip(document["intrinsics"], rows, strict=True):
        assert (entry["camera"], entry["name"], entry["unit"]) == (row[0], row[1], row[4])
        assert entry["sigma"] == pytest.approx(row[3], rel=1e-6)
    assert json.loads(run("bundle", folder, "--refine", "pose", "--json")[1])["intrinsics"] == []


def test_precision_is_of_scenes_only(run, tmp_path) -> None:
    scene = eg.multi_view_scene(n_points=30, seed=1)
    path = tmp_path / "t.npz"
    np.savez(path, view=scene.tracks.view, point=scene.tracks.point, xy=scene.tracks.xy)
    code, _, err = run("bundle", path, "--precision", tmp_path / "p.png")
    assert code != 0
    assert "--precision" in err
