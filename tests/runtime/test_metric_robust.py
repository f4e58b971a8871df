"""Covariances of calibrated scenes under robust losses, and with a covariance a measurement."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.two_view.losses import Loss
from epigauge.uncertainty.influence import RobustFit
from numpy.typing import NDArray

from tests.metric_dense import Dense, assert_same, conditions
from tests.metric_scenes import metric_scene

Array = NDArray[np.float64]


def ellipses(count: int, rng: np.random.Generator) -> Array:
    """Return covariances (count, 2, 2) of all directions and ratios of axes up to ten."""
    angle = rng.uniform(0.0, np.pi, count)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    axes = rng.uniform(0.2, 2.0, (count, 2)) ** 2
    turn = turn.transpose(2, 0, 1)
    return np.asarray((turn * axes[:, None]) @ np.swapaxes(turn, 1, 2))


def white(C: Array, values: Array) -> Array:
    """Return rows (2 N, ...) whitened by hand: L^-1 with C = L L^T."""
    L = np.linalg.cholesky(C)
    return np.linalg.solve(L, values.reshape(len(C), 2, -1)).reshape(values.shape)


def disturbed(
    xy: Array, rng: np.random.Generator, share: float, off: float = 40.0, noise_px: float = 1.0
) -> Array:
    """Return measurements with noise, and a share of them far off."""
    found = xy + noise_px * rng.standard_normal(xy.shape)
    wrong = rng.choice(len(xy), round(share * len(xy)), replace=False)
    angle = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
    found[wrong] += off * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(found)


def test_covariances_of_measurements_weigh_as_whitening_by_hand() -> None:
    tracks, scene = metric_scene("SIMPLE_RADIAL", 7, n_points=15, noise_px=0.5)
    rng = np.random.default_rng(1)
    C = ellipses(len(tracks), rng)
    measured = eg.Tracks(tracks.view, tracks.point, tracks.xy, covariance=C)
    result = eg.bundle_adjust(measured, scene, refine="pose", ftol=1e-15)
    dense = Dense(result.reconstruction, ())
    J = white(C, dense.jacobian(lambda s: s.project(measured).ravel()))
    r = white(C, result.fun.ravel())
    assert np.abs(J.T @ r).max() < 1e-5 * np.abs(J).max()
    assert result.cost == pytest.approx(0.5 * measured.unit**2 * float(r @ r), rel=1e-9)
    datum, conditioned = conditions(dense, "all points")
    options: dict[str, Any] = {"refine": "pose"}
    cov = eg.covariance(measured, result.reconstruction, datum, measured.unit, **options)
    assert_same(cov, dense, dense.covariance(J.T @ J, conditioned), 1e-5)


def test_equal_axes_are_one_sigma_and_axes_of_the_image_two() -> None:
    tracks, scene = metric_scene("PINHOLE", 3, n_points=15, noise_px=0.5)
    rng = np.random.default_rng(2)
    sigma = rng.uniform(0.3, 2.0, (len(tracks), 2))
    rows = tracks.view, tracks.point, tracks.xy
    C = np.zeros((len(tracks), 2, 2))
    C[:, [0, 1], [0, 1]] = sigma**2
    found = [
        eg.bundle_adjust(t, scene, refine="pose", ftol=1e-14).reconstruction.X
        for t in (eg.Tracks(*rows, sigma=sigma), eg.Tracks(*rows, covariance=C))
    ]
    np.testing.assert_allclose(*found, rtol=1e-8, atol=1e-9)
    alike = eg.Tracks(*rows, covariance=4.0 * np.eye(2))
    assert alike.unit == pytest.approx(2.0)
    np.testing.assert_allclose(alike.weights, 1.0)


def test_sightings_of_one_point_are_merged_by_their_information() -> None:
    """Two measurements with covariances cost what their mean costs, but for a constant."""
    tracks, scene = metric_scene("PINHOLE", 4, n_points=15)
    rng = np.random.default_rng(3)
    again = np.sort(rng.choice(len(tracks), 9, replace=False))
    rows = np.r_[np.arange(len(tracks)), again]
    xy = tracks.xy[rows] + rng.standard_normal((len(rows), 2))
    C = ellipses(len(rows), rng)
    both = eg.Tracks(tracks.view[rows], tracks.point[rows], xy, covariance=C, repeated=True)
    merged, constant = both.merged()
    assert len(merged) == len(tracks)
    C = C[both.order]

    def cost(measured: Array, predicted: Array) -> float:
        r = white(C, (measured - predicted).ravel())
        return 0.5 * both.unit**2 * float(r @ r)

    for offset in (0.0, 3.0):
        moved = eg.MetricReconstruction(scene.R, scene.t + 0.01 * offset, scene.X, scene.cameras)
        r = merged.xy - moved.project(merged)
        assert merged.whitening is not None
        r = np.einsum("ijn,nj->ni", merged.whitening, r)
        ours = 0.5 * float(merged.weights @ np.sum(r**2, axis=1)) + constant
        assert ours == pytest.approx(cost(both.xy, moved.project(both)), rel=1e-10)


@pytest.mark.parametrize("each", ["alike", "covariance"])
def test_a_robust_covariance_equals_the_dense_sandwich(each: str) -> None:
    """With priors of all kinds, whose noise no loss cuts."""
    tracks, scene = metric_scene("SIMPLE_RADIAL", 1, n_points=24, n_cameras=1, visible=1.0)
    rng = np.random.default_rng(6)
    xy = disturbed(tracks.xy, rng, 0.1, 20.0)
    N = len(tracks)
    C = ellipses(N, rng) if each == "covariance" else np.broadcast_to(np.eye(2), (N, 2, 2))
    tracks = eg.Tracks(tracks.view, tracks.point, xy, covariance=C)
    noise_px = tracks.unit
    priors = [
        eg.Distance(2, 5, 1.01 * float(np.linalg.norm(scene.X[2] - scene.X[5])), 0.003),
        eg.PointPrior(0, scene.X[0], sigma=0.02),
        eg.IntrinsicPrior(0, "f", scene.cameras.params[0, 0], 0.7),
    ]
    options: dict[str, Any] = {"refine": ("f", "k"), "priors": priors}
    r = eg.bundle_adjust(tracks, scene, loss="huber", ftol=1e-13, **options)
    robust: dict[str, Any] = {"loss": "huber", "loss_scale_px": r.loss_scale_px}
    cov = eg.covariance(tracks, r.reconstruction, None, **robust, **options)

    dense, found = Dense(r.reconstruction, ("f", "k")), r.reconstruction
    J = white(C, dense.jacobian(lambda s: s.project(tracks).ravel())) * noise_px
    residuals = (noise_px * white(C, r.fun.ravel())).reshape(-1, 2)
    unit = np.sqrt(np.linalg.det(C)) ** -1 * noise_px**2
    if each == "alike":
        unit = np.ones(N)
    J, residuals = (
        J.reshape(N, 2, -1) / np.sqrt(unit)[:, None, None],
        residuals / np.sqrt(unit)[:, None],
    )
    known = np.zeros((5, dense.size))
    apart = found.X[2] - found.X[5]
    known[0, dense.point(2)] = apart / np.linalg.norm(apart) / 0.003
    known[0, dense.point(5)] = -known[0, dense.point(2)]
    known[1:4, dense.point(0)] = np.eye(3) / 0.02
    known[4, dense.camera(0).start] = 1.0 / 0.7
    known *= noise_px
    fit = RobustFit.of(residuals, unit, Loss("huber", r.loss_scale_px), dense.size - 3 - len(known))
    assert len(fit.wrong) > 5
    L = known.T @ known
    A = np.einsum("k,kip,kiq->pq", fit.weights, J, J) + L
    # A bar and a point leave three turns.
    G = dense.similarities()
    held = known @ G / np.linalg.norm(G, axis=0)
    free = np.linalg.svd(held)[2][4:].T / np.linalg.norm(G, axis=0)[:, None]
    conditioned = np.zeros((dense.size, 3))
    conditioned[dense.point(0).start :] = (G @ free)[dense.point(0).start :]
    X = dense.covariance(A, conditioned)
    moved = np.einsum("kip,p->ki", J, X @ np.einsum("kip,ki->p", J[fit.wrong], fit.psi))
    said = fit.influence(moved)
    B = said.kappa * (A - L) + L
    B += np.einsum("kip,kij,kjq->pq", J[said.wrong], said.rest, J[said.wrong])
    assert cov.open == 3
    assert cov.noise_px == pytest.approx(said.noise, rel=1e-6)
    assert_same(cov, dense, said.noise**2 * X @ B @ X, 2e-5)


@pytest.mark.parametrize("model", ["bal", "brown"])
def test_without_influence_of_the_loss_it_is_the_plain_covariance(model: str) -> None:
    """Noise within a disc leaves no observation beyond the cut."""
    tracks, scene = metric_scene(model, 5, n_points=30)
    rng = np.random.default_rng(4)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, len(tracks)), np.sqrt(rng.random(len(tracks)))
    xy = tracks.xy + (radius * np.array([np.cos(angle), np.sin(angle)])).T
    tracks = eg.Tracks(tracks.view, tracks.point, xy)
    found = eg.bundle_adjust(tracks, scene, refine="pose").reconstruction
    options: dict[str, Any] = {"refine": "pose"}
    plain = eg.covariance(tracks, found, **options)
    wide = eg.covariance(tracks, found, loss="huber", loss_scale_px=1e4, **options)
    for part in (("camera", 1), ("point", 3)):
        np.testing.assert_allclose(wide.between(part, part), plain.between(part, part), rtol=1e-6)
    np.testing.assert_allclose(wide.std.points, plain.std.points, rtol=1e-7)


def test_a_robust_loss_costs_its_efficiency() -> None:
    """Of normal noise of known size: 95 % for the scale that is chosen by itself."""
    tracks, scene = metric_scene("PINHOLE", 2, n_views=8, n_points=150, visible=1.0)
    rng = np.random.default_rng(5)
    tracks = eg.Tracks(tracks.view, tracks.point, disturbed(tracks.xy, rng, 0.0))
    ratios = {}
    for loss in ("linear", "huber", "cauchy"):
        found = eg.bundle_adjust(tracks, scene, refine="pose", loss=loss).reconstruction
        spread = eg.covariance(tracks, found, loss=loss, refine="pose").std.points
        ratios[loss] = float(np.sum(spread**2))
    # 1.03 and 1.05, to a twentieth by the noise that each estimates; without kappa 1.2 and 1.4.
    assert ratios["huber"] / ratios["linear"] == pytest.approx(1.03, abs=0.07)
    assert ratios["cauchy"] / ratios["linear"] == pytest.approx(1.05, abs=0.07)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loss", "share", "off"), [("huber", 0.0, 0.0), ("huber", 0.05, 40.0), ("cauchy", 0.15, 5.0)]
)
def test_errors_of_many_runs_are_as_promised(loss: str, share: float, off: float) -> None:
    """Monte Carlo: ratios of lengths and angles, which no datum changes, 30 runs."""
    blank, scene = metric_scene("SIMPLE_RADIAL", 9, n_views=5, n_points=30, visible=1.0)
    clean, squares = scene.project(blank), []
    picks = [(0, 1, 2, 3), (4, 5, 6, 7), (8, 9, 10, 11), (12, 13, 14, 15), (16, 17, 18, 19)]

    def quantities(s: eg.MetricReconstruction) -> Array:
        length = np.linalg.norm
        ratios = [length(s.X[a] - s.X[b]) / length(s.X[c] - s.X[d]) for a, b, c, d in picks]
        return np.r_[ratios, s.cameras.params[0, 0]]

    truth = quantities(scene)
    for seed in range(30):
        xy = disturbed(clean, np.random.default_rng(seed), share, off)
        tracks = eg.Tracks(blank.view, blank.point, xy)
        r = eg.bundle_adjust(tracks, scene, refine=("f",), loss=loss)
        cov = eg.covariance(
            *(tracks, r.reconstruction),
            loss=loss,
            loss_scale_px=r.loss_scale_px,
            refine=("f",),
        )
        sigma = [cov.ratio((a, b), (c, d))[1] for a, b, c, d in picks]
        sigma.append(cov.std.intrinsics[0, 0])
        squares.append(((quantities(r.reconstruction) - truth) / sigma) ** 2)
    # 180 squares, weakly correlated: a deviation of 0.11.
    assert 0.7 <= np.mean(np.minimum(squares, 16.0)) <= 1.4
