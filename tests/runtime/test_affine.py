"""Affine cameras: reconstruction, start by factorization, adjustment, verdicts."""

from __future__ import annotations

import copy
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]


def scene(
    n: int = 6,
    m: int = 40,
    *,
    seed: int = 0,
    noise_px: float = 1.0,
    seen: float = 1.0,
    depth: float = 1.0,
) -> tuple[eg.Tracks, eg.AffineReconstruction]:
    """Return noisy tracks of affine cameras and points, and the truth."""
    rng = np.random.default_rng(seed)
    P = 100.0 * rng.standard_normal((n, 2, 4)) + np.array([0.0, 0.0, 0.0, 300.0])
    X = rng.uniform(-1.0, 1.0, (m, 3)) * np.array([1.0, 1.0, depth])
    truth = eg.AffineReconstruction(P, X)
    sees = rng.random((m, n)) < seen
    sees[:, :2] = True
    point, view = np.nonzero(sees)
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = truth.project(blank) + noise_px * rng.standard_normal((len(view), 2))
    return eg.Tracks(blank.view, blank.point, xy), truth


@pytest.mark.parametrize("seed", range(2))
def test_full_tracks_are_factored_to_the_minimum(seed: int) -> None:
    """The best matrix of rank three of the centred measurements (Tomasi and Kanade)."""
    tracks, _ = scene(seed=seed)
    found = eg.bundle_adjust(tracks, eg.initialize_affine(tracks))
    matrix = np.zeros((tracks.n_views, 2, tracks.n_points))
    matrix[tracks.view, :, tracks.point] = tracks.xy
    matrix = (matrix - matrix.mean(axis=2, keepdims=True)).reshape(-1, tracks.n_points)
    values = np.linalg.svd(matrix, compute_uv=False)
    assert found.cost == pytest.approx(0.5 * np.sum(values[3:] ** 2), rel=1e-10)
    assert found.success
    assert found.flags == ()
    assert found.rank == 8 * tracks.n_views + 3 * tracks.n_points - 12
    assert isinstance(found.reconstruction, eg.AffineReconstruction)


@pytest.mark.parametrize("backend", ["c", "numpy"])
def test_missing_points_lead_to_the_minimum_near_the_truth(backend: str) -> None:
    many_views.need_backend(backend)
    tracks, truth = scene(seen=0.4, seed=3)
    start = eg.initialize_affine(tracks, backend=backend)
    found = eg.bundle_adjust(tracks, start, backend=backend)
    best = eg.bundle_adjust(tracks, truth, backend=backend, ftol=1e-12)
    assert found.cost == pytest.approx(best.cost, rel=1e-7)
    assert found.rank == 8 * tracks.n_views + 3 * tracks.n_points - 12


def test_exact_images_end_at_rounding() -> None:
    tracks, truth = scene(noise_px=0.0, seen=0.5)
    found = eg.bundle_adjust(tracks, eg.initialize_affine(tracks))
    assert found.success
    assert found.rms_px < 1e-9
    # The same shape: some affine change of space takes one to the other.
    mine = np.column_stack([found.reconstruction.X, np.ones(tracks.n_points)])
    T = np.linalg.lstsq(mine, truth.X, rcond=None)[0]
    assert np.abs(mine @ T - truth.X).max() < 1e-9


def test_every_affine_frame_takes_the_same_steps() -> None:
    tracks, truth = scene(seen=0.5)
    rng = np.random.default_rng(1)
    start = eg.AffineReconstruction(
        truth.P[:, :2], truth.X + 0.1 * rng.standard_normal(truth.X.shape)
    )
    T = np.eye(4)
    T[:3] = [[3.0, 1.0, 0.0, 500.0], [0.0, 0.2, 0.1, -70.0], [1.0, 0.0, 2.0, 9.0]]
    moved = eg.gauge.transform(start, T)
    assert np.abs(moved.project(tracks) - start.project(tracks)).max() < 1e-10
    one, other = (eg.bundle_adjust(tracks, s, ftol=1e-12) for s in (start, moved))
    assert [row.cost for row in other.history] == pytest.approx(
        [row.cost for row in one.history], rel=1e-9
    )
    for method in ("levenberg", "marquardt", "free"):
        assert eg.bundle_adjust(tracks, start, method=method, ftol=1e-12).cost == pytest.approx(
            one.cost, rel=1e-9
        )


