"""Laws of weights in two views: what counts, by how much, wherever it stands and however it is
computed. Some have more matches than the compiled loop works on at a time (256).
"""

from __future__ import annotations

import math
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.scenes import two_view_scene
from two_views import same_geometry

#: The ways through the solver: the compiled loop over pairs (also with one who listens), the one
#: over conditioned matches, the readable one, other criteria, charts, structures and losses.
WAYS: dict[str, dict[str, Any]] = {
    "pairs": {},
    "callback": {"callback": lambda row: False},
    "numpy": {"backend": "numpy"},
    "gauss-newton": {"hessian": "gauss-newton"},
    "seber": {"damping": "seber"},
    "block": {"parameterization": "block"},
    "sampson": {"criterion": "sampson"},
    "epipolar": {"criterion": "epipolar"},
    "huber": {"loss": "huber", "loss_scale_px": 1.0},
    "cauchy": {"loss": "cauchy", "loss_scale_px": 1.0},
    "scale estimated": {"loss": "huber"},
    "joint": {"structure": "joint"},
    "noise estimated": {"noise_px": None},
    "several starts": {"starts": 3},
    "mahalanobis": {"covariance1": np.array([[2.0, 0.3], [0.3, 1.0]]), "noise_px": 1.0},
}
way = pytest.mark.parametrize("way", WAYS)


def weighted_scene(count: int = 60, seed: int = 3) -> tuple[Any, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    return two_view_scene(6.0, n_points=count, seed=seed), rng.uniform(0.2, 3.0, count), rng


def assert_same(a: eg.FundamentalResult, b: eg.FundamentalResult, x1: Any, x2: Any) -> None:
    """Compare F, cost, noise, RMS and covariance of two results of the same matches."""
    assert same_geometry(a.F, b.F, x1, x2) < 1e-6
    assert a.cost == pytest.approx(b.cost, rel=1e-9)
    assert a.rms_px == pytest.approx(b.rms_px, rel=1e-6)
    assert a.noise_px == pytest.approx(b.noise_px, rel=1e-6)
    size = np.abs(b.covariance).max()
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0.0, atol=1e-5 * size)
    assert a.loss_scale_px == pytest.approx(b.loss_scale_px, rel=1e-6)


@way
def test_a_match_of_weight_zero_is_a_match_left_out(way: str) -> None:
    scene, weights, rng = weighted_scene()
    x1, x2 = scene.x1, scene.x2
    without = eg.refine_fundamental(x1, x2, weights=weights, **WAYS[way])
    # Far off and everywhere: in centroid, scale, median or count they would show.
    places = np.sort(rng.integers(0, len(x1) + 1, 40))
    absurd1, absurd2 = rng.uniform(-4e3, 4e3, (2, 40, 2))
    y1, y2 = np.insert(x1, places, absurd1, axis=0), np.insert(x2, places, absurd2, axis=0)
    w = np.insert(weights, places, 0.0)
    found = eg.refine_fundamental(y1, y2, weights=w, **WAYS[way])
    assert_same(found, without, x1, x2)
    np.testing.assert_allclose(np.abs(found.fun[w > 0.0]), np.abs(without.fun), atol=1e-6)
    assert len(found.fun) == len(w)


@way
def test_the_order_of_matches_changes_nothing_beyond_one_block_either(way: str) -> None:
    scene, weights, rng = weighted_scene(700)
    # Two blocks of light matches and one of heavy ones: weights of one for those of another show.
    weights = np.concatenate([np.full(300, 0.1), np.full(400, 5.0)]) * weights
    order = rng.permutation(700)
    options = WAYS[way]
    one = eg.refine_fundamental(scene.x1, scene.x2, weights=weights, **options)
    other = eg.refine_fundamental(
        scene.x1[order], scene.x2[order], weights=weights[order], **options
    )
    assert_same(one, other, scene.x1, scene.x2)
    assert abs(one.nfev - other.nfev) <= 1


