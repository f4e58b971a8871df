"""Every kind of page in a real browser: a phone, a tablet and a desk, by day and by night."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import browser
import epigauge as eg
import html_pages
import pytest
from metric_scenes import metric_scene

pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
if browser.missing():
    pytest.skip(f"no browser: {browser.missing()}", allow_module_level=True)

from epigauge.plots import plot_precision
from epigauge.reports import save_pair_report, save_picture_page, save_viewer

pytestmark = pytest.mark.slow

PAIR = eg.two_view_scene(seed=3)
TRACKS = eg.multi_view_scene(n_points=60, seed=2).tracks


def pair(path: Path) -> None:
    pytest.importorskip("cv2", reason="photographs need OpenCV")
    images = eg.samples.path("A.jpg"), eg.samples.path("B.jpg")
    matches = eg.match_images(*images)
    save_pair_report(path, eg.estimate_fundamental(matches.x1, matches.x2), matches, images)


def refinement(path: Path) -> None:
    result = eg.refine_fundamental(PAIR.x1, PAIR.x2)
    save_picture_page(path, result.plot(PAIR.x1, PAIR.x2), "folder/matches.csv", result)


def space(path: Path) -> None:
    save_viewer(path, eg.bundle_adjust(TRACKS), TRACKS, "folder/tracks.csv")


def calibrated(path: Path) -> None:
    tracks, start = metric_scene("SIMPLE_RADIAL", noise_px=0.3, n_cameras=1)
    result = eg.bundle_adjust(tracks, start, refine="pose")
    covariance = eg.covariance(tracks, result.reconstruction, refine="pose")
    save_viewer(path, result, tracks, "A calibrated scene", covariance=covariance)


def precision(path: Path) -> None:
    tracks, start = metric_scene("SIMPLE_RADIAL", noise_px=0.3, n_cameras=1)
    result = eg.bundle_adjust(tracks, start)
    covariance = eg.covariance(tracks, result.reconstruction)
    save_picture_page(path, plot_precision(covariance, tracks), "Precision", covariance)


def comparison(path: Path) -> None:
    found = eg.compare(TRACKS, ["covariant", "levenberg", "mclauchlan"])
    save_picture_page(path, found.plot("tracks.csv"), "Methods", found)


PAGES: dict[str, Callable[[Path], None]] = {
    made.__name__: made for made in (pair, refinement, space, calibrated, precision, comparison)
}


@pytest.fixture(scope="module")
def window() -> Iterator[browser.Browser]:
    with browser.Browser() as opened:
        yield opened


@pytest.fixture(scope="module", params=PAGES)
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("pages") / f"{request.param}.html"
    PAGES[request.param](path)
    return path


@pytest.mark.parametrize("width", browser.WIDTHS)
def test_nothing_overflows_and_nothing_is_empty(
    page: Path, width: int, window: browser.Browser
) -> None:
    assert window.problems(page, width) == []
    assert window.problems(page, width, dark=True) == []
    assert html_pages.problems(page) == []


def brightness(colour: str) -> float:
    red, green, blue = map(float, colour[colour.index("(") + 1 : -1].split(",")[:3])
    return 0.299 * red + 0.587 * green + 0.114 * blue


def test_text_is_read_by_day_and_by_night(page: Path, window: browser.Browser) -> None:
    look = "const s = getComputedStyle(document.body); return [s.color, s.backgroundColor]"
    shades: list[Any] = []
    for dark in (False, True):
        window.show(page, dark=dark)
        shades.append([brightness(colour) for colour in window.run(look)])
    assert shades[0][0] < 90
    assert shades[0][1] > 230
    assert shades[1][0] > 200
    assert shades[1][1] < 50


def test_faults_of_a_page_are_seen(window: browser.Browser, tmp_path: Path) -> None:
    path = tmp_path / "bad.html"
    head = '<!doctype html><meta name="viewport" content="width=device-width"><title>x</title>'
    for body, problem in (
        ('<div style="width: 900px; height: 9px">x</div>', "px wide where there are"),
        ('<canvas style="height: 0"></canvas>', "x 0 px"),
        ('<img alt="x" src="data:image/png;base64,AAAA">', "does not load"),
        ("<script>no.such.name()</script>", "no is not defined"),
    ):
        path.write_text(head + body)
        found = window.problems(path, 390)
        assert any(problem in one for one in found), (body, found)
    path.write_text(head + "<p>All is well.")
    assert window.problems(path, 390) == []
