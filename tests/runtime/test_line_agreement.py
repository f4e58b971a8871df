"""Wrong segments and wild start lines: told, left out, or refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> eg.LineScene:
    return eg.line_scene(n_views=6, n_points=20, n_lines=20, seed=2)


def off(found: Array, wanted: Array | None) -> Array:
    """Return the distances of lines from others, their signs being free."""
    assert wanted is not None
    sign = np.sign(np.sum(found[:, 3:] * wanted[:, 3:], axis=1))[:, None]
    return np.linalg.norm(found * sign - wanted, axis=1)


def adjusted(scene: eg.LineScene, start: Any, lines: eg.LineTracks, **options: Any) -> Any:
    return eg.bundle_adjust(scene.tracks, start, lines=lines, refine="pose", **options)


def with_segments(lines: eg.LineTracks, segments: Array) -> eg.LineTracks:
    return eg.LineTracks(lines.view, lines.line, segments)


def with_wrong(lines: eg.LineTracks, count: int, seed: int = 0) -> tuple[eg.LineTracks, set[int]]:
    """Return segments, one in so many lines far off, and which."""
    random = np.random.default_rng(seed)
    segments = lines.segments.copy()
    chosen = random.choice(lines.n_lines, count, replace=False)
    rows = [int(random.choice(np.flatnonzero(lines.line == k))) for k in chosen]
    # Moved across and turned: by 100 px at both ends, to different sides.
    along = segments[rows, 2:] - segments[rows, :2]
    across = along[:, ::-1] * [-1.0, 1.0] / np.linalg.norm(along, axis=1, keepdims=True)
    segments[rows] += 100.0 * np.concatenate([across, -0.4 * across], axis=1)
    return with_segments(lines, segments), set(rows)


def test_a_wild_start_line_changes_nothing(scene: eg.LineScene) -> None:
    assert scene.true.lines is not None
    random, wild = np.random.default_rng(1), scene.true.lines.copy()
    for k in (3, 11):
        X, v = 8.0 * random.standard_normal(3), random.standard_normal(3)
        wild[k] = np.concatenate([np.cross(X, v), v])
    found = adjusted(scene, dataclasses.replace(scene.true, lines=wild), scene.line_tracks)
    wanted = adjusted(scene, scene.true, scene.line_tracks)
    assert not found.flags
    np.testing.assert_allclose(found.cost, wanted.cost, rtol=1e-7)


def test_a_segment_that_disagrees_is_left_out(scene: eg.LineScene) -> None:
    wrong, _ = with_wrong(scene.line_tracks, 8)
    found = eg.triangulate_lines(wrong, scene.true)
    wanted = eg.triangulate_lines(scene.line_tracks, scene.true)
    assert off(found, wanted).max() < 0.1
    assert np.median(off(found, scene.true.lines)) < 0.03
    # With the noise of the images only where segments are right.
    touched = np.flatnonzero(off(found, wanted) > 1e-9)
    assert len(touched) == 8


def test_wrong_segments_are_named_and_a_robust_loss_bears_them(scene: eg.LineScene) -> None:
    start = dataclasses.replace(scene.true, lines=None)
    wrong, rows = with_wrong(scene.line_tracks, 4, seed=3)
    found = adjusted(scene, start, wrong)
    assert "wrong segments" in found.flags
    robust = adjusted(scene, start, wrong, loss="cauchy")
    assert robust.success
    far = np.flatnonzero(np.abs(robust.line_fun).max(axis=1) > 12.0)
    assert set(far.tolist()) == rows
    clean = adjusted(scene, start, scene.line_tracks).reconstruction
    reached = off(robust.reconstruction.lines, scene.true.lines).max()
    assert reached < 1.5 * off(clean.lines, scene.true.lines).max()
    assert "wrong segments" not in adjusted(scene, start, scene.line_tracks).flags


def test_a_line_of_segments_that_have_none_is_refused(scene: eg.LineScene) -> None:
    lines, random = scene.line_tracks, np.random.default_rng(5)
    segments, those = lines.segments.copy(), lines.line == 7
    segments[those] = random.uniform(-300, 300, (int(those.sum()), 4))
    mixed = with_segments(lines, segments)
    with pytest.raises(eg.ArgumentError, match=r"1 lines that half of their .*: 7; needed"):
        eg.triangulate_lines(mixed, scene.true)
    start = dataclasses.replace(scene.true, lines=None)
    with pytest.raises(eg.ArgumentError, match="lines have 1 lines that half"):
        adjusted(scene, start, mixed)
    with pytest.raises(eg.ArgumentError, match="start has 1 lines that half"):
        adjusted(scene, scene.true, mixed)


def test_three_segments_tell_no_wrong_one() -> None:
    scene = eg.line_scene(n_views=3, n_points=12, n_lines=6, seed=1)
    wrong, _ = with_wrong(scene.line_tracks, 1, seed=4)
    # Any two of three agree: none is left out, and the adjustment tells.
    found = adjusted(scene, dataclasses.replace(scene.true, lines=None), wrong)
    assert "wrong segments" in found.flags
