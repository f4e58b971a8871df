"""Flags: raised on scenes that do not determine F, silent on those that do."""

from __future__ import annotations

from dataclasses import replace

import epigauge as eg
import numpy as np
import pytest
from epigauge.kernels import available
from epigauge.two_view import diagnostics, minima
from epigauge.two_view.consensus import RANGE
from epigauge.two_view.diagnostics import (
    AFFINE,
    _variance_ratio_99,
    diagnose,
    planar_bound,
    still_bound,
)
from epigauge.two_view.evidence import evidence
from epigauge.two_view.homography import fit_homography
from epigauge.two_view.planes import HIDDEN
from epigauge.two_view.suspicion import WIDE, is_suspicious
from epigauge.verdicts import FLAGS
from two_views import algebraic, homogeneous, inliers, scene


def shares(kind: str, m: int, noise: float, trials: int, **options: object) -> dict[str, float]:
    """How often each flag is raised."""
    rng = np.random.default_rng(7)
    raised = [
        eg.refine_fundamental(*scene(kind, m, noise, rng), max_iter=40, **options).flags
        for _ in range(trials)
    ]
    return {flag: np.mean([flag in flags for flags in raised]) for flag in FLAGS}


class TestSimulated:
    @pytest.mark.parametrize(
        ("m", "noise"),
        [(20, 0.3), pytest.param(50, 1.5, marks=pytest.mark.slow), (200, 0.5)],
    )
    def test_general_scene_raises_nothing(self, m, noise) -> None:
        share = shares("general", m, noise, 12)
        assert share.pop("near-affine") <= 0.2
        assert not any(share.values()), share

    @pytest.mark.parametrize(
        ("m", "noise"),
        [
            (12, 0.5),
            pytest.param(20, 1.5, marks=pytest.mark.slow),
            pytest.param(50, 0.3, marks=pytest.mark.slow),
            (200, 1.0),
        ],
    )
    @pytest.mark.parametrize("kind", ["planar", "rotation"])
    def test_homographies_are_told(self, kind, m, noise) -> None:
        share = shares(kind, m, noise, 12)
        # 95 % over 60 trials with few matches, 99 % with many; two slips in 12 are allowed
        assert share["planar scene"] >= 0.8
        if kind == "rotation":
            assert share["pure rotation"] >= 0.8
        elif m >= 50:
            assert share["pure rotation"] <= 0.3  # a plane may look like it by chance

    @pytest.mark.parametrize("kind", ["planar", "rotation"])
    def test_without_noise_too(self, kind) -> None:
        x1, x2 = scene(kind, 40, 0.0, np.random.default_rng(1))
        flags = eg.refine_fundamental(x1, x2).flags
        assert "planar scene" in flags
        assert ("pure rotation" in flags) == (kind == "rotation")

    def test_few_matches_are_told(self) -> None:
        for m, expected in ((14, True), (15, False)):
            x1, x2 = scene("general", m, 0.3, np.random.default_rng(2))
            assert ("few matches" in eg.refine_fundamental(x1, x2).flags) == expected

    def test_near_affine_at_a_distance_only(self) -> None:
        share = []
        for distance in (2.0, 8.0):
            views = [eg.two_view_scene(distance, seed=seed) for seed in range(8)]
            flags = [eg.refine_fundamental(view.x1, view.x2).flags for view in views]
            share.append(np.mean(["near-affine" in raised for raised in flags]))
        assert share[0] == 0
        assert share[1] > 0.7

    def test_weak_geometry_grows_with_distance(self) -> None:
        share = []
        for distance in (5.0, 14.0):
            views = [eg.two_view_scene(distance, seed=seed) for seed in range(10)]
            flags = [eg.refine_fundamental(view.x1, view.x2).flags for view in views]
            share.append(np.mean(["weak geometry" in raised for raised in flags]))
        assert share[0] == 0
        assert share[1] >= 0.3

    @pytest.mark.parametrize("distance", [12.0, 20.0])
    def test_noise_that_hides_relief_is_weak_geometry_and_no_plane(self, distance) -> None:
        # Points within 80 and 50 px, a noise of 1.4: the relief of a cube is below it.
        spoiling = {"planar scene", "still camera", "pure rotation", "no common geometry"}
        for seed in range(40, 46):
            view = eg.two_view_scene(distance, seed=seed)
            result = eg.refine_fundamental(view.x1, view.x2)
            assert spoiling.isdisjoint(result.flags)
            assert result.success
            if distance == 20.0:
                assert "weak geometry" in result.flags
            fresh = eg.two_view_scene(distance, seed=seed + 1000, noise_px=0.0, n_points=200)
            # It does predict other points of the scene, to less than the noise.
            assert np.median(np.abs(algebraic(result.F, fresh.x1, fresh.x2))) < 1.0

    def test_flags_do_not_depend_on_the_noise_that_the_caller_believes(self) -> None:
        view = eg.two_view_scene(8.0, seed=0)
        flags = [
            eg.refine_fundamental(view.x1, view.x2, noise_px=noise).flags
            for noise in (0.01, 1.0, 100.0, None)
        ]
        assert len(set(flags)) == 1

    def test_matches_that_contradict_the_orientation_are_told(self) -> None:
        view = eg.two_view_scene(4.0, noise_px=0.1, n_points=60, seed=2)
        X = view.X.copy()
        X[:3] = [[3.0, 0.1 * k, -3.75, 1.0] for k in range(3)]  # behind one of the cameras
        h1, h2 = X @ view.P1.T, X @ view.P2.T
        assert (h1[:3, 2] * h2[:3, 2] < 0).all()
        x1, x2 = h1[:, :2] / h1[:, 2:], h2[:, :2] / h2[:, 2:]
        assert "not oriented" in eg.refine_fundamental(x1, x2, view.F_true).flags


