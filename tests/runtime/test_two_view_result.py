"""The result object: every field keeps what its description promises, in the caller's pixels."""

from __future__ import annotations

import dataclasses

import epigauge as eg
import numpy as np
import pytest
from epigauge import lm
from epigauge.kernels import table
from epigauge.scenes import two_view_scene
from epigauge.two_view.conditioning import condition, displaced
from epigauge.two_view.parameterizations import PARAMETERIZATIONS
from laws import central_differences
from two_views import algebraic, cross, project, up_to_sign

OFFSET = np.array([640.0, 480.0])

#: The forms a minimum can be reached in.
FORMS = [
    {},
    {"hessian": "gauss-newton"},
    {"damping": "seber"},
    {"structure": "joint", "max_iter": 300},
    {"structure": "joint", "damping": "seber", "max_iter": 300},
]


def scene(seed: int = 1, **options):
    """Pixels as images have them: the origin is a corner."""
    view = two_view_scene(8.0, seed=seed, **options)
    return view.x1 + OFFSET, view.x2 + OFFSET


def weights(m: int = 50) -> np.ndarray:
    return np.random.default_rng(2).uniform(0.2, 3.0, m)


@pytest.fixture(params=FORMS, ids=lambda form: " ".join(map(str, form.values())) or "default")
def solved(request):
    """Matches, weights and a result, in each form."""
    x1, x2 = scene()
    w = weights()
    return x1, x2, w, eg.refine_fundamental(x1, x2, weights=w, ftol=1e-13, **request.param)


class TestMatrix:
    def test_has_unit_norm_and_rank_two(self, solved) -> None:
        result = solved[3]
        assert np.linalg.norm(result.F) == pytest.approx(1.0, abs=1e-15)
        values = np.linalg.svd(result.F, compute_uv=False)
        # Rounding of an entry; the smallest value that counts is sigma, about 1e-5 in pixels.
        assert values[2] < 1e-15 < 1e-6 < values[1]

    def test_x_is_vect_of_F(self, solved) -> None:
        result = solved[3]
        np.testing.assert_array_equal(result.x, result.F.reshape(9))
        assert result.x[1] == result.F[0, 1]  # row-wise

    def test_factors_give_F_back(self, solved) -> None:
        result = solved[3]
        product = result.U @ np.diag([1.0, result.sigma, 0.0]) @ result.V.T
        assert up_to_sign(product, result.F) < 4e-15
        np.testing.assert_allclose(result.U.T @ result.U, np.eye(3), rtol=0, atol=1e-14)
        np.testing.assert_allclose(result.V.T @ result.V, np.eye(3), rtol=0, atol=1e-14)
        assert 0.0 <= result.sigma <= 1.0
        assert type(result.sigma) is float

    def test_epipoles_are_the_last_columns(self, solved) -> None:
        result = solved[3]
        np.testing.assert_allclose(result.F @ result.V[:, 2], 0, atol=1e-15)
        np.testing.assert_allclose(result.F.T @ result.U[:, 2], 0, atol=1e-15)


class TestReconstruction:
    def test_cameras_realise_F(self, solved) -> None:
        result = solved[3]
        np.testing.assert_array_equal(result.P1, np.eye(3, 4))
        F = cross(result.P2[:, 3]) @ result.P2[:, :3]
        assert up_to_sign(F, result.F) < 1e-14

    def test_points_project_to_the_corrected_matches(self, solved) -> None:
        x1, x2, _, result = solved
        _, x1_hat, x2_hat = eg.reprojection_distances(result.F, x1, x2)
        assert result.points.shape == (len(x1), 4)
        # F has sixteen digits of its largest entry, about 1e6 times the smallest: 1e-9 pixels.
        np.testing.assert_allclose(project(result.P1, result.points), x1_hat, rtol=0, atol=1e-8)
        np.testing.assert_allclose(project(result.P2, result.points), x2_hat, rtol=0, atol=1e-8)

    def test_points_have_unit_norm(self, solved) -> None:
        np.testing.assert_allclose(np.linalg.norm(solved[3].points, axis=1), 1.0, rtol=1e-14)


