"""Results as people use them: printed, in notebooks, as plain data, in files, copied, unpacked."""

from __future__ import annotations

import copy
import functools
import html.parser
import importlib.util
import json
import pickle
import tempfile
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import colmap_databases
import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge._results import Result, SavedResult
from epigauge.errors import ArgumentError
from metric_scenes import metric_scene

VIEW = eg.two_view_scene(noise_px=0.5, seed=7)
TRACKS = eg.multi_view_scene(n_points=30, seed=2).tracks
BUNDLE = eg.bundle_adjust(TRACKS)
CALIBRATED = metric_scene("SIMPLE_RADIAL", noise_px=0.3, n_cameras=1)
ADJUSTED = eg.bundle_adjust(*CALIBRATED, refine="pose")
K = np.array([[800.0, 0.0, 0.0], [0.0, 800.0, 0.0], [0.0, 0.0, 1.0]])
UPGRADED = eg.metric_upgrade(eg.load_tracks(eg.samples.path("tracks.csv")), image_size=(512, 512))
NOISE = np.random.default_rng(3).normal(size=VIEW.x1.shape)
FEW = np.array([0, 50, 53])


def pickled(result: Any) -> Any:
    """Return a result that has been to another process."""
    return pickle.loads(pickle.dumps(result))  # noqa: S301


def batch() -> eg.FundamentalBatch:
    """One pair that can be refined, one that cannot."""
    x1, x2 = (np.vstack([x, x[:3]]) for x in (VIEW.x1, VIEW.x2))
    return eg.refine_fundamental_batch(x1, x2, FEW)


def affine() -> eg.AffineReconstruction:
    rng = np.random.default_rng(0)
    return eg.AffineReconstruction(rng.normal(size=(3, 2, 4)), rng.normal(size=(8, 3)))


def affine_covariance() -> eg.AffineCovariance:
    found, rng = affine(), np.random.default_rng(1)
    view, point = np.divmod(np.arange(24), 8)
    X = np.column_stack([found.X, np.ones(8)])
    xy = np.einsum("nij,nj->ni", found.P[view][:, :2], X[point])
    return eg.covariance(eg.Tracks(view, point, xy + rng.normal(0, 0.1, xy.shape)), found)


@functools.cache
def database(verified: bool) -> Any:
    """The pairs of a COLMAP database, refined; or the raw matches of one pair, verified."""
    n_views = 3 if verified else 2
    with tempfile.TemporaryDirectory() as folder:
        path = colmap_databases.Project(n_views=n_views).write(Path(folder, "database.db"))
        if verified:
            return eg.colmap.refine_database(path)
        return eg.colmap.verify_database(
            colmap_databases.change(path, "DELETE FROM two_view_geometries")
        )


MADE: dict[str, Callable[[], Any]] = {
    "fundamental": lambda: eg.refine_fundamental(VIEW.x1, VIEW.x2),
    "python loop": lambda: eg.refine_fundamental(VIEW.x1, VIEW.x2, backend="numpy", max_iter=2),
    "essential": lambda: eg.refine_fundamental(VIEW.x1, VIEW.x2, essential=True, K1=K),
    "robust": lambda: eg.estimate_fundamental(VIEW.x1, VIEW.x2),
    "batch": batch,
    "robust batch": lambda: eg.estimate_fundamental_batch(VIEW.x1, VIEW.x2, [0, len(VIEW.x1)]),
    "bundle": lambda: BUNDLE,
    "metric bundle": lambda: ADJUSTED,
    "comparison": lambda: eg.compare(TRACKS, ["covariant", "free"]),
    "covariance": lambda: eg.covariance(TRACKS, BUNDLE.reconstruction),
    "robust covariance": lambda: eg.covariance(TRACKS, BUNDLE.reconstruction, loss="huber"),
    "covariance in a gauge": lambda: eg.covariance(
        TRACKS, BUNDLE.reconstruction, eg.gauge.two_cameras()
    ),
    "metric covariance": lambda: eg.covariance(
        CALIBRATED[0], ADJUSTED.reconstruction, refine="pose"
    ),
    "deviations": lambda: eg.covariance(CALIBRATED[0], ADJUSTED.reconstruction, refine="pose").std,
    "homography": lambda: eg.refine_homography(VIEW.x1, 1.1 * VIEW.x1 + NOISE),
    "model": lambda: eg.estimate_two_view(VIEW.x1, VIEW.x2),
    "focal lengths": lambda: eg.focal_lengths(VIEW.F_true, (0, 0), (3, 1)),
    "metric upgrade": lambda: UPGRADED,
    "no metric upgrade": lambda: replace(
        UPGRADED, reconstruction=None, covariance=None, bundle=None, rms_px=np.nan, success=False
    ),
    "affine covariance": affine_covariance,
    "lines": lambda: eg.line_scene(n_views=4, n_lines=8).line_tracks,
    "reconstruction": lambda: BUNDLE.reconstruction,
    "metric reconstruction": lambda: ADJUSTED.reconstruction,
    "affine reconstruction": affine,
    "tracks": lambda: TRACKS,
    "matches": lambda: eg.Matches(VIEW.x1, VIEW.x2, name="<b>pair</b>"),
    "database": lambda: database(verified=True),
    "raw database": lambda: database(verified=False),
}
SLOW = ("robust",)
HAS_FRONT_END = any(importlib.util.find_spec(name) for name in ("cv2", "poselib"))


