"""``epigauge colmap``: table on stderr, F on stdout, exit codes 0 done and 2 bad input."""

from __future__ import annotations

import csv
import json
import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from colmap_databases import Project, change, content, pair_id

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

from epigauge.io import _sqlite

PROJECT = Project()


@pytest.fixture
def run(run, monkeypatch):
    """Run this command: (exit code, stdout, stderr)."""
    monkeypatch.setenv("COLUMNS", "120")
    return partial(run, "colmap")


@pytest.fixture
def database(tmp_path) -> Path:
    return PROJECT.write(tmp_path / "database.db")


def test_stdout_is_F_of_every_pair_and_stderr_a_table(run, database) -> None:
    code, out, err = run(database)
    result = eg.colmap.refine_database(database)
    numbers = np.loadtxt(out.splitlines())
    assert code == 0
    np.testing.assert_array_equal(numbers[:, :2], result.image_id)
    np.testing.assert_array_equal(numbers[:, 2:].reshape(-1, 3, 3), result.F)
    for k in range(1, 15):
        first, second = result.image_id[k]
        before, after = result.rms_before_px[k], result.rms_px[k]
        row = f"{first}.jpg {second}.jpg 40 {before:.4f} {after:.4f} refined"
        assert row in " ".join(err.split())
    assert "1.jpg 2.jpg 40 - " in " ".join(err.split())
    for words in ("15 refined", "median RMS", "nothing", "seconds"):
        assert words in err


def test_json_is_one_document_and_nothing_else(run, database) -> None:
    code, out, err = run(database, "--json")
    found = json.loads(out, parse_constant=pytest.fail)
    result = eg.colmap.refine_database(database)
    assert (code, err) == (0, "")
    assert (found["source"], found["stored"], found["backup"]) == (str(database), 0, None)
    assert len(found["pairs"]) == 15
    last = found["pairs"][-1]
    assert (last["image1"], last["name2"], last["inliers"]) == (5, "6.jpg", 40)
    assert (last["verdict"], last["rms_px"]) == ("refined", result.rms_px[-1])
    np.testing.assert_array_equal(last["F"], result.F[-1])
    assert found["pairs"][0]["rms_before_px"] is None


def test_write_stores_F_and_says_where_the_backup_is(run, database) -> None:
    before = content(database)
    code, _, err = run(database, "--write", "--workers", "2")
    assert code == 0
    assert "F of 15 pairs" in err
    assert "database.db.bak" in err
    assert content(database.with_name("database.db.bak")) == before != content(database)
    assert run(database, "--write", "--no-backup")[0] == 0
    assert len(list(database.parent.iterdir())) == 2


def test_csv_and_npz_hold_all_pairs(run, database, tmp_path) -> None:
    awkward = 'a, "b"\nc'
    change(database, "UPDATE images SET name = ? WHERE image_id = 1", parameters=(awkward,))
    result = eg.colmap.refine_database(database)
    assert run(database, "-o", tmp_path / "pairs.csv")[0] == 0
    with (tmp_path / "pairs.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 15
    assert rows[0]["name1"] == awkward
    assert float(rows[3]["F23"]) == result.F[3, 1, 2]
    assert [row["verdict"] for row in rows] == list(result.verdict)
    assert run(database, "-o", tmp_path / "pairs.npz")[0] == 0
    with np.load(tmp_path / "pairs.npz") as arrays:
        np.testing.assert_array_equal(arrays["F"], result.F)
        np.testing.assert_array_equal(arrays["covariance"], result.covariance)
        np.testing.assert_array_equal(arrays["pair_id"], result.pair_id)
        assert arrays["names"].tolist() == [awkward, *(f"{k}.jpg" for k in range(2, 7))]


def test_pairs_that_were_not_refined_are_listed_with_the_reason(run, database) -> None:
    change(
        database,
        f"UPDATE two_view_geometries SET config = 8 WHERE pair_id = {pair_id(1, 4)}",
        "UPDATE images SET name = '[red]' || char(27) || '.jpg' WHERE image_id = 4",
    )
    code, out, err = run(database)
    assert code == 0
    assert len(out.splitlines()) == 14
    assert "[red]?.jpg" in err
    assert "skipped: COLMAP found several motions in it" in err
    assert "14 refined, 1 skipped" in err


def test_long_tables_show_what_needs_a_look(run, tmp_path) -> None:
    path = Project(n_views=10).write(tmp_path / "d.db")
    change(path, f"UPDATE two_view_geometries SET rows = 41 WHERE pair_id = {pair_id(3, 7)}")
    code, out, err = run(path)
    assert (code, len(out.splitlines())) == (0, 44)
    assert "3.jpg" in err
    assert "4.jpg" not in err
    assert "1 of 45 pairs shown" in err


def test_bad_input_ends_with_code_2_and_one_line(run, database, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(_sqlite, "_WAIT_S", 0.05)
    (tmp_path / "text.db").write_text("no database")
    for words, arguments in {
        "text.db: is no SQLite database": [tmp_path / "text.db"],
        "none.db: No such file": [tmp_path / "none.db", "--write"],
        "path is": [database, "-o", "pairs.txt"],
        "loss is 'cauchi'": [database, "--loss", "cauchi"],
        "workers is 0": [database, "--workers", "0"],
    }.items():
        code, out, err = run(*arguments)
        assert (code, out) == (2, "")
        assert err.count("\n") == 1
        assert words in err
    with closing(sqlite3.connect(database)) as other:
        other.execute("BEGIN IMMEDIATE")
        code, out, err = run(database, "--write")
    assert (code, out) == (2, "")
    assert "database.db: is locked by another program" in err


def test_a_database_of_which_nothing_can_be_refined_is_bad_input(run, database) -> None:
    change(database, "DELETE FROM keypoints")
    code, out, err = run(database)
    assert (code, out) == (2, "")
    assert "15 skipped" in err
    assert "image 1 has no keypoints" in err
