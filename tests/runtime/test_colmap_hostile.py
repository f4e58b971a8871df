"""COLMAP databases that are damaged, forged or of another kind: refused, or the pair is skipped."""

from __future__ import annotations

import re
import sqlite3
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from colmap_databases import Project, change, content, pair_id

PROJECT = Project(n_views=3, n_points=12)


@pytest.fixture
def database(tmp_path) -> Path:
    return PROJECT.write(tmp_path / "database.db")


# refused


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "is empty"),
        (b"x1,y1,x2,y2\n1,2,3,4\n", "is no SQLite database"),
        (b"SQLite format 3\0", "is damaged or no database"),
        (b"SQLite format 3\0" + bytes(4080), "is damaged or no database"),
    ],
)
def test_what_is_no_database_is_refused(tmp_path, text, reason) -> None:
    path = tmp_path / "d.db"
    path.write_bytes(text)
    with pytest.raises(eg.FileFormatError, match=reason) as caught:
        eg.colmap.refine_database(path)
    assert caught.value.file == str(path)
    assert path.read_bytes() == text


def test_what_the_system_refuses_is_an_os_error(tmp_path) -> None:
    with pytest.raises(FileNotFoundError):
        eg.colmap.refine_database(tmp_path / "none.db", write=True)
    with pytest.raises(IsADirectoryError):
        eg.colmap.refine_database(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("version", [1, 2999, 4000, 39000, 4030000, 5000000, -1])
@pytest.mark.parametrize("write", [False, True])
def test_unknown_versions_are_refused(database, version, write) -> None:
    change(database, f"PRAGMA user_version = {version}")
    before = database.read_bytes()
    with pytest.raises(eg.FileFormatError, match=f"version {version} of COLMAP's schema"):
        eg.colmap.refine_database(database, write=write)
    assert database.read_bytes() == before


ENDLESS = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT"


@pytest.mark.parametrize(
    ("statements", "reason"),
    [
        (["DROP TABLE two_view_geometries"], "no table two_view_geometries"),
        (["ALTER TABLE two_view_geometries RENAME TO inlier_matches"], "of an old COLMAP"),
        (["DROP TABLE keypoints"], "no table keypoints"),
        (["DROP TABLE images"], "no table images"),
        (["ALTER TABLE two_view_geometries DROP COLUMN F"], "no column F"),
        (["ALTER TABLE keypoints RENAME COLUMN cols TO columns"], "no column cols"),
        (
            [
                "DROP TABLE keypoints",
                f"CREATE VIEW keypoints AS {ENDLESS} k AS image_id, 1 AS rows, 2 AS cols,"
                " zeroblob(8) AS data FROM n",
            ],
            "no table keypoints",
        ),
        (
            [
                "ALTER TABLE keypoints DROP COLUMN data",
                "ALTER TABLE keypoints ADD COLUMN data AS (zeroblob(rows * cols * 4))",
            ],
            "no column data",
        ),
        (
            ["DROP TABLE images", "CREATE TABLE images (image_id TEXT PRIMARY KEY, name TEXT)"],
            "image_id is not the key of images",
        ),
        (["DELETE FROM two_view_geometries"], "holds no verified pair"),
        (["UPDATE two_view_geometries SET rows = 0"], "holds no verified pair"),
    ],
)
def test_databases_of_another_kind_are_refused(database, statements, reason) -> None:
    change(database, "PRAGMA foreign_keys = OFF", *statements)
    with pytest.raises(eg.FileFormatError, match=reason):
        eg.colmap.refine_database(database)


def test_a_database_with_triggers_is_read_but_not_written_to(database) -> None:
    change(
        database,
        "CREATE TRIGGER t AFTER UPDATE ON two_view_geometries BEGIN DELETE FROM images; END",
    )
    before = database.read_bytes()
    assert len(eg.colmap.refine_database(database)) == 3
    with pytest.raises(eg.FileFormatError, match="triggers"):
        eg.colmap.refine_database(database, write=True)
    assert database.read_bytes() == before


# skipped

_NAN = PROJECT.keypoints[1].copy()
_NAN[PROJECT.inliers[1, 2][3, 0]] = np.nan
_FAR = np.full((12, 2), 7, np.uint32)
_FAR[5, 1] = 19
_LINE = PROJECT.keypoints[1].copy()
_LINE[:, 1] = 2.0 * _LINE[:, 0]
_PAIR, _POINTS = "two_view_geometries", "keypoints"
_SPOILED = [
    (_PAIR, "data = ?", b"1234567", "inliers: 7 bytes of data, needed: 96"),
    (_PAIR, "data = ?", None, "inliers: 0 bytes of data, needed: 96"),
    (_PAIR, "data = ?", "text", "inliers: 0 bytes of data, needed: 96"),
    (_PAIR, "rows = ?", 11, "inliers: 96 bytes of data, needed: 88"),
    (_PAIR, "rows = ?", 2**62, "inliers: shape \\(4611686018427387904, 2\\)"),
    (_PAIR, "rows = ?", 10**7, "inliers: 96 bytes of data, needed: 80000000"),
    (_PAIR, "rows = ?", "many", "inliers: shape \\(many, 2\\)"),
    (_PAIR, "rows = ?", 12.5, "inliers: shape \\(12.5, 2\\)"),
    (_PAIR, "cols = ?", 3, "inliers: shape \\(12, 3\\)"),
    (_PAIR, "cols = ?", -2, "inliers: shape \\(12, -2\\)"),
    (_PAIR, "data = ?", _FAR.tobytes(), "an inlier is keypoint 19 of 19 of image 2"),
    (_PAIR, "config = ?", 1, "COLMAP calls it degenerate"),
    (_PAIR, "config = ?", 7, "COLMAP calls it a watermark"),
    (_PAIR, "config = ?", 10, "config is 10, needed: 0 to 9"),
    (_PAIR, "config = ?", "\x1b[31mred", "config is \\?\\[31mred, needed: 0 to 9"),
    (_PAIR, "pair_id = ?", pair_id(2, 1), "stands for no two images"),
    (_PAIR, "pair_id = ?", pair_id(2, 2), "stands for no two images"),
    (_PAIR, "pair_id = ?", -5, "pair_id -5 stands for no two images"),
    (_PAIR, "pair_id = ?", 2**63 - 1, "stands for no two images"),
    (_PAIR, "pair_id = ?", pair_id(1, 9), "image 9 has no keypoints"),
    (_POINTS, "data = ?", b"1234", "keypoints of image 1: 4 bytes of data, needed: 456"),
    (_POINTS, "rows = ?", -1, "keypoints of image 1: shape \\(-1, 6\\)"),
    (_POINTS, "cols = ?", 5, "keypoints of image 1: shape \\(19, 5\\)"),
    (_POINTS, "rows = 19, cols = 2, data = ?", _NAN.tobytes(), "of image 1 is not finite"),
    (_POINTS, "rows = 19, cols = 2, data = ?", _LINE.tobytes(), "on one line"),
    (_POINTS, "image_id = ?", 4, "image 1 has no keypoints"),
]


@pytest.mark.parametrize(
    ("table", "change_", "value", "note"), _SPOILED, ids=[row[-1] for row in _SPOILED]
)
def test_a_damaged_row_spoils_its_pairs_only(database, table, change_, value, note) -> None:
    key = {_PAIR: f"pair_id = {pair_id(1, 2)}", _POINTS: "image_id = 1"}[table]
    change(database, f"UPDATE {table} SET {change_} WHERE {key}", parameters=(value,))
    before = {row[0]: row for row in content(database)["two_view_geometries"]}
    result = eg.colmap.refine_database(database, write=True)
    skipped = [k for k in range(3) if result.verdict[k] == "skipped"]
    assert len(skipped) == (1 if table == _PAIR else 2)
    for k in range(3):
        if k in skipped:
            assert re.search(note, result.note[k])
            assert before[int(result.pair_id[k])] in content(database)["two_view_geometries"]
            assert not result.F[k].any()
    assert result.stored.sum() == 3 - len(skipped)


@pytest.mark.parametrize(
    "F",
    [
        b"short",
        "text",
        *(np.full(9, v).tobytes() for v in (np.nan, np.inf, 0.0, 1.0, 1e300, 5e-324)),
    ],
    ids=["short", "text", "NaN", "infinite", "zero", "rank 1", "huge", "tiny"],
)
def test_a_useless_stored_F_is_as_none(database, F) -> None:
    expected = eg.colmap.refine_database(database)
    change(database, "UPDATE two_view_geometries SET F = ?", parameters=(F,))
    result = eg.colmap.refine_database(database)
    assert np.isnan(result.rms_before_px).all()
    np.testing.assert_allclose(result.rms_px, expected.rms_px, rtol=1e-9)


def test_names_of_any_kind_are_text(database) -> None:
    change(
        database,
        "UPDATE images SET name = CAST(x'ff00fe' AS TEXT) WHERE image_id = 1",
        "UPDATE images SET name = x'0102' WHERE image_id = 2",
        "DELETE FROM images WHERE image_id = 3",
    )
    result = eg.colmap.refine_database(database)
    assert set(result.names) == {1, 2}
    assert all(isinstance(name, str) for name in result.names.values())
    assert set(result.verdict) == {"refined"}


# mutated

_ROUNDS = 40


def mutated(data: bytes, random: np.random.Generator) -> bytes:
    """Return a file with bytes changed, a piece cut off, or a piece moved elsewhere."""
    changed = bytearray(data)
    kind = random.integers(4)
    if kind == 0:
        return bytes(changed[: random.integers(1, len(changed))])
    if kind == 1:
        a, b, size = random.integers(0, len(changed) - 200, 3)
        size = size % 200
        changed[a : a + size] = changed[b : b + size]
        return bytes(changed)
    # Damage in the first page goes to the schema, elsewhere to the rows.
    end = 4096 if kind == 2 else len(changed)
    for place in random.integers(16, end, random.integers(1, 30)):
        changed[place] = random.integers(256)
    return bytes(changed)


def test_mutated_databases_are_read_or_refused(database) -> None:
    """Not one raises anything else, and none is changed by reading it."""
    random = np.random.default_rng(0)
    data = database.read_bytes()
    path = database.with_name("mutated.db")
    outcomes = {"read": 0, "refused": 0}
    for _ in range(_ROUNDS):
        path.write_bytes(mutated(data, random))
        before = path.read_bytes()
        try:
            eg.colmap.refine_database(path)
            outcomes["read"] += 1
        except (eg.EpigaugeError, OSError):
            outcomes["refused"] += 1
        assert path.read_bytes() == before
    assert min(outcomes.values()) > _ROUNDS // 10


def test_mutated_databases_are_written_to_or_refused(database) -> None:
    random = np.random.default_rng(1)
    data = database.read_bytes()
    path = database.with_name("mutated.db")
    for _ in range(_ROUNDS // 3):
        path.write_bytes(mutated(data, random))
        try:
            eg.colmap.refine_database(path, write=True, backup=bool(random.integers(2)))
        except (eg.EpigaugeError, OSError):
            continue
        sqlite3.connect(path).close()
