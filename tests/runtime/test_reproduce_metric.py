"""``epigauge reproduce gauges-metric``: its pieces are what they say."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="reports need matplotlib")

from epigauge.reproduce import gauges_metric
from epigauge.reproduce.gauges_metric import LABELS, MetricGaugeStudy, moved, random_similarity
from epigauge.reproduce.report import Table


def test_a_random_similarity_changes_no_image() -> None:
    tracks, start = MetricGaugeStudy(1).start(0.1, 0)
    for origin in (0.0, 1e3):
        there = random_similarity(np.random.default_rng(1), origin)
        images = moved(start, there).project(tracks)
        np.testing.assert_allclose(images, start.project(tracks), atol=1e-7 * (1.0 + origin))
    s, Q, b = there
    assert np.linalg.norm(b) == pytest.approx(1e3 * s)
    np.testing.assert_allclose(Q @ Q.T, np.eye(3), atol=1e-12)


def test_every_method_is_compared_and_the_steps_are_those_of_its_history(monkeypatch) -> None:
    monkeypatch.setattr(gauges_metric, "FLATNESS", (0.5,))
    study = MetricGaugeStudy(1)
    section = gauges_metric.flatness(study)
    table = next(item for item in section.content if isinstance(item, Table))
    assert [row[0] for row in table.rows] == list(LABELS.values())
    results = {method: study.run(0.5, 0, method) for method in LABELS}
    lowest = min(result.cost for result in results.values())
    for row, result in zip(table.rows, results.values(), strict=True):
        steps = int(row[1])
        before = [r.cost for r in result.history[:steps] if r.accepted]
        assert result.history[steps].cost <= (1.0 + 1e-6) * lowest < min(before)


def test_covariant_takes_the_same_steps_in_a_similarity() -> None:
    tracks, start = MetricGaugeStudy(1).start(0.1, 0)
    here = eg.bundle_adjust(tracks, start, refine=("f", "k"))
    there = random_similarity(np.random.default_rng(2), 1e3)
    again = eg.bundle_adjust(tracks, moved(start, there), refine=("f", "k"))
    assert [row.accepted for row in again.history] == [row.accepted for row in here.history]
    costs = [[row.cost for row in result.history] for result in (here, again)]
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-8)
