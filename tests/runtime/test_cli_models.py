"""``epigauge estimate --model``: the matrix of each model, what is said of it, and exit codes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.io import Matches, save_matches
from numpy.typing import NDArray

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

Array = NDArray[np.float64]
Run = Callable[..., tuple[int, str, str]]

K = np.array([[1000.0, 0.0, 500.0], [0.0, 1000.0, 500.0], [0.0, 0.0, 1.0]])
INTRINSICS = ("--intrinsics", "1000,500,500")


def matches(kind: str, m: int = 80) -> tuple[Array, Array]:
    rng = np.random.default_rng(4)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (m, 2)), np.ones(m)])
    X = rays * rng.uniform(4.0, 8.0, (m, 1))
    if kind == "plane":
        X = 6.0 * rays / (rays @ [0.3, -0.2, 1.0])[:, None]
    C = np.cross(np.eye(3), [0.1, -0.15, 0.05])
    R = np.linalg.solve(np.eye(3) + C, np.eye(3) - C)
    t = [0.0, 0.0, 0.0] if kind == "rotation" else [0.6, 0.2, 0.1]
    x1, x2 = ((Y / Y[:, 2:] @ K.T)[:, :2] for Y in (X, X @ R.T + t))
    x1, x2 = (x + 0.4 * rng.standard_normal(x.shape) for x in (x1, x2))
    count = m if kind == "nothing" else m // 5
    for x in (x1, x2):
        x[:count] = rng.uniform(0.0, 1000.0, (count, 2))
    return x1, x2


@pytest.fixture
def file(tmp_path: Path) -> Callable[[str], Path]:
    def written(kind: str) -> Path:
        path = tmp_path / f"{kind}.npz"
        save_matches(path, Matches(*matches(kind)))
        return path

    return written


def matrix(text: str) -> Array:
    return np.loadtxt(text.splitlines())


def test_each_model_is_the_matrix_of_the_library(
    run: Run, file: Callable[[str], Path], tmp_path: Path
) -> None:
    x1, x2 = matches("general")
    code, out, err = run("estimate", file("general"), "--model", "E", *INTRINSICS)
    assert code == 0
    np.testing.assert_array_equal(matrix(out), eg.estimate_essential(x1, x2, K).E)
    x1, x2 = matches("plane")
    code, out, err = run("estimate", file("plane"), "--model", "H", "-o", tmp_path / "H.npz")
    expected = eg.estimate_homography(x1, x2)
    assert code == 0
    np.testing.assert_array_equal(matrix(out), expected.H)
    for words in ("model", "inliers within", "rms_px", "evaluations", "converged"):
        assert words in err
    saved = eg.load_result(tmp_path / "H.npz")
    np.testing.assert_array_equal(saved.covariance, expected.covariance)
    assert (saved.kind, saved.model) == ("HomographyResult", "H")
    # A file of matches too, with the inliers marked
    marked = eg.load_matches(tmp_path / "H.npz", inliers=True)
    assert len(marked) == np.count_nonzero(expected.inlier)


@pytest.mark.parametrize(
    ("kind", "model", "code"),
    [
        ("general", "F", 0),
        ("plane", "plane", 0),
        ("rotation", "rotation", 0),
        ("nothing", "nothing", 1),
    ],
)
def test_auto_says_which_model(
    run: Run, file: Callable[[str], Path], tmp_path: Path, kind: str, model: str, code: int
) -> None:
    saved = tmp_path / "found.npz"
    ended, out, _ = run("estimate", file(kind), "--model", "auto", "--json", "-o", saved)
    found = json.loads(out, parse_constant=pytest.fail)
    told = eg.estimate_two_view(*matches(kind))
    assert (ended, found["model"]) == (code, model)
    assert found["evidence"] == told.evidence
    assert found["success"] == told.success == (code == 0)
    assert found["flags"] == list(told.flags)
    for name in ("F", "H"):
        if getattr(told, name) is not None:
            np.testing.assert_array_equal(found[name], getattr(told, name))
    again = eg.load_result(saved)
    assert again.model == model
    assert again["evidence_nothing_score"] == 0.0
    ended, out, err = run("estimate", file(kind), "--model", "auto")
    assert ended == code
    assert (out == "") == (model == "nothing")
    assert model in err


def test_auto_with_calibration_finds_e(run: Run, file: Callable[[str], Path]) -> None:
    code, out, _ = run("estimate", file("general"), "--model", "auto", *INTRINSICS, "--json")
    found = json.loads(out)
    assert (code, found["model"]) == (0, "E")
    assert found["E"] is not None
    assert found["probability_good"].keys() == {"0.5", "1", "2", "5"}
    code, out, _ = run("estimate", file("rotation"), "--model", "auto", *INTRINSICS, "--json")
    R = np.array(json.loads(out)["R"])
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12


def test_two_cameras_may_differ(run: Run, file: Callable[[str], Path], tmp_path: Path) -> None:
    x1, x2 = matches("general")
    save_matches(tmp_path / "zoom.csv", Matches(x1, 2.0 * x2))
    again = ("--intrinsics", "2000,2000,1000,1000")
    code, out, _ = run("estimate", tmp_path / "zoom.csv", "--model", "E", *INTRINSICS, *again)
    assert code == 0
    expected = eg.estimate_essential(x1, 2.0 * x2, K, np.diag([2.0, 2.0, 1.0]) @ K)
    np.testing.assert_allclose(matrix(out), expected.E, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--model", "G"), "--model"),
        (("--model", "E"), "--intrinsics"),
        (("--model", "F", *INTRINSICS), "--model E or auto"),
        (("--model", "H", *INTRINSICS), "--model E or auto"),
        (("--model", "H", "--robust", "poselib"), "--robust"),
        (("--model", "H", "--plot", "a.png"), "--plot"),
        (("--model", "auto", "--threshold-px", "2"), "--threshold-px"),
        (("--model", "auto", "--noise-px", "2"), "--noise-px"),
        (("--model", "auto", "--max-iter", "7"), "--max-iter"),
        (("--model", "E", "--intrinsics", "1000,500"), "F,CX,CY"),
        (("--model", "E", "--intrinsics", "-1000,500,500"), "F,CX,CY"),
        (("--model", "E", "--intrinsics", "f,500,500"), "F,CX,CY"),
        (("--model", "E", "--intrinsics", "nan,500,500"), "F,CX,CY"),
        (("--model", "E", *INTRINSICS * 3), "3 times"),
    ],
)
def test_what_does_not_go_together_is_refused(
    run: Run, file: Callable[[str], Path], options: tuple[str, ...], named: str
) -> None:
    code, out, err = run("estimate", file("general"), *options)
    assert (code, out) == (2, "")
    assert named in err
    assert len(err.splitlines()) == 1


def test_weights_are_not_dropped_in_silence(run: Run, tmp_path: Path) -> None:
    x1, x2 = matches("plane")
    weights = np.linspace(0.5, 2.0, len(x1))
    save_matches(tmp_path / "weighed.npz", Matches(x1, x2, weights))
    code, out, _ = run("estimate", tmp_path / "weighed.npz", "--model", "H")
    assert code == 0
    np.testing.assert_array_equal(matrix(out), eg.estimate_homography(x1, x2, weights=weights).H)
    code, _, err = run("estimate", tmp_path / "weighed.npz", "--model", "auto")
    assert code == 2
    assert "weights" in err


def test_a_picture_of_no_epipolar_geometry_is_told(
    run: Run, file: Callable[[str], Path], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    picture: Any = tmp_path / "a.png"
    code, _, err = run("estimate", file("plane"), "--model", "auto", "--plot", picture)
    assert code == 0
    assert not picture.exists()
    assert "the model is plane" in " ".join(err.split())
