"""What is fixed of projective cameras and points, in the verdict."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from metric_scenes import metric_scene


@pytest.mark.parametrize("n_views", [4, 14])
def test_what_is_fixed_counts_in_the_verdict(n_views: int) -> None:
    """A view of five points lacks an equation; so does all else, if this view alone is known.

    With another known view, four changes of basis are left to five points, one equation each.
    """
    tracks, truth = metric_scene("PINHOLE", 5, noise_px=0.3, n_views=n_views, visible=1.0)
    last = n_views - 1
    keep = (tracks.view != last) | (tracks.point < 5)
    few = eg.Tracks(tracks.view[keep], tracks.point[keep], tracks.xy[keep], min_points=1)
    start = truth.to_projective()
    for views, told in (((last,), True), ((0,), True), ((0, last), False), ((), True)):
        found = eg.bundle_adjust(few, start, fixed_views=views)
        assert ("undetermined" in found.flags) is told, views
        assert bool(np.isfinite(found.condition)) is not told
    points = range(8)
    held = eg.bundle_adjust(few, start, fixed_views=[last], fixed_points=points)
    assert "undetermined" not in held.flags
    assert held.rank == 11 * last + 3 * (30 - 8)
