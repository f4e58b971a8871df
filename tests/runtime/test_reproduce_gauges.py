"""The experiments on gauges run, and their report says what it measured."""

import csv

import numpy as np
import pytest
from epigauge.reproduce import b2003
from epigauge.reproduce.gauge_runs import (
    LABELS,
    STEPS,
    GaugeStudy,
    moved,
    random_transformation,
    step_defect,
)

pytest.importorskip("matplotlib")


def test_report_has_a_row_a_method(tmp_path):
    paths = b2003.PAPER.reproduce(tmp_path, GaugeStudy(trials=1), {}, ["iterations"])
    assert {path.name for path in paths} >= {"fig1c.csv", "fig1c.png", "b2003.md", "b2003.html"}
    with (tmp_path / "b2003" / "fig1c.csv").open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    assert [row[0] for row in rows] == list(LABELS.values())
    errors = np.array([row[1:] for row in rows], dtype=float)
    assert np.all(np.diff(errors, axis=1) <= 0.0)  # the lowest so far
    np.testing.assert_allclose(errors[:, 0], errors[0, 0], rtol=1e-6)  # the same start


def test_absent_data_are_said_to_be_absent():
    section = b2003.EXPERIMENTS["table2"](GaugeStudy(trials=1))
    assert "left out" in str(section.content[0])


def test_random_cameras_are_tried_without_measured_data(tmp_path):
    paths = b2003.PAPER.reproduce(tmp_path, GaugeStudy(trials=2), {}, ["starts"])
    assert {path.name for path in paths} == {"factorization.csv", "b2003.md", "b2003.html"}
    with (tmp_path / "b2003" / "factorization.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["set"].split()[-1] for row in rows] == ["0.5", "0.1", "0.02"]
    assert all(float(row["successes (%)"]) == 100.0 for row in rows[:2])
    assert "left out" in (tmp_path / "b2003.md").read_text()


def test_defect_tells_invariant_steps_from_others():
    tracks, start = GaugeStudy(trials=1).start(0.5, 0)
    there = random_transformation(np.random.default_rng(0), 10.0, tracks.n_views, tracks.n_points)
    assert moved(start, there).rms_px(tracks) == pytest.approx(start.rms_px(tracks), rel=1e-9)
    defect = {step.label: step_defect(tracks, start, step, there) for step in STEPS}
    assert defect.pop("covariant, in the normalised basis") < 1e-9
    assert defect.pop("covariant, in the basis given") < 1e-8
    assert min(defect.values()) > 0.01
