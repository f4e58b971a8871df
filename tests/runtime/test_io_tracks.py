"""Files of tracks: what was saved comes back, what cannot be used is refused by line or name."""

from __future__ import annotations

import bz2
import gzip
import io
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io import load_track_file, save_ply
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.metric_scenes import metric_scene

SCENE = eg.multi_view_scene(n_views=4, n_points=12, visible=0.7, seed=2)
TRACKS = SCENE.tracks
#: In the other coordinates everything is behind cameras of BAL, which look along -z.
BEHIND = eg.Reconstruction(np.diag([-1.0, -1.0, 1.0]) @ SCENE.true.P, SCENE.true.Q)
MIRROR = np.array([-1.0, -1.0, -1.0, 1.0])
BAL_START = eg.Reconstruction(BEHIND.P * MIRROR, BEHIND.Q * MIRROR)
SUFFIXES = [".npz", ".csv", ".txt", ".txt.bz2", ".txt.gz"]
NEED_START = SUFFIXES[2:]


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assert_same(found: eg.Tracks, expected: eg.Tracks) -> None:
    for name in ("view", "point", "xy", "weights"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


# What is written comes back


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_tracks_come_back_to_the_last_bit(tmp_path, suffix) -> None:
    path = tmp_path / f"some tracks{suffix}"
    eg.save_tracks(path, TRACKS, BAL_START if suffix in NEED_START else None)
    assert_same(eg.load_tracks(path), TRACKS)


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_weights_come_back(tmp_path, suffix) -> None:
    weights = np.linspace(0.1, 1 / 3, len(TRACKS))
    tracks = eg.Tracks(TRACKS.view, TRACKS.point, TRACKS.xy / 3, weights=weights)
    eg.save_tracks(tmp_path / f"t{suffix}", tracks)
    assert_same(eg.load_tracks(tmp_path / f"t{suffix}"), tracks)


def test_reconstruction_comes_back_alone_and_with_tracks(tmp_path) -> None:
    eg.save_reconstruction(tmp_path / "r.npz", SCENE.true)
    eg.save_tracks(tmp_path / "t.npz", TRACKS, SCENE.true)
    for name in ("r.npz", "t.npz"):
        found = eg.load_reconstruction(tmp_path / name)
        np.testing.assert_array_equal(found.P, SCENE.true.P)
        np.testing.assert_array_equal(found.Q, SCENE.true.Q)
    with pytest.raises(ArgumentError, match=r"\.npz"):
        eg.save_reconstruction(tmp_path / "r.csv", SCENE.true)
    with pytest.raises(FileFormatError, match="holds a reconstruction but no tracks"):
        eg.load_tracks(tmp_path / "r.npz")


@pytest.mark.parametrize("suffix", NEED_START)
@pytest.mark.parametrize("scale", [1.0, -3.0])
def test_bal_keeps_the_geometry_of_its_cameras(tmp_path, suffix, scale) -> None:
    # Scales and signs of cameras and points are free; BAL has its own.
    start = eg.Reconstruction(scale * BAL_START.P, -scale * BAL_START.Q)
    eg.save_tracks(tmp_path / f"t{suffix}", TRACKS, start)
    found = eg.load_reconstruction(tmp_path / f"t{suffix}")
    np.testing.assert_allclose(found.project(TRACKS), start.project(TRACKS), atol=1e-9)
    np.testing.assert_allclose(found.Q, BAL_START.Q, atol=1e-15)


@pytest.mark.parametrize("start", [BAL_START, BEHIND], ids=["before", "behind"])
def test_bal_puts_the_scene_before_its_cameras(tmp_path, start) -> None:
    eg.save_tracks(tmp_path / "t.txt", TRACKS, start)
    found = eg.load_reconstruction(tmp_path / "t.txt")
    np.testing.assert_allclose(found.project(TRACKS), start.project(TRACKS), atol=1e-9)
    tracks, scene = eg.load_scene(tmp_path / "t.txt")
    seen = np.einsum("nij,nj->ni", scene.R[tracks.view], scene.X[tracks.point])
    assert (seen[:, 2] + scene.t[tracks.view, 2] < 0.0).all()  # they look along -z


def test_bal_refuses_a_camera_that_looks_away_from_its_points(tmp_path) -> None:
    P = BAL_START.P.copy()
    P[2] = np.diag([-1.0, 1.0, -1.0]) @ P[2]  # half a turn about the x axis
    P[2, :2] *= -1.0
    with pytest.raises(ArgumentError, match="camera 2 with its points behind it"):
        eg.save_tracks(tmp_path / "t.txt", TRACKS, eg.Reconstruction(P, BAL_START.Q))
    assert not (tmp_path / "t.txt").exists()


def test_bal_rotations_near_and_at_half_a_turn_come_back(tmp_path) -> None:
    for angle in (0.0, 1e-9, 3.0, np.pi - 1e-9, np.pi):
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        P = BAL_START.P.copy()
        P[0] = np.diag([-900.0, -900.0, 1.0]) @ np.column_stack([R, [1.0, 2.0, -40.0]])
        eg.save_tracks(tmp_path / "t.txt", TRACKS, eg.Reconstruction(P, BAL_START.Q))
        found = eg.load_reconstruction(tmp_path / "t.txt").P[0]
        np.testing.assert_allclose(found, P[0], atol=1e-9)  # entries up to 4e4


def test_same_content_gives_the_same_bytes(tmp_path) -> None:
    for suffix in NEED_START:
        for name in ("a", "b"):
            eg.save_tracks(tmp_path / f"{name}{suffix}", TRACKS, BAL_START)
        first, second = ((tmp_path / f"{n}{suffix}").read_bytes() for n in ("a", "b"))
        assert first == second


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "view,point,x,y\n{}",
        "# made by hand\n\n{}",
        "# view point x y\n{}",
    ],
)
def test_every_way_to_write_a_table_is_read_alike(tmp_path, text) -> None:
    rows = zip(TRACKS.view, TRACKS.point, *TRACKS.xy.T.tolist(), strict=True)
    table = "".join(f"{v},{p},{x!r},{y!r}\n" for v, p, x, y in rows)
    assert_same(eg.load_tracks(write(tmp_path / "t.csv", text.format(table))), TRACKS)