def test_what_is_fixed_stays_and_counts_as_known() -> None:
    tracks, truth = scene()
    found = eg.bundle_adjust(tracks, truth, fixed_views=[0], fixed_points=[1, 2])
    assert np.array_equal(found.reconstruction.P[0], truth.P[0])
    assert np.array_equal(found.reconstruction.X[1:3], truth.X[1:3])
    # Of the changes of space four move all points along the sight of a view; two points leave two.
    assert found.rank == 8 * (tracks.n_views - 1) + 3 * (tracks.n_points - 2) - 2
    assert found.success


@pytest.mark.parametrize("seen", [1.0, 0.7])
def test_flat_scenes_are_told(seen: float) -> None:
    """Of a plane, noise is all that is left for the third dimension."""
    tracks, _ = scene(depth=0.0, seen=seen)
    flat = eg.bundle_adjust(tracks, eg.initialize_affine(tracks))
    assert {"undetermined", "weak geometry"} & set(flat.flags)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"refine": "pose"}, "refine"),
        ({"refine": ("f",)}, "refine"),
        ({"priors": [eg.PointPrior(0, (0, 0, 0), sigma=1.0)]}, "priors"),
        ({"fixed_views": [9]}, "fixed_views.*9"),
        ({"fixed_views": range(6), "fixed_points": range(40)}, "fixed_views"),
        ({"method": "hartley"}, "method.*hartley"),
        ({"method": "mclauchlan"}, "method.*mclauchlan"),
        ({"gauge": eg.gauge.normalized()}, "gauge"),
    ],
)
def test_options_of_other_cameras_are_refused(options: dict[str, Any], named: str) -> None:
    with pytest.raises(eg.ArgumentError, match=named):
        eg.bundle_adjust(*scene(), **options)


def test_bad_affine_reconstructions_are_refused() -> None:
    P, X = np.ones((3, 2, 4)), np.zeros((5, 3))
    rows = np.broadcast_to([0.0, 0.0, 0.0, 2.0], (3, 1, 4))
    for bad, named in (
        ((np.concatenate([P, rows], axis=1), X), "third row"),
        ((P[:, :1], X), "P has shape"),
        ((np.where(P == 1.0, np.nan, P), X), "nan"),
        ((P, X[:0]), "X has no row"),
        ((P, X[:, :2]), "X has shape"),
    ):
        with pytest.raises(eg.ArgumentError, match=named):
            eg.AffineReconstruction(*bad)
    whole = eg.AffineReconstruction(P, X)
    assert repr(copy.deepcopy(whole)) == "AffineReconstruction(3 views, 5 points)"
    with pytest.raises(eg.ArgumentError, match="last row"):
        eg.gauge.transform(whole, 2.0 * np.eye(4))
    with pytest.raises(eg.ArgumentError, match="camera_scales"):
        eg.gauge.transform(whole, np.eye(4), 2.0)  # type: ignore[call-overload]
    with pytest.raises(eg.ArgumentError, match="tracks"):
        whole.project(scene()[0])


def test_the_projective_scene_shows_the_same() -> None:
    tracks, truth = scene()
    same = truth.to_projective()
    assert np.abs(same.project(tracks) - truth.project(tracks)).max() < 1e-10


def test_covariances_of_affine_cameras_are_refused() -> None:
    with pytest.raises(eg.ArgumentError, match="reconstruction is a AffineReconstruction"):
        eg.covariance(*scene())  # type: ignore[call-overload]
