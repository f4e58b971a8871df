"""The experiments of Bartoli & Sturm: definitions, files, determinism, rows."""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.reproduce import bs2004
from epigauge.reproduce.common import (
    DISTANCES,
    ELIMINATED,
    METHODS,
    Setup,
    Study,
    converge,
    reprojection_rms,
)
from epigauge.reproduce.essential import closest_essential
from epigauge.reproduce.pairs import epipole_class
from epigauge.reproduce.report import Claim, Section, Table, write_report, write_section
from epigauge.reproduce.several import minima_section
from epigauge.reproduce.successes import success
from epigauge.reproduce.sweeps import ERROR_SWEEPS, TIME_SWEEPS, Sweep
from epigauge.scenes import two_view_scene
from epigauge.two_view.initial import fundamental_8point

NAMES = [method.label for method in METHODS]


@pytest.fixture
def easy(monkeypatch):
    """Let the experiments run at 6 m only, where every method converges in a few steps."""
    sweep = Sweep("distance", (6,), "distance")
    for sweeps in (ERROR_SWEEPS, TIME_SWEEPS):
        for name in sweeps:
            monkeypatch.setitem(sweeps, name, sweep)
    monkeypatch.setattr("epigauge.reproduce.successes.DISTANCES", (6,) * len(DISTANCES))


def rows(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


# What is measured


def test_success_is_agreement_with_every_restart():
    xi = 1e-3
    E_initial = np.array([1.0, 2.0, 1.0])
    E_after = np.array([[9.0, 1.0, 1.0], [1.0, 9.0, 2.0], [1.0, 1.0, 9.0]])
    # The second method is improved by the first one; the diagonal does not matter.
    assert success(E_initial, E_after, xi).tolist() == [True, False, True]


@pytest.mark.parametrize(("change", "expected"), [(0.9e-3, True), (-0.9e-3, True), (1.1e-3, False)])
def test_success_compares_absolute_differences_with_xi(change, expected):
    E_after = np.array([[1.0, 1.0 + change], [1.0, 1.0]])
    assert success(np.ones(2), E_after, 1e-3).tolist() == [expected, True]


@pytest.mark.parametrize("method", [*METHODS, *ELIMINATED], ids=lambda method: method.label)
def test_error_of_a_run_is_that_of_its_estimate(method):
    scene = two_view_scene(6.0, seed=3)
    F0 = fundamental_8point(scene.x1, scene.x2)
    run = converge(scene.x1, scene.x2, F0, method, xi=1e-10)
    # Structure at the minimum is at the foot points, up to what the stopping rule leaves.
    assert run.error_px == pytest.approx(reprojection_rms(run.F, scene.x1, scene.x2), rel=1e-8)
    assert run.error_px < reprojection_rms(F0, scene.x1, scene.x2)
    assert run.evaluations > 1
    assert run.seconds > 0.0
    assert not run.broke


def test_a_study_restarts_from_the_other_methods_result():
    study = Study(trials=1)
    setup = Setup(seed=0, distance=6.0)
    again = study.run(setup, METHODS[0], after=METHODS[1])
    assert again.evaluations < study.run(setup, METHODS[0]).evaluations


def test_closest_essential_has_equal_singular_values():
    scene = two_view_scene(seed=1)
    F = closest_essential(fundamental_8point(scene.x1, scene.x2), scene.K)
    values = np.linalg.svd(scene.K.T @ F @ scene.K, compute_uv=False)
    np.testing.assert_allclose(values / values[0], [1.0, 1.0, 0.0], atol=1e-12)


def test_closest_essential_leaves_the_truth():
    scene = two_view_scene(seed=1)
    F = closest_essential(scene.F_true, scene.K)
    np.testing.assert_allclose(F * np.sign(np.sum(F * scene.F_true)), scene.F_true, atol=1e-12)


@pytest.mark.parametrize(
    ("e", "expected"),
    [
        ((50.0, 50.0, 1.0), "inside"),
        ((-50.0, -50.0, -1.0), "inside"),
        ((-149.0, 50.0, 1.0), "near"),
        ((0.0, 1000.0, 1.0), "far"),
        ((0.0, 5100.0, 1.0), "infinity"),
        ((1.0, 0.0, 0.0), "infinity"),
    ],
)
def test_epipole_class(e, expected):
    assert epipole_class(np.array(e), (100, 100)) == expected


# Files


def test_report_escapes_and_marks_verdicts(tmp_path):
    (tmp_path / "r").mkdir()
    claims = [Claim("s", "a < b", True, "1"), Claim("s", "c", False, "2")]
    table = Table("t", "caption", ("name", "x"), [("<i>", 1.23456), ("none", None)], ("", ".2f"))
    section = Section("A & B", ["a < b", table], claims)
    assert write_section(tmp_path / "r", section) == [tmp_path / "r" / "t.csv"]
    assert rows(tmp_path / "r" / "t.csv") == [["name", "x"], ["<i>", "1.23456"], ["none", ""]]
    markdown, page = write_report(tmp_path / "r", "T", ["intro"], [section])
    text = markdown.read_text()
    assert "| c | s | not confirmed | 2 |" in text
    assert "| <i> | 1.23 |" in text
    text = page.read_text()
    assert "A &amp; B" in text
    assert "&lt;i&gt;" in text
    assert '<td class="confirmed">confirmed</td>' in text
    assert '<td class="not">not confirmed</td>' in text


def test_unknown_experiment_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ArgumentError, match="--only"):
        bs2004.PAPER.reproduce(tmp_path / "out", Study(trials=1), {}, ["fig9"])
    assert not (tmp_path / "out").exists()