# Part of a file


def test_only_clean_points_of_some_views_are_read(tmp_path) -> None:
    clean = np.arange(12) != 5
    arrays = {"view": TRACKS.view, "point": TRACKS.point, "xy": TRACKS.xy}
    np.savez(tmp_path / "t.npz", clean=clean, P=SCENE.true.P, X=SCENE.true.Q[:, :3], **arrays)
    found = load_track_file(tmp_path / "t.npz", clean=True, views=[0, 1, 3])
    assert found.views.tolist() == [0, 1, 3]
    assert 5 not in found.points
    keep = np.isin(TRACKS.view, found.views) & np.isin(TRACKS.point, found.points)
    np.testing.assert_array_equal(found.tracks.xy, TRACKS.xy[keep])
    np.testing.assert_array_equal(found.points[found.tracks.point], TRACKS.point[keep])
    assert found.start is not None
    np.testing.assert_array_equal(found.start.P, SCENE.true.P[[0, 1, 3]])
    np.testing.assert_array_equal(found.start.Q, SCENE.true.Q[found.points])
    assert_same(eg.load_tracks(tmp_path / "t.npz"), TRACKS)


def test_clean_observations_of_a_table(tmp_path) -> None:
    rows = zip(TRACKS.view, TRACKS.point, *TRACKS.xy.T.tolist(), strict=True)
    lines = [f"{v},{p},{x!r},{y!r},{int(p != 3)}\n" for v, p, x, y in rows]
    path = write(tmp_path / "t.csv", "view,point,x,y,clean\n" + "".join(lines))
    assert eg.load_tracks(path).n_points == 12
    assert eg.load_tracks(path, clean=True).n_points == 11


def test_weak_points_are_dropped_only_when_asked(tmp_path) -> None:
    view, point = np.append(TRACKS.view, 0), np.append(TRACKS.point, 12)
    np.savez(tmp_path / "t.npz", view=view, point=point, xy=np.vstack([TRACKS.xy, [[1, 2]]]))
    with pytest.raises(FileFormatError, match=r"point 12 has fewer than 2 observations"):
        eg.load_tracks(tmp_path / "t.npz")
    assert_same(eg.load_tracks(tmp_path / "t.npz", views=range(4)), TRACKS)


