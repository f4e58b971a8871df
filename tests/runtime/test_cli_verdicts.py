"""Every command says of a scene what the library says: in JSON, in files, and by its exit code."""

from __future__ import annotations

import json
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from epigauge.io import Matches, save_matches
from pair_scenes import PINHOLE, SIZE, K, pixels, plane, write
from photographs import rendered
from two_views import Array

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")


@pytest.fixture
def run(run):
    """Run the command line in this process: exit code and the JSON document on stdout."""

    def run_json(*arguments: object) -> tuple[int, dict]:
        code, out, _ = run(*arguments, "--json")
        return code, json.loads(out)

    return run_json


def moved(n: int, t: list[float]) -> tuple[Array, Array]:
    """Matches of a scene with depth, the camera moving by t."""
    rng = np.random.default_rng(n)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.45, 0.45, n), np.ones(n)])
    X = rays * rng.uniform(4.0, 8.0, n)[:, None]
    return tuple(pixels(Y) + rng.normal(0.0, 0.5, (n, 2)) for Y in (X, X + np.array(t)))


def spoilt(n: int, wrong: int) -> tuple[Array, Array]:
    """A scene with depth, and wrong matches."""
    x1, x2 = moved(n, [0.8, 0.1, 0.2])
    x2[:wrong] = np.random.default_rng(wrong).uniform([0.0, 0.0], SIZE, (wrong, 2))
    return x1, x2


KINDS = {
    "general": moved(80, [0.8, 0.1, 0.2]),
    "still": moved(80, [0.0, 0.0, 0.0]),
    "planar": plane(400, 0, seed=3),
    "planar, two wrong": plane(80, 2, seed=2),
    "some wrong": spoilt(80, 16),
    "random": spoilt(60, 60),
    "few": moved(10, [0.8, 0.1, 0.2]),
}

