"""Which model of two views matches support."""

from __future__ import annotations

from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]

K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 480.0], [0.0, 0.0, 1.0]])


def scene(kind: str, m: int, wrong: float, seed: int) -> tuple[Array, Array, Array]:
    """Return matches with half a pixel of noise, the first ones wrong, and the rotation."""
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, m), rng.uniform(-0.45, 0.45, m), np.ones(m)])
    X = rays * rng.uniform(4.0, 8.0, m)[:, None]
    if kind == "plane":
        X = 6.0 * rays / (rays @ [0.3, -0.2, 1.0])[:, None]
    angle = 0.0 if kind == "still" else 0.15
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    t = np.array([0.7, 0.3, 0.2]) if kind in ("F", "plane") else np.zeros(3)
    x1, x2 = ((Y / Y[:, 2:] @ K.T)[:, :2] for Y in (X, X @ R.T + t))
    x1, x2 = (x + 0.5 * rng.standard_normal((m, 2)) for x in (x1, x2))
    count = m if kind == "nothing" else round(wrong * m)
    for x in (x1, x2):
        x[:count] = rng.uniform([0.0, 0.0], [1280.0, 960.0], (count, 2))
    return x1, x2, R


@pytest.mark.parametrize("kind", ["nothing", "still", "rotation", "plane", "F"])
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_the_model_is_named(kind: str, wrong: float) -> None:
    x1, x2, _ = scene(kind, 100, wrong, 5)
    result = eg.estimate_two_view(x1, x2)
    assert result.model == kind
    assert result.success == (kind != "nothing")
    assert (result.H is not None) == (kind in ("still", "rotation", "plane"))
    assert (result.F is not None) == (kind == "F")
    if kind not in ("nothing", "still"):
        assert np.count_nonzero(result.inliers[: round(wrong * 100)]) < 6
        assert result.evidence[kind if kind != "rotation" else "plane"]["score"] > 0.0
    assert result.evidence["nothing"]["score"] == 0.0


def test_calibrated_cameras_give_the_motion() -> None:
    x1, x2, R = scene("F", 150, 0.3, 6)
    result = eg.estimate_two_view(x1, x2, K)
    assert result.model == "E"
    assert result.R is not None
    assert np.abs(result.R - R).max() < 0.01
    x1, x2, R = scene("rotation", 150, 0.3, 7)
    result = eg.estimate_two_view(x1, x2, K)
    assert result.model == "rotation"
    assert result.R is not None
    assert np.abs(result.R - R).max() < 0.005
    assert result.t is None


def test_a_result_is_plain_data_and_text(tmp_path: Path) -> None:
    x1, x2, _ = scene("plane", 60, 0.0, 8)
    result = eg.estimate_two_view(x1, x2)
    assert "plane" in str(result)
    assert result.to_dict()["model"] == "plane"
    result.save(tmp_path / "pair.json")
    assert eg.load_result(tmp_path / "pair.json").model == "plane"


def test_bad_input_is_refused() -> None:
    x1, x2, _ = scene("F", 20, 0.0, 9)
    with pytest.raises(eg.ArgumentError, match="at least 8"):
        eg.estimate_two_view(x1[:5], x2[:5])
    with pytest.raises(eg.ArgumentError, match="K1"):
        eg.estimate_two_view(x1, x2, np.zeros((3, 3)))
    with pytest.raises(eg.ArgumentError, match="K1 has a focal length"):
        eg.estimate_two_view(x1, x2, np.diag([1e-80, 1e-80, 1.0]))


def test_calibration_tells_a_plane_from_a_rotation() -> None:
    # A plane that the camera moves along: H has the eigenvalues of a rotation, but is that of no
    # camera with an ordinary lens.
    rng = np.random.default_rng(10)
    x1 = rng.uniform([0.0, 0.0], [1280.0, 960.0], (60, 2))
    x2 = x1 + np.array([100.0, 0.0])
    x1, x2 = (x + 0.3 * rng.standard_normal((60, 2)) for x in (x1, x2))
    assert eg.estimate_two_view(x1, x2).model == "plane"
    result = eg.estimate_two_view(x1, x2, K)
    assert result.model == "plane"
    assert result.evidence["rotation"]["score"] < result.evidence["plane"]["score"]
    assert "pure rotation" not in result.flags


def test_no_motion_is_told_where_no_essential_matrix_was_found() -> None:
    for seed in range(3):
        x1 = np.random.default_rng(seed).uniform(0.0, 1000.0, (60, 2))
        x2 = x1 + np.array([5.0, 0.0])
        result, found = eg.estimate_two_view(x1, x2, K), eg.estimate_essential(x1, x2, K)
        assert result.model == "plane"
        assert (result.E is None) == (result.t is None) == (not found.success)


def test_the_message_tells_how_far_a_rotation_is_ahead() -> None:
    x1, x2, _ = scene("rotation", 60, 0.0, 11)
    result = eg.estimate_two_view(x1, x2)
    assert result.model == "rotation"
    assert f"{result.evidence['plane']['score']:.1f} above" in result.message


def test_one_calibration_alone_is_refused() -> None:
    x1, x2, _ = scene("F", 20, 0.0, 9)
    with pytest.raises(eg.ArgumentError, match="K1"):
        eg.estimate_two_view(x1, x2, None, K)
    with pytest.raises(eg.ArgumentError, match="K1"):
        eg.estimate_essential(x1, x2, None)  # type: ignore[arg-type]


@pytest.mark.study
def test_few_matches_tell_their_model() -> None:
    # Fourteen right ones of twenty, of which any seven fit exactly
    for seed in range(3):
        for kind in ("rotation", "plane", "F"):
            x1, x2, _ = scene(kind, 20, 0.3, 20 + seed)
            result = eg.estimate_two_view(x1, x2)
            assert result.model == kind
            assert np.count_nonzero(result.inliers[6:]) >= 12


def test_few_matches_with_relief_are_no_plane() -> None:
    """Eight right ones of a general scene, near a homography by chance, are no success."""
    x1, x2, _ = scene("F", 20, 0.6, 10)
    plane = eg.estimate_homography(x1, x2)
    assert plane.success  # alone it cannot know
    result = eg.estimate_two_view(x1, x2)
    assert (result.model, result.success) == ("nothing", False)
    x1, x2, _ = scene("plane", 20, 0.6, 10)
    assert eg.estimate_two_view(x1, x2).model == "plane"


def test_a_few_sharp_matches_do_not_hide_a_still_camera() -> None:
    x1, x2, _ = scene("still", 20, 0.6, 31)
    assert eg.estimate_two_view(x1, x2).model == "still"


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1.002, False), (1.3, True)])
def test_a_calibration_that_does_not_fit_is_told(factor: float, told: bool) -> None:
    x1, x2, _ = scene("F", 200, 0.2, 12)
    given = K * [[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]]
    for result in (
        eg.estimate_essential(x1, x2, given),
        eg.refine_fundamental(x1[40:], x2[40:], essential=True, K1=given),
        eg.estimate_two_view(x1, x2, given),
    ):
        assert ("wrong calibration" in result.flags) == told
        assert result.success != told


def test_a_plane_agrees_with_any_calibration() -> None:
    x1, x2, _ = scene("plane", 100, 0.0, 14)
    given = K * [[1.3, 1.0, 1.0], [1.0, 1.3, 1.0], [1.0, 1.0, 1.0]]
    assert "wrong calibration" not in eg.estimate_essential(x1, x2, given).flags
