"""Ways in which other systems fail: each is an error with a message, or a result that says so."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from two_views import same_geometry, up_to_sign


@pytest.fixture
def view() -> eg.TwoViewScene:
    return eg.two_view_scene(5.0, seed=0)


def test_unequal_lengths_are_refused(view) -> None:
    with pytest.raises(eg.ArgumentError, match="x2"):
        eg.refine_fundamental(view.x1, view.x2[:-1])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_refused(view, value) -> None:
    x1 = view.x1.copy()
    x1[3, 1] = value
    with pytest.raises(eg.ArgumentError, match="row 3"):
        eg.refine_fundamental(x1, view.x2)
    with pytest.raises(eg.ArgumentError, match="F0"):
        eg.refine_fundamental(view.x1, view.x2, np.full((3, 3), value))


@pytest.mark.parametrize("m", [0, 1, 5, 7])
def test_too_few_matches_are_refused(view, m) -> None:
    with pytest.raises(eg.ArgumentError):
        eg.refine_fundamental(view.x1[:m], view.x2[:m])


def test_eight_matches_are_flagged(view) -> None:
    assert "few matches" in eg.refine_fundamental(view.x1[:8], view.x2[:8]).flags


def test_mistyped_options_are_errors(view) -> None:
    with pytest.raises(TypeError, match="los_scale_px"):
        eg.refine_fundamental(view.x1, view.x2, los_scale_px=2.0)  # type: ignore[call-arg]
    with pytest.raises(eg.ArgumentError, match="did you mean 'cauchy'"):
        eg.refine_fundamental(view.x1, view.x2, loss="cauchi")


@pytest.mark.parametrize("noise", [0.05, 1.4, 10.0])
def test_scale_of_the_loss_follows_the_noise(noise) -> None:
    view = eg.two_view_scene(4.0, noise_px=noise, n_points=400, seed=0)
    result = eg.refine_fundamental(view.x1, view.x2, loss="cauchy")
    assert result.loss_scale_px == pytest.approx(2.385 * noise, rel=0.15)


def test_a_start_is_used(view) -> None:
    start = eg.fundamental_8point(view.x1, view.x2)
    best = eg.refine_fundamental(view.x1, view.x2, start)
    again = eg.refine_fundamental(view.x1, view.x2, best.F)
    assert again.nit <= 2
    assert up_to_sign(again.F, best.F) < 1e-6


def test_an_origin_a_million_pixels_away_costs_no_accuracy(view) -> None:
    near = eg.refine_fundamental(view.x1, view.x2)
    far = eg.refine_fundamental(view.x1 + 1e6, view.x2 + 1e6)
    # Coordinates near 1e6 are rounded to 1e-10 px
    assert far.cost == pytest.approx(near.cost, rel=1e-7)
    assert far.rms_px == pytest.approx(near.rms_px, rel=1e-7)


def test_results_have_rank_two(view) -> None:
    for parameterization in ("ortho", "block", "maps", "parfree", "free", "normalized"):
        F = eg.refine_fundamental(view.x1, view.x2, parameterization=parameterization).F
        s = np.linalg.svd(F, compute_uv=False)
        assert s[2] <= 1e-15 * s[0]


def test_a_start_of_rank_three_is_accepted(view) -> None:
    F0 = view.F_true + 1e-6 * np.random.default_rng(0).standard_normal((3, 3))
    assert np.linalg.matrix_rank(F0) == 3
    result = eg.refine_fundamental(view.x1, view.x2, F0)
    best = eg.refine_fundamental(view.x1, view.x2)
    assert same_geometry(result.F, best.F, view.x1, view.x2) < 1e-3


@pytest.mark.parametrize("sigma", [0.9999, 1.0])
def test_covariance_exists_at_sigma_one(sigma) -> None:
    rng = np.random.default_rng(5)
    U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
    F = U @ np.diag([1.0, sigma, 0.0]) @ V.T
    _, x1, x2 = eg.reprojection_distances(F, *rng.uniform(-2, 2, (2, 40, 2)))
    result = eg.refine_fundamental(x1, x2, F, noise_px=1e-3)
    assert np.isfinite(result.covariance).all()
    assert result.rank == 7


def test_planar_scene_and_pure_rotation_are_flagged() -> None:
    rng = np.random.default_rng(3)
    K = np.array([[1000.0, 0.0, 500.0], [0.0, 1000.0, 400.0], [0.0, 0.0, 1.0]])
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (80, 2)), np.ones(80)])
    angle = 0.2
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    plane = 5 * rays / (1 + 0.3 * rays[:, :1] - 0.2 * rays[:, 1:2])
    for X, t, expected in (
        (plane, np.array([-1.0, 0.2, 0.1]), {"planar scene"}),
        (rays * rng.uniform(3, 9, (80, 1)), np.zeros(3), {"planar scene", "pure rotation"}),
    ):
        h1, h2 = X @ K.T, (X @ R.T + t) @ K.T
        x1, x2 = (h[:, :2] / h[:, 2:] + 0.5 * rng.standard_normal((80, 2)) for h in (h1, h2))
        flags = set(eg.refine_fundamental(x1, x2).flags)
        assert flags & {"planar scene", "pure rotation"} == expected


def test_local_minima_are_found_and_told() -> None:
    view = eg.two_view_scene(16.0, seed=1)
    result = eg.refine_fundamental(view.x1, view.x2, starts=8)
    assert len(result.minima) > 1
    assert result.ambiguous
