"""Tracks with gross errors: the start, the adjustment and what is set aside."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import kernels
from epigauge.bundle.observations import ObservationGraph
from epigauge.multi_view.agreement import agreed_camera, agreed_fundamental, agreed_points
from epigauge.multi_view.frame import Frame
from laws import distance
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def spoiled(tracks: eg.Tracks, share: float, seed: int) -> tuple[eg.Tracks, Mask]:
    """Return tracks with a share of uniform observations, and which are right."""
    rng = np.random.default_rng(seed)
    right = np.ones(len(tracks), dtype=np.bool_)
    right[rng.choice(len(tracks), round(share * len(tracks)), replace=False)] = False
    xy = tracks.xy.copy()
    low, high = xy.min(axis=0), xy.max(axis=0)
    xy[~right] = rng.uniform(low, high, (int(np.sum(~right)), 2))
    return eg.Tracks(tracks.view, tracks.point, xy), right


def median(found: eg.BundleResult, right: Mask) -> float:
    return float(np.median(np.linalg.norm(found.fun[right], axis=1)))


@pytest.mark.parametrize(("share", "seed"), [(0.002, 0), (0.01, 1), (0.05, 0), (0.1, 1)])
def test_simulated_tracks_end_as_without_gross_errors(share: float, seed: int) -> None:
    truth = many_views.cameras_and_points(8, 150, seed=seed)
    clean = many_views.observed(truth, seen=0.7, seed=seed)
    tracks, right = spoiled(clean, share, seed)
    found = eg.bundle_adjust(tracks, robust=True)
    assert found.success
    everything = np.ones(len(clean), dtype=np.bool_)
    assert median(found, right) < 1.15 * median(eg.bundle_adjust(clean), everything)
    assert found.rejected[~right].mean() > 0.9
    # A right one goes where its point loses all others but one, and beyond six deviations.
    assert found.rejected[right].mean() < 0.5 * share + 0.01
    kept = found.fun[~found.rejected]
    assert found.rms_px == pytest.approx(np.sqrt(np.mean(kept**2)))
    assert f"{np.count_nonzero(found.rejected)} of {len(tracks)} observations" in found.message


@cache
def clean_median(data_dir: Path, name: str) -> tuple[eg.Tracks, float]:
    """Return measured tracks, and the median of their residuals without gross errors."""
    clean = many_views.real_tracks(data_dir, name)
    found = eg.bundle_adjust(clean, robust=True)
    return clean, median(found, np.ones(len(clean), dtype=np.bool_))


@pytest.mark.parametrize(
    ("name", "share", "seed"),
    [
        ("corridor", 0.002, 0),
        ("corridor", 0.1, 1),
        ("house", 0.05, 1),
        ("house", 0.1, 0),
        pytest.param("dinosaur_trimmed", 0.1, 0, marks=pytest.mark.slow),
        pytest.param("strecha_fountain_p11", 0.1, 0, marks=pytest.mark.slow),
    ],
)
def test_measured_tracks_end_as_without_gross_errors(
    data_dir: Path, name: str, share: float, seed: int
) -> None:
    clean, reference = clean_median(data_dir, name)
    tracks, right = spoiled(clean, share, seed)
    found = eg.bundle_adjust(tracks, robust=True)
    assert found.success
    assert median(found, right) < 1.15 * reference


def test_nothing_is_set_aside_of_clean_tracks() -> None:
    tracks = many_views.observed(many_views.cameras_and_points(6, 100))
    found, plain = eg.bundle_adjust(tracks, robust=True), eg.bundle_adjust(tracks)
    assert not found.rejected.any()
    assert found.cost == pytest.approx(plain.cost, rel=1e-6)
    assert "nothing set aside" in found.message


def test_what_is_kept_is_at_its_minimum() -> None:
    tracks, _ = spoiled(many_views.observed(many_views.cameras_and_points(6, 100)), 0.05, 3)
    found = eg.bundle_adjust(tracks, robust=True, ftol=1e-12)
    kept = tracks.weighted(np.where(found.rejected, 0.0, 1.0))
    again = eg.bundle_adjust(kept, found.reconstruction, ftol=1e-12)
    assert again.cost == pytest.approx(found.cost, rel=1e-9)


def test_weight_zero_stays_out_of_what_is_set_aside() -> None:
    tracks, right = spoiled(many_views.observed(many_views.cameras_and_points(6, 100)), 0.05, 3)
    off = np.arange(len(tracks)) % 11 == 0
    weighted = tracks.weighted(np.where(off, 0.0, 1.0))
    found = eg.bundle_adjust(weighted, robust=True)
    assert not found.rejected[off].any()
    assert found.rejected[~right & ~off].mean() > 0.9


def test_interrupted_by_the_callback() -> None:
    tracks, _ = spoiled(many_views.observed(many_views.cameras_and_points(5, 60)), 0.05, 0)
    found = eg.bundle_adjust(tracks, robust=True, callback=lambda row: row.iteration == 1)
    assert (found.status, found.success) == (-2, False)


# ---------------------------------------------------------------- what most agree on


@pytest.mark.parametrize("wrong", [0.1, 0.3])
def test_camera_that_most_points_agree_on(wrong: float) -> None:
    truth = many_views.cameras_and_points(2, 120)
    tracks = many_views.observed(truth, 0.0)
    frame = Frame.of(tracks)
    P, Q = frame.cameras_in(truth.P)[0], truth.Q.T
    h = P @ Q
    q = h[:2] / h[2]
    rng = np.random.default_rng(0)
    bad = rng.uniform(size=120) < wrong
    q[:, bad] = rng.uniform(-2.0, 2.0, (2, int(bad.sum())))
    found = agreed_camera(np.ascontiguousarray(q), np.ascontiguousarray(Q))
    assert distance(abs(found.ravel() @ P.ravel()) / np.linalg.norm(P), 1.0) < 1e-6


@pytest.mark.parametrize("wrong", [0.1, 0.3])
def test_fundamental_matrix_that_most_matches_agree_on(wrong: float) -> None:
    scene = eg.two_view_scene(distance=6.0, n_points=150, noise_px=0.5)
    rng = np.random.default_rng(1)
    x2 = scene.x2.copy()
    bad = rng.uniform(size=150) < wrong
    x2[bad] = rng.uniform(x2.min(axis=0), x2.max(axis=0), (int(bad.sum()), 2))
    F, agrees = agreed_fundamental(kernels.table(), scene.x1, x2)
    assert agrees[~bad].mean() > 0.97
    assert agrees[bad].mean() < 0.2
    assert np.median(np.abs(eg.sampson_distances(F, scene.x1[~bad], x2[~bad]))) < 1.0


def test_points_that_most_lines_of_sight_agree_on() -> None:
    truth = many_views.cameras_and_points(6, 80)
    clean = many_views.observed(truth, 0.0)
    xy = clean.xy.copy()
    # One wrong observation of six of every point.
    first = np.searchsorted(clean.point, np.arange(80))
    xy[first + np.arange(80) % 6] += [150.0, -90.0]
    tracks = eg.Tracks(clean.view, clean.point, xy)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    q = np.ascontiguousarray(tracks.xy.T / 1000.0)
    P, Q = many_views.in_units(truth)
    parts = kernels.table(), graph, q, np.array(tracks.weights)
    found = agreed_points(*parts, P, np.ones_like(Q), 1e-3)
    h, expected = (np.einsum("nij,nj->ni", P[tracks.view], X[tracks.point]) for X in (found, Q))
    assert distance(h[:, :2] / h[:, 2:], expected[:, :2] / expected[:, 2:]) < 1e-3
