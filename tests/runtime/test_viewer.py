"""The page to turn a reconstruction in: it holds its numbers, and its script works on its own."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.multi_view.display import display
from epigauge.reports.viewer import save_viewer

from tests.metric_scenes import metric_scene

SCENE = eg.multi_view_scene(n_points=50, noise_px=0.5, distance=4.0, seed=6, visible=0.8)
RESULT = eg.bundle_adjust(SCENE.tracks)
FRAME = display(RESULT.reconstruction, SCENE.tracks)

BROWSER = Path(__file__).with_name("browser.js")


def saved(directory: Path, **options: Any) -> str:
    path = directory / "view.html"
    save_viewer(path, options.pop("result", RESULT), SCENE.tracks, frame=FRAME, **options)
    return path.read_text(encoding="utf-8")


def data_of(page: str) -> dict[str, Any]:
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(text, parse_constant=pytest.fail)


def test_page_holds_every_point_and_camera_with_its_numbers(tmp_path) -> None:
    numbers = {"view_numbers": np.arange(5) * 10, "point_numbers": np.arange(50) + 100}
    data = data_of(saved(tmp_path, **numbers))
    X = np.reshape(data["points"], (-1, 3))
    np.testing.assert_allclose(X, FRAME.points, atol=1e-4)
    assert data["number"] == list(range(100, 150))
    squared = np.sum(RESULT.fun**2, axis=1)
    for k in range(50):
        rows = SCENE.tracks.point == k
        views = data["seen"][data["first"][k] : data["first"][k + 1]]
        assert views == SCENE.tracks.view[rows].tolist()
        assert data["views"][k] == len(views)
        assert data["rms"][k] == pytest.approx(np.sqrt(squared[rows].mean() / 2), abs=1e-4)
    for k, camera in enumerate(data["cameras"]):
        rows = SCENE.tracks.view == k
        assert camera["number"] == 10 * k
        assert camera["points"] == rows.sum()
        assert camera["rms"] == pytest.approx(np.sqrt(squared[rows].mean() / 2), abs=1e-4)
        np.testing.assert_allclose(camera["centre"], FRAME.centres[k], atol=1e-4)
        np.testing.assert_allclose(camera["corners"], FRAME.corners[k], atol=1e-4)


def test_the_view_is_fitted_to_the_scene_and_not_to_what_is_behind_it(tmp_path) -> None:
    def extent(far: float) -> float:
        points = FRAME.points.copy()
        points[:4] += [far, 0.0, 0.0]
        path = tmp_path / "far.html"
        moved = dataclasses.replace(FRAME, points=points)
        save_viewer(path, RESULT, SCENE.tracks, frame=moved)
        bounds = np.array(data_of(path.read_text(encoding="utf-8"))["bounds"])
        return float(np.ptp(bounds, axis=0).max())

    assert extent(40.0) <= extent(0.0)


def test_page_needs_nothing_else_and_says_what_it_is(tmp_path) -> None:
    page = saved(tmp_path, title="</script><b>&")
    assert not re.search(r"(src|href)\s*=|https?://|@import|fetch\(|XMLHttpRequest", page)
    assert "default-src 'none'" in page
    assert "no calibration" in page
    assert "No ellipsoids are drawn" in page
    assert page.count("</script>") == 2
    assert "<h1>&lt;/script&gt;&lt;b&gt;&amp;</h1>" in page
    assert 'class="warning"' not in page


def test_doubtful_reconstruction_comes_with_a_warning(tmp_path) -> None:
    stopped = dataclasses.replace(RESULT, success=False, message="stopped <early>")
    assert "Not converged: stopped &lt;early&gt;." in saved(tmp_path, result=stopped)
    bent = dataclasses.replace(FRAME, deviation=9.0)
    save_viewer(tmp_path / "bent.html", RESULT, SCENE.tracks, frame=bent)
    assert "distorted" in (tmp_path / "bent.html").read_text()


def test_points_without_a_place_or_a_residual_are_left_out(tmp_path) -> None:
    fun = RESULT.fun.copy()
    fun[SCENE.tracks.point == 3] = np.inf
    fun[SCENE.tracks.view == 4] = np.nan
    data = data_of(saved(tmp_path, result=dataclasses.replace(RESULT, fun=fun)))
    unseen = set(range(50)) - {3} - set(SCENE.tracks.point[SCENE.tracks.view == 4].tolist())
    assert set(data["number"]) == unseen
    assert data["cameras"][4]["rms"] is None
    nowhere = dataclasses.replace(FRAME, shown=np.zeros(50, dtype=bool))
    save_viewer(tmp_path / "empty.html", RESULT, SCENE.tracks, frame=nowhere)
    page = (tmp_path / "empty.html").read_text()
    assert data_of(page)["points"] == []
    assert "50 points far away or behind a camera are not shown" in page


def test_other_forms_are_refused(tmp_path) -> None:
    with pytest.raises(ArgumentError, match=r"a name ending in \.html"):
        save_viewer(tmp_path / "view.htm", RESULT, SCENE.tracks)


@pytest.mark.parametrize("empty", [False, True])
def test_script_draws_turns_and_names_what_is_under_the_pointer(tmp_path, empty) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node to run the script of the page")
    frame = dataclasses.replace(FRAME, shown=np.zeros(50, dtype=bool)) if empty else FRAME
    save_viewer(tmp_path / "view.html", RESULT, SCENE.tracks, frame=frame)
    run = subprocess.run([node, BROWSER, tmp_path / "view.html"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    said = json.loads(run.stdout)
    drawn = said["first"].get("fillRect", 0) + said["first"].get("fill", 0)
    assert drawn == (0 if empty else 50)
    assert said["first"]["moveTo"] > said["bare"]["moveTo"]  # cameras, path and grid
    if not empty:
        title, numbers = said["tip"][0], said["tip"][1]
        k = int(title.removeprefix("point "))
        squared = np.sum(RESULT.fun[SCENE.tracks.point == k] ** 2, axis=1)
        views = SCENE.tracks.view[SCENE.tracks.point == k]
        rms = float(re.search(r"RMS ([0-9.]+) px", numbers)[1])
        assert rms == pytest.approx(np.sqrt(squared.mean() / 2), rel=0.01, abs=1e-4)
        assert f"in {len(views)} views: {', '.join(map(str, views))}" in numbers
        assert said["views"][1:] == ["\u2264 2", "\u2265 5"]
    # Right, up and away are a right-handed frame seen from behind: right x up = -away.
    axes = [np.array(said["axes"][name]) for name in ("right", "up", "away")]
    np.testing.assert_allclose(axes @ np.transpose(axes), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), -axes[2], atol=1e-12)
    middle, right, up, behind = np.array(said["places"])
    np.testing.assert_allclose(middle, [400, 300, 5])
    assert right[0] > 400
    assert up[1] < 300
    assert behind[2] == pytest.approx(6)
    # What is behind the viewer is cut off: nothing is drawn there.
    assert said["cut"][0][1][2] == pytest.approx(0.02, rel=0.02)
    assert said["cut"][1] is None
    assert said["order"] == [2, 3, 0]


def test_ellipsoids_are_those_of_the_covariance_where_it_is_shown(tmp_path) -> None:
    """Covariances of the picture, turned back and scaled, are those of the scene."""
    tracks, scene = metric_scene("SIMPLE_RADIAL", 2, n_points=40, noise_px=0.3)
    result = eg.bundle_adjust(tracks, scene, refine=("f",))
    spread = eg.covariance(tracks, result.reconstruction, refine=("f",))
    frame = display(result.reconstruction, tracks)
    path = tmp_path / "view.html"
    save_viewer(path, result, tracks, frame=frame, covariance=spread)
    data = data_of(path.read_text(encoding="utf-8"))
    L = frame.T[:3, :3]
    for name in ("points", "cameras"):
        for k in (0, 2):
            xx, xy, xz, yy, yz, zz = data["spread"][name][6 * k : 6 * k + 6]
            C = L @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ L.T
            point = name == "points"
            known = spread.point(data["number"][k]) if point else spread.camera(k)[3:, 3:]
            np.testing.assert_allclose(C, known, rtol=2e-3, atol=2e-3 * np.abs(known).max())
    np.testing.assert_allclose(L @ L.T, data["spread"]["unit"] ** 2 * np.eye(3), atol=1e-9)
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node to run the script of the page")
    run = subprocess.run([node, BROWSER, path], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    said = json.loads(run.stdout)
    assert said["first"]["ellipse"] == len(data["number"]) + len(data["cameras"])
    assert "ellipse" not in said["bare"]
    assert said["times"].startswith("\u00d7 ")
    assert any(row.startswith("sigma ") for row in said["tip"][1].splitlines())
    values, axes = np.linalg.eigh([[3.0, 1.0], [1.0, 2.0]])
    long, short, angle = said["ellipse"]
    np.testing.assert_allclose([long**2, short**2], values[::-1])
    assert abs(np.array([np.cos(angle), np.sin(angle)]) @ axes[:, 1]) == pytest.approx(1.0)
    known = np.linalg.eigvalsh([[3.0, 1.0, 0.5], [1.0, 2.0, 0.2], [0.5, 0.2, 1.0]])
    np.testing.assert_allclose(said["extremes"], known[[2, 0]])


def test_pictures_are_in_the_page(tmp_path) -> None:
    pictures = [bytes([255, 216, k]) for k in range(SCENE.tracks.n_views)]
    found = data_of(saved(tmp_path, pictures=pictures))["pictures"]
    assert [base64.b64decode(picture) for picture in found] == pictures
    assert data_of(saved(tmp_path))["pictures"] == []