#: What `epigauge colmap` calls them.
VERDICTS = {
    "general": "refined",
    "still": "degenerate",
    "planar": "degenerate",
    "planar, two wrong": "degenerate",
    "some wrong": "unsupported",
    "random": "unsupported",
    "few": "refined",
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", ["refine", "estimate"])
def test_commands_of_matches_say_what_the_library_says(run, tmp_path, command, kind) -> None:
    if command == "estimate":
        pytest.importorskip("cv2", reason="needs a front end")
    x1, x2 = KINDS[kind]
    result = getattr(eg, f"{command}_fundamental")(x1, x2)
    save_matches(tmp_path / "m.npz", Matches(x1, x2))
    code, document = run(command, tmp_path / "m.npz", "-o", tmp_path / "r.npz")
    _, again = run(command, tmp_path / "m.npz", "-o", tmp_path / "r.json")
    assert code == (0 if result.success else 1)
    assert list(document["flags"]) == list(again["flags"]) == list(result.flags)
    assert document["success"] == result.success
    for name in ("r.npz", "r.json"):
        saved = eg.load_result(tmp_path / name)
        assert saved["flags"] == result.flags
        assert saved["success"] == result.success


def test_kinds_have_the_verdicts_that_they_must_have() -> None:
    told = {kind: eg.refine_fundamental(*x).flags for kind, x in KINDS.items()}
    assert told["general"] == ()
    assert "still camera" in told["still"]
    assert told["planar"] == ("planar scene",)  # nothing else makes it degenerate
    assert {"planar scene", "nearly planar"} & set(told["planar, two wrong"])
    assert "gross errors" in told["some wrong"]
    assert "no common geometry" in told["random"]
    assert "few matches" in told["few"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_of_databases_judges_as_the_others(run, tmp_path, kind) -> None:
    x1, x2 = (x.astype(np.float32).astype(float) for x in KINDS[kind])
    _, document = run("colmap", write(tmp_path / "d.db", x1, x2, camera=PINHOLE))
    (pair,) = document["pairs"]
    assert pair["verdict"] == VERDICTS[kind]
    for flag in eg.refine_fundamental(x1, x2).flags:
        assert flag in pair["note"]


@pytest.mark.parametrize("m", [20, 300])
@pytest.mark.parametrize("command", ["refine", "estimate"])
def test_random_matches_end_with_exit_code_1(run, tmp_path, command, m) -> None:
    rng = np.random.default_rng([5, m])
    x1, x2 = rng.uniform([0.0, 0.0], SIZE, (2, m, 2))
    save_matches(tmp_path / "m.npz", Matches(x1, x2))
    code, document = run(command, tmp_path / "m.npz")
    assert "no common geometry" in document["flags"]
    assert code == 1


@pytest.mark.parametrize(("distinct", "times"), [(7, 3), (9, 2), (40, 4)])
def test_copies_count_once_in_every_command(run, tmp_path, distinct, times) -> None:
    x1, x2 = moved(40, [0.8, 0.1, 0.2])
    x1, x2 = (x[:distinct].astype(np.float32).astype(float) for x in (x1, x2))
    again = np.random.default_rng(distinct).permutation(np.repeat(np.arange(distinct), times))
    for name, rows in (("once", np.arange(distinct)), ("again", again)):
        save_matches(tmp_path / f"{name}.npz", Matches(x1[rows], x2[rows]))
        write(tmp_path / f"{name}.db", x1[rows], x2[rows], camera=PINHOLE)
    _, once = run("colmap", tmp_path / "once.db")
    _, more = run("colmap", tmp_path / "again.db")
    assert more["pairs"][0]["verdict"] == once["pairs"][0]["verdict"]
    assert more["pairs"][0]["note"].replace(" different", "") == once["pairs"][0]["note"]
    if distinct < 8:  # fewer than can be solved: the commands of one pair refuse them
        assert "needed: at least 8" in more["pairs"][0]["note"]
        return
    code, once = run("refine", tmp_path / "once.npz")
    other, more = run("refine", tmp_path / "again.npz")
    assert code == other
    assert more["flags"] == once["flags"]
    assert more["rank"] == once["rank"]
    np.testing.assert_allclose(more["noise_px"], once["noise_px"], rtol=1e-6)
    F, G = (np.array(document["F"]) for document in (once, more))
    np.testing.assert_allclose(G * np.sign(np.sum(F * G)), F, atol=1e-6 * np.abs(F).max())
    np.testing.assert_allclose(more["std_F"], once["std_F"], rtol=1e-3)


def test_lenses_that_bend_are_told_by_the_command(run, tmp_path) -> None:
    x1, x2 = moved(300, [-0.8, 0.05, 0.2])
    bent = []
    for x in (x1, x2):
        q = (x - [640.0, 480.0]) / 1000.0
        bent.append(x + 1000.0 * q * -0.28 * np.sum(q**2, axis=1)[:, None])
    camera = (4, np.array([1000.0, 1000.0, 640.0, 480.0, -0.28, 0.0, 0.0, 0.0]))
    _, document = run("colmap", write(tmp_path / "d.db", *bent, camera=camera))
    assert document["pairs"][0]["verdict"] == "distorted"


@pytest.mark.parametrize("n", [12, 40, 90])
@pytest.mark.parametrize("command", ["refine", "estimate"])
def test_a_plane_before_turned_axes_is_no_motion(run, tmp_path, command, n) -> None:
    rng = np.random.default_rng([1, n])
    X = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.ones(n)])
    x1, x2 = (pixels(Y) + rng.normal(0.0, 1.0, (n, 2)) for Y in (X, X + np.array([0.2, 0.0, 0.0])))
    save_matches(tmp_path / "m.npz", Matches(x1, x2))
    code, document = run(command, tmp_path / "m.npz")
    assert "planar scene" in document["flags"]
    assert not document["success"]
    assert code == 1


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_field_of_view_converges(run, tmp_path, seed) -> None:
    rng = np.random.default_rng([9, seed])
    X = np.column_stack([rng.uniform(-0.006, 0.006, (25, 2)), 1.0 + rng.uniform(-0.003, 0.003, 25)])
    f = 11365.0
    x1, x2 = (
        np.round(f * Y[:, :2] / Y[:, 2:] + [1280.0, 960.0], 2)
        for Y in (X, X + np.array([0.034, -0.0131, -0.0355]))
    )
    save_matches(tmp_path / "m.npz", Matches(x1, x2))
    _, document = run("refine", tmp_path / "m.npz")
    assert document["status"] > 0
    assert document["rms_px"] < 0.01  # coordinates are rounded to that


