"""``epigauge reproduce metrology``: its pieces are what they say."""

from __future__ import annotations

from pathlib import Path

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="reports need matplotlib")

from epigauge.reproduce import metrology
from epigauge.reproduce.report import Table
from epigauge.reproduce.study import Experiments


def test_simulated_runs_differ_by_noise_of_half_a_pixel() -> None:
    for model in ("pinhole", "bal", "brown"):
        (a, truth), (b, same) = (metrology.simulated(model, seed) for seed in (0, 1))
        np.testing.assert_array_equal(truth.X, same.X)
        assert (truth.depths(a) > 0.0).all()
        off = a.xy - truth.project(a)
        assert np.std(off) == pytest.approx(0.5, rel=0.15)
        assert not np.allclose(off, b.xy - truth.project(b))


def test_an_estimate_is_moved_to_where_it_agrees_in_the_datum() -> None:
    tracks, truth = metrology.simulated("pinhole", 3)
    found = eg.bundle_adjust(tracks, truth, refine="pose").reconstruction
    cameras = metrology._moved_to(eg.gauge.two_cameras(0, 4), found, truth)
    np.testing.assert_allclose(cameras.R[0], truth.R[0], atol=1e-12)
    apart = [np.linalg.norm(r.centres[4] - r.centres[0]) for r in (cameras, truth)]
    assert apart[0] == pytest.approx(apart[1], rel=1e-12)
    inner = metrology._moved_to("inner", found, truth)
    off = inner.X - truth.X
    assert np.abs(off.mean(axis=0)).max() < 1e-12
    moment = np.cross(truth.X - truth.X.mean(axis=0), off).sum(axis=0)
    assert np.abs(moment).max() < 1e-3 * np.abs(off).max()


def test_coverage_has_a_row_a_model_datum_and_part() -> None:
    section = metrology.coverage(Experiments(2))
    table = next(item for item in section.content if isinstance(item, Table))
    assert len(table.rows) == 3 * 3 * 3 + 3 * 2 + 1
    assert all(0.0 <= row[3] <= 100.0 and row[4] > 0.0 for row in table.rows)


def test_the_network_is_told_to_be_missing(tmp_path: Path) -> None:
    section = metrology.network(Experiments(1, data=tmp_path))
    assert "EPIGAUGE_DATA" in section.content[0]
    assert not section.claims
