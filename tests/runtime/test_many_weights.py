"""Laws of weights in many views: what counts, by how much, in whatever order and by how many
workers.
"""

from __future__ import annotations

from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge.bundle.solve import Blocks
from epigauge.bundle.strategies import InGauge
from epigauge.cameras import camera_model
from epigauge.scatter import scatter_constraints

Array = many_views.Array

LOSSES: dict[str, dict[str, Any]] = {
    "linear": {},
    "huber": {"loss": "huber", "loss_scale_px": 1.0},
    "cauchy": {"loss": "cauchy", "loss_scale_px": 1.0},
    "scale estimated": {"loss": "huber"},
}


def weighted(n: int = 6, m: int = 40, *, seen: float = 0.7, seed: int = 1) -> tuple[Any, ...]:
    """Return tracks with weights from 0.2 to 4, and a start away from their optimum."""
    truth = many_views.cameras_and_points(n, m, seed=seed)
    tracks = many_views.observed(truth, 1.0, seen=seen, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.2, 4.0, len(tracks))
    tracks = eg.Tracks(tracks.view, tracks.point, tracks.xy, n, m, weights)
    return tracks, many_views.shaken(truth, seed=seed)


def squares(tracks: eg.Tracks, found: eg.Reconstruction) -> Array:
    """Return the squared residuals in pixels."""
    h = np.einsum("kij,kj->ki", found.P[tracks.view], found.Q[tracks.point])
    return np.sum((h[:, :2] / h[:, 2:] - tracks.xy) ** 2, axis=1)


