"""Raw matches of a COLMAP database: what each pair is, stored whole or not at all."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from colmap_databases import SCHEMA, change, content, pair_id
from epigauge import _colmap_verification as verification
from epigauge._colmap_pair import verified
from epigauge._processes import Processes
from epigauge.io.colmap_raw import RawDatabase
from two_views import up_to_sign

Array = np.ndarray

F, W, H = 900.0, 1200, 900
K = np.array([[F, 0.0, 600.0], [0.0, F, 450.0], [0.0, 0.0, 1.0]])
NUMBERS = {"SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 2, "FOV": 7}


def turned(x: float, y: float, z: float) -> Array:
    """Return a rotation about the axes, one after the other."""
    (a, b), (c, d), (e, f) = ((np.cos(t), np.sin(t)) for t in (x, y, z))
    Rx = np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
    Ry = np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]])
    return Rx @ Ry @ np.array([[e, -f, 0], [f, e, 0], [0, 0, 1]])


R, T = turned(0.05, -0.12, 0.03), np.array([-1.0, 0.1, 0.3])


def views(kind: str, rng: np.random.Generator, m: int = 150) -> tuple[Array, Array]:
    """Return rays (m, 2) of both images for matches of a kind, without noise."""
    rays = np.column_stack([rng.uniform(-0.6, 0.6, m), rng.uniform(-0.45, 0.45, m), np.ones(m)])
    depth = rng.uniform(4.0, 10.0, m)
    if kind == "plane":
        depth = 6.0 / (rays @ [0.3, -0.2, 1.0])
    t = np.zeros(3) if kind == "rotation" else T
    second = (rays * depth[:, None]) @ R.T + t
    return rays[:, :2], second[:, :2] / second[:, 2:]


def matches(kind: str, seed: int, *, wrong: float = 0.3, k: float = 0.0) -> tuple[Array, Array]:
    """Return noisy points of both images; k is the radial distortion."""
    rng = np.random.default_rng(seed)
    points = []
    for rays in views(kind, rng):
        bent = rays * (1.0 + k * np.sum(rays**2, axis=1, keepdims=True))
        points.append(F * bent + K[:2, 2] + rng.normal(0.0, 0.3, rays.shape))
    x1, x2 = points
    if kind == "watermark":
        x1 = np.column_stack([rng.uniform(0.0, W, len(x1)), rng.uniform(H - 80.0, H, len(x1))])
        x2 = x1 + np.array([3.0, -2.0]) + rng.normal(0.0, 0.3, x1.shape)
    bad = rng.random(len(x1)) < (1.0 if kind == "random" else wrong)
    x2[bad] = rng.uniform([0.0, 0.0], [W, H], (np.count_nonzero(bad), 2))
    return x1, x2


def database(path: Path, pairs: list[tuple[Array, Array]], **options: Any) -> Path:
    """Make a database whose images 2 k + 1 and 2 k + 2 have the matches of pair k."""
    camera = {"model": "SIMPLE_PINHOLE", "params": [F, 600.0, 450.0], "prior": 0} | options
    with sqlite3.connect(path) as connection:
        connection.executescript(SCHEMA)
        params = np.array(camera["params"]).tobytes()
        row = (NUMBERS[camera["model"]], W, H, params, camera["prior"])
        connection.execute("INSERT INTO cameras VALUES (1, ?, ?, ?, ?, ?)", row)
        for k, (x1, x2) in enumerate(pairs):
            for image, x in ((2 * k + 1, x1), (2 * k + 2, x2)):
                connection.execute("INSERT INTO images VALUES (?, ?, 1)", (image, f"{image}.jpg"))
                table = x.astype(np.float32)
                connection.execute(
                    "INSERT INTO keypoints VALUES (?, ?, 2, ?)", (image, len(x), table.tobytes())
                )
            numbers = np.repeat(np.arange(len(x1), dtype=np.uint32)[:, None], 2, axis=1)
            connection.execute(
                "INSERT INTO matches VALUES (?, ?, 2, ?)",
                (pair_id(2 * k + 1, 2 * k + 2), len(numbers), numbers.tobytes()),
            )
        connection.execute("PRAGMA user_version = 3900")
    connection.close()
    return path


KINDS = ("general", "plane", "rotation", "watermark", "random")


@pytest.fixture(scope="module")
def some(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with two general pairs and one of random matches."""
    pairs = [matches(kind, seed) for seed, kind in enumerate(("general", "random", "general"))]
    return database(tmp_path_factory.mktemp("some") / "some.db", pairs)