@pytest.fixture(scope="module", params=MADE)
def result(request: pytest.FixtureRequest) -> Any:
    if request.param == "robust" and not HAS_FRONT_END:
        pytest.skip("needs OpenCV or PoseLib")
    return MADE[request.param]()


def test_all_results_have_one_base() -> None:
    kinds = {name for name in eg.__all__ if isinstance(getattr(eg, name), type)}
    shown = {name for name in kinds if issubclass(getattr(eg, name), Result)}
    endings = ("Result", "Batch", "Covariance", "Reconstruction", "Comparison", "Tracks")
    endings += ("Matches", "Upgrade", "Lengths")
    wanted = {name for name in kinds if name.endswith(endings)}
    assert wanted - {"PairwiseMatches"} <= shown  # features in photographs: what is found in them
    # Every one of them is tried below; a new kind of result belongs into MADE.
    tried = {type(make()).__name__ for name, make in MADE.items() if name not in SLOW}
    assert shown - tried == {"RobustResult", "ImageMatches"}


def test_a_copy_is_the_same(result: Any) -> None:
    expected = json.dumps(result.to_dict())
    for again in (pickled(result), copy.deepcopy(result), copy.copy(result)):
        assert type(again) is type(result)
        assert json.dumps(again.to_dict()) == expected
        assert again.summary() == result.summary()


def test_plain_data_is_strict_json(result: Any) -> None:
    document = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert document["kind"] == type(result).__name__
    assert (document["version"], document["schema"]) == (eg.__version__, 1)


def test_print_is_the_summary_and_begins_with_the_kind(result: Any) -> None:
    assert str(result) == result.summary()
    assert result.summary().startswith(type(result).__name__)
    assert all(line == line.rstrip() or line.strip() for line in result.summary().splitlines())