@pytest.mark.skipif(kernels.available()["c"] is not None, reason="needs the C library")
@pytest.mark.parametrize("loss", ["linear", "huber", "soft_l1", "cauchy", "truncated"])
@pytest.mark.parametrize("criterion", ["reprojection", "sampson", "epipolar"])
@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
def test_compiled_and_readable_loops_take_the_same_steps_with_weights_and_losses(
    loss: str, criterion: str, hessian: str
) -> None:
    scene, weights, rng = weighted_scene(600)
    x2 = scene.x2 + np.where(rng.random((600, 1)) < 0.1, rng.uniform(-9.0, 9.0, (600, 2)), 0.0)
    weights[::7] = 0.0
    options: dict[str, Any] = {"loss": loss, "criterion": criterion, "hessian": hessian}
    if loss != "linear":
        options["loss_scale_px"] = 1.5
    for F0 in (None, eg.fundamental_8point(scene.x1[:9], x2[:9])):
        a, b = (
            eg.refine_fundamental(
                scene.x1, x2, F0, weights=weights, max_iter=6, ftol=1e-9, backend=backend, **options
            )
            for backend in ("c", "numpy")
        )
        for row, other in zip(a.history, b.history, strict=False):
            assert row.accepted == other.accepted
            assert row.cost == pytest.approx(other.cost, rel=1e-6)
            assert row.step_norm == pytest.approx(other.step_norm, rel=1e-3, abs=1e-7)


@way
def test_weights_twice_as_large_are_twice_the_cost_of_the_same_geometry(way: str) -> None:
    scene, weights, _ = weighted_scene()
    one, two = (
        eg.refine_fundamental(
            scene.x1, scene.x2, weights=f * weights, **{"noise_px": 1.0} | WAYS[way]
        )
        for f in (1.0, 2.0)
    )
    assert same_geometry(one.F, two.F, scene.x1, scene.x2) < 1e-6
    assert two.cost == pytest.approx(2.0 * one.cost, rel=1e-8)
    if way != "noise estimated":
        np.testing.assert_allclose(
            two.covariance, 0.5 * one.covariance, rtol=0.0, atol=1e-6 * np.abs(one.covariance).max()
        )


def test_weights_and_isotropic_covariances_say_the_same() -> None:
    scene, weights, rng = weighted_scene()
    split = rng.uniform(0.5, 2.0, len(weights))
    options: dict[str, Any] = {"hessian": "gauss-newton", "ftol": 1e-14, "noise_px": 1.0}
    plain = eg.refine_fundamental(scene.x1, scene.x2, weights=weights, **options)
    C = np.eye(2) * (split / weights)[:, None, None]
    both = eg.refine_fundamental(
        scene.x1, scene.x2, weights=split, covariance1=C, covariance2=C, **options
    )
    assert same_geometry(both.F, plain.F, scene.x1, scene.x2) < 1e-6
    assert both.cost == pytest.approx(plain.cost, rel=1e-10)
    size = np.abs(plain.covariance).max()
    np.testing.assert_allclose(both.covariance, plain.covariance, rtol=0.0, atol=1e-5 * size)
    # The equations that led there were weighted, too: full steps, not many short ones.
    assert both.nfev <= plain.nfev + 2


def test_one_covariance_alone_leaves_the_other_image_at_one_pixel() -> None:
    scene, _, _ = weighted_scene()
    C = np.array([[4.0, 1.0], [1.0, 2.0]])
    for name, other in (("covariance1", "covariance2"), ("covariance2", "covariance1")):
        alone = eg.refine_fundamental(scene.x1, scene.x2, **{name: C})
        both = eg.refine_fundamental(scene.x1, scene.x2, **{name: C, other: np.eye(2)})
        np.testing.assert_array_equal(alone.F, both.F)
        same = eg.refine_fundamental(scene.x1, scene.x2, covariance1=C, covariance2=C)
        assert alone.cost > 1.01 * same.cost  # it is not taken for both


# An estimated scale of the loss is another one at another F.
@pytest.mark.parametrize("way", [w for w in WAYS if w != "scale estimated"])
def test_the_minimum_is_one_of_the_weighted_cost(way: str) -> None:
    # No direction away from F lowers the cost that distances, weights and loss make up.
    scene, weights, rng = weighted_scene(300)
    options = WAYS[way]
    result = eg.refine_fundamental(scene.x1, scene.x2, weights=weights, **options)

    def cost(F: np.ndarray) -> float:
        start = eg.refine_fundamental(
            scene.x1, scene.x2, F, weights=weights, max_iter=1, **options
        ).history[0]
        return float(start.cost)

    U, s, Vt = np.linalg.svd(result.F)
    for _ in range(8):
        twist = np.eye(3) + 1e-5 * np.diag([1.0, -1.0], 1) * rng.standard_normal((3, 3))
        near = (U @ twist)[:, :2] * s[:2] @ Vt[:2]
        assert cost(near) > result.cost * (1.0 - 1e-12)
    assert cost(result.F) == pytest.approx(result.cost, rel=1e-8)