def test_measured_sets_are_read(data_dir) -> None:
    corridor = eg.load_tracks(data_dir / "corridor" / "tracks.npz")
    assert (corridor.n_views, corridor.n_points, len(corridor)) == (11, 737, 4035)
    hotel = data_dir / "hotel_klt" / "tracks.npz"
    assert eg.load_tracks(hotel, clean=True, views=range(0, 51, 5)).n_points == 586


@pytest.mark.slow
def test_published_cost_of_a_bal_problem(data_dir) -> None:
    found = load_track_file(data_dir / "bal" / "problem-49-7776-pre.txt.bz2")
    assert found.start is not None
    cost = 0.5 * np.sum((found.tracks.xy - found.start.project(found.tracks)) ** 2)
    # 8.509125e5 with the BAL camera, whose distortion is below 1e-6 here.
    assert cost == pytest.approx(8.509125e5, rel=1e-4)


# What cannot be used is refused


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", None, "is empty"),
        ("view,point,x,y\n", None, "holds no observations"),
        ("0,0,1,2\n0,1.5,1,2\n", 2, "point is 1.5, needed: a whole number"),
        ("0,0,1,2\n-1,0,1,2\n", 2, "view is -1"),
        ("0,99999999999,1,2\n", 1, "point is 1e+11"),
        ("0,0,1\n", 1, "3 columns, needed: 4 (view point x y)"),
        ("0,0,1,two\n", 1, "'two' is not a number"),
        ("0,0,1,inf\n", 1, "'inf' is not finite"),
        ("a,b,c,d\n0,0,1,2\n", 1, "no column view, point, x, y among a, b, c, d"),
        ("0,0,1,2\n0,0,1,2\n", None, "twice"),
        ("0,0,1,2\n0,1,1,2\n", None, "fewer than 2 observations"),
    ],
)
def test_bad_tables_are_refused_with_line_and_reason(tmp_path, text, line, reason) -> None:
    path = write(tmp_path / "bad.csv", text)
    with pytest.raises(FileFormatError) as caught:
        eg.load_tracks(path)
    assert caught.value.line == line
    assert reason in caught.value.reason


def good_bal() -> bytes:
    lines = ["2 1 2", "0 0 1 2", "1 0 3 4", *["0.5"] * 18, "1", "2", "3"]
    return "\n".join(lines).encode() + b"\n"


@pytest.mark.parametrize(
    ("old", "new", "line", "reason"),
    [
        ("2 1 2\n", "2 1 2 0\n", 1, "is no BAL problem"),
        ("2 1 2\n", "view,point,x,y\n", 1, "is no BAL problem"),
        ("2 1 2\n", "2 1 0\n", 1, "1 to 10000000 views points observations"),
        ("2 1 2\n", "2 1 99999999\n", 1, "1 to 10000000"),
        ("2 1 2\n", "2 1 3\n", None, "ends after 29 of the 33 numbers"),
        ("1 0 3 4", "2 0 3 4", 3, "view is 2, needed: a whole number from 0 below 2"),
        ("1 0 3 4", "1 0.5 3 4", 3, "point is 0.5"),
        ("1 0 3 4", "1 0 3 nan", 3, "'nan' is not finite"),
        ("1 0 3 4", "1 0 3 4 5", 24, "more than the 29 numbers"),
        ("\n0.5", "\nO.5", 4, "'O.5' is not a number"),
        ("1\n2\n3\n", "1\n2\n", None, "ends after 28 of the 29"),
        ("2 1 2\n", "2 1 2\n" + "\n" * 2000, None, "more than 1000 empty lines"),
    ],
)
def test_bad_bal_is_refused_with_line_and_reason(tmp_path, old, new, line, reason) -> None:
    text = good_bal().decode()
    assert old in text
    path = write(tmp_path / "bad.txt", text.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        eg.load_tracks(path)
    assert reason in caught.value.reason
    if "empty lines" not in reason:
        assert caught.value.line == line


def test_damaged_compression_is_refused(tmp_path) -> None:
    for suffix, pack in ((".txt.bz2", bz2.compress), (".txt.gz", gzip.compress)):
        content = pack(good_bal())
        for bad in (content[:-9], b"no archive", content[:20] + b"\xaa" * 9 + content[29:]):
            with pytest.raises(FileFormatError, match="is damaged"):
                eg.load_tracks(write(tmp_path / f"bad{suffix}", bad))


VALID = {"view": TRACKS.view, "point": TRACKS.point, "xy": TRACKS.xy}


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"xy": None}, "needs arrays view and point and xy, or P and Q, or P and X"),
        ({"view": TRACKS.view * 1.0}, "view has type float64"),
        ({"point": TRACKS.point[:-1]}, "point has type"),
        ({"view": TRACKS.view + 10**8}, "in row 0, needed: 0 to 9999999"),
        ({"point": np.full(len(TRACKS), -1)}, "point is -1 in row 0"),
        ({"xy": TRACKS.xy[:, :1]}, "xy has type"),
        ({"xy": TRACKS.xy * np.nan}, "xy is not finite in row 0"),
        ({"xy": TRACKS.xy.astype(str)}, "array xy holds values of type"),
        ({"weights": np.ones(3)}, "weights has shape (3,)"),
        ({"n_points": np.array(10**9)}, "n_points is no number from 1"),
        ({"n_views": np.array(2)}, "view is 3"),
        ({"P": SCENE.true.P[:2], "Q": SCENE.true.Q}, "2 cameras and 12 points but tracks of more"),
        ({"P": SCENE.true.P[:, :2], "Q": SCENE.true.Q}, "P is float64 (4, 2, 4)"),
    ],
)
def test_bad_arrays_are_refused_by_name(tmp_path, arrays, reason) -> None:
    content = {name: array for name, array in (VALID | arrays).items() if array is not None}
    np.savez(tmp_path / "bad.npz", **content)
    with pytest.raises(FileFormatError) as caught:
        load_track_file(tmp_path / "bad.npz")
    assert reason in caught.value.reason


