"""COLMAP databases: every verified pair refined, F put back, everything else as it was."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from colmap_databases import Project, change, content, pair_id
from epigauge.io import _sqlite
from epigauge.io.colmap import ColmapDatabase
from epigauge.io.colmap_matches import database_matches
from two_views import up_to_sign

PROJECT = Project()
PAIRS = list(PROJECT.inliers)


@pytest.fixture
def database(tmp_path) -> Path:
    return PROJECT.write(tmp_path / "database.db")


@pytest.fixture
def by_colmap(tmp_path) -> Path:
    """A database that COLMAP made itself."""
    pytest.importorskip("pycolmap", reason="COLMAP's own databases need pycolmap")
    return PROJECT.write_by_pycolmap(tmp_path / "by_colmap.db")


def files(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def without_F(tables: dict) -> dict:
    rows = [row[:5] + row[6:] for row in tables["two_view_geometries"]]
    return tables | {"two_view_geometries": rows}


# reading


@pytest.mark.parametrize("cols", [2, 4, 6])
def test_pairs_are_the_keypoints_that_inliers_join(tmp_path, cols) -> None:
    path = PROJECT.write(tmp_path / "d.db", cols=cols)
    with ColmapDatabase(path) as opened:
        assert opened.count() == 15
        assert opened.names() == {k: f"{k}.jpg" for k in range(1, 7)}
        parts = list(opened.pairs(at_most=4))
    assert [len(part) for part in parts] == [4, 4, 4, 3]
    assert [tuple(ids) for part in parts for ids in part.image_id.tolist()] == PAIRS
    for part in parts:
        for k, pair in enumerate(map(tuple, part.image_id.tolist())):
            rows = slice(part.offsets[k], part.offsets[k + 1])
            x1, x2 = PROJECT.points(pair)
            np.testing.assert_array_equal(part.x1[rows], x1)
            np.testing.assert_array_equal(part.x2[rows], x2)
            if pair == (1, 2):
                assert np.isnan(part.F[k]).all()
            else:
                np.testing.assert_allclose(part.F[k], PROJECT.F[pair], rtol=1e-14)


def test_matches_of_a_database_are_its_inliers_from_the_middle_of_pixels(database) -> None:
    damaged = change(
        database,
        "UPDATE two_view_geometries SET data = ? WHERE pair_id = ?",
        parameters=(b"damaged", pair_id(*PAIRS[-1])),
    )
    found = database_matches(damaged)
    assert found.names == tuple(f"{k}.jpg" for k in PROJECT.keypoints)
    assert list(found.pairs) == [(i - 1, j - 1) for i, j in PAIRS[:-1]]
    for pair, rows in found.pairs.items():
        ends = [found.points[image][own] + 0.5 for image, own in zip(pair, rows.T, strict=True)]
        expected = PROJECT.points((pair[0] + 1, pair[1] + 1))
        both = (np.hstack(ends), np.hstack(expected))
        np.testing.assert_allclose(*(np.array(sorted(map(tuple, x))) for x in both))


def test_a_database_made_by_colmap_reads_the_same(by_colmap, database) -> None:
    found, expected = eg.colmap.refine_database(by_colmap), eg.colmap.refine_database(database)
    assert found.names == expected.names
    np.testing.assert_array_equal(found.pair_id, expected.pair_id)
    # COLMAP turned every other pair round, F transposed: exactly, but for its scale.
    np.testing.assert_allclose(found.F_before, expected.F_before, rtol=1e-14)
    np.testing.assert_allclose(found.F, expected.F, rtol=1e-9)
    assert found.verdict == expected.verdict == ("refined",) * 15


def test_each_pair_is_refined_as_by_itself(database) -> None:
    result = eg.colmap.refine_database(database)
    for k, pair in enumerate(PAIRS):
        single = eg.refine_fundamental(*PROJECT.points(pair), noise_px=None)
        assert result.rms_px[k] == pytest.approx(single.rms_px, rel=1e-9)
        assert up_to_sign(result.F[k], single.F) < 1e-9
        assert result.noise_px[k] == pytest.approx(single.noise_px, rel=1e-9)
    np.testing.assert_array_equal(result.inliers, 40)
    assert np.isnan(result.rms_before_px[0])
    assert (result.rms_px[1:] < result.rms_before_px[1:]).all()
    assert not result.stored.any()


def test_threads_and_progress_change_nothing(database) -> None:
    calls: list[tuple[int, int]] = []
    one = eg.colmap.refine_database(database)
    two = eg.colmap.refine_database(database, workers=2, progress=lambda *k: calls.append(k))
    np.testing.assert_array_equal(one.F, two.F)
    assert calls == [(k, 15) for k in range(1, 16)]


def test_options_reach_the_solver_and_those_of_the_database_are_refused(database) -> None:
    result = eg.colmap.refine_database(database, criterion="sampson", noise_px=3.0)
    np.testing.assert_array_equal(result.noise_px, 3.0)
    with pytest.raises(eg.ArgumentError, match="weights"):
        eg.colmap.refine_database(database, weights=np.ones(40))
    with pytest.raises(eg.ArgumentError, match="workers"):
        eg.colmap.refine_database(database, workers=0)


@pytest.mark.parametrize("fails", [False, True])
def test_a_database_is_closed_at_the_end_whatever_happens(database, fails) -> None:
    reader = ColmapDatabase(database)
    try:
        with reader:
            if fails:
                raise KeyError("something else")
    except KeyError:
        assert fails
    with pytest.raises(eg.FileFormatError, match="closed"):
        reader.names()


def test_reading_leaves_nothing_behind(by_colmap) -> None:
    before = files(by_colmap.parent)
    assert list(before) == ["by_colmap.db"]
    eg.colmap.refine_database(by_colmap)
    assert files(by_colmap.parent) == before


def test_a_stored_F_far_from_the_points_is_no_start(database) -> None:
    expected = eg.colmap.refine_database(database)
    wrong = np.array([[0.0, 1e-3, -0.4], [1e-3, 0.0, -0.3], [-0.4, -0.3, 200.0]]).tobytes()
    change(database, "UPDATE two_view_geometries SET F = ?", parameters=(wrong,))
    result = eg.colmap.refine_database(database)
    np.testing.assert_allclose(result.rms_px, expected.rms_px, rtol=1e-9)
    assert (result.rms_before_px > 10.0).all()
    eye = np.eye(3).tobytes()  # COLMAP's placeholder, which is no F
    change(database, "UPDATE two_view_geometries SET F = ?", parameters=(eye,))
    result = eg.colmap.refine_database(database)
    np.testing.assert_allclose(result.rms_px, expected.rms_px, rtol=1e-9)
    assert np.isnan(result.rms_before_px).all()


# verdicts


def test_pairs_that_do_not_determine_F_are_named_and_left(database) -> None:
    random = np.random.default_rng(1)
    x1 = random.uniform(0.0, 1000.0, (47, 2))
    H = np.array([[1.0, 0.1, 5.0], [-0.1, 0.9, 9.0], [1e-4, 2e-4, 1.0]])
    h = np.column_stack([x1, np.ones(47)]) @ H.T
    x2 = h[:, :2] / h[:, 2:] + random.normal(0.0, 0.5, (47, 2))
    for image, points in ((1, x1), (2, x2)):
        change(
            database,
            f"UPDATE keypoints SET cols = 2, data = ? WHERE image_id = {image}",
            parameters=(points.astype(np.float32).tobytes(),),
        )
    inliers = np.repeat(np.arange(40, dtype=np.uint32)[:, None], 2, 1).tobytes()
    set_pair = "UPDATE two_view_geometries SET {} WHERE pair_id = {}"
    change(database, set_pair.format("data = ?", pair_id(1, 2)), parameters=(inliers,))
    change(
        database,
        set_pair.format("rows = 7, data = substr(data, 1, 56)", pair_id(3, 4)),
        set_pair.format("config = 8", pair_id(3, 5)),
    )
    result = eg.colmap.refine_database(database, write=True)
    told = dict(
        zip(PAIRS, zip(result.verdict, result.note, result.stored, strict=True), strict=True)
    )
    assert told[1, 2][0] == "degenerate"
    assert "planar scene" in told[1, 2][1]
    assert told[3, 4][0] == "skipped"
    assert "at least 8" in told[3, 4][1]
    assert told[3, 5] == ("skipped", "COLMAP found several motions in it", False)
    assert told[4, 5][0] == "refined"
    assert [t[2] for t in told.values()] == [t[0] == "refined" for t in told.values()]
    rows = {row[0]: row[5] for row in content(database)["two_view_geometries"]}
    assert rows[pair_id(1, 2)] is None
    assert rows[pair_id(3, 5)] == PROJECT.F[3, 5].tobytes()


def test_a_pair_whose_rms_rises_is_called_worse_and_left(database) -> None:
    # Half of the keypoints of image 6 off by up to 30 pixels: a robust loss gives them up.
    points = PROJECT.keypoints[6].copy()
    points[::3] += np.random.default_rng(0).uniform(-30.0, 30.0, points[::3].shape)
    change(
        database,
        "UPDATE keypoints SET cols = 2, data = ? WHERE image_id = 6",
        parameters=(points.tobytes(),),
    )
    eg.colmap.refine_database(database, write=True, backup=False)
    before = content(database)
    result = eg.colmap.refine_database(database, write=True, backup=False, loss="cauchy")
    of_six = result.image_id[:, 1] == 6
    assert "worse" in {v for v, six in zip(result.verdict, of_six, strict=True) if six}
    worse = np.array([v == "worse" for v in result.verdict])
    assert (result.rms_px > result.rms_before_px)[worse].all()
    after = content(database)
    for k in np.flatnonzero(worse):
        assert before["two_view_geometries"][k] == after["two_view_geometries"][k]


def test_pairs_that_did_not_converge_are_named_and_left(database) -> None:
    before = content(database)
    result = eg.colmap.refine_database(database, write=True, max_iter=1)
    assert set(result.verdict) == {"not converged"}
    assert "max_iter" in result.note[0]
    assert (content(database), result.backup) == (before, None)


# writing


@pytest.mark.parametrize("version", [0, 3400, 3900, 4000400, 4020100])
def test_written_F_is_read_back_and_nothing_else_changed(tmp_path, version) -> None:
    path = PROJECT.write(tmp_path / "d.db", version=version)
    before = content(path)
    result = eg.colmap.refine_database(path, write=True)
    after = content(path)
    assert without_F(after) == without_F(before)
    stored = np.array([np.frombuffer(row[5]) for row in after["two_view_geometries"]])
    np.testing.assert_array_equal(stored.reshape(-1, 3, 3), result.F)
    assert result.stored.all()
    again = eg.colmap.refine_database(path)
    assert (again.nfev == 1).all()
    np.testing.assert_allclose(again.rms_before_px, result.rms_px, rtol=1e-9)


def test_colmap_reads_what_was_written(by_colmap) -> None:
    import pycolmap

    database = pycolmap.Database.open(by_colmap)
    pairs, old = database.read_two_view_geometries()
    database.close()
    result = eg.colmap.refine_database(by_colmap, write=True)
    assert sorted(p.name for p in by_colmap.parent.iterdir()) == [
        "by_colmap.db",
        "by_colmap.db.bak",
    ]
    database = pycolmap.Database.open(by_colmap)
    assert database.num_verified_image_pairs() == 15
    again, new = database.read_two_view_geometries()
    assert again == pairs == result.pair_id.tolist()
    for k, (geometry, was) in enumerate(zip(new, old, strict=True)):
        np.testing.assert_array_equal(geometry.F, result.F[k])
        np.testing.assert_array_equal(geometry.inlier_matches, was.inlier_matches)
        assert geometry.config == was.config
    # Asked for the other way round, COLMAP transposes.
    np.testing.assert_array_equal(database.read_two_view_geometry(5, 2).F, F_of(result, 2, 5).T)
    database.close()
    x1, x2 = PROJECT.points((2, 5))
    assert np.abs(eg.reprojection_distances(F_of(result, 2, 5), x1, x2)[0]).max() < 5.0


def F_of(result: eg.colmap.DatabaseResult, image1: int, image2: int) -> np.ndarray:
    return result.F[result.pair_id.tolist().index(pair_id(image1, image2))]


def test_backups_are_complete_and_never_replaced(by_colmap) -> None:
    states = [content(by_colmap)]
    by_colmap.chmod(0o600)
    (by_colmap.parent / "by_colmap.db.bak1").write_text("mine")
    made = []
    for damage in (1e-3, 2e-3):
        result = eg.colmap.refine_database(by_colmap, write=True)
        made.append(Path(str(result.backup)))
        F = F_of(result, 1, 2) + damage
        change(by_colmap, "UPDATE two_view_geometries SET F = ?", parameters=(F.tobytes(),))
        states.append(content(by_colmap))
    assert [path.name for path in made] == ["by_colmap.db.bak", "by_colmap.db.bak2"]
    assert [content(path) for path in made] == states[:2]
    assert made[0].stat().st_mode & 0o777 == 0o600
    assert (by_colmap.parent / "by_colmap.db.bak1").read_text() == "mine"
    eg.colmap.refine_database(by_colmap, write=True, backup=False)
    assert len(list(by_colmap.parent.iterdir())) == 4


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_exception_on_the_way_leaves_the_database_as_it_was(database, error) -> None:
    before = files(database.parent)

    def fail(done: int, total: int) -> None:
        if done == total:
            raise error

    with pytest.raises(error):
        eg.colmap.refine_database(database, write=True, progress=fail)
    assert files(database.parent) == before


KILLED = """
import os, signal, sys
import epigauge as eg
from epigauge.io.colmap import ColmapDatabase

