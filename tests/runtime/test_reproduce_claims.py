"""What the reports conclude follows from the numbers, and other numbers lead to other verdicts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.reproduce import essential, gauge_runs, gauge_variations, successes, sweeps
from epigauge.reproduce.common import METHODS
from epigauge.reproduce.gauge_runs import LABELS, GaugeStudy
from epigauge.reproduce.report import Claim, Table, fewest, lower


def test_a_verdict_is_that_of_the_numbers() -> None:
    verdicts = {True: "confirmed", False: "not confirmed", None: "tie"}
    for confirmed, text in verdicts.items():
        assert Claim("where", "what", confirmed, "numbers").verdict == text


def test_numbers_too_near_one_another_are_a_tie_whatever_their_order() -> None:
    assert lower(1.0, 1.1, 0.05) is True
    assert lower(1.1, 1.0, 0.05) is False
    assert lower(1.0, 1.02, 0.05) is lower(1.02, 1.0, 0.05) is None
    assert lower(0.0, 0.0, 0.05) is None


def test_fewest_is_a_tie_where_any_is_one_and_none_is_higher() -> None:
    assert fewest([1.0, 2.0], [1.5, 2.5]) is True
    assert fewest([1.0, 2.5], [1.5, 2.5]) is None
    assert fewest([1.0, 3.0], [1.5, 2.5]) is False
    assert fewest([1.5, 3.0], [1.5, 2.5]) is False
    assert fewest([3], [3], 0.0) is None


def _runs(stopped: float) -> list[Any]:
    most = essential.MAX_ITER
    return [SimpleNamespace(evaluations=most + 1 if k < 100 * stopped else 9) for k in range(100)]


@pytest.mark.parametrize(("moved", "scaled"), [(0.4, 0.0), (0.0, 0.4)])
def test_the_cause_is_told_by_the_numbers(moved: float, scaled: float) -> None:
    found = {
        (case, label, method.label): _runs(0.0)
        for case in essential._CASES
        for label in essential._DAMPINGS
        for method in essential._METHODS
    }
    for label in essential._DAMPINGS:
        found[essential._BOTH, label, "ORTHO"] = _runs(0.4)
        found[essential._MOVED, label, "ORTHO"] = _runs(moved)
        found[essential._SCALED, label, "ORTHO"] = _runs(scaled)
    text = essential._cause(found)
    assert "Fewer runs of BLOCK" in text
    first, second = text.split("quarter of the RMS ")[1].split(", the retina divided")
    assert first.startswith("cures it" if moved == 0.0 else "does not cure it")
    assert ("cures it" in second) == (scaled == 0.0)


def test_variations_have_a_row_a_method_and_a_verdict_a_quantity(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    varied = {"n_points": ("points", (15, 40)), "start": ("error", (0.05, 0.0))}
    monkeypatch.setattr(gauge_variations, "_VARIED", varied)
    section = gauge_variations.variations(GaugeStudy(trials=1))
    tables = [item for item in section.content if isinstance(item, Table)]
    assert [table.name for table in tables] == ["varied_n_points", "varied_start"]
    for table, claim in zip(tables, section.claims, strict=True):
        steps = np.array([row[1:] for row in table.rows[:-1]], dtype=float)
        assert len(steps) == len(gauge_variations._METHODS)
        paper = steps[: gauge_variations._COMPARED]
        weak, strong = paper.max(axis=0) / paper.min(axis=0)
        assert claim.confirmed is lower(strong, weak, 0.05)
    tracks, start = gauge_variations._configuration(0, "start", 0.05)
    _, plain = gauge_variations._configuration(0, "start", 0.0)
    assert start.rms_px(tracks) > 2.0 * plain.rms_px(tracks)


def test_times_are_in_the_papers_order_or_not() -> None:
    ortho, maps, parfree, free, norm = 1.0, 1.1, 1.5, 2.0, 2.1
    assert sweeps.in_the_papers_order(np.array([ortho, maps, parfree, free, norm]))
    for changed in (
        [ortho, maps, 2.05, free, norm],  # PARFREE beyond FREE
        [ortho, maps, parfree, free, 1.4],  # NORM below PARFREE
        [ortho, 1.6, parfree, free, norm],  # MAPS beyond PARFREE
        [1.6, maps, parfree, free, norm],  # ORTHO beyond PARFREE
    ):
        assert not sweeps.in_the_papers_order(np.array(changed))


def test_table3_restarts_each_method_where_the_others_ended() -> None:
    def run(setup: Any, method: Any, damping: str, xi: float, after: Any) -> Any:
        row, column = METHODS.index(method), METHODS.index(after)
        return SimpleNamespace(error_px=10.0 * row + column)

    found = successes.restarted(SimpleNamespace(run=run), None, "lm", 1e-6)  # type: ignore[arg-type]
    rows, columns = np.indices(found.shape)
    np.testing.assert_array_equal(found, 10.0 * rows + columns)


@pytest.mark.parametrize(
    ("above", "same"), [(0.0, True), (1e-8, True), (1e-5, False), (0.1, False)]
)
def test_errors_that_differ_by_a_few_millionths_are_not_the_same(above: float, same: bool) -> None:
    error = np.array([[[1.0, 2.0]], [[1.0 + above, 2.0 * (1.0 + above)]]])
    found = gauge_runs.lowest(error)
    assert found[0].all()
    assert (found[1] == same).all()


def test_coordinates_on_the_retina_are_those_of_calibrated_cameras() -> None:
    scene = eg.two_view_scene(6.0, seed=1)
    q1, q2 = essential._retina(scene, "retina", np.eye(3)).forward(scene.x1, scene.x2)
    for q, x in ((q1, scene.x1), (q2, scene.x2)):
        h = np.linalg.solve(scene.K, np.vstack([x.T, np.ones(len(x))]))
        np.testing.assert_allclose(q, h[:2] / h[2], rtol=0.0, atol=1e-15)


def test_step_3_of_table_1_takes_the_same_steps_in_every_basis() -> None:
    # A projection onto a global gauge after each step, which the paper recommends.
    assert {"gauge_invariant_normalized", "covariant_alone"} <= set(LABELS)
    study = GaugeStudy(trials=1)
    from epigauge.reproduce.gauge_runs import moved, random_transformation

    tracks, start = study.start(0.2, 0)
    random = np.random.default_rng(0)
    steps: dict[str, set[int]] = {"gauge_invariant_normalized": set(), "gauge_invariant": set()}
    for condition in (1.0, 10.0, 100.0):
        there = random_transformation(random, condition, tracks.n_views, tracks.n_points)
        for method, counts in steps.items():
            counts.add(study.adjust(tracks, moved(start, there), method).nit)
    assert len(steps["gauge_invariant_normalized"]) == 1
    assert len(steps["gauge_invariant"]) > 1
    plain = study.adjust(tracks, start, "covariant")
    alone = study.adjust(tracks, start, "covariant_alone")
    assert plain.nit <= alone.nit