class TestResiduals:
    def test_fun_is_the_reprojection_distance(self, solved) -> None:
        x1, x2, _, result = solved
        d, x1_hat, x2_hat = eg.reprojection_distances(result.F, x1, x2)
        np.testing.assert_allclose(np.abs(result.fun), np.abs(d), rtol=0, atol=1e-9)
        shifts = np.sum((x1_hat - x1) ** 2 + (x2_hat - x2) ** 2, axis=1)
        np.testing.assert_allclose(result.fun**2, shifts, rtol=0, atol=1e-8)

    def test_sign_of_fun_is_that_of_the_equation(self, solved) -> None:
        x1, x2, _, result = solved
        clear = np.abs(result.fun) > 1e-6
        assert clear.sum() > 40
        signs = np.sign(result.fun) * np.sign(algebraic(result.F, x1, x2))
        # One sign for all matches: F itself is known up to sign.
        assert abs(signs[clear].sum()) == clear.sum()

    def test_cost_is_half_the_weighted_sum_of_squares_in_pixels(self, solved) -> None:
        _, _, w, result = solved
        # The joint form stops when its points still owe the last digits.
        assert result.cost == pytest.approx(0.5 * np.sum(w * result.fun**2), rel=1e-10)

    def test_rms_is_over_the_four_coordinates_of_a_match(self, solved) -> None:
        result = solved[3]
        expected = np.sqrt(np.sum(result.fun**2) / (4 * len(result.fun)))
        assert result.rms_px == pytest.approx(expected, rel=1e-14)

    def test_minimum_is_one(self) -> None:
        x1, x2 = scene()
        result = eg.refine_fundamental(x1, x2, ftol=1e-13)
        rng = np.random.default_rng(4)
        T = np.diag([1e2, 1e2, 1.0])  # steps of equal effect in all entries
        for size in (1e-2, 1e-4):
            for _ in range(20):
                step = T @ rng.standard_normal((3, 3)) @ T
                F = result.F + size * step / np.linalg.norm(step)
                d, _, _ = eg.reprojection_distances(F, x1, x2)
                assert 0.5 * np.sum(d**2) > result.cost

    def test_truth_is_not_better_than_the_estimate(self) -> None:
        for seed in range(10):
            view = two_view_scene(8.0, seed=seed)
            d, _, _ = eg.reprojection_distances(view.F_true, view.x1, view.x2)
            assert eg.refine_fundamental(view.x1, view.x2).cost < 0.5 * np.sum(d**2)


class TestDerivatives:
    @pytest.mark.parametrize("name", ["ortho"])
    def test_jacobian_is_that_through_the_retraction(self, name) -> None:
        x1, x2 = scene()
        w = weights()
        F0 = eg.fundamental_8point(x1, x2)
        result = eg.refine_fundamental(x1, x2, F0, parameterization=name, weights=w)
        frame = condition(x1, x2)
        frame = displaced(frame, frame.from_pixels(F0))
        chart = PARAMETERIZATIONS[name](table("numpy"))
        estimate = chart.start(frame.from_pixels(result.F))

        def distances(delta: np.ndarray) -> np.ndarray:
            F = frame.to_pixels(chart.fundamental(chart.retract(estimate, delta)))
            return eg.reprojection_distances(F, x1, x2)[0]

        J = central_differences(distances, np.zeros(result.jac.shape[1]), 1e-4)
        # F is known up to sign, and so is each column: the signs of the factors are free.
        # Distances are known to 1e-10 pixels, over the step.
        for mine, expected in zip(result.jac.T, J.T, strict=True):
            assert min(np.abs(mine - expected).max(), np.abs(mine + expected).max()) < 1e-5

    def test_gradient_is_the_jacobians(self, solved) -> None:
        _, _, w, result = solved
        np.testing.assert_allclose(result.grad, result.jac.T @ (w * result.fun), rtol=1e-12)
        assert result.optimality == np.abs(result.grad).max()

    def test_gradient_vanishes_at_the_minimum(self, solved) -> None:
        result = solved[3]
        # A gradient g leaves about g^2 / h of the cost, h the curvature: 1e-13 of it at most.
        curvature = np.linalg.eigvalsh(result.jac.T @ result.jac)[-1]
        assert result.optimality < np.sqrt(1e-10 * result.cost * curvature)