store = ColmapDatabase.store

def killed(self, pairs):
    self._connection.execute("PRAGMA cache_size = 1")  # changed pages go to the disk at once
    def some():
        for k, pair in enumerate(pairs):
            if k == int(sys.argv[2]):
                os.kill(os.getpid(), signal.SIGKILL)
            yield pair
    store(self, some())
    os.kill(os.getpid(), signal.SIGKILL)  # before the commit

ColmapDatabase.store = killed
eg.colmap.refine_database(sys.argv[1], write=True, backup=False)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
@pytest.mark.parametrize(("journal", "after"), [("wal", 9), ("delete", 9), ("wal", 15)])
def test_killed_in_the_middle_of_writing_the_database_is_as_it_was(
    database, journal, after
) -> None:
    change(database, f"PRAGMA journal_mode = {journal}")
    before = content(database)
    assert run_killed(database, after) == -signal.SIGKILL
    assert {path.name for path in database.parent.iterdir()} > {"database.db"}
    if journal == "delete":
        # The change has begun in the file itself: who may not write cannot take it back.
        with pytest.raises(OSError, match="interrupted write"):
            eg.colmap.refine_database(database)
    else:
        np.testing.assert_allclose(
            eg.colmap.refine_database(database).F_before[1], PROJECT.F[1, 3], rtol=1e-14
        )
    assert content(database) == before
    assert eg.colmap.refine_database(database, write=True).stored.all()