def test_table_in_a_notebook_has_the_same_text(result: Any) -> None:
    class Text(html.parser.HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.words: list[str] = []
            self.tags: list[str] = []

        def handle_data(self, data: str) -> None:
            self.words += data.split()

        def handle_starttag(self, tag: str, attrs: Any) -> None:
            self.tags.append(tag)

        def handle_endtag(self, tag: str) -> None:
            while self.tags.pop() != tag:
                pass

    page = Text()
    page.feed(result._repr_html_())
    assert page.tags == []  # every tag is closed, and none comes from a name
    assert sorted(page.words) == sorted(result.summary().split())


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_what_was_saved_is_loaded(result: Any, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"result{suffix}"
    if isinstance(result, eg.Tracks | eg.Matches):
        path = path.with_suffix(".csv")
        result.save(path)
        load = eg.load_tracks if isinstance(result, eg.Tracks) else eg.load_matches
        again = load(path)
        for name in ("xy", "view", "x1", "x2"):
            if hasattr(result, name):
                np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
        return
    result.save(path, remark="of a test")
    found = eg.load_result(path)
    assert isinstance(found, SavedResult)
    assert (found.kind, found.remark) == (type(result).__name__, "of a test")
    for name in ("F", "P", "R", "X", "rms_px", "noise_px", "success", "flags", "projections"):
        if isinstance(result, eg.FundamentalBatch) and name == "flags":
            continue
        if result._contents().get(name) is not None:
            value = np.nan if found[name] is None else found[name]  # JSON has no NaN
            np.testing.assert_array_equal(value, getattr(result, name))
    assert found.summary().startswith(f"{found.kind} from a file")
    assert found.summary() in (str(found), str(pickled(found)))
    with pytest.raises(AttributeError, match="the file holds no 'nothing'; it has"):
        _ = found.nothing


def test_a_result_that_must_not_be_used_says_so() -> None:
    turn = np.array([[0.99, -0.1, 3.0], [0.1, 0.99, -5.0], [0.0, 0.0, 1.0]])
    h = np.column_stack([VIEW.x1, np.ones(len(VIEW.x1))]) @ turn.T
    noise = np.random.default_rng(0).normal(0.0, 0.3, VIEW.x1.shape)
    flat = eg.refine_fundamental(VIEW.x1, h[:, :2] + noise)
    assert not flat.success
    for text in (flat.summary(), flat._repr_html_()):
        assert "not to be used" in text
        for flag, sentence in eg.verdicts.explained(flat.flags).items():
            assert flag in text
            assert sentence in text


@pytest.mark.skipif(not HAS_FRONT_END, reason="needs OpenCV or PoseLib")
def test_a_robust_result_unpacks_as_that_of_opencv() -> None:
    result = MADE["robust"]()
    F, mask = result
    np.testing.assert_array_equal(F, result.F)
    np.testing.assert_array_equal(mask, result.inlier)
    assert mask.dtype == np.bool_
    assert VIEW.x1[mask].shape == (mask.sum(), 2)


def test_a_pickle_of_another_machine_needs_no_compiled_library(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = MADE["fundamental"]()
    sent = pickle.dumps(result)
    monkeypatch.setattr(kernels, "available", lambda: {"numpy": None, "c": "no", "casadi": "no"})
    again = pickle.loads(sent)  # noqa: S301
    np.testing.assert_array_equal(again.covariance, result.covariance)
    np.testing.assert_allclose(
        again.epipole_covariance(1), result.epipole_covariance(1), rtol=1e-12, atol=1e-18
    )


def test_pictures_are_drawn_by_the_results() -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    assert MADE["fundamental"]().plot(VIEW.x1, VIEW.x2).axes
    assert BUNDLE.plot(TRACKS, "scene").axes
    assert MADE["comparison"]().plot().axes


#: What the pictures of some results show beside them.
DATA: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("fundamental", "python loop", "essential"), (VIEW.x1, VIEW.x2)),
    "homography": (VIEW.x1, 1.1 * VIEW.x1 + NOISE),
    "model": (VIEW.x1, VIEW.x2),
    "bundle": (TRACKS,),
    "reconstruction": (TRACKS,),
    "metric bundle": (CALIBRATED[0],),
    "metric covariance": (CALIBRATED[0],),
    "metric reconstruction": (CALIBRATED[0],),
    "metric upgrade": (eg.load_tracks(eg.samples.path("tracks.csv")),),
}


@pytest.mark.parametrize("name", [n for n in MADE if n not in (*SLOW, "no metric upgrade")])
def test_every_kind_of_result_has_a_picture(name: str) -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    figure = MADE[name]().plot(*DATA.get(name, ()))
    figure.draw_without_rendering()
    assert any(axes.has_data() for axes in figure.axes)


def test_what_has_no_picture_says_so() -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    with pytest.raises(ArgumentError, match="has no scene"):
        MADE["no metric upgrade"]().plot(TRACKS)
    with pytest.raises(ArgumentError, match="is a SavedResult, which has no picture"):
        SavedResult(kind="x").plot()
    with pytest.raises(ArgumentError, match="x1 has 3 matches"):
        MADE["homography"]().plot(VIEW.x1[:3], VIEW.x2[:3])


def test_public_methods_are_described_with_an_example() -> None:
    for method in vars(Result).values():
        if isinstance(method, types.FunctionType) and not method.__name__.startswith("_"):
            assert "Examples\n" in (method.__doc__ or "")


def test_a_picture_of_matches_that_do_not_agree_says_so() -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    x1, x2 = np.random.default_rng(0).uniform(0.0, 500.0, (2, 60, 2))
    lengths = eg.estimate_two_view(x1, x2).plot(x1, x2).axes[1]
    assert [text.get_text() for text in lengths.texts] == ["none"]
    assert not lengths.patches