@pytest.fixture
def copied(some: Path, tmp_path: Path) -> Path:
    path = tmp_path / "database.db"
    path.write_bytes(some.read_bytes())
    return path


def the_same(one: eg.colmap.DatabaseVerification, other: eg.colmap.DatabaseVerification) -> None:
    for name in ("pair_id", "config", "inliers", "F", "E", "H", "noise_px"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.note == other.note


@pytest.mark.parametrize("prior", [0, 1])
def test_points_of_one_line_have_no_geometry(tmp_path: Path, prior: int) -> None:
    rng = np.random.default_rng(5)
    x1 = np.column_stack([rng.uniform(0.0, W, 150), np.full(150, 300.0)])
    x2 = x1 @ [[0.9, 0.2], [-0.2, 0.9]] + [60.0, 20.0]
    pairs = []
    for noise in (0.0, 0.5):
        pair = [x + noise * rng.standard_normal(x.shape) for x in (x1, x2)]
        for x in pair:
            x[:40] = rng.uniform([0.0, 0.0], [W, H], (40, 2))
        pairs.append((pair[0], pair[1]))
    path = database(tmp_path / "lines.db", pairs, prior=prior)
    assert eg.colmap.verify_database(path).config.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("prior", "expected"), [(1, [2, 4, 5, 7, 1]), (0, [3, 6, 6, 7, 1])], ids=["known f", "guessed"]
)
def test_pairs_are_called_what_they_are(tmp_path, prior, expected) -> None:
    for seed in (0, 10):
        pairs = [matches(kind, seed + k) for k, kind in enumerate(KINDS)]
        path = database(tmp_path / f"{seed}.db", pairs, prior=prior)
        found = eg.colmap.verify_database(path)
        assert found.config.tolist() == expected
        assert (found.inliers[:4] > 95).all()
        assert found.inliers[4] == 0
        general = found.F[0]
        true = np.linalg.inv(K).T @ np.cross(T, R, axisb=0, axisc=0) @ np.linalg.inv(K)
        assert up_to_sign(general / np.linalg.norm(general), true / np.linalg.norm(true)) < 2e-3
        moved = found.H[1] @ np.column_stack([pairs[1][0], np.ones(150)]).T
        off = np.linalg.norm((moved[:2] / moved[2]).T - pairs[1][1], axis=1)
        assert np.median(off) < 1.0
        assert np.isnan(found.E[1:]).all()
        if prior:
            E = K.T @ general @ K
            assert up_to_sign(found.E[0], E / np.linalg.norm(E)) < 1e-9
            values = np.linalg.svd(found.E[0])[1]
            np.testing.assert_allclose(values, [0.5**0.5, 0.5**0.5, 0.0], atol=1e-9)


def test_a_known_lens_is_undone(tmp_path) -> None:
    pairs = [matches("general", 3, k=-0.15)]
    radial = {"model": "SIMPLE_RADIAL", "params": [F, 600.0, 450.0, -0.15], "prior": 1}
    known = eg.colmap.verify_database(database(tmp_path / "known.db", pairs, **radial))
    straight = eg.colmap.verify_database(
        database(tmp_path / "straight.db", [matches("general", 3)], prior=1)
    )
    assert known.config.tolist() == straight.config.tolist() == [2]
    assert abs(known.inliers[0] - straight.inliers[0]) <= 5
    assert up_to_sign(known.E[0], straight.E[0]) < 0.01
    assert known.noise_px[0] == pytest.approx(straight.noise_px[0], rel=0.5)