def run_killed(path: Path, after: int) -> int:
    command = [sys.executable, "-c", KILLED, str(path), str(after)]
    here = str(Path(eg.__file__).parents[1])
    search = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(command, env=os.environ | {"PYTHONPATH": search}).returncode


def test_colmap_goes_on_with_a_database_that_a_killed_run_left(by_colmap) -> None:
    import pycolmap

    before = content(by_colmap)
    assert run_killed(by_colmap, 9) == -signal.SIGKILL
    database = pycolmap.Database.open(by_colmap)
    np.testing.assert_array_equal(database.read_two_view_geometry(1, 3).F, PROJECT.F[1, 3])
    database.close()
    assert content(by_colmap) == before


# other programs


@pytest.fixture
def impatient(monkeypatch) -> None:
    monkeypatch.setattr(_sqlite, "_WAIT_S", 0.05)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(("lock", "write"), [("IMMEDIATE", True), ("EXCLUSIVE", False)])
def test_a_locked_database_is_refused(database, lock, write) -> None:
    other = sqlite3.connect(database, isolation_level=None)
    other.execute(f"BEGIN {lock}")
    with pytest.raises(OSError, match="locked by another program"):
        eg.colmap.refine_database(database, write=write)
    other.execute("ROLLBACK")
    other.close()
    eg.colmap.refine_database(database, write=write)


@pytest.mark.usefixtures("impatient")
def test_nobody_else_writes_between_reading_and_writing(database) -> None:
    def intrude(done: int, total: int) -> None:
        with (
            closing(sqlite3.connect(database, timeout=0.0)) as other,
            pytest.raises(sqlite3.OperationalError, match="locked"),
        ):
            other.execute("DELETE FROM two_view_geometries")

    assert eg.colmap.refine_database(database, write=True, progress=intrude).stored.all()


def test_a_database_open_in_colmap_is_read(by_colmap) -> None:
    import pycolmap

    database = pycolmap.Database.open(by_colmap)
    assert (by_colmap.parent / "by_colmap.db-wal").exists()
    database.delete_matches(1, 2)
    assert len(eg.colmap.refine_database(by_colmap)) == 15
    assert eg.colmap.refine_database(by_colmap, write=True).stored.all()
    database.close()


def test_a_change_during_reading_does_not_pass_unseen(by_colmap) -> None:
    def intrude(done: int, total: int) -> None:
        if done == total:
            change(by_colmap, "DELETE FROM two_view_geometries WHERE rows = 40")

    with pytest.raises(OSError, match="changed while it was read"):
        eg.colmap.refine_database(by_colmap, progress=intrude)