@pytest.mark.parametrize("backend", ["c", "numpy"])
@pytest.mark.parametrize("loss", LOSSES)
def test_an_observation_of_weight_zero_is_one_left_out(backend: str, loss: str) -> None:
    many_views.need_backend(backend)
    tracks, start = weighted()
    seen = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    seen[tracks.view, tracks.point] = True
    view, point = np.nonzero(~seen)
    absurd = np.random.default_rng(3).uniform(-5e4, 5e4, (len(view), 2))
    order = np.random.default_rng(4).permutation(len(tracks) + len(view))
    more = eg.Tracks(
        np.concatenate([tracks.view, view])[order],
        np.concatenate([tracks.point, point])[order],
        np.concatenate([tracks.xy, absurd])[order],
        tracks.n_views,
        tracks.n_points,
        np.concatenate([tracks.weights, np.zeros(len(view))])[order],
    )
    options = LOSSES[loss] | {"backend": backend}
    one, other = (eg.bundle_adjust(t, start, **options) for t in (tracks, more))
    assert other.cost == pytest.approx(one.cost, rel=1e-7)
    assert other.rms_px == pytest.approx(one.rms_px, rel=1e-6)
    assert other.loss_scale_px == pytest.approx(one.loss_scale_px, rel=1e-6)
    assert abs(other.nfev - one.nfev) <= 1
    assert other.rank == one.rank
    if loss == "linear":
        sizes = [
            eg.covariance(t, r.reconstruction, backend=backend).noise_px
            for t, r in ((tracks, one), (more, other))
        ]
        assert sizes[1] == pytest.approx(sizes[0], rel=1e-6)
        p = 11 * tracks.n_views + 3 * tracks.n_points - 15
        expected = np.sqrt(2.0 * one.cost / (2 * len(tracks) - p))
        assert sizes[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("backend", ["c", "numpy"])
@pytest.mark.parametrize("n", [5, 60])
def test_the_cost_weighs_each_observation_with_its_own_weight(backend: str, n: int) -> None:
    # Many views in a chain, given in random order: the solver works on them in another one.
    many_views.need_backend(backend)
    m = 12 * n
    truth = many_views.cameras_and_points(n, m, seed=2)
    rng = np.random.default_rng(2)
    first = np.arange(m) % (n - 3)
    point, view = np.repeat(np.arange(m), 4), (first[:, None] + np.arange(4)).ravel()
    shuffled = rng.permutation(n)
    cameras = np.empty_like(truth.P)
    cameras[shuffled] = truth.P
    truth = eg.Reconstruction(cameras, truth.Q)
    view = shuffled[view]
    h = np.einsum("kij,kj->ki", truth.P[view], truth.Q[point])
    xy = h[:, :2] / h[:, 2:] + rng.standard_normal((len(view), 2))
    weights = 0.1 + 10.0 * (rng.random(len(view)) < 0.3)
    order = rng.permutation(len(view))
    tracks = eg.Tracks(view[order], point[order], xy[order], n, m, weights[order])
    start = many_views.shaken(truth, seed=2)
    found = eg.bundle_adjust(tracks, start, backend=backend, max_iter=4, embedded=False)
    before = 0.5 * np.sum(tracks.weights * squares(tracks, start))
    assert found.history[0].cost == pytest.approx(before, rel=1e-8)
    after = 0.5 * np.sum(tracks.weights * squares(tracks, found.reconstruction))
    assert found.cost == pytest.approx(after, rel=1e-8)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("schedule", ["classic", "nielsen"])
def test_workers_and_back_ends_take_the_same_course(loss: str, schedule: str) -> None:
    many_views.need_backend("c")
    tracks, start = weighted(8, 90)
    ways: list[dict[str, Any]] = [
        {"backend": "c"},
        {"backend": "c", "workers": 3},
        {"backend": "numpy"},
    ]
    runs = [
        eg.bundle_adjust(tracks, start, schedule=schedule, max_iter=6, **way, **LOSSES[loss])
        for way in ways
    ]
    for other in runs[1:]:
        assert len(runs[0].history) == len(other.history)
        for a, b in zip(runs[0].history, other.history, strict=True):
            assert b.cost == pytest.approx(a.cost, rel=1e-5)
            assert b.lam == pytest.approx(a.lam, rel=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_optimum_is_one_of_the_weighted_cost(loss: str) -> None:
    tracks, start = weighted()
    found = eg.bundle_adjust(tracks, start, ftol=1e-13, **LOSSES[loss])
    options = {"loss": LOSSES[loss].get("loss", "linear"), "loss_scale_px": found.loss_scale_px}
    if options["loss"] == "linear":
        options = {}

    def cost(P: Array, Q: Array) -> float:
        row = eg.bundle_adjust(tracks, eg.Reconstruction(P, Q), max_iter=1, **options).history[0]
        return float(row.cost)

    P, Q = found.reconstruction.P, found.reconstruction.Q
    assert cost(P, Q) == pytest.approx(found.cost, rel=1e-9)
    rng = np.random.default_rng(6)
    for _ in range(4):
        moves = 1e-4 * rng.standard_normal(P.shape), 1e-4 * rng.standard_normal(Q.shape)
        sides = [cost(P * (1.0 + s * moves[0]), Q * (1.0 + s * moves[1])) for s in (1.0, -1.0)]
        # Both sides rise, and by the same amount to first order.
        assert min(sides) > found.cost
        rises = [side - found.cost for side in sides]
        assert max(rises) < 1.5 * min(rises)


def test_steps_of_mclauchlan_keep_the_normalised_basis_to_first_order() -> None:
    truth = many_views.cameras_and_points(4, 25, seed=3)
    tracks = many_views.observed(truth, 2.0, seed=3)
    P, Q = many_views.in_units(many_views.shaken(truth, seed=3))
    leaves = {}
    for constrained in (False, True):
        problem = many_views.problem_of(tracks)
        problem.freedom = InGauge(
            model=camera_model("projective"),
            gauge=eg.gauge.normalized(),
            with_constraints=constrained,
        )
        system = problem.linearize(problem.evaluate((P, Q)))
        identities = np.tile(np.eye(12), (4, 1, 1)), np.zeros(0), np.tile(np.eye(4), (25, 1, 1))
        lam = 1e-9 * system.largest()
        step = system.damped_step(Blocks(*identities), lam)
        dP, dQ = step.cameras.reshape(4, 3, 4), step.points
        norms = np.concatenate([np.sum(P * dP, axis=(1, 2)), np.sum(Q * dQ, axis=1)])
        scatter = np.einsum("mi,mij->j", dQ, scatter_constraints(Q).reshape(25, 4, -1))
        size = max(np.abs(dP).max(), np.abs(dQ).max())
        leaves[constrained] = max(np.abs(norms).max(), np.abs(scatter).max()) / size
    assert leaves[True] < 1e-4
    assert leaves[False] > 1e-2