class TestCounts:
    def test_history_has_one_row_an_evaluation_and_ends_at_the_cost(self, solved) -> None:
        result = solved[3]
        assert result.nfev == len(result.history) == result.nit + 1
        assert result.njev == sum(row.accepted for row in result.history)
        accepted = [row.cost for row in result.history if row.accepted]
        assert accepted == sorted(accepted, reverse=True)
        # Squared pixels: the cost of the history is scaled in another order.
        assert accepted[-1] == pytest.approx(result.cost, rel=1e-14)

    def test_history_starts_at_the_cost_of_the_start_in_squared_pixels(self) -> None:
        x1, x2 = scene()
        F0 = eg.fundamental_8point(x1, x2)
        d, _, _ = eg.reprojection_distances(F0, x1, x2)
        for structure in ("eliminated", "joint"):
            result = eg.refine_fundamental(x1, x2, F0, structure=structure)
            assert result.history[0].cost == pytest.approx(0.5 * np.sum(d**2), rel=1e-8)

    def test_status_message_and_success_say_the_same(self, solved) -> None:
        result = solved[3]
        assert result.success is True
        assert result.status > 0
        assert result.message == lm.STATUS[result.status]

    def test_too_few_iterations_are_no_success(self) -> None:
        x1, x2 = scene()
        result = eg.refine_fundamental(x1, x2, max_iter=1)
        assert (result.status, result.success, result.nit, result.nfev) == (0, False, 1, 2)

    def test_callback_sees_every_row_and_may_stop(self) -> None:
        x1, x2 = scene()
        rows: list[lm.Row] = []
        result = eg.refine_fundamental(x1, x2, callback=rows.append)
        assert tuple(rows) == result.history
        stopped = eg.refine_fundamental(x1, x2, callback=lambda row: row.iteration == 1)
        assert (stopped.status, stopped.success, stopped.nit) == (-2, False, 1)
        assert stopped.cost == pytest.approx(result.history[1].cost, rel=1e-12)

    @pytest.mark.parametrize("form", [*FORMS, {"loss": "huber"}, {"starts": 2}])
    def test_a_callback_changes_nothing_and_stops_where_it_says(self, form) -> None:
        """Whether it hears of each step or, after a compiled run, of all of them."""
        x1, x2 = scene(noise_px=2.0)
        rows: list[lm.Row] = []
        free = eg.refine_fundamental(x1, x2, **form)
        heard = eg.refine_fundamental(x1, x2, callback=rows.append, **form)
        np.testing.assert_array_equal(heard.F, free.F)
        assert (heard.nfev, heard.njev, heard.status) == (free.nfev, free.njev, free.status)
        assert len(rows) == free.nfev
        for last in (0, 2):
            stopped = eg.refine_fundamental(
                x1, x2, callback=lambda row, last=last: row.iteration == last, **form
            )
            assert (stopped.status, stopped.success) == (-2, False)
            # Neither search goes on after the one that was stopped.
            assert stopped.nit == last
            accepted = [row.cost for row in rows[: last + 1] if row.accepted]
            assert stopped.cost == pytest.approx(min(accepted), rel=1e-9)

    def test_default_tolerances_leave_nothing_that_shows(self) -> None:
        x1, x2 = scene()
        default = eg.refine_fundamental(x1, x2)
        tight = eg.refine_fundamental(x1, x2, ftol=0.0, xtol=0.0, gtol=0.0, max_iter=200)
        assert default.cost == pytest.approx(tight.cost, rel=1e-10)
        assert tight.success

    def test_prints_its_numbers_but_not_its_arrays(self) -> None:
        text = repr(eg.refine_fundamental(*scene()))
        assert "rms_px" in text
        assert "covariance" not in text
        assert len(text) < 3000