def test_an_unknown_lens_is_flagged_and_not_stored(tmp_path) -> None:
    pairs = [matches("general", 3), matches("random", 4)]
    path = database(tmp_path / "fov.db", pairs, model="FOV", params=[F, F, 600.0, 450.0, 0.9])
    found = eg.colmap.verify_database(path, write=True, backup=False)
    assert found.config.tolist() == [-1, 1]
    assert "distorted cameras" in found.note[0]
    assert found.stored.tolist() == [False, True]
    assert len(content(path)["two_view_geometries"]) == 1


@pytest.mark.parametrize(("size", "f"), [(1e30, F), (1.0, 1e-300)], ids=["points", "focal length"])
def test_cameras_that_are_far_from_their_points_spoil_their_pair_only(tmp_path, size, f) -> None:
    pairs = [matches("general", 1), matches("general", 4)]
    pairs[0] = tuple(size * x for x in pairs[0])
    path = database(tmp_path / "d.db", pairs, params=[f, 600.0, 450.0], prior=1)
    found = eg.colmap.verify_database(path)
    assert found.config.tolist() == [3, 2 if f == F else 3]


def test_keypoints_that_no_ray_is_seen_at_spoil_their_pair_only(tmp_path) -> None:
    pairs = [matches("general", 3), matches("general", 4)]
    params = [F, 600.0, 450.0, -0.5]
    shrunk = [tuple(0.3 * (x - K[:2, 2]) + K[:2, 2] for x in pair) for pair in pairs]
    shrunk[1][0][7] = [20.0, 30.0]  # beyond where this lens folds the image back
    path = database(tmp_path / "d.db", shrunk, model="SIMPLE_RADIAL", params=params)
    found = eg.colmap.verify_database(path)
    assert found.config.tolist() == [3, -1]
    assert "no ray at its keypoint 7" in found.note[1]


# writing


def test_what_is_stored_is_what_was_found_and_nothing_else_changes(copied) -> None:
    before = content(copied)
    dry = eg.colmap.verify_database(copied)
    assert content(copied) == before
    assert not dry.stored.any()
    found = eg.colmap.verify_database(copied, write=True)
    the_same(found, dry)
    assert found.stored.all()
    after = content(copied)
    rows = after.pop("two_view_geometries")
    assert before.pop("two_view_geometries") == []
    assert after == before
    for k, (number, count, cols, data, config, stored, E, _, qvec, _) in enumerate(rows):
        assert (number, count, cols) == (found.pair_id[k], found.inliers[k], 2)
        assert config == found.config[k]
        assert len(np.frombuffer(data, "<u4")) == 2 * count
        assert E is None
        assert np.frombuffer(qvec).tolist() == [1.0, 0.0, 0.0, 0.0]
        if config == 3:
            np.testing.assert_array_equal(np.frombuffer(stored).reshape(3, 3), found.F[k])
    assert content(Path(found.backup))["two_view_geometries"] == []


def test_a_second_run_goes_on_where_the_first_was_stopped(copied) -> None:
    whole = eg.colmap.verify_database(copied)
    eg.colmap.verify_database(copied, write=True, backup=False)
    change(copied, f"DELETE FROM two_view_geometries WHERE pair_id = {pair_id(3, 4)}")
    rest = eg.colmap.verify_database(copied, write=True)
    assert (rest.pair_id.tolist(), rest.already) == ([pair_id(3, 4)], 2)
    np.testing.assert_array_equal(rest.F[0], whole.F[1])
    none = eg.colmap.verify_database(copied, write=True)
    assert (len(none), none.already, none.backup) == (0, 3, None)
    assert "verified before" in str(none)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