@pytest.mark.parametrize("clean", [None, np.ones(3, bool), np.ones(12), np.zeros(12, bool)])
def test_clean_points_must_be_marked(tmp_path, clean) -> None:
    np.savez(tmp_path / "t.npz", **VALID, **({} if clean is None else {"clean": clean}))
    with pytest.raises(
        FileFormatError, match=r"marks nothing as clean|one mark a point|none|no obs"
    ):
        eg.load_tracks(tmp_path / "t.npz", clean=True)


def test_what_a_form_cannot_hold_is_refused(tmp_path) -> None:
    at_infinity = SCENE.true.Q.copy()
    at_infinity[3, 3] = 0.0
    for name, start, words in (
        ("t.csv", SCENE.true, "start is given; needed: none for CSV"),
        ("t.txt", None, "start is None"),
        ("t.txt", SCENE.true, r"has camera 0 away from diag\(-f, -f, 1\)"),
        ("t.txt", eg.Reconstruction(BAL_START.P, at_infinity), "has point 3 at infinity"),
        ("t.npz", eg.Reconstruction(BAL_START.P[:3], SCENE.true.Q), "has 3 cameras"),
        ("t.ply", None, "a name ending in .npz"),
    ):
        if name == "t.txt" and start is SCENE.true:
            # A principal point off the origin.
            start = eg.Reconstruction(
                np.array([[1.0, 0, 9], [0, 1, 0], [0, 0, 1]]) @ BAL_START.P, SCENE.true.Q
            )
        with pytest.raises(ArgumentError, match=words):
            eg.save_tracks(tmp_path / name, TRACKS, start)
    assert list(tmp_path.iterdir()) == []


# Whatever the bytes: tracks or a FileFormatError

fuzzing = settings(
    max_examples=100,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def as_bytes(suffix: str) -> bytes:
    stream = io.BytesIO()
    if suffix == ".npz":
        np.savez(stream, **VALID, clean=np.ones(12, bool), P=SCENE.true.P, Q=SCENE.true.Q)
        return stream.getvalue()
    if suffix == ".csv":
        rows = zip(TRACKS.view, TRACKS.point, *TRACKS.xy.T.tolist(), strict=True)
        return b"view,point,x,y,clean\n" + b"".join(b"%d,%d,%r,%r,1\n" % row for row in rows)
    return good_bal()


@st.composite
def hostile(draw: st.DrawFn, good: bytes) -> bytes:
    """Overwrite, insert, delete or repeat a few stretches of a good file."""
    content = bytearray(good)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(content)))
        new = draw(st.binary(max_size=8) | st.sampled_from([b"nan", b",", b"\n", b"1e308 ", b"-"]))
        content[at : at + draw(st.integers(0, 12))] = new * draw(st.sampled_from([1, 1, 1, 300]))
    return bytes(content)


