"""Pictures of precision: bars are the standard deviations, colours those of the points."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need matplotlib")

from epigauge.plots import plot_precision, save_figure

from tests.metric_scenes import metric_scene


@pytest.mark.parametrize("cameras", [1, 30])
def test_bars_and_maps_show_the_covariance(tmp_path, cameras: int) -> None:
    views = max(cameras, 4)
    tracks, scene = metric_scene("RADIAL", 2, n_cameras=cameras, n_views=views, noise_px=0.3)
    refine = ("f", "k1") if cameras > 1 else ("f",)
    found = eg.bundle_adjust(tracks, scene, refine=refine).reconstruction
    spread = eg.covariance(tracks, found, refine=refine)
    figure = plot_precision(spread, tracks, "scene")
    heights = [bar.get_height() for bar in figure.axes[0].patches]
    known = [row[3] for row in spread.intrinsic_rows()]
    assert set(heights) <= set(known)
    assert len(heights) == min(len(known), 40)
    assert max(heights) == max(known)
    colours = figure.axes[1].collections[0].get_array()
    largest = np.sqrt(np.linalg.eigvalsh(spread.point_blocks)[:, -1])
    np.testing.assert_allclose(np.sort(colours), np.sort(largest), rtol=1e-9)
    save_figure(figure, tmp_path / "p.svg")


def test_nothing_refined_is_said() -> None:
    tracks, scene = metric_scene("PINHOLE", 1, noise_px=0.3)
    figure = plot_precision(eg.covariance(tracks, scene, refine="pose"), tracks)
    assert "no intrinsics" in figure.axes[0].texts[0].get_text()
