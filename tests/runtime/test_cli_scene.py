"""``epigauge scene``: everything in one folder, or a sentence and nothing at all."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from calibration import SIZE, tracks_of
from colmap_databases import Project

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")
pytest.importorskip("cv2", reason="photographs need OpenCV")

from epigauge.cli.scene import _photographs, _reason, _with_exif
from epigauge.metric.checks import images_of
from epigauge.metric.result import nothing


def test_a_database_becomes_a_scene(run, tmp_path: Path) -> None:
    database = Project(n_views=4, n_points=150).write(tmp_path / "database.db")
    output = tmp_path / "scene"
    output.mkdir()
    place = output.stat().st_ino
    code, _, err = run("scene", database, "-o", output)
    assert code == 0, err
    # An empty folder is filled, not replaced: a shell may stand in it.
    assert output.stat().st_ino == place
    assert not list(output.glob(".*"))
    report = json.loads((output / "report.json").read_text())
    assert report["photographs"] == ["1.jpg", "2.jpg", "3.jpg", "4.jpg"]
    assert report["left_out"] == {}
    # COLMAP counts from the corner of the first pixel: the same centre, half a pixel less.
    assert abs(report["focal_px"] - 1000.0) < 4.0 * report["focal_std_px"]
    for folder in ("sparse/0", "sparse_text"):
        tracks, scene = eg.load_scene(output / folder)
        assert scene.rms_px(tracks) < 1.0
        assert tracks.names == ("1.jpg", "2.jpg", "3.jpg", "4.jpg")
    assert "Focal length" in (output / "index.html").read_text()
    assert (output / "points.ply").stat().st_size > 1000
    assert not list(tmp_path.glob(".scene*"))
    code, _, err = run("scene", database, "-o", output)
    assert code == 2
    assert "empty" in err


def test_names_with_blanks_are_kept_where_a_file_can_hold_them(run, tmp_path: Path) -> None:
    database = Project(n_views=4, n_points=150).write(tmp_path / "database.db")
    with contextlib.closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("UPDATE images SET name = 'IMG ' || name")
    output = tmp_path / "scene"
    code, _, err = run("scene", database, "-o", output)
    assert code == 0, err
    assert "sparse_text cannot hold 'IMG 1.jpg'" in " ".join(err.split())
    assert not (output / "sparse_text").exists()
    assert eg.load_scene(output / "sparse" / "0")[0].names[0] == "IMG 1.jpg"


def _poster(folder: Path, seed: int) -> list[Path]:
    """Write three views of something flat."""
    import cv2

    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (240, 320)), (0, 0), 1.2)
    picture = cv2.normalize(picture, None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)
    paths = []
    for k in range(3):
        H = np.eye(3) + rng.normal(0.0, 1.0, (3, 3)) * [
            [0.05, 0.05, 5],
            [0.05, 0.05, 5],
            [3e-4, 3e-4, 0],
        ]
        paths.append(folder / f"{seed}_{k}.png")
        cv2.imwrite(str(paths[-1]), cv2.warpPerspective(picture, H, (320, 240)))
    return paths


def test_what_is_no_scene_is_said_and_nothing_is_written(run, tmp_path: Path) -> None:
    poster, other = _poster(tmp_path, 0), _poster(tmp_path, 1)
    output = tmp_path / "scene"
    code, _, err = run("scene", *poster, "-o", output)
    assert code == 1
    assert "no parallax" in err
    code, _, err = run("scene", poster[0], other[0], "-o", output)
    assert code == 1
    assert "nothing in common" in err
    assert not output.exists()
    assert not list(tmp_path.glob(".scene*"))


def test_bad_input_ends_with_two(run, tmp_path: Path) -> None:
    output = tmp_path / "scene"
    (tmp_path / "empty").mkdir()
    assert run("scene", tmp_path / "empty", "-o", output)[0] == 2
    assert run("scene", tmp_path / "no.jpg", tmp_path / "nor.jpg", "-o", output)[0] == 2
    assert run("scene", tmp_path / "a.db", tmp_path / "b.jpg", "-o", output)[0] == 2
    (tmp_path / "one.db").write_bytes(b"nothing")
    assert run("scene", tmp_path / "one.db", "-o", output)[0] == 2
    (poster, *_) = _poster(tmp_path, 0)
    assert run("scene", poster, "-o", output)[0] == 2
    assert run("scene", poster, poster, "--cameras", "two", "-o", output)[0] == 2
    code, _, err = run("scene", poster, poster, "--cache", tmp_path / "no" / "c.npz", "-o", output)
    assert code == 2
    assert "no: No such file or directory" in err


def test_a_folder_that_cannot_be_made_is_named_before_any_work(run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, err = run("scene", tmp_path / "no.jpg", "-o", tmp_path / "file" / "scene")
    assert code == 2
    assert "file: cannot be written (Not a directory)" in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_photographs_that_are_not_there_are_named(run, tmp_path: Path) -> None:
    code, _, err = run("scene", tmp_path / "photos", "-o", tmp_path / "scene")
    assert code == 2
    assert "photos: No such file or directory" in err


def test_each_photograph_is_taken_once_and_notes_of_systems_are_not(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg", "._a.jpg", ".DS_Store"):
        (tmp_path / name).touch()
    (tmp_path / "c.jpg").symlink_to(tmp_path / "b.jpg")
    found = _photographs([tmp_path / "b.jpg", tmp_path, tmp_path / "a.jpg"])
    assert [path.name for path in found] == ["b.jpg", "a.jpg"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("weak focal length", "unlike cameras"), "are not all of one camera"),
        (("undetermined",), "determine no scene"),
        (("pure rotation", "undetermined"), "show no parallax"),
    ],
)
def test_why_there_is_no_scene_is_said_of_the_photographs(
    flags: tuple[str, ...], words: str
) -> None:
    tracks, _ = tracks_of()
    result = nothing(tracks, images_of(tracks, SIZE, True), flags)
    assert _reason(result).startswith(f"the photographs {words}")


def test_focal_lengths_that_photographs_tell_can_be_wrong() -> None:
    tracks, _ = tracks_of(n_views=4, noise_px=0.3, seed=3)
    tracks = eg.Tracks(tracks.view, tracks.point, tracks.xy, sizes=np.tile(SIZE, (4, 1)))
    how = tracks, "auto", "SIMPLE_RADIAL", 1
    right, text = _with_exif(np.full(4, 950.0), *how)
    assert text == "focal lengths of 4 of 4 photographs"
    assert right.success
    wrong, text = _with_exif(np.full(4, 5000.0), *how)
    assert text == "focal lengths of 4 of 4 photographs, 4 of them contradicted by what is seen"
    assert wrong.success
    mixed, text = _with_exif(np.array([900.0, 9000.0, np.nan, 120.0]), *how)
    assert text == "focal lengths of 3 of 4 photographs, not used: with them there is no scene"
    assert mixed.success
    for result in (right, wrong, mixed):
        assert abs(result.focal_px - 900.0) < 4.0 * result.focal_std_px < 0.1 * 900.0


@pytest.mark.parametrize("ending", [".JPG", ".heic"])
def test_photographs_in_a_folder_are_found_by_their_endings(ending: str, tmp_path: Path) -> None:
    for name in (f"a{ending}", "b.png", "c.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in _photographs([tmp_path])] == [f"a{ending}", "b.png"]


def test_it_is_said_when_no_photograph_tells_its_focal_length(run, tmp_path: Path) -> None:
    photographs = [eg.samples.path(f"room{k}.jpg") for k in range(3)]
    options = ["--exif-focal", "--max-features", "1500", "-o", tmp_path / "scene"]
    _, _, err = run("scene", *photographs, *options)
    assert "focal lengths of none of 3 photographs" in err
