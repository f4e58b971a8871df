"""Picture of and report on an image pair: what is drawn and written is what was found."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from importlib.resources import files

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.images import ImageMatches
from epigauge.images.summary import epipole_text, explained, inside, summary, with_deviation
from epigauge.two_view.robust import RobustResult
from two_views import homogeneous

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from epigauge.plots import plot_pair, save_figure
from epigauge.plots.pair_view import reduced
from epigauge.reports import save_pair_report
from epigauge.two_view.confidence import Signs
from matplotlib.collections import PathCollection
from matplotlib.patches import Ellipse

SHIFT = np.array([400.0, 300.0])  # from the scenes' centred pixels to those of an image
PHOTO = np.add.outer(np.arange(600), np.arange(800)).astype(np.uint8)


def found(
    motion: str = "forward", noise_px: float = 0.5, outliers: int = 5, name: str = "a - b"
) -> tuple[RobustResult, ImageMatches]:
    """Return a result whose last matches are outliers, as a robust estimate gives it."""
    scene = eg.two_view_scene(
        noise_px=noise_px, n_points=60, distance=4.0, motion=motion, focal=900.0, seed=2
    )
    x1, x2 = scene.x1 + SHIFT, scene.x2 + SHIFT
    used = np.arange(60 - outliers)
    refined = eg.refine_fundamental(x1[used], x2[used], noise_px=None)
    values = {entry.name: getattr(refined, entry.name) for entry in dataclasses.fields(refined)}
    marks = {"inlier": np.arange(60) < 60 - outliers, "used": used}
    how = {"threshold_px": 2.0, "rounds": 3, "start": "8point"}
    error = {"error_px": 0.2, "p_wrong": 0.01, "_signs": Signs(0.1, 150.0, -40.0)}
    result = RobustResult(**values, **marks, **how, **error)
    size = (800, 600)
    return result, ImageMatches(x1, x2, None, size, size, name, "sift", 100, 90)


FORWARD = found()
SIDEWAYS = found("sideways")


def numbers_of(axes) -> dict[str, np.ndarray]:
    """Places of the numbers written into an image."""
    return {t.get_text(): np.array(t.get_position()) for t in axes.texts if t.get_text().isdigit()}


# the picture


@pytest.mark.parametrize("pair", [FORWARD, SIDEWAYS], ids=["forward", "sideways"])
def test_lines_are_the_epipolar_lines_of_the_ringed_matches(pair) -> None:
    result, matches = pair
    figure = plot_pair(result, matches, [PHOTO, PHOTO])
    views = figure.axes[:2]
    rings = [
        np.array([line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o"])
        for axes in views
    ]
    chosen = [int(np.argmin(np.linalg.norm(matches.x1 - x, axis=1))) for x in rings[0]]
    assert len(set(chosen)) == 8
    assert set(chosen) <= set(result.used.tolist())
    np.testing.assert_array_equal(matches.x2[chosen], rings[1])
    _, *feet = eg.reprojection_distances(result.F, matches.x1, matches.x2)
    for view, F in ((0, result.F.T), (1, result.F)):
        expected = homogeneous(feet[1 - view][chosen]) @ F.T
        expected /= np.linalg.norm(expected[:, :2], axis=1)[:, None]
        drawn = [line.get_xydata() for line in views[view].lines if line.get_linestyle() == "-"]
        drawn = [ends for ends in drawn if len(ends) == 2]
        numbers = numbers_of(views[view])
        assert len(drawn) == 8
        for k, (line, ends) in enumerate(zip(expected, drawn, strict=True), 1):
            assert np.abs(homogeneous(ends) @ line).max() < 1e-6
            for x, y in ends:  # it reaches from border to border
                assert min(abs(x + 0.5), abs(x - 799.5), abs(y + 0.5), abs(y - 599.5)) < 1e-6
            if str(k) in numbers:
                assert abs(np.append(numbers[str(k)], 1.0) @ line) < 1e-6
        assert len(numbers) >= 6  # but for lines that only cut a corner


def test_points_are_the_inliers_with_the_colours_of_their_distances() -> None:
    result, matches = SIDEWAYS
    figure = plot_pair(result, matches, [PHOTO, PHOTO])
    d = eg.reprojection_distances(result.F, matches.x1, matches.x2)[0]
    for axes, x in zip(figure.axes, (matches.x1, matches.x2), strict=False):
        (points,) = (c for c in axes.collections if isinstance(c, PathCollection))
        places, values = np.array(points.get_offsets()), np.array(points.get_array())
        rows = [int(np.argmin(np.linalg.norm(x - place, axis=1))) for place in places]
        assert sorted(rows) == result.used.tolist()
        np.testing.assert_allclose(values, np.abs(d[rows]), atol=1e-9)
        assert (np.diff(values) >= 0).all()  # the worst on top
        assert points.norm.vmin == 0.0
        assert points.norm.vmax == pytest.approx(values.max())


def test_epipole_has_the_ellipse_of_its_covariance_times_the_factor_written() -> None:
    result, matches = FORWARD
    figure = plot_pair(result, matches, [PHOTO, PHOTO])
    for view, axes in enumerate(figure.axes[:2]):
        e = (result.epipole1, result.epipole2)[view]
        covariance = result.epipole_px_covariance(view + 1)
        (label,) = (t.get_text() for t in axes.texts if t.get_text().startswith("epipole"))
        times = int(label.partition("\N{MULTIPLICATION SIGN}")[2] or 1)
        ellipses = [p for p in axes.patches if isinstance(p, Ellipse)]
        assert len(ellipses) == 2  # white below black
        for ellipse in ellipses:
            border = ellipse.get_patch_transform().transform([(1.0, 0.0), (0.0, 1.0), (0.6, 0.8)])
            off = (border - e[:2] / e[2]) / times
            mahalanobis = np.sum(off * np.linalg.solve(covariance, off.T).T, axis=1)
            np.testing.assert_allclose(np.sqrt(mahalanobis), 2.0, rtol=1e-6)
        assert ellipses[0].get_width() > 40  # of 600 pixels: to be seen


def test_no_epipole_is_drawn_where_none_is_in_the_picture() -> None:
    figure = plot_pair(*SIDEWAYS, [PHOTO, PHOTO])
    assert not [p for axes in figure.axes[:2] for p in axes.patches if isinstance(p, Ellipse)]
    assert not [t for axes in figure.axes[:2] for t in axes.texts if "epipole" in t.get_text()]


def test_an_epipole_of_unknown_accuracy_is_a_cross_without_ellipse(monkeypatch) -> None:
    unknown = np.full((2, 2), np.inf)
    monkeypatch.setattr(RobustResult, "epipole_px_covariance", lambda self, image: unknown)
    axes = plot_pair(*FORWARD, [PHOTO, PHOTO]).axes[0]
    assert [line for line in axes.lines if line.get_marker() == "+"]
    assert not [p for p in axes.patches if isinstance(p, Ellipse)]
    assert "unknown" in epipole_text(*FORWARD, 1)


def test_numbers_are_written_below() -> None:
    result, matches = SIDEWAYS
    figure = plot_pair(result, matches, [PHOTO, PHOTO], seconds=(1.25, 0.5))
    words = [t.get_text() for axes in figure.axes for t in axes.texts]
    for value in summary(result, matches, (1.25, 0.5)).values():
        assert value in words
    assert f"{result.F[0, 0]: .6e}" in " ".join(words)
    assert "55 of 60 matches agree" in figure.get_suptitle()
    assert "1.25 for the matches, 0.50 for F" in words


def test_warnings_are_explained_in_the_picture() -> None:
    result, matches = found("sideways", noise_px=20.0)
    assert result.flags
    words = " ".join(
        t.get_text() for axes in plot_pair(result, matches, [PHOTO, PHOTO]).axes for t in axes.texts
    )
    for flag, sentence in explained(result).items():
        assert f"{flag}: {sentence}" in " ".join(words.split())


@pytest.mark.parametrize(("shape", "name"), [((1200, 400), "tall.png"), ((200, 1600), "wide.svg")])
def test_images_of_any_shape_and_format_are_drawn(tmp_path, shape, name) -> None:
    result, matches = SIDEWAYS
    matches = dataclasses.replace(matches, image_size2=shape[::-1])
    other = np.zeros((*shape, 3), dtype=np.uint8)
    figure = plot_pair(result, matches, [PHOTO, other])
    figure.set_dpi(40)  # saves time
    save_figure(figure, tmp_path / name)
    start = (tmp_path / name).read_bytes()[:1000]
    assert start.startswith(b"\x89PNG") or b"<svg" in start


def test_wide_images_stand_one_below_the_other() -> None:
    result, matches = SIDEWAYS
    matches = dataclasses.replace(matches, image_size1=(1600, 500), image_size2=(1600, 500))
    wide = np.zeros((500, 1600), dtype=np.uint8)
    first, second = plot_pair(result, matches, [wide, wide]).axes[:2]
    assert first.get_position().y0 > second.get_position().y1


def test_reduced_photographs_are_means_and_keep_their_scale() -> None:
    photo = np.random.default_rng(0).integers(0, 256, (203, 305, 3)).astype(np.uint8)
    small, size = reduced(photo, 100)
    assert small.shape == (50, 76, 3)
    assert size == (304, 200)
    np.testing.assert_array_equal(small[3, 5], photo[12:16, 20:24].mean(axis=(0, 1)) // 1)
    np.testing.assert_array_equal(reduced(photo, 305)[0], photo)
    assert reduced(photo[:1], 10)[0].shape == (1, 305, 3)


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ([PHOTO], "images has 1 elements"),
        ([PHOTO, PHOTO[:-1]], r"images has one of \(800, 599\) pixels"),
        ([PHOTO, np.zeros(3)], r"images has shape \(3,\)"),
    ],
)
def test_other_images_are_refused(images, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        plot_pair(*SIDEWAYS, images)


def test_a_result_of_other_matches_is_refused() -> None:
    result, matches = SIDEWAYS
    fewer = dataclasses.replace(matches, x1=matches.x1[1:], x2=matches.x2[1:])
    with pytest.raises(ArgumentError, match="result is for 60 matches; needed: one for these 59"):
        plot_pair(result, fewer, [PHOTO, PHOTO])


# words


@pytest.mark.parametrize(
    ("value", "deviation", "text"),
    [
        (573.418, 40.2, "573 ± 40"),
        (8111.3, 1323.0, "8100 ± 1300"),
        (-0.43217, 0.00123, "-0.4322 ± 0.0012"),
        (0.00099116, 0.0000281, "(9.91 ± 0.28) 1e-4"),
        (0.5, np.inf, "0.5 ± unknown"),
        (0.5, 0.0, "0.500000 ± 0.000000"),
        (0.0, 0.0, "0.000000 ± 0.000000"),
    ],
)
def test_values_are_written_as_far_as_they_are_known(value, deviation, text) -> None:
    assert with_deviation(value, deviation) == text


def test_epipoles_are_told_inside_outside_and_at_infinity() -> None:
    result, matches = FORWARD
    assert inside(result, matches, 1)
    assert "in the picture" in epipole_text(result, matches, 1)
    for factor in (1.0, -1.0):  # e is known up to sign
        turned = dataclasses.replace(result, V=factor * result.V)
        assert inside(turned, matches, 1)
    result, matches = SIDEWAYS
    assert not inside(result, matches, 2)
    assert "outside the picture" in epipole_text(result, matches, 2)
    rectified = dataclasses.replace(result, V=np.roll(np.eye(3), 1, axis=0)[:, ::-1])
    assert rectified.epipole1.tolist() == [0.0, 1.0, 0.0]
    assert epipole_text(rectified, matches, 1) == "at infinity, direction 90.0°"
    assert not inside(rectified, matches, 1)


def test_every_failure_is_explained_in_a_sentence() -> None:
    result = dataclasses.replace(SIDEWAYS[0], rank=5, status=0, message="no more steps")
    sentences = explained(result)
    assert sentences["rank"] == "The matches determine only 5 of the 7 directions of F."
    assert sentences["not converged"] == "No more steps."
    for sentence in sentences.values():
        assert re.fullmatch(r"[A-Z].*[^.]\.", sentence)


# the report


class Page(HTMLParser):
    """What a page holds: text, links and scripts; fails where elements are not closed."""

    VOID = frozenset({"meta", "img", "image", "link", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.scripts: list[str] = []
        self.words = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs) -> None:
        self.links += [value for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_startendtag(self, tag, attrs) -> None:
        self.links += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif self.open and self.open[-1] != "style":
            self.words += data


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("report") / "pair.html"
    result, matches = found("sideways", noise_px=20.0, name="<b>R&D</b></script> - 'b\"")
    save_pair_report(path, result, matches, [PHOTO, np.dstack([PHOTO] * 3)], seconds=(1.0, 2.0))
    return path.read_text(encoding="utf-8")


def test_report_holds_numbers_warnings_and_images_and_needs_nothing_else(report) -> None:
    result, matches = found("sideways", noise_px=20.0)
    page = Page(report)
    forms = [link.partition(",")[0] for link in page.links]
    assert forms == ["data:image/png;base64", *["data:image/jpeg;base64"] * 2, forms[0]]
    for link in page.links:
        content = base64.b64decode(link.partition(",")[2], validate=True)
        assert content.startswith((b"\x89PNG\r\n", b"\xff\xd8\xff"))
    assert not re.search(r"(?:src|href|url\(|@import)[^>]{0,3}https?:", report)
    assert "default-src 'none'" in report
    words = " ".join(page.words.split())
    assert "<b>R&D</b></script> - 'b\"" in words
    for text in (*summary(result, matches, (1.0, 2.0)).values(), *explained(result).values()):
        assert text in words
    for value in result.F.ravel():
        assert f"{value:.8e}" in words


def test_report_carries_F_its_covariance_and_the_inliers(report) -> None:
    result, matches = found("sideways", noise_px=20.0)
    data = json.loads(Page(report).scripts[0])
    np.testing.assert_array_equal(data["F"], result.F)
    np.testing.assert_array_equal(data["covariance"], result.covariance)
    np.testing.assert_allclose(data["x"][0], matches.x1[result.used], atol=6e-4)
    np.testing.assert_allclose(np.abs(data["distance"]), np.abs(result.fun), atol=6e-5)
    assert len(data["colour"]) == len(data["rows"]) == len(result.used)


def test_report_of_an_undetermined_F_has_no_band(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("epigauge.reports.pair._png", lambda figure: "data:,")  # saves time
    result, matches = SIDEWAYS
    result = dataclasses.replace(result, covariance=np.full((9, 9), np.inf), rank=6)
    save_pair_report(tmp_path / "a.html", result, matches, [PHOTO, PHOTO])
    page = Page((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert json.loads(page.scripts[0])["covariance"] is None
    assert "determine only 6 of the 7 directions" in page.words


def test_reports_end_in_html(tmp_path) -> None:
    with pytest.raises(ArgumentError, match=r"a name ending in \.html"):
        save_pair_report(tmp_path / "a.htm", *SIDEWAYS, [PHOTO, PHOTO])


@pytest.mark.skipif(shutil.which("node") is None, reason="the script is run by Node.js")
@pytest.mark.parametrize("view", [0, 1])
def test_script_draws_the_line_of_F_and_its_propagated_deviation(view) -> None:
    result, matches = FORWARD
    x, size = (matches.x1, matches.x2)[view][3], [800, 600]
    arguments = json.dumps([result.F.tolist(), result.covariance.tolist(), x.tolist(), view, size])
    script = (files("epigauge.reports") / "pair.js").read_text(encoding="utf-8")
    script += f"""
    const [F, covariance, x, view, size] = {arguments};
    const line = epipolarLine(F, x, view), by = lineCovariance(covariance, x, view);
    const ends = clip(line, size);
    const outline = band(line, by, ends), near = deviation(line, by, ends[0]);
    console.log(JSON.stringify({{ line, ends, outline, near }}));
    """
    run = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    drawn = json.loads(run.stdout)
    F = result.F if view == 0 else result.F.T
    line = F @ np.append(x, 1.0)
    np.testing.assert_allclose(drawn["line"], line, rtol=1e-12)
    scale = np.linalg.norm(line[:2])
    ends = np.array(drawn["ends"])
    assert np.abs(homogeneous(ends) @ line / scale).max() < 1e-8
    # d (y^T F x) = (y x^T) . dF
    outer = np.outer(np.append(ends[0], 1.0), np.append(x, 1.0))
    by_F = (outer if view == 0 else outer.T).ravel()
    expected = np.sqrt(by_F @ result.covariance @ by_F) / scale
    assert drawn["near"] == pytest.approx(expected, rel=1e-6)
    off = homogeneous(np.array(drawn["outline"])) @ line / scale
    assert abs(off[0]) == pytest.approx(2 * expected, rel=1e-6)
    assert off[0] * off[-1] < 0  # on both sides
