"""Adjustment as users call it: options, losses, weights, backends, statuses, promises."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge.bundle.strategies import STRATEGIES
from epigauge.errors import ArgumentError
from laws import distance


@pytest.fixture(scope="module")
def truth() -> eg.Reconstruction:
    return many_views.cameras_and_points()


@pytest.fixture(scope="module")
def tracks(truth: eg.Reconstruction) -> eg.Tracks:
    return many_views.observed(truth, seen=0.8)


@pytest.fixture(scope="module")
def start(tracks: eg.Tracks) -> eg.Reconstruction:
    return many_views.shaken(eg.initialize(tracks), 0.02)


class TestResult:
    def test_cost_residuals_and_rms_agree(
        self, tracks: eg.Tracks, start: eg.Reconstruction
    ) -> None:
        found = eg.bundle_adjust(tracks, start)
        np.testing.assert_array_equal(found.fun, tracks.xy - found.reconstruction.project(tracks))
        assert found.cost == pytest.approx(0.5 * np.sum(found.fun**2), rel=1e-9)
        assert found.rms_px == pytest.approx(np.sqrt(np.mean(found.fun**2)), rel=1e-12)
        assert found.rms_px == pytest.approx(found.reconstruction.rms_px(tracks), rel=1e-12)
        assert found.success
        assert found.loss_scale_px == 0.0

    def test_no_direction_lowers_the_cost(
        self, tracks: eg.Tracks, start: eg.Reconstruction, truth: eg.Reconstruction
    ) -> None:
        found = eg.bundle_adjust(tracks, start, ftol=1e-13)
        assert found.cost < 0.5 * np.sum((tracks.xy - truth.project(tracks)) ** 2)
        rng = np.random.default_rng(0)
        P, Q = found.reconstruction.P, found.reconstruction.Q
        for _ in range(50):
            other = eg.Reconstruction(
                P * (1.0 + 1e-6 * rng.standard_normal(P.shape)),
                Q * (1.0 + 1e-6 * rng.standard_normal(Q.shape)),
            )
            assert 0.5 * np.sum((tracks.xy - other.project(tracks)) ** 2) > found.cost

    def test_history_has_a_row_an_evaluation(
        self, tracks: eg.Tracks, start: eg.Reconstruction
    ) -> None:
        rows: list[Any] = []
        found = eg.bundle_adjust(
            tracks, start, method="levenberg", callback=lambda row: rows.append(row)
        )
        assert tuple(rows) == found.history
        assert [row.iteration for row in rows] == list(range(found.nfev))
        assert found.nit == found.nfev - 1
        assert found.njev == sum(row.accepted for row in rows)
        first = 0.5 * np.sum((tracks.xy - start.project(tracks)) ** 2)
        assert rows[0].cost == pytest.approx(first, rel=1e-9)
        assert (rows[0].lam, rows[0].step_norm, rows[0].accepted) == (0.0, 0.0, True)
        best = rows[0].cost
        for row, following in zip(rows[1:], [*rows[2:], None], strict=True):
            assert row.accepted == (row.cost < best)
            best = min(best, row.cost)
            if following is not None:
                assert following.lam == pytest.approx(row.lam * (0.1 if row.accepted else 10.0))
        assert best == found.cost
        assert sorted(row.seconds for row in rows) == [row.seconds for row in rows]

    def test_inputs_are_not_touched(self, tracks: eg.Tracks, start: eg.Reconstruction) -> None:
        before = start.P.copy(), start.Q.copy(), tracks.xy.copy()
        for method in STRATEGIES:
            eg.bundle_adjust(tracks, start, method=method, max_iter=3)
        for a, b in zip((start.P, start.Q, tracks.xy), before, strict=True):
            np.testing.assert_array_equal(a, b)

    @pytest.mark.parametrize("method", ["covariant", "free", "bartoli"])
    def test_is_deterministic_to_the_last_bit(
        self, tracks: eg.Tracks, start: eg.Reconstruction, method: str
    ) -> None:
        a, b = (eg.bundle_adjust(tracks, start, method=method) for _ in range(2))
        np.testing.assert_array_equal(a.reconstruction.P, b.reconstruction.P)
        np.testing.assert_array_equal(a.reconstruction.Q, b.reconstruction.Q)
        assert [row.cost for row in a.history] == [row.cost for row in b.history]

    @pytest.mark.parametrize("backend", ["c", "casadi"])
    @pytest.mark.parametrize("method", ["covariant", "free", "hartley", "gauge_invariant"])
    def test_backends_agree(
        self, tracks: eg.Tracks, start: eg.Reconstruction, method: str, backend: str
    ) -> None:
        many_views.need_backend(backend)
        expected = eg.bundle_adjust(tracks, start, method=method, backend="numpy")
        found = eg.bundle_adjust(tracks, start, method=method, backend=backend)
        assert found.nfev == expected.nfev
        assert found.cost == pytest.approx(expected.cost, rel=1e-10)

    def test_rows_in_another_order_give_the_same_answer(
        self, tracks: eg.Tracks, start: eg.Reconstruction
    ) -> None:
        rows = np.random.default_rng(0).permutation(len(tracks))
        other = eg.Tracks(tracks.view[rows], tracks.point[rows], tracks.xy[rows])
        assert eg.bundle_adjust(other, start).cost == eg.bundle_adjust(tracks, start).cost


class TestStatus:
    def test_convergence(self, tracks: eg.Tracks, start: eg.Reconstruction) -> None:
        found = eg.bundle_adjust(tracks, start)
        assert (found.status, found.success) == (2, True)
        assert "ftol" in found.message
        decrease = found.history[-2].cost - found.history[-1].cost
        assert decrease <= 1e-8 * found.history[-2].cost

    def test_max_iter(self, tracks: eg.Tracks, start: eg.Reconstruction) -> None:
        found = eg.bundle_adjust(tracks, start, max_iter=1)
        assert (found.status, found.success, found.nit, found.nfev) == (0, False, 1, 2)
        assert found.cost == found.history[1].cost

    def test_callback_stops(self, tracks: eg.Tracks, start: eg.Reconstruction) -> None:
        found = eg.bundle_adjust(tracks, start, callback=lambda row: row.iteration == 2)
        assert (found.status, found.success, found.nit) == (-2, False, 2)
        assert found.cost == found.history[2].cost
        at_once = eg.bundle_adjust(tracks, start, callback=lambda row: True)
        assert (at_once.status, at_once.nfev) == (-2, 1)
        assert distance(at_once.fun, tracks.xy - start.project(tracks)) < 1e-9

    def test_gradient_and_step(self, tracks: eg.Tracks, start: eg.Reconstruction) -> None:
        assert eg.bundle_adjust(tracks, start, gtol=0.5, ftol=0.0).status == 1
        assert eg.bundle_adjust(tracks, start, xtol=0.5, ftol=0.0).status == 3

    def test_exact_data(self, truth: eg.Reconstruction) -> None:
        exact = many_views.observed(truth, 0.0)
        for method in STRATEGIES:
            found = eg.bundle_adjust(exact, truth, method=method)
            assert found.success
            assert found.rms_px < 1e-10
        assert eg.bundle_adjust(exact, many_views.shaken(truth, 0.02)).rms_px < 1e-10

    @pytest.mark.parametrize("kind", ["focal plane", "flat", "line", "one place", "centre"])
    def test_starts_without_a_step_are_nudged(
        self, tracks: eg.Tracks, truth: eg.Reconstruction, kind: str
    ) -> None:
        P, Q = truth.P.copy(), truth.Q.copy()
        if kind == "focal plane":
            P[0, 2] = 0.0  # that of a camera for every point
        elif kind == "flat":
            Q[:, 2] = 0.0
        elif kind == "line":
            Q[:, 1:3] = 0.0
        elif kind == "one place":
            P[:] = P[0]
        else:
            Q[3, :3] = -np.linalg.solve(P[0, :, :3], P[0, :, 3])
        best = eg.bundle_adjust(tracks, truth)
        found = eg.bundle_adjust(tracks, eg.Reconstruction(P, Q))
        assert found.success
        assert found.cost == pytest.approx(best.cost, rel=1e-6)

    @pytest.mark.parametrize("method", STRATEGIES)
    def test_flat_starts_are_solved_by_every_method_or_told(
        self, tracks: eg.Tracks, truth: eg.Reconstruction, method: str
    ) -> None:
        flat = eg.Reconstruction(truth.P, truth.Q * [1.0, 1.0, 0.0, 1.0])
        found = eg.bundle_adjust(tracks, flat, method=method)
        best = eg.bundle_adjust(tracks, truth)
        assert found.cost == pytest.approx(best.cost, rel=1e-6) or not found.success

    def test_points_in_one_plane_and_behind_cameras(self) -> None:
        flat = many_views.cameras_and_points(flatness=0.0)
        found = eg.bundle_adjust(many_views.observed(flat))
        assert np.isfinite(found.rms_px)
        assert found.rms_px < 1.0

    def test_points_at_infinity(self) -> None:
        truth = many_views.cameras_and_points()
        Q = truth.Q.copy()
        Q[:10, :3] += [0.0, 0.0, 1.0]
        Q[:10, 3] = 0.0
        far = eg.Reconstruction(truth.P, Q)
        found = eg.bundle_adjust(many_views.observed(far))
        assert found.success
        assert found.rms_px < 1.0


class TestRefusals:
    @pytest.mark.parametrize(
        ("options", "named"),
        [
            ({"method": "covarient"}, "did you mean 'covariant'"),
            ({"damping": "marquart"}, "did you mean 'marquardt'"),
            ({"schedule": "x"}, "schedule is 'x'"),
            ({"loss": "Huber"}, "did you mean 'huber'"),
            ({"gauge_mode": "both"}, "gauge_mode"),
            ({"backend": "fortran"}, "backend"),
            ({"loss": "huber", "loss_scale_px": -1.0}, "loss_scale_px"),
            ({"max_iter": 0}, "max_iter"),
            ({"ftol": 2.0}, "ftol"),
            ({"gauge": "normalized"}, "gauge is 'normalized'"),
            ({"gauge": "normalized"}, "gauge is"),
            ({"gauge": int}, "gauge is"),
            ({"method": "hartley", "gauge": eg.gauge.normalized()}, "gauge is given"),
            ({"method": "mclauchlan", "gauge": eg.gauge.normalized()}, "gauge is given"),
            ({"method": "hartley", "damping": "none"}, "damping is 'none'"),
            ({"method": "mclauchlan", "damping": "gauge_invariant"}, "damping is"),
            (
                {"method": "free", "gauge": eg.gauge.normalized(), "gauge_mode": "implicit"},
                "gauge_mode",
            ),
        ],
    )
    def test_bad_options_are_named(
        self, tracks: eg.Tracks, start: eg.Reconstruction, options: dict, named: str
    ) -> None:
        with pytest.raises(ArgumentError, match=named):
            eg.bundle_adjust(tracks, start, **options)

    @pytest.mark.parametrize("other", [None, "parts", np.zeros((4, 2))])
    def test_what_are_no_tracks_is_named(self, start: eg.Reconstruction, other: Any) -> None:
        with pytest.raises(ArgumentError, match=f"tracks is a {type(other).__name__}"):
            eg.bundle_adjust(other, start)

    def test_a_start_of_another_size(self, tracks: eg.Tracks, start: eg.Reconstruction) -> None:
        with pytest.raises(ArgumentError, match="has 4 cameras and 100 points"):
            eg.bundle_adjust(tracks, eg.Reconstruction(start.P[:-1], start.Q))
        with pytest.raises(ArgumentError, match="needed: 5 and 100"):
            eg.bundle_adjust(tracks, eg.Reconstruction(start.P, start.Q[:-1]))


class TestOptions:
    @pytest.mark.parametrize("schedule", ["classic", "nielsen"])
    @pytest.mark.parametrize("embedded", [True, False])
    def test_schedules_and_embedding_reach_the_same_cost(
        self, tracks: eg.Tracks, start: eg.Reconstruction, schedule: str, embedded: bool
    ) -> None:
        best = eg.bundle_adjust(tracks, start, ftol=1e-12).cost
        found = eg.bundle_adjust(tracks, start, schedule=schedule, embedded=embedded)
        assert found.cost == pytest.approx(best, rel=1e-6)
        assert found.success

    def test_embedding_saves_evaluations_on_flat_scenes(self) -> None:
        saved = 0
        for seed in range(3):
            scene = many_views.cameras_and_points(flatness=0.05, seed=seed)
            tracks = many_views.observed(scene, seed=seed)
            start = eg.initialize(tracks)
            found = [eg.bundle_adjust(tracks, start, embedded=e) for e in (True, False)]
            assert found[0].cost == pytest.approx(found[1].cost, rel=1e-4)
            saved += found[1].nfev - found[0].nfev
        assert saved > 0


class TestRobust:
    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize("loss", ["cauchy", "truncated", "huber", "soft_l1"])
    def test_gross_errors_hardly_move_the_good_points(self, loss: str, seed: int) -> None:
        truth = many_views.cameras_and_points(seed=seed)
        clean = many_views.observed(truth, seed=seed)
        tracks, good = many_views.with_gross_errors(clean, 0.05, seed=seed)
        best = eg.bundle_adjust(clean).reconstruction.project(clean)
        wrong = np.bincount(tracks.point, ~good) > 0
        whole = ~wrong[tracks.point]

        def error(**options: Any) -> float:
            found = eg.bundle_adjust(tracks, **options).reconstruction.project(clean)
            return float(np.sqrt(np.mean((found - best)[whole] ** 2)))

        robust = error(loss=loss)
        # Noise of one pixel; without the loss gross errors of 30 to 90 px pull by several.
        assert robust < 0.2  # measured: 0.05 to 0.17
        assert robust < 0.1 * error()

    @pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy", "truncated"])
    def test_cost_is_the_robust_sum(
        self, tracks: eg.Tracks, start: eg.Reconstruction, loss: str
    ) -> None:
        found = eg.bundle_adjust(tracks, start, loss=loss, loss_scale_px=2.0)
        assert found.loss_scale_px == 2.0
        z = np.sum(found.fun**2, axis=1) / 4.0
        rho = {
            "huber": np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0),
            "soft_l1": 2.0 * (np.sqrt(1.0 + z) - 1.0),
            "cauchy": np.log1p(z),
            "truncated": np.minimum(z, 1.0),
        }[loss]
        assert found.cost == pytest.approx(0.5 * 4.0 * rho.sum(), rel=1e-9)
        assert found.success

    def test_a_scale_far_above_the_noise_is_the_linear_loss(
        self, tracks: eg.Tracks, start: eg.Reconstruction
    ) -> None:
        best = eg.bundle_adjust(tracks, start)
        found = eg.bundle_adjust(tracks, start, loss="cauchy", loss_scale_px=1e5)
        assert found.rms_px == pytest.approx(best.rms_px, rel=1e-7)

    def test_points_all_of_whose_observations_are_wrong_do_no_harm(self) -> None:
        truth = many_views.cameras_and_points(5, 60)
        clean = many_views.observed(truth, seen=0.5)
        xy = clean.xy.copy()
        rng = np.random.default_rng(0)
        bad = clean.point < 3
        xy[bad] += rng.uniform(50.0, 200.0, (int(bad.sum()), 2)) * rng.choice([-1, 1], (1, 2))
        tracks = eg.Tracks(clean.view, clean.point, xy)
        for loss in ("truncated", "cauchy"):
            found = eg.bundle_adjust(tracks, loss=loss)
            assert found.success
            assert np.sqrt(np.mean(found.fun[~bad] ** 2)) < 1.1


class TestWeights:
    def test_weight_two_is_the_information_twice(
        self, tracks: eg.Tracks, start: eg.Reconstruction
    ) -> None:
        # Every observation twice as well known: the same optimum at twice the cost, and the same
        # iterations, since lambda and the damping are relative.
        doubled = eg.Tracks(tracks.view, tracks.point, tracks.xy, weights=np.full(len(tracks), 2.0))
        once, twice = eg.bundle_adjust(tracks, start), eg.bundle_adjust(doubled, start)
        assert twice.nfev == once.nfev
        for a, b in zip(twice.history, once.history, strict=True):
            assert a.cost == pytest.approx(2.0 * b.cost, rel=1e-9)
        assert twice.rms_px == pytest.approx(once.rms_px, rel=1e-9)

    def test_weight_two_equals_a_second_view_from_the_same_camera(self) -> None:
        # View 5 repeats view 4; by symmetry both have the same camera at the optimum.
        truth = many_views.cameras_and_points(5, 40)
        tracks = many_views.observed(truth)
        last = tracks.view == 4
        repeated = eg.Tracks(
            np.concatenate([tracks.view, np.full(int(last.sum()), 5)]),
            np.concatenate([tracks.point, tracks.point[last]]),
            np.concatenate([tracks.xy, tracks.xy[last]]),
        )
        weighted = eg.Tracks(tracks.view, tracks.point, tracks.xy, weights=np.where(last, 2.0, 1.0))
        a = eg.bundle_adjust(weighted, ftol=1e-13)
        start = eg.Reconstruction(a.reconstruction.P[[0, 1, 2, 3, 4, 4]], a.reconstruction.Q)
        b = eg.bundle_adjust(repeated, many_views.shaken(start, 0.01), ftol=1e-13)
        assert a.cost == pytest.approx(b.cost, rel=1e-9)
        pixels = a.reconstruction.project(tracks)
        assert distance(b.reconstruction.project(repeated)[repeated.view < 5], pixels) < 1e-6

    @pytest.mark.parametrize("what", ["rows", "point", "view"])
    def test_weight_zero_switches_off(self, truth: eg.Reconstruction, what: str) -> None:
        tracks = many_views.observed(truth)
        off = {
            "rows": np.random.default_rng(0).uniform(size=len(tracks)) < 0.05,
            "point": tracks.point == 7,
            "view": tracks.view == 2,
        }[what]
        weighted = eg.Tracks(tracks.view, tracks.point, tracks.xy, weights=np.where(off, 0.0, 1.0))
        xy = tracks.xy + np.where(off, 20.0, 0.0)[:, None]
        disturbed = eg.Tracks(tracks.view, tracks.point, xy, weights=np.where(off, 0.0, 1.0))
        start = eg.initialize(tracks)
        a, b = (eg.bundle_adjust(t, start, ftol=1e-12) for t in (weighted, disturbed))
        # The camera of a view without weight is nowhere in particular.
        assert a.success is b.success is (what != "view")
        assert ("undetermined" in a.flags) is (what == "view")
        assert a.cost == pytest.approx(b.cost, rel=1e-7)
        on = ~off
        assert a.cost == pytest.approx(0.5 * np.sum(a.fun[on] ** 2), rel=1e-9)

    def test_weight_zero_does_not_count_for_the_scale_of_the_loss(
        self, truth: eg.Reconstruction
    ) -> None:
        tracks = many_views.observed(truth)
        on = np.random.default_rng(0).uniform(size=len(tracks)) < 0.4
        scales = []
        for error in (0.0, 20.0):
            xy = tracks.xy + np.where(on, 0.0, error)[:, None]
            given = eg.Tracks(tracks.view, tracks.point, xy, weights=1.0 * on)
            found = eg.bundle_adjust(given, truth, loss="cauchy", max_iter=1)
            scales.append(found.loss_scale_px)
        assert scales[0] == scales[1]


@pytest.mark.slow
def test_memory_of_a_long_sequence_stays_bounded(data_dir: Path) -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("the peak is read from /proc")
    # VmHWM is the peak of this program alone; ru_maxrss starts at that of the process it was
    # forked from, a whole test suite.
    program = """
import sys
import numpy as np
import epigauge as eg
with np.load(sys.argv[1]) as z:
    tracks = eg.Tracks(z["view"], z["point"], z["xy"])
assert (tracks.n_views, len(tracks)) == (51, 25041)
result = eg.bundle_adjust(tracks, max_iter=30)
with open("/proc/self/status") as status:
    peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM:"))
print(peak / 1024, result.rms_px)
"""
    path = data_dir / "hotel_course" / "tracks.npz"
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    megabytes, rms = map(float, done.stdout.split())
    assert megabytes < 500.0
    assert rms < 3.0  # with the tracks that jump


def test_a_gauge_may_be_named_without_parentheses(
    tracks: eg.Tracks, start: eg.Reconstruction
) -> None:
    named = eg.bundle_adjust(tracks, start, method="levenberg", gauge=eg.gauge.normalized)
    made = eg.bundle_adjust(tracks, start, method="levenberg", gauge=eg.gauge.normalized())
    assert [row.cost for row in named.history] == [row.cost for row in made.history]