class TestMeasured:
    def test_only_the_rectified_pair_is_flagged(self, pair) -> None:
        x1, x2 = inliers(pair)
        flags = eg.refine_fundamental(x1, x2).flags
        # Rectified images: F is affine indeed, both epipoles at infinity
        assert flags == (("near-affine",) if pair.stem == "motorcycle_rectified" else ())


class TestParts:
    def test_homography_fit_is_exact_without_noise_and_near_the_optimum_with_it(self) -> None:
        rng = np.random.default_rng(0)
        H = np.array([[1.1, 0.1, 0.3], [-0.2, 0.9, -0.4], [0.05, -0.02, 1.0]])
        q1 = rng.uniform(-2, 2, (2, 60))
        h = H @ homogeneous(q1.T).T
        q2 = h[:2] / h[2]
        weights = np.ones(60)
        G, squares, _ = fit_homography(q1, q2, weights)
        cost = float(weights @ squares)
        np.testing.assert_allclose(G / G[2, 2], H, rtol=0, atol=1e-9)
        assert cost < 1e-20
        noise = 1e-3
        noisy = [q + noise * rng.standard_normal(q.shape) for q in (q1, q2)]
        _, squares, _ = fit_homography(*noisy, weights)
        cost = float(weights @ squares)
        # chi-square with 2 * 60 - 8 degrees of freedom: 112, deviation 15
        assert cost / noise**2 == pytest.approx(112, abs=45)

    def test_quantile_of_the_variance_ratio_is_fishers(self) -> None:
        stats = pytest.importorskip("scipy.stats")
        for above, below in ((16, 5), (32, 13), (92, 43), (2000, 990)):
            expected = stats.f.ppf(0.99, above, below)
            # The cube root is nearly normal: better than a tenth at the smallest degrees
            assert _variance_ratio_99(above, below) == pytest.approx(expected, rel=0.1)

    def test_every_flag_is_explained(self) -> None:
        view = eg.two_view_scene(20.0, seed=1)
        result = eg.refine_fundamental(view.x1, view.x2, starts=6)
        assert result.flags
        assert set(result.flags) <= set(FLAGS)
        assert result.flags == tuple(flag for flag in FLAGS if flag in result.flags)


def test_the_bound_of_a_plane_is_fishers_quantile_by_its_degrees_of_freedom() -> None:
    stats = pytest.importorskip("scipy.stats")
    for n in (12, 25, 60, 400):
        for parameters in (5, 7):
            # A homography leaves 2 n - 8 degrees of freedom, F leaves n - parameters.
            exact = stats.f.ppf(0.99, 2 * n - 8, n - parameters)
            least = planar_bound(10**7, 7) / (2e7 - 8)
            expected = (2 * n - 8) * max(exact, least)
            assert planar_bound(n, parameters) == pytest.approx(expected, rel=0.1)


def test_bounds_are_the_quantiles_that_they_are_said_to_be() -> None:
    stats = pytest.importorskip("scipy.stats")
    assert pytest.approx(stats.chi2.ppf(0.99, 3), abs=0.01) == AFFINE  # what an affine F lacks
    for n in (8, 20, 60):
        assert still_bound(n) == pytest.approx(8.0 * stats.f.ppf(0.99, 8, 2 * n - 8), rel=0.05)
    assert still_bound(5000) == pytest.approx(500.0)  # a twentieth of 2 n
    assert pytest.approx(stats.norm.ppf(0.99), abs=1e-3) == diagnostics._NORMAL_99


def test_of_many_matches_the_bound_of_a_plane_is_the_geometric_aic() -> None:
    # S_H + 2 (2 n + 8) s^2 <= S + 2 (3 n + p) s^2, with S = (n - p) s^2
    for n, p in ((10**5, 7), (10**6, 5)):
        aic = (n - p) + 2 * (3 * n + p) - 2 * (2 * n + 8)
        assert planar_bound(n, p) == pytest.approx(aic, rel=1e-3)


