"""Methods side by side: rows are what `bundle_adjust` returns, all from one start."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.multi_view.strategies import STRATEGIES

SCENE = eg.multi_view_scene(n_points=30, seed=1)
START = eg.initialize(SCENE.tracks)
METHODS = ["levenberg", "covariant", "bartoli"]
COMPARISON = eg.compare(SCENE.tracks, METHODS, START)


def test_rows_are_the_results_of_the_methods() -> None:
    assert [row.method for row in COMPARISON.rows] == METHODS
    assert COMPARISON.start_rms_px == START.rms_px(SCENE.tracks)
    for row in COMPARISON.rows:
        result = eg.bundle_adjust(SCENE.tracks, START, method=row.method)
        for name in ("nfev", "nit", "rms_px", "cost", "status", "message", "success"):
            assert getattr(row, name) == getattr(result, name)
        assert row.seconds > 0.0
        assert len(row.history) == row.nfev
        assert row.history[0].cost == pytest.approx(COMPARISON.rows[0].history[0].cost)


def test_all_means_every_strategy_and_the_usual_start() -> None:
    told = []
    found = eg.compare(SCENE.tracks, on_method=told.append, max_iter=2)
    assert [row.method for row in found.rows] == list(STRATEGIES) == told
    assert all(row.nit <= 2 for row in found.rows)
    assert found.start_rms_px == COMPARISON.start_rms_px


def test_markdown_holds_the_rows() -> None:
    lines = COMPARISON.to_markdown().splitlines()
    assert len(lines) == 2 + len(METHODS)
    assert len({line.count("|") for line in lines}) == 1
    for line, row in zip(lines[2:], COMPARISON.rows, strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[:4] == [row.method, str(row.nfev), str(row.nit), f"{row.rms_px:.6f}"]


@pytest.mark.parametrize(
    ("methods", "words"),
    [
        ("covariant", "methods is 'covariant'"),
        ([], "methods is"),
        (["free", "free"], "methods is"),
        (["covarian"], "did you mean 'covariant'"),
    ],
)
def test_bad_names_are_refused(methods, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        eg.compare(SCENE.tracks, methods, START)


def test_picture_shows_the_lowest_cost_so_far_of_every_method() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    axes = COMPARISON.plot("a scene").axes[0]
    best = min(row.cost for row in COMPARISON.rows)
    curves = {line.get_label().partition(":")[0]: line for line in axes.lines}
    assert axes.get_yscale() == "log"
    for row in COMPARISON.rows:
        x, y = curves[row.method].get_data()
        assert len(x) == row.nfev
        assert (np.diff(y) <= 0.0).all()
        assert y[0] == pytest.approx(row.history[0].cost - best)
        assert (y > 0.0).all()
    assert len(axes.get_legend().get_texts()) == len(METHODS)