def contents(suffix: str) -> st.SearchStrategy[bytes]:
    """Return damaged files; the compressed ones also damaged inside."""
    good = as_bytes(suffix.removesuffix(".gz").removesuffix(".bz2"))
    for end, form in ((".gz", gzip), (".bz2", bz2)):
        if suffix.endswith(end):
            return hostile(form.compress(good)) | hostile(good).map(form.compress)
    return hostile(good)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_any_file_gives_tracks_or_a_file_format_error(tmp_path, suffix) -> None:
    @fuzzing
    @given(contents(suffix))
    def read(content: bytes) -> None:
        path = write(tmp_path / f"fuzz{suffix}", content)
        for load in (
            lambda: load_track_file(path).tracks.xy,
            lambda: load_track_file(path, clean=True).tracks.xy,
            lambda: eg.load_reconstruction(path).Q,
        ):
            message = ""
            try:
                assert np.isfinite(load()).all()
            except FileFormatError as error:
                message = str(error)
            assert len(message) < 800
            assert message.isprintable()

    read()


# Clouds


def test_ply_is_what_its_header_says(tmp_path) -> None:
    xyz, rgb = SCENE.true.Q[:, :3], np.arange(36, dtype=np.uint8).reshape(12, 3)
    save_ply(tmp_path / "c.ply", xyz, rgb, "a comment")
    head, _, body = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:4] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment a comment",
        "element vertex 12",
    ]
    assert [line.split()[1] for line in lines[4:]] == ["float"] * 3 + ["uchar"] * 3
    table = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    np.testing.assert_array_equal(table["xyz"], xyz.astype(np.float32))
    np.testing.assert_array_equal(table["rgb"], rgb)


def test_weights_stay_with_their_observations_where_some_are_dropped(tmp_path) -> None:
    # Observations in random order, of which the kept ones are not the first.
    rng = np.random.default_rng(4)
    view, point = map(np.ravel, np.meshgrid(np.arange(4), np.arange(9), indexing="ij"))
    xy, weights = rng.uniform(0.0, 100.0, (36, 2)), rng.uniform(0.5, 2.0, 36)
    order = rng.permutation(36)
    path = tmp_path / "tracks.npz"
    np.savez(path, view=view[order], point=point[order], xy=xy[order], weights=weights[order])
    found = eg.load_tracks(path, views=[1, 2, 3])
    by_place = {tuple(place): weight for place, weight in zip(xy, weights, strict=True)}
    assert len(found) == 27
    for place, weight in zip(found.xy, found.weights, strict=True):
        assert weight == by_place[tuple(place)]


# Names and numbers of views


@pytest.mark.parametrize("named", ["a b{}.jpg", "{}", "1{}0"])
def test_views_may_have_names_or_any_numbers(tmp_path, named) -> None:
    rows = zip(TRACKS.view, TRACKS.point, *TRACKS.xy.T.tolist(), strict=True)
    lines = [f"{named.format(v)},{3 * p + 1},{x!r},{y!r}\n" for v, p, x, y in rows]
    path = write(tmp_path / "t.csv", "view,point,x,y\n" + "".join(lines))
    found = eg.load_tracks(path)
    assert_same(found, TRACKS)
    names = tuple(named.format(v) for v in range(TRACKS.n_views))
    assert found.names == (None if named == "{}" else names)
    eg.save_tracks(tmp_path / "again.csv", found)
    again = eg.load_tracks(tmp_path / "again.csv")
    assert_same(again, TRACKS)
    assert again.names == found.names