def test_a_still_camera_is_told_as_often_as_its_bound_says() -> None:
    """F fits such matches too well: by its noise half of these would be planes."""
    told = 0
    for seed in range(30):
        rng = np.random.default_rng([seed, 5])
        x = rng.uniform([0.0, 0.0], [1280.0, 960.0], (12, 2))
        x1, x2 = x + 0.5 * rng.standard_normal((2, 12, 2))
        told += "still camera" in eg.refine_fundamental(x1, x2).flags
    assert told >= 26


def test_wide_residuals_of_a_plane_are_suspicious(evidences) -> None:
    """An F that a plane leaves free bends to wrong matches with little error."""
    for kind, expected in (("general", False), ("planar", True)):
        x1, x2 = scene(kind, 200, 2.5, np.random.default_rng(2))
        eg.refine_fundamental(x1, x2, backend="numpy")
        found = evidences[-1][0]
        assert WIDE < found.noise / RANGE < HIDDEN
        assert is_suspicious(found) == expected


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_flags_do_not_ask_for_the_unit_of_length(loss: str) -> None:
    """Pixels, or units of ten of them: with the scale of the loss alike, the same verdict."""
    rng = np.random.default_rng(5)
    for kind in ("general", "planar"):
        x1, x2 = scene(kind, 120, 1.0, rng)
        x2[:12] += rng.uniform(-60.0, 60.0, (12, 2))
        results = [
            eg.refine_fundamental(s * x1, s * x2, loss=loss, loss_scale_px=2.0 * s)
            for s in (1.0, 10.0, 0.1)
        ]
        for found in results[1:]:
            assert set(found.flags) - {"not pixels"} == set(results[0].flags)
        assert ("planar scene" in results[0].flags) == (kind == "planar")


@pytest.fixture
def evidences(monkeypatch: pytest.MonkeyPatch) -> list:
    """What the diagnosis is shown, and pixels a unit."""
    seen = []

    def recorded(matches, *rest):
        seen.append((evidence(matches, *rest), matches.frame.scale))
        return seen[-1][0]

    monkeypatch.setattr(minima, "evidence", recorded)
    return seen


def test_the_diagnosis_is_shown_the_noise_that_a_loss_leaves(evidences) -> None:
    x1, x2 = scene("general", 200, 0.5, np.random.default_rng(3))
    x2[:20] += np.random.default_rng(4).uniform(-60.0, 60.0, (20, 2))
    eg.refine_fundamental(x1, x2, loss="huber", loss_scale_px=0.7)
    found, scale = evidences[-1]
    assert found.noise * scale == pytest.approx(0.5, rel=0.25)
    assert 10 <= found.rejected <= 25


def test_one_match_far_beyond_the_noise_is_suspicious(evidences) -> None:
    for off, expected in ((0.0, False), (8.0, True)):
        x1, x2 = scene("general", 100, 0.1, np.random.default_rng(4))
        x2[0] += off
        eg.refine_fundamental(x1, x2, backend="numpy")
        assert is_suspicious(evidences[-1][0]) == expected


def test_a_run_that_did_not_begin_has_flags(evidences) -> None:
    # A start whose distances are infinite leaves no residuals to judge.
    x1, x2 = scene("planar", 20, 0.3, np.random.default_rng(1))
    eg.refine_fundamental(x1, x2, backend="numpy")
    infinite = replace(evidences[-1][0], noise=float("inf"))
    assert diagnose(infinite, 0.0, ambiguous=False) == ("weak geometry",)


@pytest.mark.study
@pytest.mark.parametrize("m", [30, 200])
@pytest.mark.parametrize("reach", [40.0, 80.0, 160.0])
def test_wrong_matches_near_their_own_place_are_no_geometry(m, reach) -> None:
    """Small motions in any direction agree with every F that is nearly that of no motion."""
    for seed in range(3 if available()["c"] is None else 1):  # searches in NumPy take seconds
        rng = np.random.default_rng([m, seed])
        x1 = rng.uniform([0.0, 0.0], [1600.0, 1200.0], (m, 2))
        far, angle = reach * np.sqrt(rng.random(m)), rng.uniform(0.0, 2.0 * np.pi, m)
        x2 = x1 + np.column_stack([far * np.cos(angle), far * np.sin(angle)])
        for solve in (eg.refine_fundamental, eg.estimate_fundamental):
            assert not solve(x1, x2).success


@pytest.mark.study
def test_a_wide_noise_is_no_random_motion() -> None:
    """Blunt matches of a scene with relief agree on its geometry as sharp ones do."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x1, x2 = (5.0 * x for x in scene("general", 200, 0.0, rng))  # 20 px in a large image
        wide = 0.005 * np.ptp(x1, axis=0).max()
        x1, x2 = (x + wide * rng.standard_normal(x.shape) for x in (x1, x2))
        for solve in (eg.refine_fundamental, eg.estimate_fundamental):
            assert "no common geometry" not in solve(x1, x2).flags
