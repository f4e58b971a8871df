"""``epigauge pair``: the library's F on stdout, text on stderr, exit codes 0, 1 and 2."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from photographs import rendered

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")


cv2 = pytest.importorskip("cv2", reason="photographs need OpenCV")


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> tuple[Path, Path]:
    """Two photographs of 420 x 320 pixels, mostly but not only of a wall."""
    folder = tmp_path_factory.mktemp("photos")
    paths = folder / "left.png", folder / "right.jpg"
    for path, view in zip(paths, rendered((0.5, 0.05, 0.2)), strict=False):
        assert cv2.imwrite(str(path), view[60:380, 60:480])
    return paths


@pytest.fixture(scope="module")
def result(photos) -> tuple[eg.ImageMatches, eg.RobustResult]:
    """What the library gives for them."""
    matches = eg.match_images(*photos)
    return matches, eg.estimate_fundamental(matches.x1, matches.x2)


@pytest.fixture
def run(run, monkeypatch):
    """Run this command: (exit code, stdout, stderr)."""
    monkeypatch.setenv("COLUMNS", "120")
    return partial(run, "pair")


def document(text: str) -> dict:
    """Parse one strict JSON document with nothing around it."""
    return json.loads(text, parse_constant=pytest.fail)


def test_stdout_is_the_matrix_of_the_library_to_the_last_bit(run, photos, result) -> None:
    matches, expected = result
    code, out, err = run(*photos)
    assert code == 0
    np.testing.assert_array_equal(np.loadtxt(out.splitlines()), expected.F)
    counts = f"{len(matches)}, {np.count_nonzero(expected.inlier)} of them inliers"
    for words in (counts, "sigma", "epipole 1", "evaluations", "seconds", "converged"):
        assert words in err


def test_json_is_the_result_of_the_library_and_nothing_else(run, photos, result) -> None:
    matches, expected = result
    code, out, err = run(*photos, "--json")
    found = document(out)
    assert (code, err) == (0, "")
    for name in ("F", "covariance", "inlier", "used", "fun"):
        np.testing.assert_array_equal(found[name], getattr(expected, name))
    for name in ("sigma", "nfev", "rms_px", "threshold_px", "noise_px", "start"):
        assert found[name] == getattr(expected, name)
    np.testing.assert_array_equal(found["x2"], matches.x2)
    assert found["flags"] == list(expected.flags)
    assert found["features"] == [matches.n_features1, matches.n_features2]
    assert (found["image_size1"], found["detector"]) == ([420, 320], "sift")
    assert "jac" not in found


def test_options_reach_matcher_and_solver(run, photos) -> None:
    options = {"detector": "orb", "ratio": 0.9, "max_size": 200, "max_features": 900}
    matches = eg.match_images(*photos, **options)
    more = {"threshold_px": 2.5, "noise_px": 3.0, "max_iter": 60, "seed": 4, "backend": "numpy"}
    expected = eg.estimate_fundamental(matches.x1, matches.x2, **more)
    words = [w for k, v in (options | more).items() for w in ("--" + k.replace("_", "-"), v)]
    found = document(run(*photos, "--json", *words)[1])
    np.testing.assert_array_equal(found["F"], expected.F)
    np.testing.assert_array_equal(found["covariance"], expected.covariance)
    assert found["noise_estimated"] is False
    assert len(found["x1"]) == len(matches)


def test_saved_result_is_a_file_of_matches_too(run, photos, result, tmp_path) -> None:
    matches, expected = result
    assert run(*photos, "-o", tmp_path / "r.npz")[0] == 0
    with np.load(tmp_path / "r.npz", allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["F"], expected.F)
        np.testing.assert_array_equal(saved["history_cost"], [h.cost for h in expected.history])
    again = eg.load_matches(tmp_path / "r.npz", inliers=True)
    np.testing.assert_array_equal(again.x1, matches.x1[expected.inlier])
    assert again.image_size2 == matches.image_size2


@pytest.mark.parametrize("name", ["pair.png", "PAIR.SVG", "pair.html"])
def test_pictures_and_reports_are_chosen_by_suffix(run, photos, tmp_path, name) -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    assert run(*photos, "--plot", tmp_path / name)[0] == 0
    start = (tmp_path / name).read_bytes()[:1000].lower()
    marks = {".png": b"\x89png", ".svg": b"<svg", ".html": b"<!doctype html>"}
    assert marks[Path(name).suffix.lower()] in start
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_warnings_are_written_with_their_explanation(run, photos) -> None:
    # A dozen matches hardly tell how large the noise is
    _, _, err = run(*photos, "--max-features", 20)
    assert "few matches: So few more matches than parameters" in err
    assert "Use more matches, or give noise_px where it is known." in err


def test_a_run_that_does_not_converge_ends_with_1(run, photos) -> None:
    code, out, err = run(*photos, "--max-iter", 1)
    assert code == 1
    assert len(out.splitlines()) == 3
    assert "not converged: " in err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("absent.png", "No such file"),
        ("folder", "Is a directory"),
        ("empty.png", "is empty"),
        ("text.png", "is damaged, or no image"),
        ("tiny.png", "is 5 x 3 pixels; needed: at least 16"),
        ("blank.png", "and 0 features but only 0 matches; needed: at least 8"),
        ("unlike.png", "features but only"),
        ("same.tiff", "show the same picture; needed: two photographs from different places"),
    ],
)
def test_bad_images_end_with_2_and_one_line(run, photos, tmp_path, name, words) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("x1,y1,x2,y2")
    images = {
        "tiny.png": np.zeros((3, 5), dtype=np.uint8),
        "blank.png": np.full((200, 200), 9, dtype=np.uint8),
        "unlike.png": np.random.default_rng(0).integers(0, 256, (90, 90), dtype=np.uint8),
        "same.tiff": cv2.imread(str(photos[0])),
    }
    if name in images:
        cv2.imwrite(str(tmp_path / name), images[name])
    code, out, err = run(photos[0], tmp_path / name)
    assert (code, out) == (2, "")
    assert words in err
    assert name in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--plot", "a.gif"], "a name ending in .png, .pdf, .svg, .html"),
        (["--plot", "absent/a.html"], "absent: No such file or directory"),
        (["-o", "a.csv"], "a name ending in .npz, .json"),
        (["--detector", "surf"], "detector is 'surf'"),
        (["--ratio", "7"], "ratio is 7"),
        (["--max-size", "3"], "max_size is 3"),
        (["--robust", "luck"], "robust is 'luck'"),
        (["--threshold-px", "-1"], "threshold_px is -1"),
        (["--seed", "-3"], "seed is -3"),
    ],
)
def test_bad_options_end_with_2_and_one_line(run, photos, options, words) -> None:
    code, out, err = run(*photos, *options)
    assert (code, out) == (2, "")
    assert words in err
    assert len(err.splitlines()) == 1


def test_measured_photographs_give_their_published_geometry(run, data_dir) -> None:
    images = data_dir / "pairs" / "images"
    code, out, err = run(images / "templeSR0001.png", images / "templeSR0002.png")
    assert code == 0
    F = np.loadtxt(out.splitlines())
    with np.load(data_dir / "pairs" / "templeSR_1_2.npz") as pair:
        d = eg.reprojection_distances(F, pair["x1"][pair["inlier"]], pair["x2"][pair["inlier"]])[0]
    assert np.median(np.abs(d)) < 0.3  # that of the true cameras is 0.14
    assert "SIFT" in err.upper()
