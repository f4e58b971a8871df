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


@pytest.mark.parametrize(
    "options",
    [
        {"method": "kanatani"},
        {"method": "mclauchlan"},
        {"method": "levenberg", "gauge": eg.gauge.normalized()},
        {"method": "levenberg", "gauge": eg.gauge.normalized(), "gauge_mode": "implicit"},
    ],
)
def test_normalised_gauges_lead_to_the_same_minimum(options: dict[str, Any]) -> None:
    tracks, truth = scene(seen=0.6, seed=2)
    rng = np.random.default_rng(1)
    start = eg.AffineReconstruction(
        truth.P[:, :2], truth.X + 0.05 * rng.standard_normal(truth.X.shape)
    )
    best = eg.bundle_adjust(tracks, start, ftol=1e-13)
    found = eg.bundle_adjust(tracks, start, ftol=1e-13, **options)
    assert found.cost == pytest.approx(best.cost, rel=1e-8)
    if options.get("gauge_mode") != "implicit":  # in the gauge: mean zero, covariance one
        X = found.reconstruction.X
        assert np.abs(X.mean(axis=0)).max() < 1e-9
        assert np.abs(X.T @ X / len(X) - np.eye(3)).max() < (
            0.1 if "gauge" not in options else 1e-9
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
        ({"method": "faugeras"}, "method.*faugeras.*kanatani"),
        ({"method": "gauge_invariant"}, "method"),
        ({"gauge": eg.gauge.two_cameras()}, "gauge"),
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


def dense_covariance(tracks, found, conditions):
    """Return the covariance of all cameras' and points' numbers from the bordered normal matrix."""
    n, m = found.n_views, found.n_points
    J = np.zeros((2 * len(tracks), 8 * n + 3 * m))
    for row, (i, j) in enumerate(zip(tracks.view, tracks.point, strict=True)):
        J[2 * row, 8 * i : 8 * i + 4] = J[2 * row + 1, 8 * i + 4 : 8 * i + 8] = [*found.X[j], 1.0]
        J[2 * row : 2 * row + 2, 8 * n + 3 * j : 8 * n + 3 * j + 3] = found.P[i, :2, :3]
    weighted = np.repeat(tracks.weights, 2)[:, None] * J
    C = conditions(n, m)
    none = np.zeros((C.shape[1], C.shape[1]))
    whole = np.block([[J.T @ weighted, C], [C.T, none]])
    scale = 1.0 / np.sqrt(np.maximum(np.abs(whole).max(axis=0), 1e-12))
    return (scale[:, None] * np.linalg.inv(scale[:, None] * whole * scale) * scale)[: J.shape[1]][
        :, : J.shape[1]
    ]


@pytest.mark.parametrize("datum", ["inner", "some", "four"])
def test_covariances_are_those_of_the_bordered_normal_matrix(datum) -> None:
    rng = np.random.default_rng(4)
    view, point = (a.ravel() for a in np.meshgrid(np.arange(4), np.arange(9), indexing="ij"))
    P, X = rng.normal(0.0, 40.0, (4, 2, 4)), rng.normal([5.0, 0.0, 2.0], [1.0, 2.0, 3.0], (9, 3))
    xy = np.einsum("kij,kj->ki", P[view], np.column_stack([X, np.ones(9)])[point])
    xy += rng.normal(0.0, 0.3, xy.shape)
    tracks = eg.Tracks(view, point, xy, weights=rng.uniform(0.5, 2.0, 36))
    found = eg.bundle_adjust(tracks, eg.AffineReconstruction(P, X), ftol=1e-14).reconstruction
    own = [2, 3, 5, 6, 8]
    gauges = {
        "inner": "inner",
        "some": eg.gauge.inner(points=own),
        "four": eg.gauge.five_points([1, 4, 6, 7]),
    }

    def conditions(n, m):
        C = np.zeros((8 * n + 3 * m, 12))
        those = {"inner": range(m), "some": own, "four": [1, 4, 6, 7]}[datum]
        for k, j in enumerate(those):
            # All affine motions of a point, or each of its coordinates.
            rows = slice(8 * n + 3 * j, 8 * n + 3 * j + 3)
            if datum == "four":
                C[rows, 3 * k : 3 * k + 3] = np.eye(3)
            else:
                C[rows] = np.kron(np.eye(3), [*found.X[j], 1.0])
        return C

    cov = eg.covariance(tracks, found, gauges[datum], noise_px=0.3)
    wanted = 0.3**2 * dense_covariance(tracks, found, conditions)
    size = np.abs(wanted).max()
    for i in range(4):
        np.testing.assert_allclose(
            cov.camera(i), wanted[8 * i : 8 * i + 8, 8 * i : 8 * i + 8], atol=1e-8 * size
        )
    at = [slice(32 + 3 * j, 35 + 3 * j) for j in range(9)]
    largest = np.abs(wanted[32:, 32:]).max()
    for j in range(9):
        np.testing.assert_allclose(cov.point(j), wanted[at[j], at[j]], atol=1e-8 * largest)
    across = cov.between(("camera", 1), ("point", 2))
    np.testing.assert_allclose(across, wanted[8:16, at[2]], atol=1e-8 * np.sqrt(size * largest))
    np.testing.assert_allclose(cov.std.points[3] ** 2, np.diag(cov.point(3)), atol=1e-12 * largest)
    np.testing.assert_allclose(
        cov.std.cameras[2].ravel() ** 2, np.diag(cov.camera(2)), atol=1e-10 * size
    )
    moved = eg.covariance(tracks, found, noise_px=0.3).in_gauge(gauges[datum])
    np.testing.assert_allclose(moved.point(0), cov.point(0), atol=1e-10 * largest)
    assert cov.open == 12
    assert cov.redundancy == 72 - 8 * 4 - 3 * 9 + 12


def test_covariance_says_what_it_does_not_know() -> None:
    tracks, found = scene(n=5)
    held = eg.covariance(tracks, found, noise_px=1.0, fixed_points=[0, 1, 2, 3])
    assert held.open == 0
    assert not held.point(2).any()
    for gauge in (eg.gauge.two_cameras(), eg.gauge.inner(views=[0])):
        with pytest.raises(eg.ArgumentError, match="gauge"):
            eg.covariance(tracks, found, gauge)
    with pytest.raises(eg.ArgumentError, match="loss"):
        eg.covariance(tracks, found, loss="huber")  # type: ignore[call-overload]
    with pytest.raises(eg.ArgumentError, match="refine"):
        eg.covariance(tracks, found, refine="pose")  # type: ignore[call-overload]
    with pytest.raises(eg.ArgumentError, match="below 5"):
        eg.covariance(tracks, found).camera(5)


@pytest.mark.parametrize("kind", ["affine", "projective"])
def test_scenes_go_through_files(tmp_path, kind) -> None:
    tracks, _ = scene(n=5)
    tracks = eg.Tracks(tracks.view, tracks.point, tracks.xy, names=[f"{k}.jpg" for k in range(5)])
    start = eg.initialize_affine(tracks)
    made = start if kind == "affine" else start.to_projective()
    eg.save_scene(tmp_path / "s.npz", tracks, made)
    again, found = eg.load_scene(tmp_path / "s.npz")
    assert type(found) is type(made)
    assert again.names == tracks.names
    for name in ("P", "X" if kind == "affine" else "Q"):
        np.testing.assert_array_equal(getattr(found, name), getattr(made, name))
    for name in ("folder", "p.txt"):
        with pytest.raises(eg.ArgumentError, match=r"\.npz"):
            eg.save_scene(tmp_path / name, tracks, made)
    with pytest.raises(eg.ArgumentError, match="tracks are of 5 views"):
        type(made)(made.P[:4], made.X if kind == "affine" else made.Q).project(tracks)