@pytest.mark.parametrize("n", [30, 75])
def test_an_exactly_flat_start_is_solved_or_refused_by_name(run, tmp_path, n) -> None:
    rng = np.random.default_rng(n)
    X = np.column_stack([rng.uniform(-1.5, 1.5, (n, 2)), np.zeros(n), np.ones(n)])
    cameras = [K @ np.c_[np.eye(3), [0.3 * k, -0.1 * k, 5 + 0.2 * k]] for k in range(4)]
    P = np.array(cameras)
    view, point = (index.ravel() for index in np.mgrid[:4, :n])
    start = eg.Reconstruction(P, X)
    exact = eg.Tracks(view, point, np.zeros((4 * n, 2)))
    xy = start.project(exact) + rng.normal(0.0, 0.3, (4 * n, 2))
    eg.save_tracks(tmp_path / "t.npz", eg.Tracks(exact.view, exact.point, xy))
    np.savez(tmp_path / "s.npz", P=P, Q=X)
    for method in ("covariant", "levenberg", "faugeras"):
        code, document = run(
            "bundle", tmp_path / "t.npz", "--start", tmp_path / "s.npz", "--method", method
        )
        assert not document["success"]
        assert "planar scene" in document["flags"]
        assert code == 1
        assert document["rms_px"] < 0.6
    code, document = run("compare", tmp_path / "t.npz", "--start", tmp_path / "s.npz")
    assert {row["method"] for row in document["rows"]} >= {"covariant", "faugeras"}


@pytest.mark.parametrize("kind", ["determined", "star"])
def test_the_command_of_tracks_says_what_the_library_says(run, tmp_path, kind) -> None:
    scene = eg.multi_view_scene(n_points=40, distance=4.0, seed=4)
    tracks = scene.tracks
    if kind == "star":  # every track has two views, the first and another
        other = 1 + tracks.point % (tracks.n_views - 1)
        keep = (tracks.view == 0) | (tracks.view == other)
        tracks = eg.Tracks(tracks.view[keep], tracks.point[keep], tracks.xy[keep])
    eg.save_tracks(tmp_path / "t.npz", tracks)
    result = eg.bundle_adjust(tracks)
    code, document = run("bundle", tmp_path / "t.npz", "-o", tmp_path / "r.npz")
    assert list(document["flags"]) == list(result.flags)
    assert document["success"] == result.success == (kind == "determined")
    assert code == (0 if result.success else 1)
    assert eg.load_result(tmp_path / "r.npz")["flags"] == result.flags


def test_the_command_of_photographs_knows_a_picture_of_the_same_picture(
    run, tmp_path: Path
) -> None:
    cv2 = pytest.importorskip("cv2", reason="photographs need OpenCV")
    photo = rendered((0.6, 0.1, 0.2))[0]
    H = np.array([[0.95, 0.04, 20.0], [-0.03, 0.97, 15.0], [2e-5, 5e-5, 1.0]])
    for name, image in (("a.png", photo), ("b.png", cv2.warpPerspective(photo, H, (640, 480)))):
        assert cv2.imwrite(str(tmp_path / name), image)
    code, document = run("pair", tmp_path / "a.png", tmp_path / "b.png", "--max-features", 1000)
    assert "planar scene" in document["flags"]
    assert not document["success"]
    assert code == 1
