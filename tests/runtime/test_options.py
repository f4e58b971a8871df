"""Options: their names are typed, none is swallowed, and what happens is logged to who listens."""

from __future__ import annotations

import inspect
import logging
from typing import Any, get_args

import epigauge as eg
import pytest
from epigauge import _options, kernels
from epigauge.bundle.dampings import DAMPINGS
from epigauge.bundle.strategies import STRATEGIES
from epigauge.images import DETECTORS
from epigauge.two_view import front_ends, losses, parameterizations, solve
from epigauge.two_view.criteria import CRITERIA
from epigauge.two_view.parameterizations import Ortho

VIEW = eg.two_view_scene(noise_px=0.5, seed=7)
SCENE = eg.multi_view_scene(n_points=30, seed=2)

#: What a checker is told, and what a solver looks up.
NAMES = {
    "Backend": kernels.NAMES,
    "Loss": losses.LOSSES,
    "Parameterization": (*parameterizations.PARAMETERIZATIONS, *solve.REDUNDANT),
    "Criterion": CRITERIA,
    "PairDamping": solve.DAMPINGS,
    "Part": Ortho.parts,
    "FrontEnd": ("auto", "native", *front_ends._PACKAGES),
    "Method": STRATEGIES,
    "BundleDamping": DAMPINGS,
    "Detector": DETECTORS,
}


@pytest.mark.parametrize("name", NAMES)
def test_checkers_know_the_names_that_solvers_know(name: str) -> None:
    assert set(get_args(getattr(_options, name))) == set(NAMES[name])


@pytest.mark.parametrize(
    ("form", "function", "apart"),
    [
        ("RefineOptions", eg.refine_fundamental, {"x1", "x2", "F0"}),
        ("HomographyOptions", eg.refine_homography, {"x1", "x2", "H0"}),
        ("PairOptions", eg.refine_fundamental, {"x1", "x2", "F0", "weights"}),
        ("AdjustOptions", eg.bundle_adjust, {"tracks", "start", "method", "lines"}),
    ],
)
def test_options_that_are_passed_on_are_all_there_are(
    form: str, function: Any, apart: set[str]
) -> None:
    known = getattr(_options, form).__annotations__
    assert set(known) == set(inspect.signature(function).parameters) - apart


@pytest.mark.parametrize(
    "call",
    [
        lambda **k: eg.refine_fundamental(VIEW.x1, VIEW.x2, **k),
        lambda **k: eg.estimate_fundamental(VIEW.x1, VIEW.x2, **k),
        lambda **k: eg.refine_fundamental_batch(VIEW.x1, VIEW.x2, [0, 50], **k),
        lambda **k: eg.estimate_fundamental_batch(VIEW.x1, VIEW.x2, [0, 50], **k),
        lambda **k: eg.compare(SCENE.tracks, ["covariant"], **k),
        lambda **k: eg.bundle_adjust(SCENE.tracks, **k),
        lambda **k: eg.colmap.refine_database("absent.db", **k),
    ],
)
def test_an_unknown_option_is_refused_by_name(call: Any) -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'max_itter'"):
        call(max_itter=3)


def test_a_similar_option_is_suggested() -> None:
    with pytest.raises(TypeError, match="did you mean 'loss_scale_px'"):
        eg.estimate_fundamental(VIEW.x1, VIEW.x2, los_scale_px=1.0)


class TestLogging:
    def test_nobody_is_told_unless_he_listens(self, caplog, capsys) -> None:
        with caplog.at_level(logging.WARNING):
            eg.refine_fundamental(VIEW.x1, VIEW.x2)
        assert caplog.records == []
        assert capsys.readouterr() == ("", "")

    def test_a_line_a_result_and_a_line_an_evaluation(self, caplog) -> None:
        with caplog.at_level(logging.INFO, "epigauge"):
            found = eg.refine_fundamental(VIEW.x1, VIEW.x2)
        (record,) = caplog.records
        assert record.name == "epigauge"
        for text in ("refine_fundamental: ", f"{found.rms_px:.6g} px", *found.flags):
            assert text in record.getMessage()
        caplog.clear()
        with caplog.at_level(logging.DEBUG, "epigauge"):
            found = eg.refine_fundamental(VIEW.x1, VIEW.x2)
        assert len(caplog.records) == found.nfev + 1
        assert f"{found.history[1].cost:.8g} px^2" in caplog.text

    def test_many_views_and_many_pairs_tell_too(self, caplog) -> None:
        with caplog.at_level(logging.INFO, "epigauge"):
            eg.bundle_adjust(SCENE.tracks)
            eg.refine_fundamental_batch(VIEW.x1, VIEW.x2, [0, 50])
        assert "bundle_adjust: BundleResult: may be used" in caplog.text
        assert "refine_fundamental_batch: FundamentalBatch: 1 pairs" in caplog.text
