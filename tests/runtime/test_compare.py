"""Methods side by side: rows are what `bundle_adjust` returns, all from one start."""

from __future__ import annotations

import dataclasses

import epigauge as eg
import numpy as np
import pytest
from epigauge.bundle.strategies import STRATEGIES
from epigauge.errors import ArgumentError

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


def test_comparison_ends_where_the_caller_says() -> None:
    started = []

    def on_method(name: str) -> bool:
        started.append(name)
        return True

    found = eg.compare(SCENE.tracks, METHODS, START, on_method=on_method, callback=lambda row: True)
    assert [row.method for row in found.rows] == METHODS[:1]  # never none
    assert found.rows[0].nfev == 1
    assert started == METHODS[:2]


def test_picture_shows_the_lowest_cost_so_far_of_every_method() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    axes, _ = COMPARISON.plot("a scene").axes
    best = min(row.cost for row in COMPARISON.rows)
    curves = {line.get_label(): line for line in axes.lines}
    assert axes.get_yscale() == "log"
    for row in COMPARISON.rows:
        x, y = curves[f"_{row.method}"].get_data()
        assert len(x) == row.nfev
        assert (np.diff(y) <= 0.0).all()
        assert y[0] == pytest.approx(row.history[0].cost - best)
        assert (y > 0.0).all()


def test_picture_has_a_table_with_the_fastest_first_and_failures_last() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    failed = dataclasses.replace(COMPARISON.rows[1], success=False)  # "covariant"
    rows = (COMPARISON.rows[0], failed, COMPARISON.rows[2])
    table = dataclasses.replace(COMPARISON, rows=rows).plot().axes[1]
    samples = [line.get_label() for line in table.lines if not line.get_label().startswith("_")]
    expected = sorted((rows[0], rows[2]), key=lambda row: row.nfev)
    assert samples == [row.method for row in (*expected, failed)]
    words = [text.get_text() for text in table.texts]
    for row in rows:
        k = words.index(row.method)
        cells = [f"{row.nfev}", f"{row.seconds:.3f}", f"{row.rms_px:.6f}"]
        assert words[k + 1 : k + 4] == cells
    colours = {text.get_text(): text.get_color() for text in table.texts}
    assert colours["covariant"] != colours["levenberg"] == colours["bartoli"]
    assert "not converged" in words[-1]


def test_every_method_has_its_own_look() -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    from epigauge.plots.comparison import _look

    looks = [_look(name) for name in STRATEGIES]
    for part in ("color", "marker"):
        assert len({look[part] for look in looks}) == len(STRATEGIES)


def test_run_without_a_finite_cost_is_drawn(tmp_path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    from epigauge.plots import save_figure

    row = COMPARISON.rows[0]
    history = (dataclasses.replace(row.history[0], cost=np.inf),)
    lost = dataclasses.replace(row, cost=np.inf, history=history, nfev=1, success=False)
    rows = (lost, *COMPARISON.rows[1:])
    save_figure(dataclasses.replace(COMPARISON, rows=rows).plot(), tmp_path / "picture.png")
