"""Pictures: what is drawn is the epipolar geometry, and every legal result can be drawn."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import xml.etree.ElementTree as ET
from itertools import combinations

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError, MissingPackageError
from epigauge.io import load_matches
from epigauge.plots import plot_refinement, save_figure
from epigauge.scenes import two_view_scene

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from matplotlib.lines import AxLine, Line2D

SCENE = two_view_scene(seed=3)
RESULT = eg.refine_fundamental(SCENE.x1, SCENE.x2)


def epipolar_lines(axes) -> list[AxLine]:
    return [line for line in axes.lines if isinstance(line, AxLine)]


def coloured_points(axes) -> np.ndarray:
    """Positions of the points with an epipolar line: all but the first collection."""
    return np.array([points.get_offsets()[0] for points in axes.collections[1:]])


def curves(axes) -> dict[str, Line2D]:
    """Curves with a label."""
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


def check_geometry(figure, F, x1, x2) -> None:
    """Assert that each line is the epipolar line of the foot point that its colour has beyond."""
    d, *feet = eg.reprojection_distances(F, x1, x2)
    views = figure.axes[:2]
    chosen = [np.argmin(np.linalg.norm(x1 - point, axis=1)) for point in coloured_points(views[0])]
    np.testing.assert_array_equal(x2[chosen], coloured_points(views[1]))
    for view, matrix in ((0, F.T), (1, F)):
        assert len(epipolar_lines(views[view])) == 12
        lines = np.column_stack([feet[1 - view][chosen], np.ones(12)]) @ matrix.T
        lines /= np.linalg.norm(lines[:, :2], axis=1)[:, None]
        for line, drawn in zip(lines, epipolar_lines(views[view]), strict=True):
            for end in (drawn.get_xy1(), drawn.get_xy2()):
                assert np.abs(line[:2] @ end + line[2]) < 1e-6  # pixels
    counted = sum(patch.get_height() for patch in figure.axes[2].patches)
    beyond = [label for label in curves(figure.axes[2]) if "farther" in label]
    assert counted + sum(int(label.split()[0]) for label in beyond) == len(d)


def test_measured_pairs_are_drawn_with_their_geometry(pair) -> None:
    m = load_matches(pair, inliers=True)
    result = eg.refine_fundamental(m.x1, m.x2)
    before = m.x1.tobytes(), m.x2.tobytes()
    figure = plot_refinement(result, m.x1, m.x2, (m.image_size1, m.image_size2))
    check_geometry(figure, result.F, m.x1, m.x2)
    for axes, x in zip(figure.axes, (m.x1, m.x2), strict=False):
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        assert left < x[:, 0].min()
        assert x[:, 0].max() < right
        assert top < x[:, 1].min()  # y runs down
        assert x[:, 1].max() < bottom
    assert (m.x1.tobytes(), m.x2.tobytes()) == before


def test_colours_agree_in_both_views() -> None:
    figure = plot_refinement(RESULT, SCENE.x1, SCENE.x2)
    first, second = (
        [line.get_color() for line in epipolar_lines(axes)] for axes in figure.axes[:2]
    )
    np.testing.assert_array_equal(first, second)
    assert len({tuple(colour) for colour in first}) == 12


def test_epipole_is_marked_where_it_lies() -> None:
    scene = two_view_scene(motion="forward")  # both epipoles at 0, moved apart here
    e1, e2 = np.array([[100.0, 50.0], [-30.0, 20.0]])
    T1, T2 = (np.array([[1, 0, -e[0]], [0, 1, -e[1]], [0, 0, 1]]) for e in (e1, e2))
    result = dataclasses.replace(RESULT, F=T2.T @ scene.F_true @ T1)
    figure = plot_refinement(result, scene.x1 + e1, scene.x2 + e2)
    for axes, epipole in zip(figure.axes, (e1, e2), strict=False):
        marks = [line.get_xydata()[0] for line in axes.lines if line.get_marker() == "+"]
        np.testing.assert_allclose(marks, [epipole] * 2, rtol=1e-12)  # white below black
    outside = plot_refinement(RESULT, SCENE.x1, SCENE.x2)
    assert not [line for line in outside.axes[0].lines if line.get_marker() == "+"]


def test_epipole_at_infinity_is_said_to_be_there() -> None:
    rectified = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]) / 2**0.5
    x1 = np.random.default_rng(2).uniform(0, 500, (20, 2))
    x2 = x1 + np.random.default_rng(3).uniform((5, -0.3), (90, 0.3), (20, 2))
    figure = plot_refinement(dataclasses.replace(RESULT, F=rectified), x1, x2)
    assert figure.axes[0].get_title("left") == "Image 1\nepipole at infinity, 0.0\N{DEGREE SIGN}"


@pytest.mark.parametrize("shape", [(0.08, 1.0), (1.0, 1.0), (1.0, 0.1)])
def test_titles_do_not_overlap_with_few_points(shape) -> None:
    x1, x2 = SCENE.x1[:9] * shape, SCENE.x2[:9] * shape
    figure = plot_refinement(eg.refine_fundamental(x1, x2), x1, x2)
    figure.draw_without_rendering()
    texts = [figure._suptitle, *(axes._left_title for axes in figure.axes)]
    texts += [axes._right_title for axes in figure.axes if axes.get_title("right")]
    boxes = [text.get_window_extent() for text in texts]
    assert [(a, b) for a, b in combinations(boxes, 2) if a.overlaps(b)] == []
    assert all(box.x1 <= figure.bbox.x1 for box in boxes)


def test_a_comparison_shows_the_flags_of_its_methods() -> None:
    tracks = eg.multi_view_scene(0.1).tracks
    found = eg.compare(tracks, ["levenberg", "covariant"], max_iter=2)
    rows = [dataclasses.replace(row, flags=("still camera",)) for row in found.rows[:1]]
    flagged = dataclasses.replace(found, rows=(*rows, *found.rows[1:]))
    assert "still camera" in flagged.plot()._suptitle.get_text()
    assert "still camera" not in found.plot()._suptitle.get_text()


def test_curves_that_coincide_take_turns() -> None:
    tracks = eg.multi_view_scene(0.1).tracks
    axes = eg.compare(tracks, ["levenberg", "mclauchlan", "covariant"]).plot().axes[0]
    drawn = {line.get_label(): line for line in axes.lines}
    same = drawn["_levenberg"], drawn["_mclauchlan"]
    np.testing.assert_allclose(*(np.log10(line.get_ydata()[:5]) for line in same), atol=0.05)
    patterns = [line._unscaled_dash_pattern for line in same]
    assert patterns[0][1] == patterns[1][1]  # as long, and one where the other is not
    assert patterns[1][0] - patterns[0][0] == patterns[0][1][0]
    assert same[0].get_markersize() > same[1].get_markersize()
    assert not drawn["_covariant"].is_dashed()


def test_every_evaluation_is_drawn_as_accepted_or_rejected() -> None:
    history = RESULT.history
    row = history[0]
    history = (
        row,
        dataclasses.replace(row, cost=2.0 * row.cost, accepted=False),
        dataclasses.replace(row, cost=np.inf, accepted=False),
        dataclasses.replace(row, cost=0.5 * row.cost, accepted=True),
        dataclasses.replace(row, cost=0.25 * row.cost, accepted=True),
    )
    axes = plot_refinement(dataclasses.replace(RESULT, history=history), SCENE.x1, SCENE.x2).axes[3]
    found = curves(axes)
    assert axes.get_yscale() == "log"
    np.testing.assert_array_equal(found["accepted"].get_xdata(), [1, 4])
    np.testing.assert_allclose(found["accepted"].get_ydata(), [0.75 * row.cost, 0.25 * row.cost])
    np.testing.assert_array_equal(found["rejected"].get_xdata(), [2])
    (lowest,) = (line for label, line in found.items() if label.startswith("lowest"))
    np.testing.assert_array_equal(lowest.get_xdata(), [5])
    assert f"{0.25 * row.cost:.6g}" in lowest.get_label()


@pytest.mark.parametrize("distances", ["zero", "tiny", "outlier"])
@pytest.mark.parametrize("rows", [1, 2])
def test_degenerate_results_are_drawn(tmp_path, distances, rows) -> None:
    scene = two_view_scene(noise_px=1e-9 if distances == "tiny" else 0.0, n_points=8, seed=1)
    x1 = scene.x1.copy()
    if distances == "outlier":
        x1[0] += 30.0
    # The status says whether it converged; `success` is false for a degenerate scene, too.
    failed = {"status": 0, "success": False, "message": "no luck"}
    result = dataclasses.replace(RESULT, F=scene.F_true, history=RESULT.history[:rows], **failed)
    figure = plot_refinement(result, x1, scene.x2)
    assert "not converged: no luck" in figure.get_suptitle()
    save_figure(figure, tmp_path / "picture.png")


def test_images_and_sizes_set_what_is_shown() -> None:
    grey, colour = np.zeros((40, 60)), np.zeros((50, 70, 3), dtype=np.uint8)
    figure = plot_refinement(RESULT, SCENE.x1, SCENE.x2, [None, (600, 500)], [grey, None])
    # The coordinates of the scene are centred: parts of the points lie left of and above 0.
    assert figure.axes[0].get_xlim()[1] == 59.5
    assert len(figure.axes[0].images) == 1
    assert figure.axes[1].get_xlim()[1] == 599.5
    assert figure.axes[1].get_ylim()[0] == 499.5
    plot_refinement(RESULT, SCENE.x1, SCENE.x2, images=[colour, colour])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"image_sizes": [(1, 2)]}, "image_sizes has 1 elements"),
        ({"image_sizes": [(1, 2), (3, 0)]}, r"image_sizes has one of \(3, 0\)"),
        ({"image_sizes": [5, None]}, "image_sizes has one of 5"),
        ({"images": [np.zeros((3, 4, 2)), None]}, r"images has one of shape \(3, 4, 2\)"),
        ({"images": [np.zeros(3), None]}, r"images has one of shape \(3,\)"),
    ],
)
def test_unusable_pictures_are_refused(arguments, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        plot_refinement(RESULT, SCENE.x1, SCENE.x2, **arguments)


def test_saved_picture_is_what_its_suffix_says_and_always_the_same(tmp_path) -> None:
    contents = {}
    for name in ("a.png", "b.png", "a.svg", "b.svg", "a.pdf", "b.pdf"):
        save_figure(plot_refinement(RESULT, SCENE.x1, SCENE.x2), tmp_path / name)
        contents[name] = (tmp_path / name).read_bytes()
    assert contents["a.png"].startswith(b"\x89PNG\r\n")
    assert ET.fromstring(contents["a.svg"]).tag.endswith("svg")
    assert contents["a.png"] == contents["b.png"]
    assert contents["a.svg"] == contents["b.svg"]
    assert contents["a.pdf"].startswith(b"%PDF")
    assert contents["a.pdf"] == contents["b.pdf"]


@pytest.mark.parametrize("name", ["a.gif", "a.jpg", "a", ".png"])
def test_other_forms_are_refused(tmp_path, name) -> None:
    with pytest.raises(ArgumentError, match=r"a name ending in \.png, \.pdf, \.svg"):
        save_figure(plot_refinement(RESULT, SCENE.x1, SCENE.x2), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_the_remedy_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'epigauge\[plot\]'") as caught:
        plot_refinement(RESULT, SCENE.x1, SCENE.x2)
    assert isinstance(caught.value, ImportError)


def test_global_state_of_matplotlib_is_not_used(tmp_path) -> None:
    code = (
        "import sys, epigauge as eg; from epigauge.plots import *\n"
        "from epigauge.scenes import two_view_scene\n"
        "assert 'matplotlib' not in sys.modules\n"
        "s = two_view_scene(); r = eg.refine_fundamental(s.x1, s.x2)\n"
        f"save_figure(plot_refinement(r, s.x1, s.x2), {str(tmp_path / 'a.svg')!r})\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "a.svg").exists()