#: The same numbers in every form a caller may have them.
CONTAINERS = {
    "lists": lambda x: x.tolist(),
    "tuples": lambda x: tuple(map(tuple, x.tolist())),
    "Fortran order": np.asfortranarray,
    "every other row": lambda x: np.repeat(x, 2, axis=0)[::2],
    "columns of a table": lambda x: np.column_stack([x[:, 0], 0 * x[:, 0], x[:, 1]])[:, ::2],
    "OpenCV": lambda x: x[:, None, :],
    "big endian": lambda x: x.astype(">f8"),
    "backwards": lambda x: x[::-1].copy()[::-1],
}


class TestInputs:
    @pytest.mark.parametrize("form", CONTAINERS)
    def test_form_of_the_points_does_not_matter(self, form) -> None:
        x1, x2 = scene()
        expected = eg.refine_fundamental(x1, x2)
        result = eg.refine_fundamental(CONTAINERS[form](x1), CONTAINERS[form](x2))
        assert_identical(result, expected)

    @pytest.mark.parametrize("dtype", [np.int32, np.uint16, np.int64, np.float32, np.float16])
    def test_short_numbers_are_taken_as_the_numbers_they_are(self, dtype) -> None:
        x1, x2 = (np.round(x).astype(dtype) for x in scene())
        expected = eg.refine_fundamental(x1.astype(float), x2.astype(float))
        assert_identical(eg.refine_fundamental(x1, x2), expected)

    def test_start_in_any_form(self) -> None:
        x1, x2 = scene()
        F0 = eg.fundamental_8point(x1, x2)
        expected = eg.refine_fundamental(x1, x2, F0)
        for form in (F0.tolist(), np.asfortranarray(F0), np.ascontiguousarray(F0.T).T):
            assert_identical(eg.refine_fundamental(x1, x2, form), expected)
        default = eg.refine_fundamental(x1, x2)  # the same estimate, to rounding
        assert default.nfev == expected.nfev
        np.testing.assert_allclose(default.F, expected.F, rtol=0.0, atol=1e-10)

    @pytest.mark.parametrize("form", FORMS, ids=str)
    def test_inputs_are_left_alone_and_may_be_read_only(self, form) -> None:
        x1, x2 = scene()
        F0, w = eg.fundamental_8point(x1, x2) * -7.0, weights()
        arrays = (x1, x2, F0, w)
        copies = [array.copy() for array in arrays]
        for array in arrays:
            array.flags.writeable = False
        result = eg.refine_fundamental(x1, x2, F0, weights=w, **form)
        for array, copy in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, copy)
        for field in dataclasses.fields(result):
            value = getattr(result, field.name)
            if isinstance(value, np.ndarray):
                assert not any(np.shares_memory(value, array) for array in arrays), field.name

    def test_ones_are_the_default_weights(self) -> None:
        x1, x2 = scene()
        for ones in (np.ones(50), [1] * 50):
            expected = eg.refine_fundamental(x1, x2)
            result = eg.refine_fundamental(x1, x2, weights=ones)
            assert result.nfev == expected.nfev
            # Sums may be associated in another way where nothing has to be multiplied.
            np.testing.assert_allclose(result.F, expected.F, rtol=0.0, atol=1e-13)
            np.testing.assert_allclose(result.covariance, expected.covariance, rtol=1e-9)


def assert_identical(a: eg.FundamentalResult, b: eg.FundamentalResult) -> None:
    """Every number of two results is the same to the last bit, but for the seconds."""
    for field in dataclasses.fields(a):
        value = getattr(a, field.name)
        if isinstance(value, np.ndarray | float | int | str):
            np.testing.assert_array_equal(getattr(b, field.name), value, err_msg=field.name)
    rows = ([dataclasses.replace(row, seconds=0.0) for row in r.history] for r in (a, b))
    assert next(rows) == next(rows)
