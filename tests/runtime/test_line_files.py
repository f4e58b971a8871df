"""Segments of lines in files, and lines on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.io import save_ply
from epigauge.multi_view.line_segments import line_pieces


@pytest.fixture(scope="module")
def scene() -> eg.LineScene:
    return eg.line_scene(n_views=5, n_points=12, n_lines=9, seed=3)


def without_lines(scene: eg.MetricReconstruction) -> eg.MetricReconstruction:
    return eg.MetricReconstruction(scene.R, scene.t, scene.X, scene.cameras)


@pytest.fixture
def folder(tmp_path: Path, scene: eg.LineScene) -> Path:
    eg.save_scene(tmp_path / "scene.npz", scene.tracks, without_lines(scene.true))
    eg.save_line_tracks(tmp_path / "lines.csv", scene.line_tracks)
    return tmp_path


def same(first: eg.LineTracks, second: eg.LineTracks) -> bool:
    names = ("view", "line", "segments", "spread")
    return all((getattr(first, name) == getattr(second, name)).all() for name in names)


def test_files_give_back_what_was_written(tmp_path: Path, scene: eg.LineScene) -> None:
    plain = scene.line_tracks
    parts = plain.view, plain.line, plain.segments
    # Of sigma 0.5 root and square are exact.
    wide = eg.LineTracks(*parts, sigma=np.where(plain.view == 2, 0.5, 2.0))
    names = [f"edge {9 - k}, upper" for k in range(9)]
    named = eg.LineTracks(*parts, names=names)
    for lines in (plain, wide, named):
        for name in ("lines.csv", "lines.npz"):
            eg.save_line_tracks(tmp_path / name, lines)
            found = eg.load_line_tracks(tmp_path / name)
            if lines is named and name == "lines.csv":  # numbered by their names
                assert found.names == tuple(sorted(names))
                back = eg.LineTracks(found.view, 8 - found.line, found.segments)
                assert same(back, plain)
                continue
            assert same(found, lines)
            assert found.names == lines.names
    S = np.tile(np.array([[2.0, 0.3], [0.3, 1.0]]), (len(plain), 2, 1, 1))
    skew = eg.LineTracks(*parts, covariance=S)
    eg.save_line_tracks(tmp_path / "skew.npz", skew)
    assert same(eg.load_line_tracks(tmp_path / "skew.npz"), skew)
    with pytest.raises(eg.ArgumentError, match=r"needed: a name ending in \.npz"):
        eg.save_line_tracks(tmp_path / "skew.csv", skew)


def test_views_have_the_names_of_the_tracks(tmp_path: Path, scene: eg.LineScene) -> None:
    tracks = scene.tracks
    names = [f"{5 - k}.jpg" for k in range(5)]
    named = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=names)
    path = tmp_path / "lines.csv"
    eg.save_line_tracks(path, scene.line_tracks, named)
    assert "\n5.jpg,0," in path.read_text()
    assert same(eg.load_line_tracks(path, named), scene.line_tracks)
    with pytest.raises(eg.FileFormatError, match=r"line 2: view is '5.jpg', needed: numbers"):
        eg.load_line_tracks(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("view,line,x1,y1,x2\n", "line 1: no column y2"),
        ("0,0,1,2,3\n", "line 1: 5 columns, needed: 6"),
        ("0,0,1,2,300,4\n1,0,1,2,x,4\n", "line 2: 'x' is not a number"),
        ("0,0,1,2,300,4\n1,0,1,2,nan,4\n", "line 2: 'nan' is not finite"),
        ("0,0,1,2,300,4\n\n# short\n1,0,1,2,2,2\n", "line 4: segments is 1 px long in line 4"),
        ("0,0,1,2,300,4\n0,0,1,2,200,2\n", r"line 1: .*twice \(lines 1 and 2\)"),
        ("0,0,1,2,300,4\n7,0,1,2,200,2\n", "line 2: view is 7, needed: 0 to 4"),
        ("0,0,1,2,300,4\n1,1,1,2,200,2\n", "0, 1 is seen by fewer than two views"),
        ("0,-1,1,2,300,4\n", "line 1: line is -1"),
        ("view,line,x1,y1,x2,y2,sigma\n0,0,1,2,99,4,0\n1,0,1,2,99,4,1\n", "line 2: sigma is 0"),
    ],
)
def test_bad_files_are_refused_by_their_lines(
    tmp_path: Path, scene: eg.LineScene, text: str, message: str
) -> None:
    path = tmp_path / "lines.csv"
    path.write_text(text)
    with pytest.raises(eg.FileFormatError, match=message):
        eg.load_line_tracks(path, scene.tracks)


def test_bad_arrays_are_refused(tmp_path: Path, scene: eg.LineScene) -> None:
    path, lines = tmp_path / "lines.npz", scene.line_tracks
    parts = {"view": lines.view, "line": lines.line, "segments": lines.segments}
    for wrong, message in (
        ({"segments": lines.segments[:, :3]}, "segments has shape"),
        ({"spread": lines.spread[:, :5]}, "array spread"),
        ({"spread": np.zeros_like(lines.spread)}, "covariance is no covariance in row 0"),
        ({"view": lines.view + 0.5}, "view is float64"),
    ):
        np.savez(path, **(parts | wrong))
        with pytest.raises(eg.FileFormatError, match=message):
            eg.load_line_tracks(path)
    np.savez(path, view=lines.view)
    with pytest.raises(eg.FileFormatError, match="needs arrays view and line and segments"):
        eg.load_line_tracks(path)


def test_the_command_adjusts_lines_and_writes_them(
    folder: Path, scene: eg.LineScene, run: Any
) -> None:
    out = [folder / name for name in ("out.npz", "out.ply", "out.csv")]
    forms = [part for path in out for part in ("-o", path)]
    options = ("--lines", folder / "lines.csv", "--refine", "pose", "--json")
    page = ("--plot", folder / "page.html")
    code, text, _ = run("bundle", folder / "scene.npz", *options, *forms, *page)
    assert code == 0
    told = json.loads(text)
    wanted = eg.bundle_adjust(
        scene.tracks, without_lines(scene.true), lines=scene.line_tracks, refine="pose"
    )
    assert told["n_lines"] == 9
    np.testing.assert_allclose(told["cost"], wanted.cost, rtol=1e-9)
    assert wanted.line_fun is not None
    np.testing.assert_allclose(told["line_fun"], wanted.line_fun, atol=1e-5)
    # What is written begins the next adjustment, which has nothing left to do.
    tracks, found = eg.load_scene(out[0])
    np.testing.assert_allclose(found.lines, told["lines"])
    again = eg.bundle_adjust(tracks, found, lines=scene.line_tracks, refine="pose")
    np.testing.assert_allclose(again.cost, wanted.cost, rtol=1e-7)
    with np.load(out[0]) as arrays:
        assert (arrays["line_tracks_segments"] == scene.line_tracks.segments).all()
    head, _, body = out[1].read_bytes().partition(b"end_header\n")
    assert b"element vertex 35\n" in head  # 12 points, 5 cameras, both ends of 9 lines
    assert b"element edge 9\n" in head
    edges = np.frombuffer(body[-9 * 8 :], "<i4").reshape(9, 2)
    assert (edges == np.arange(17, 35).reshape(9, 2)).all()
    rows = (folder / "out.lines.csv").read_text().splitlines()
    assert rows[0] == "view,line,x1,y1,x2,y2,distance_1,distance_2"
    assert len(rows) == 46
    data = (folder / "page.html").read_text().split('id="data">')[1].split("</script>")[0]
    assert len(json.loads(data)["lines"]) == 9
    code, text, err = run("bundle", folder / "scene.npz", *options[:-1])
    assert code == 0
    assert "9, 45 segments" in err
    assert len(text.splitlines()) == 5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("-o", "model"), "has no place for lines"),
        (("-o", "scene.txt"), "has no place for lines"),
        (("--robust",), "robust"),
        (("--method", "free"), "method"),
        (("--lines", "none.csv"), "none.csv"),
    ],
)
def test_what_lines_do_not_go_with_is_refused(
    folder: Path, run: Any, options: tuple[str, ...], message: str
) -> None:
    given = [folder / part if "." in part or part == "model" else part for part in options]
    lines = () if "--lines" in options else ("--lines", folder / "lines.csv")
    code, _, err = run("bundle", folder / "scene.npz", *lines, *given)
    assert code == 2
    assert message in err
    assert not (folder / "model").exists()


def test_lines_are_adjusted_with_tracks_alone(folder: Path, scene: eg.LineScene, run: Any) -> None:
    eg.save_tracks(folder / "tracks.csv", scene.tracks)
    words = "bundle", folder / "tracks.csv", "--lines", folder / "lines.csv"
    outputs = [folder / f"r.{suffix}" for suffix in ("npz", "ply", "csv")]
    code, out, err = run(*words, *(word for path in outputs for word in ("-o", path)))
    assert code == 0
    expected = eg.bundle_adjust(scene.tracks, lines=scene.line_tracks, callback=lambda row: None)
    P = np.loadtxt(out.splitlines()).reshape(-1, 3, 4)
    np.testing.assert_array_equal(P, expected.reconstruction.P)
    assert "9, 45 segments" in err
    # Everything comes back, and a run from there has nothing left to do.
    again = eg.load_reconstruction(outputs[0])
    np.testing.assert_array_equal(again.lines, expected.reconstruction.lines)
    words = "bundle", outputs[0], "--lines", folder / "lines.csv"
    code, out, _ = run(*words, "--start", outputs[0], "--json")
    found = json.loads(out)
    assert found["history"][0]["cost"] == pytest.approx(expected.cost, rel=1e-9)
    assert found["n_lines"] == 9
    table = (folder / "r.lines.csv").read_text().splitlines()
    assert len(table) == 46
    row = np.array(table[1].split(",")[6:], float)
    np.testing.assert_array_equal(row, expected.line_fun[0])
    assert b"element edge 9" in outputs[1].read_bytes()
    # Without segments the lines of the file would be lost, and COLMAP has no place for them.
    words_without = "bundle", outputs[0], "--start", outputs[0]
    assert "their segments: --lines FILE" in " ".join(run(*words_without)[2].split())
    assert "--colmap is given with lines" in run(*words, "--colmap", folder / "model")[2]
    assert not (folder / "model").exists()


def test_lines_name_the_views_of_files_with_gaps(
    folder: Path, scene: eg.LineScene, run: Any
) -> None:
    tracks, lines = scene.tracks, scene.line_tracks
    text = "\n".join(
        f"{3 * i + 2},{j},{x!r},{y!r}"
        for i, j, (x, y) in zip(
            tracks.view.tolist(), tracks.point.tolist(), tracks.xy.tolist(), strict=True
        )
    )
    (folder / "gaps.csv").write_text(text + "\n")
    found = eg.load_tracks(folder / "gaps.csv")
    eg.save_line_tracks(folder / "gaps.lines.csv", lines, found)
    assert "\n14,0," in (folder / "gaps.lines.csv").read_text()
    assert same(eg.load_line_tracks(folder / "gaps.lines.csv", found), lines)
    words = "bundle", folder / "gaps.csv", "--lines"
    assert run(*words, folder / "gaps.lines.csv")[0] == 0
    # Numbers from 0 would be other views, without a word.
    code, _, err = run(*words, folder / "lines.csv")
    assert code == 2
    assert "view is '0', needed: a name of the 5 views" in " ".join(err.split())
    eg.save_line_tracks(folder / "gaps.npz", lines)
    assert "--lines is 'gaps.npz', whose views have no names" in run(*words, folder / "gaps.npz")[2]


def test_pieces_are_what_the_views_show(scene: eg.LineScene) -> None:
    pieces = line_pieces(scene.line_tracks, scene.true)
    assert scene.true.lines is not None
    n, v = scene.true.lines[:, :3], scene.true.lines[:, 3:]
    for end in (0, 1):
        np.testing.assert_allclose(np.cross(pieces[:, end], v), n, atol=1e-9)
    # Pieces are about a third to the whole of the side of the cube, 4 m, about its middle.
    lengths = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    assert (lengths > 1.0).all()
    assert (lengths < 4.1).all()
    # A wrong end point in one view moves none of them far.
    segments = scene.line_tracks.segments.copy()
    segments[0, :2] += 5.0 * (segments[0, :2] - segments[0, 2:])
    wrong = eg.LineTracks(scene.line_tracks.view, scene.line_tracks.line, segments)
    assert np.abs(line_pieces(wrong, scene.true) - pieces).max() < 1.0
    # Images decide where they end: a basis does not.
    T = np.random.default_rng(0).normal(size=(4, 4))
    moved = eg.gauge.transform(scene.true.to_projective(), T)
    ends = line_pieces(scene.line_tracks, moved) @ T.T
    np.testing.assert_allclose(ends[..., :3] / ends[..., 3:], pieces, rtol=1e-9, atol=1e-9)


def test_a_cloud_without_edges_is_as_before(tmp_path: Path) -> None:
    save_ply(tmp_path / "cloud.ply", np.zeros((2, 3)), np.zeros((2, 3), np.uint8))
    head, _, body = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
    assert b"edge" not in head
    assert len(body) == 2 * 15


def test_names_that_a_table_would_not_give_back_are_refused(
    tmp_path: Path, scene: eg.LineScene
) -> None:
    lines, tracks = scene.line_tracks, scene.tracks
    few = lines.line < 2
    parts = lines.view[few], lines.line[few], lines.segments[few]
    # The second were read as lines 1 and 0.
    for names in (["a\nb", "c"], ["1", "0"], ["nan", "edge"]):
        named = eg.LineTracks(*parts, names=names)
        with pytest.raises(eg.ArgumentError, match=r"lines (hold|begin with) '"):
            eg.save_line_tracks(tmp_path / "named.csv", named)
        eg.save_line_tracks(tmp_path / "named.npz", named)
        assert eg.load_line_tracks(tmp_path / "named.npz").names == tuple(names)
    for numbers in (["7", "8", "9", "10", "110"], ["0", "2", "30", "31", "99"]):  # rising
        views = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=numbers)
        eg.save_tracks(tmp_path / "numbers.csv", views)
        assert eg.load_tracks(tmp_path / "numbers.csv").names == tuple(numbers)
    for numbers in (["01", "02", "03", "04", "05"], ["1", "2", "3", "4", "99999999999"]):
        views = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=numbers)
        with pytest.raises(eg.ArgumentError, match="which is read as a number"):
            eg.save_tracks(tmp_path / "numbers.csv", views)
    views = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=list("10234"))
    with pytest.raises(eg.ArgumentError, match="tracks begin with '1', which is read as a number"):
        eg.save_line_tracks(tmp_path / "named.csv", lines, views)
    with pytest.raises(eg.ArgumentError, match="names begin with '1', which is read as a number"):
        eg.save_tracks(tmp_path / "named.csv", views)
    assert not (tmp_path / "named.csv").exists()


def test_what_is_given_for_tracks_is_checked(tmp_path: Path, scene: eg.LineScene) -> None:
    eg.save_line_tracks(tmp_path / "lines.csv", scene.line_tracks)
    wrong: Any = 5
    with pytest.raises(eg.ArgumentError, match="tracks is a int"):
        eg.load_line_tracks(tmp_path / "lines.csv", wrong)
    with pytest.raises(eg.ArgumentError, match="tracks is a int"):
        eg.save_line_tracks(tmp_path / "lines.csv", scene.line_tracks, wrong)


@pytest.mark.parametrize("sigma", [1e200, 1e-200])
def test_deviations_whose_squares_are_none_are_refused(sigma: float, scene: eg.LineScene) -> None:
    lines, tracks = scene.line_tracks, scene.tracks
    with pytest.raises(eg.ArgumentError, match="sigma is"):
        eg.LineTracks(lines.view, lines.line, lines.segments, sigma=sigma)
    with pytest.raises(eg.ArgumentError, match="sigma is"):
        eg.Tracks(tracks.view, tracks.point, tracks.xy, sigma=sigma)
    covariance = np.full((len(lines), 1, 1, 1), sigma**1.5) * np.tile(np.eye(2), (2, 1, 1))
    with pytest.raises(eg.ArgumentError, match=r"covariance is no covariance"):
        eg.LineTracks(lines.view, lines.line, lines.segments, covariance=covariance)