@pytest.mark.parametrize("criterion", ["reprojection", "sampson", "epipolar"])
@pytest.mark.parametrize("backend", ["c", "numpy"])
def test_rms_is_that_of_the_reprojection_whatever_is_minimised(
    criterion: str, backend: str
) -> None:
    if kernels.available()[backend] is not None:
        pytest.skip("needs the C library")
    scene, weights, _ = weighted_scene()
    weights[::3] = 0.0
    result = eg.refine_fundamental(
        scene.x1, scene.x2, weights=weights, criterion=criterion, backend=backend
    )
    d = eg.reprojection_distances(result.F, scene.x1, scene.x2)[0][weights > 0.0]
    # Four coordinates a match share its squared distance.
    assert result.rms_px == pytest.approx(np.sqrt(np.mean(d**2) / 4.0), rel=1e-9)
    if criterion == "epipolar":
        assert np.abs(result.fun[weights > 0.0]).max() > 1.1 * np.abs(d).max()


@pytest.mark.parametrize("backend", ["c", "numpy"])
def test_distances_are_those_of_the_result_where_the_last_step_was_rejected(backend: str) -> None:
    if kernels.available()[backend] is not None:
        pytest.skip("needs the C library")
    rejected = 0
    for seed in range(12 if backend == "c" else 2):
        scene = two_view_scene(14.0, n_points=30, seed=seed)
        for most in range(1, 8):
            result = eg.refine_fundamental(
                scene.x1, scene.x2, max_iter=most, backend=backend, damping="seber"
            )
            rejected += not result.history[-1].accepted
            d, *_ = eg.reprojection_distances(result.F, scene.x1, scene.x2)
            np.testing.assert_allclose(np.abs(result.fun), np.abs(d), atol=1e-8)
            assert result.cost == pytest.approx(0.5 * np.sum(d**2), rel=1e-9)
            assert result.success <= (result.status > 0)
            assert (result.status == 0) <= (result.nit == most)
            if result.status == 0:
                assert not result.success
    assert rejected > 1


def judged_scene(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return matches that are judged in different ways: see the names."""
    scene, rng = two_view_scene(6.0, n_points=60, noise_px=0.5, seed=4), np.random.default_rng(4)
    x1, x2 = scene.x1.copy(), scene.x2.copy()
    noise = 0.3 * rng.standard_normal(x1.shape)
    if kind == "plane":
        x2 = x1 @ [[1.1, 0.1], [-0.1, 0.9]] + [20.0, 5.0] + noise
    elif kind == "line":
        x1 = rng.uniform(0.0, 500.0, (60, 1)) * [1.0, 0.4] + noise
        x2 = 0.8 * x1 + [30.0, -9.0] + 0.2 * rng.standard_normal(x1.shape)
    elif kind == "random":
        x2 = rng.uniform(0.0, 500.0, x1.shape)
    elif kind == "gross errors":
        x2[:3] += 90.0
    return x1, x2


@pytest.mark.parametrize("kind", ["scene", "plane", "line", "random", "gross errors"])
@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_a_common_factor_of_the_weights_changes_no_verdict(kind: str, factor: float) -> None:
    """Powers of two leave every digit as it is: noise is that of weight one, flags are of all."""
    x1, x2 = judged_scene(kind)
    weights = np.random.default_rng(5).uniform(0.5, 2.0, len(x1))
    ways: list[Any] = [
        lambda w: eg.refine_fundamental(x1, x2, weights=w),
        lambda w: eg.refine_fundamental(x1, x2, weights=w, loss="huber"),
    ]
    if kind == "scene":
        ways.append(lambda w: eg.estimate_fundamental(x1, x2, weights=w))
    batches = [
        eg.refine_fundamental_batch(x1, x2, [0, len(x1)], weights=w)
        for w in (weights, factor * weights)
    ]
    assert batches[0].flags == batches[1].flags
    for run in ways:
        one, other = run(weights), run(factor * weights)
        assert one.flags == other.flags
        assert one.success == other.success
        if kind != "gross errors":  # which a robust loss leaves out
            assert one.success == (kind == "scene")
        assert other.noise_px == pytest.approx(math.sqrt(factor) * one.noise_px, rel=1e-3)