def test_repeated_measurements_are_pruned_when_asked(tmp_path) -> None:
    arrays = {name: getattr(TRACKS, name) for name in ("view", "point", "xy")}
    np.savez(tmp_path / "t.npz", **{name: np.concatenate([a, a[:1]]) for name, a in arrays.items()})
    with pytest.raises(FileFormatError, match="twice"):
        eg.load_tracks(tmp_path / "t.npz")
    assert_same(eg.load_tracks(tmp_path / "t.npz", prune="first"), TRACKS)


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_names_of_views_survive(tmp_path: Path, suffix: str) -> None:
    names = ("a, b.jpg", 'the "best".png', "room #7; left.png", "o'clock", " spaced ", "ä.jpg")
    names = tuple(sorted(names))  # in a table names are numbered by their order
    view, point = (index.ravel() for index in np.indices((len(names), 7)))
    xy = np.random.default_rng(0).uniform(0.0, 100.0, (len(view), 2))
    tracks = eg.Tracks(view, point, xy, weights=np.arange(1.0, len(view) + 1.0), names=names)
    path = tmp_path / f"tracks{suffix}"
    eg.save_tracks(path, tracks)
    again = eg.load_tracks(path)
    assert again.names == names
    for name in ("view", "point", "xy", "weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))


def test_a_name_of_two_lines_is_refused_by_a_table(tmp_path: Path) -> None:
    view, point = (index.ravel() for index in np.indices((2, 7)))
    tracks = eg.Tracks(view, point, np.zeros((14, 2)), names=("a\nb", "c"))
    with pytest.raises(ArgumentError, match="NPZ"):
        eg.save_tracks(tmp_path / "tracks.csv", tracks)
    assert not (tmp_path / "tracks.csv").exists()


def test_names_of_another_number_are_refused(tmp_path: Path) -> None:
    view, point = (index.ravel() for index in np.indices((3, 7)))
    arrays = {"view": view, "point": point, "xy": np.zeros((21, 2))}
    for names in (np.array(["a", "b"]), np.array([["a", "b", "c"]]), np.arange(3)):
        np.savez(tmp_path / "tracks.npz", names=names, **arrays)
        with pytest.raises(FileFormatError, match="names"):
            eg.load_tracks(tmp_path / "tracks.npz")


@pytest.mark.parametrize("form", ["sigma", "sigmas", "covariance"])
def test_npz_keeps_how_well_coordinates_are_measured(form: str, tmp_path: Path) -> None:
    """Unit and whitening come back to the last bit, from tracks and from scenes."""
    rng = np.random.default_rng(2)
    tracks, scene = metric_scene("SIMPLE_RADIAL", 3, n_points=20)
    order = rng.permutation(len(tracks))
    L = rng.normal(0.0, 0.2, (len(tracks), 2, 2)) + np.eye(2)
    how: dict[str, Any] = {
        "sigma": {"sigma": rng.uniform(0.2, 3.0, len(tracks))},
        "sigmas": {"sigma": rng.uniform(0.2, 3.0, (len(tracks), 2))},
        "covariance": {"covariance": L @ np.swapaxes(L, 1, 2)},
    }[form]
    rows = tracks.view[order], tracks.point[order], tracks.xy[order]
    whole = eg.Tracks(*rows, **how)
    path = tmp_path / "tracks.npz"
    eg.save_tracks(path, whole)
    eg.save_scene(tmp_path / "scene.npz", whole, scene)
    for found in (
        eg.load_tracks(path),
        eg.load_tracks(path, prune="first"),
        eg.load_scene(tmp_path / "scene.npz")[0],
    ):
        assert found.unit == whole.unit
        np.testing.assert_array_equal(found.weights, whole.weights)
        assert (found.whitening is None) == (whole.whitening is None)
        if whole.whitening is not None:
            np.testing.assert_array_equal(found.whitening, whole.whitening)
    some = eg.load_tracks(path, views=[0, 1, 3], prune="first")
    kept = np.isin(whole.view, [0, 1, 3]) & (
        np.bincount(whole.point[np.isin(whole.view, [0, 1, 3])], minlength=20)[whole.point] > 1
    )
    if whole.whitening is None:
        assert some.whitening is None
    else:
        np.testing.assert_array_equal(some.whitening, whole.whitening[:, :, kept])
        with pytest.raises(eg.ArgumentError, match="npz"):
            eg.save_tracks(tmp_path / "tracks.csv", whole)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("unit", np.array(-1.0)),
        ("unit", np.array([1.0, 2.0])),
        ("whitening", np.ones((3, 2, 2))),
        ("whitening", None),
    ],
)
def test_npz_with_no_such_measurements_is_refused(name: str, array: Any, tmp_path: Path) -> None:
    tracks, _ = metric_scene("PINHOLE", 3, n_points=10)
    array = np.full((len(tracks), 2, 2), np.nan) if array is None else array
    path = tmp_path / "tracks.npz"
    np.savez(path, view=tracks.view, point=tracks.point, xy=tracks.xy, **{name: array})
    with pytest.raises(eg.FileFormatError, match=name):
        eg.load_tracks(path)
