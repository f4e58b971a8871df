"""Batches over other array libraries: the same answers, of the same kind, differentiable."""

from __future__ import annotations

import importlib

import epigauge as eg
import numpy as np
import pytest
from epigauge import arrays
from epigauge.errors import ArgumentError
from two_views import scene

pytest.importorskip("array_api_compat", reason="needs array-api-compat")

SIZES = (30, 12, 60, 5, 20)
LIBRARIES = ("numpy", "array_api_strict", "torch", "jax")


def ragged(seed=0):
    rng = np.random.default_rng(seed)
    pairs = [scene("general", size, 0.7, rng) for size in SIZES]
    x1, x2 = (np.concatenate([pair[k] for pair in pairs]) for k in range(2))
    return x1, x2, np.concatenate([[0], np.cumsum(SIZES)])


@pytest.fixture(params=LIBRARIES)
def library(request):
    """A library, and what turns a NumPy array into one of its own."""
    module = pytest.importorskip(request.param, reason=f"needs {request.param}")
    if request.param == "jax":
        module.config.update("jax_enable_x64", True)
        return importlib.import_module("jax.numpy").asarray
    return module.asarray


def test_a_batch_is_the_batch_of_numpy(library):
    x1, x2, offsets = ragged()
    expected = eg.refine_fundamental_batch(x1, x2, offsets, ftol=1e-15)
    given = library(x1)
    found = eg.refine_fundamental_batch(given, library(x2), offsets, backend="array")
    for name in ("F", "cost", "rms_px", "sigma", "distances", "covariance", "noise_px"):
        value = getattr(found, name)
        assert type(value) is type(given), name
        # The minimum is where the gradient is at rounding: F within the root of it.
        np.testing.assert_allclose(
            arrays.host(value), getattr(expected, name), rtol=1e-6, atol=1e-7, err_msg=name
        )
    np.testing.assert_allclose(arrays.host(found.cost), expected.cost, rtol=1e-12)
    assert found.reasons.keys() == expected.reasons.keys() == {3}
    assert found.flags == expected.flags
    np.testing.assert_array_equal(found.success, expected.success)
    np.testing.assert_array_equal(found.status > 0, expected.status > 0)
    assert np.all(found.nfev <= expected.nfev + 2)


def test_start_values_and_weights_go_to_their_pairs(library):
    x1, x2, offsets = ragged(1)
    weights = np.linspace(0.0, 2.0, len(x1))
    starts = np.stack([np.eye(3)] * len(SIZES))
    for k in (0, 1, 2, 4):
        rows = slice(offsets[k], offsets[k + 1] - 3)  # not the start it would take itself
        starts[k] = eg.fundamental_8point(x1[rows], x2[rows])
    expected = eg.refine_fundamental_batch(x1, x2, offsets, starts, weights=weights)
    found = eg.refine_fundamental_batch(
        library(x1),
        library(x2),
        offsets,
        library(starts),
        weights=library(weights),
        backend="array",
    )
    for k in (0, 2, 4):
        np.testing.assert_allclose(arrays.host(found.cost)[k], expected.cost[k], rtol=1e-8)


def central(value, x, row, column, step=1e-3):
    moved = []
    for sign in (1.0, -1.0):
        shifted = x.copy()
        shifted[row, column] += sign * step
        moved.append(value(shifted))
    return (moved[0] - moved[1]) / (2.0 * step)


@pytest.mark.parametrize("name", ["torch", "jax"])
def test_derivatives_of_f_by_the_matches_are_differences(name):
    module = pytest.importorskip(name, reason=f"needs {name}")
    x1, x2 = scene("general", 25, 0.5, np.random.default_rng(3))
    weights = np.random.default_rng(4).standard_normal((3, 3))

    def number(F, cost):
        return (F * weights).sum() + 0.01 * cost

    def differenced(x):
        found = eg.refine_fundamental(x, x2, ftol=1e-16)
        return number(found.F, found.cost)

    if name == "torch":
        given = module.tensor(x1, requires_grad=True)
        found = eg.refine_fundamental_batch(given, module.tensor(x2), [0, 25])
        weights = module.tensor(weights)
        number(found.F[0], found.cost[0]).backward()
        gradient = given.grad.numpy()
        weights = weights.numpy()
    else:
        module.config.update("jax_enable_x64", True)

        def traced(x):
            found = eg.refine_fundamental_batch(x, module.numpy.asarray(x2), [0, 25])
            return number(found.F[0], found.cost[0])

        gradient = np.asarray(module.grad(traced)(module.numpy.asarray(x1)))
    for row, column in ((0, 0), (11, 1), (24, 0)):
        expected = central(differenced, x1, row, column)
        assert gradient[row, column] == pytest.approx(expected, rel=1e-4, abs=1e-8)


def test_one_newton_step_more_changes_nothing():
    # The step that carries derivatives is zero at a minimum, and a pair short of it stays.
    x1, x2, offsets = ragged(2)
    whole = eg.refine_fundamental_batch(x1, x2, offsets, backend="array")
    again = eg.refine_fundamental_batch(x1, x2, offsets, whole.F, backend="array")
    np.testing.assert_allclose(again.F, whole.F, atol=1e-9)
    short = eg.refine_fundamental_batch(x1, x2, offsets, backend="array", max_iter=1)
    assert not short.success[[0, 2, 4]].all()
    assert set(short.status) <= {0, 4, -9}


def test_bad_arguments_are_named():
    x1, x2, offsets = ragged()
    with pytest.raises(ArgumentError, match="loss"):
        eg.refine_fundamental_batch(x1, x2, offsets, backend="array", loss="huber")
    with pytest.raises(ArgumentError, match="F0"):
        eg.refine_fundamental_batch(x1, x2, offsets, np.eye(3), backend="array")
    bad = x1.copy()
    bad[3, 1] = np.nan
    with pytest.raises(ArgumentError, match="row 3"):
        eg.refine_fundamental_batch(bad, x2, offsets, backend="array")


def test_no_matches_and_no_pairs_are_batches_too():
    nothing = np.empty((0, 2))
    assert len(eg.refine_fundamental_batch(nothing, nothing, [0], backend="array")) == 0
    refused = eg.refine_fundamental_batch(nothing, nothing, [0, 0], backend="array")
    assert refused.reasons.keys() == {0}
    assert not refused.success.any()


def test_a_library_that_is_missing_is_named(monkeypatch):
    monkeypatch.setattr(arrays.importlib.util, "find_spec", lambda name: None)
    x1, x2, offsets = ragged()
    with pytest.raises(eg.BackendError, match="array-api-compat"):
        eg.refine_fundamental_batch(x1, x2, offsets, backend="array")
