"""``epigauge metric``: data on stdout, text on stderr, files, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from calibration import SIZE, tracks_of

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")


def _saved(folder: Path, motion: str = "general") -> Path:
    path = folder / "tracks.npz"
    tracks, _ = tracks_of(motion, 1, noise_px=0.5, n_points=80, bend=-0.03)
    eg.save_tracks(path, tracks)
    return path


def test_a_scene_is_written_in_every_form(run, tmp_path: Path) -> None:
    path = _saved(tmp_path)
    outputs = [tmp_path / "model", tmp_path / "scene.npz", tmp_path / "scene.ply"]
    page = tmp_path / "scene.html"
    asked = [word for target in outputs for word in ("-o", target)]
    code, out, err = run("metric", path, "--image-size", *SIZE, *asked, "--plot", page)
    assert code == 0
    value, std = map(float, out.split())
    assert abs(value - 900.0) < 4.0 * std
    assert "+-" in err
    assert "nothing can be measured" not in page.read_text()
    assert "Ellipsoids of one sigma" in page.read_text()
    for target in outputs[:2]:
        tracks, scene = eg.load_scene(target)
        assert scene.cameras.params[0, 0] == pytest.approx(value, rel=1e-12)
        assert scene.rms_px(tracks) < 0.6


def test_json_has_everything(run, tmp_path: Path) -> None:
    code, out, _ = run("metric", _saved(tmp_path), "--image-size", *SIZE, "--json")
    found = json.loads(out)
    assert code == 0
    assert found["success"]
    assert found["refined"] == ["f", "cx", "cy", "k"]
    assert np.array(found["R"]).shape == (6, 3, 3)
    assert found["focal_std_px"] > 0.0


@pytest.mark.parametrize("camera", ["SIMPLE_PINHOLE", "PINHOLE"])
def test_the_report_says_what_deviations_are_made_of(run, tmp_path: Path, camera: str) -> None:
    path = tmp_path / "tracks.npz"
    tracks, _ = tracks_of("general", 1, noise_px=0.3, n_points=80, bend=-0.03)
    eg.save_tracks(path, tracks)
    code, out, err = run("metric", path, "--image-size", *SIZE, "--camera", camera)
    assert code == 0
    wide = "f" if camera == "SIMPLE_PINHOLE" else "mean f"
    words = " ".join(err.replace("│", " ").split())
    assert f"{wide} with errors of the model, all else of noise alone" in words
    value, std = map(float, out.split())
    assert f"{wide} {value:.7g} +- {std:.3g} px" in words


def test_a_motion_that_says_nothing_ends_with_one_and_no_file(run, tmp_path: Path) -> None:
    for motion, flag in (("translation", "pure translation"), ("rotation", "pure rotation")):
        path = _saved(tmp_path, motion)
        target = tmp_path / "scene.npz"
        code, _, err = run("metric", path, "--image-size", *SIZE, "-o", target)
        assert code == 1
        assert flag in err
        assert not target.exists()


def test_bad_input_ends_with_two(run, tmp_path: Path) -> None:
    path = _saved(tmp_path)
    assert run("metric", path, "--image-size", 0, 600)[0] == 2
    assert run("metric", path, "--image-size", 800, 600, "-o", tmp_path / "a" / "b")[0] == 2
    assert run("metric", tmp_path / "no.npz", "--image-size", 800, 600)[0] == 2