@pytest.mark.parametrize("after", [1, 2])
def test_killed_on_the_way_whole_pairs_are_left_and_the_rest_is_done_later(copied, after) -> None:
    code = (
        "import os, signal, sys, epigauge as eg\n"
        "from epigauge import _colmap_verification as v\n"
        "from epigauge.io.colmap_raw import RawDatabase\n"
        "v._STORED = 1\n"
        "store, done = RawDatabase.store_geometries, []\n"
        "def killed(self, rows):\n"
        "    found = store(self, rows)\n"
        "    done.append(found)\n"
        f"    if len(done) == {after}:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return found\n"
        "RawDatabase.store_geometries = killed\n"
        "eg.colmap.verify_database(sys.argv[1], write=True, backup=False)\n"
    )
    whole = eg.colmap.verify_database(copied)
    here = str(Path(eg.__file__).parents[1])
    search = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", code, str(copied)], env=os.environ | {"PYTHONPATH": search}
    )
    assert done.returncode == -signal.SIGKILL
    rest = eg.colmap.verify_database(copied, write=True, backup=False)
    assert (rest.already, len(rest)) == (after - 1, 4 - after)
    np.testing.assert_array_equal(rest.F, whole.F[after - 1 :])
    assert [row[0] for row in content(copied)["two_view_geometries"]] == whole.pair_id.tolist()


def test_an_exception_on_the_way_leaves_what_was_stored(copied, monkeypatch) -> None:
    monkeypatch.setattr(verification, "_STORED", 1)

    def fail(done: int, total: int) -> None:
        if done == 2:
            raise KeyError("stop")

    with pytest.raises(KeyError):
        eg.colmap.verify_database(copied, write=True, backup=False, progress=fail)
    assert len(content(copied)["two_view_geometries"]) == 1