def test_error_panels_are_deterministic(tmp_path, easy):
    pytest.importorskip("matplotlib", reason="figures need matplotlib")
    for run in ("a", "b"):
        bs2004.PAPER.reproduce(tmp_path / run, Study(trials=1, seed=5), {}, ["fig1a"])
    for name in ("fig1a.csv", "fig1a.png"):
        a, b = ((tmp_path / run / "bs2004" / name).read_bytes() for run in ("a", "b"))
        assert a == b


def test_command_writes_all_files(tmp_path, monkeypatch, capsys, easy):
    for package in ("typer", "rich", "matplotlib"):
        pytest.importorskip(package)
    from epigauge.__main__ import main

    arguments = ["reproduce", "bs2004", "--trials", "2", "--only", "fig1c,fig1d", "-o"]
    arguments += [str(tmp_path / "out"), "--only", "table3", "--only", "methods"]
    monkeypatch.setattr(sys, "argv", ["epigauge", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 0
    assert capsys.readouterr().out == ""
    out = tmp_path / "out"
    expected = {
        *("fig1c.csv", "fig1c.png", "fig1d.png", "fig1d_evaluations.csv"),
        *("fig1d_milliseconds.csv", "table3.csv", "table3.png", "table3_breakdowns.csv"),
        *("methods.png", "methods_evaluations.csv", "methods_milliseconds.csv"),
        "methods_success.csv",
    }
    assert {path.name for path in (out / "bs2004").iterdir()} == expected
    assert {path.name for path in out.iterdir()} == {"bs2004", "bs2004.md", "bs2004.html"}

    assert [row[2] for row in rows(out / "bs2004" / "fig1c.csv")[:1]] == ["INIT"]
    table3 = rows(out / "bs2004" / "table3.csv")
    assert table3[0] == ["case", "method", *["6 m"] * len(DISTANCES), "mean"]
    for case in ("paper", "LM, xi = 0.0001", "LM, xi = 1e-06", "SEBER, xi = 1e-06"):
        found = [row for row in table3 if row[0] == case]
        assert [row[1] for row in found] == NAMES
        assert all(0.0 <= float(cell) <= 100.0 for row in found for cell in row[2:])
    methods = rows(out / "bs2004" / "methods_evaluations.csv")
    assert [row[0] for row in methods[1:]] == [m.label for m in (*METHODS, *ELIMINATED)]

    text = (out / "bs2004.md").read_text()
    assert "## Claims" in text
    assert re.search(r"\| (not )?confirmed \|", text)
    links = re.findall(r"\]\((bs2004/[^)]+)\)", text)
    assert links
    assert all((out / link).is_file() for link in links)
    page = (out / "bs2004.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert 'src="bs2004' not in page


@pytest.mark.slow
def test_several_starts_never_lose_the_best_minimum_of_fewer(monkeypatch):
    monkeypatch.setattr("epigauge.reproduce.several.DISTANCES", (6, 16))
    monkeypatch.setattr("epigauge.reproduce.several._REFERENCE", 20)
    section = minima_section(Study(trials=1))
    table = next(item for item in section.content if isinstance(item, Table))
    assert [row[0] for row in table.rows] == [6, 16]
    assert all(row[3] == 100.0 for row in table.rows)  # 20 starts against 20 starts


def test_table4_without_data_says_so():
    section = bs2004.EXPERIMENTS["table4"](Study(trials=1))
    assert not section.claims
    assert "EPIGAUGE_DATA" in section.content[0]


@pytest.mark.slow
def test_table4_finds_one_minimum_a_pair(data_dir, tmp_path):
    # Two small pairs, one with epipoles near, one with epipoles far
    for name in ("kusvod2_kampa", "kusvod2_zoom"):
        (tmp_path / f"{name}.npz").write_bytes((data_dir / "pairs" / f"{name}.npz").read_bytes())
    section = bs2004.EXPERIMENTS["table4"](Study(trials=1, data=tmp_path))
    tables = {item.name: item for item in section.content if isinstance(item, Table)}
    assert [row[:3] for row in tables["table4_error"].rows] == [
        ("near", "near", "kusvod2_kampa"),
        ("far", "far", "kusvod2_zoom"),
    ]
    assert section.claims[0].confirmed
    assert {row[1] for row in tables["table4_classes"].rows} == {"near", "far"}