def test_pycolmap_reads_what_was_stored(tmp_path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    pairs = [matches(kind, k) for k, kind in enumerate(KINDS)]
    path = database(tmp_path / "database.db", pairs, prior=1)
    found = eg.colmap.verify_database(path, write=True, backup=False)
    with pycolmap.Database.open(path) as opened:
        for k, config in enumerate(found.config.tolist()):
            own = opened.read_two_view_geometry(2 * k + 1, 2 * k + 2)
            assert int(own.config) == config
            assert len(own.inlier_matches) == found.inliers[k]
            if config == 2:
                np.testing.assert_array_equal(own.E, found.E[k])


# how


def test_workers_executors_and_progress_change_nothing(some) -> None:
    one = eg.colmap.verify_database(some)
    told: list[tuple[int, int]] = []
    the_same(one, eg.colmap.verify_database(some, workers=3, progress=lambda *k: told.append(k)))
    assert told == [(1, 3), (2, 3), (3, 3)]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        the_same(one, eg.colmap.verify_database(some, executor=executor))


def test_processes_of_their_own_change_nothing(some, monkeypatch, capfd) -> None:
    one = eg.colmap.verify_database(some)
    monkeypatch.setattr(verification, "_MANY", 1)
    monkeypatch.setattr(verification, "_PART", 1)
    monkeypatch.setattr(verification, "ThreadPoolExecutor", None)
    the_same(one, eg.colmap.verify_database(some, workers=2))
    with Processes(2) as pool:
        assert pool.submit(print, "said").result() is None  # and comes not between answers
        bad = pool.submit(verified, [None], {})
        with pytest.raises(TypeError):
            bad.result()
        assert pool.submit(abs, -3).result() == 3
    assert "said" not in capfd.readouterr().out
    with Processes(1) as pool, pytest.raises(BrokenExecutor, match="ended"):
        pool.submit(os._exit, 1).result()


def test_threads_compute_where_no_process_can_be_started(some, monkeypatch) -> None:
    one = eg.colmap.verify_database(some)
    monkeypatch.setattr(verification, "_MANY", 1)
    monkeypatch.setattr(sys, "executable", "")
    the_same(one, eg.colmap.verify_database(some, workers=2))


def test_inliers_are_those_of_the_estimate(some) -> None:
    found = eg.colmap.verify_database(some, seed=5)
    with RawDatabase(some) as opened:
        pair = opened.raw_pairs([pair_id(1, 2)])[0]
    single = eg.estimate_fundamental(pair.x1, pair.x2, seed=5)
    np.testing.assert_array_equal(found.F[0], single.F)
    assert found.inliers[0] == np.count_nonzero(single.inlier)
    assert found.noise_px[0] == pytest.approx(single.noise_px, rel=0.3)


@pytest.mark.parametrize(
    ("change_", "note"),
    [
        ("UPDATE matches SET cols = 3", "shape"),
        ("UPDATE matches SET data = x'00'", "bytes of data"),
        ("DELETE FROM keypoints", "no keypoints"),
        ("UPDATE keypoints SET rows = 10, data = substr(data, 1, 80)", "of 10 of image"),
        (f"UPDATE matches SET pair_id = {pair_id(5, 3)}", "no two images"),
    ],
)
def test_damaged_rows_spoil_their_pairs_only(copied, change_, note) -> None:
    first = "image_id = 1" if "keypoints" in change_ else f"pair_id = {pair_id(1, 2)}"
    change(copied, f"{change_} WHERE {first}")
    found = eg.colmap.verify_database(copied, write=True, backup=False)
    spoilt = found.config == -1
    assert np.count_nonzero(spoilt) == 1
    assert note in found.note[int(np.flatnonzero(spoilt)[0])]
    assert found.stored.tolist() == (~spoilt).tolist()


@pytest.mark.parametrize(
    "statement", ["DROP TABLE cameras", "UPDATE cameras SET params = x'00', width = 'wide'"]
)
def test_without_cameras_pairs_are_uncalibrated(copied, statement) -> None:
    change(copied, statement)
    assert eg.colmap.verify_database(copied).config.tolist() == [3, 1, 3]


def test_few_and_equal_matches_are_degenerate(tmp_path) -> None:
    x1, x2 = matches("general", 0)
    equal = np.repeat(x1[:1], 40, axis=0), np.repeat(x2[:1], 40, axis=0)
    copies = np.repeat(x1[:10], 4, axis=0), np.repeat(x2[:10], 4, axis=0)
    path = database(tmp_path / "few.db", [(x1[:10], x2[:10]), equal, copies])
    found = eg.colmap.verify_database(path)
    assert found.config.tolist() == [1, 1, 1]
    assert found.note[0] == found.note[2] == "10 matches"


@pytest.mark.parametrize(
    ("options", "name"),
    [({"min_inliers": 3}, "min_inliers"), ({"workers": 0}, "workers"), ({"executor": 4}, "submit")],
)
def test_bad_options_are_refused(some, options, name) -> None:
    with pytest.raises(eg.ArgumentError, match=name):
        eg.colmap.verify_database(some, **options)


def test_a_database_without_raw_matches_is_refused(copied) -> None:
    change(copied, "DELETE FROM matches")
    with pytest.raises(eg.FileFormatError, match="no raw match"):
        eg.colmap.verify_database(copied)
    change(copied, "DROP TABLE matches")
    with pytest.raises(eg.FileFormatError, match="no table matches"):
        eg.colmap.verify_database(copied)


def test_the_command(run, copied, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    found = eg.colmap.verify_database(copied)
    code, out, err = run("colmap", copied, "--from-matches", "-o", tmp_path / "pairs.csv")
    assert code == 0
    numbers = np.loadtxt(out.splitlines())
    np.testing.assert_array_equal(numbers[:, 2:].reshape(-1, 3, 3), found.F[[0, 2]])
    assert "2 uncalibrated, 1 degenerate" in err
    header, *lines = (tmp_path / "pairs.csv").read_text().splitlines()
    assert len(lines) == 3
    assert "H33" in header
    code, _, err = run("colmap", copied, "--from-matches", "--write", "--workers", "2")
    assert (code, "3 pairs" in err, "database.db.bak" in err) == (0, True, True)
    code, out, err = run("colmap", copied, "--from-matches", "--write")
    assert (code, out, "verified already" in err) == (0, "", True)
    assert run("colmap", copied, "--from-matches", "--loss", "huber")[0] == 2
