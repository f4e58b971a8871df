"""Bundle adjustment of metric cameras takes the same steps in every frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from bundle_scenes import CASES, LONE, problem_of, scene, similarity
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.problem import Estimate
from epigauge.bundle.similarity import Similarity, normal_frame
from laws import distance

Array = many_views.Array


class TestInvariance:
    """The theorem of docs/gauges.md: equivariant update, covariant damping, choices by costs."""

    def test_steps_are_equivariant_in_any_frame(self) -> None:
        tracks, start = scene(**LONE)
        problem, state = problem_of(tracks, start)
        system = problem.linearize(state)
        step = Covariant().step(system, 1e-3)
        for seed in range(10):
            rng = np.random.default_rng(seed)
            there = replace(similarity(seed), target=rng.standard_normal(3))
            moved = problem.evaluate(Estimate(*there.apply(state.cameras, state.points)))
            other = Covariant().step(problem.linearize(moved), 1e-3)
            cameras, points = there.blocks(4, 25, step.cameras.shape[1])
            expected = np.einsum("nij,nj->ni", cameras, step.cameras)
            size = np.abs(expected).max(axis=0)
            assert distance(other.cameras / size, expected / size) < 1e-6
            expected = np.einsum("mij,mj->mi", points, step.points)
            size = np.abs(expected).max()
            assert distance(other.points / size, expected / size) < 1e-6

    def test_lambda_diag_of_the_usual_frame_is_not_invariant(self) -> None:
        # Marquardt's diagonal of the points depends on the directions of the axes.
        tracks, start = scene()
        costs = [
            eg.bundle_adjust(
                tracks, eg.gauge.transform(start, similarity(seed)), method="marquardt", max_iter=3
            )
            .history[1]
            .cost
            for seed in range(3)
        ]
        assert np.ptp(costs) > 1e-6 * costs[0]

    @pytest.mark.parametrize("case", ["pose", "groups", "priors"])
    def test_whole_runs_are_the_same_in_any_frame(self, case: str) -> None:
        made, options = CASES[case]
        tracks, start = scene(**made)
        expected = eg.bundle_adjust(tracks, start, **options)
        for seed in range(20):
            there, moved_options = similarity(seed), dict(options)
            if options.get("priors"):
                moved_options["priors"] = [_moved(prior, there) for prior in options["priors"]]
            found = eg.bundle_adjust(tracks, eg.gauge.transform(start, there), **moved_options)
            assert (found.nfev, found.status) == (expected.nfev, expected.status)
            for a, b in zip(found.history, expected.history, strict=True):
                assert a.cost == pytest.approx(b.cost, rel=1e-9)
            back = eg.gauge.transform(found.reconstruction, there.inverse())
            assert distance(back.X, expected.reconstruction.X) < 1e-3
            assert distance(found.fun, expected.fun) < 1e-3

    def test_the_normal_frame_is_the_same_from_anywhere(self) -> None:
        _, start = scene()
        points = normal_frame(start.vectors, start.X).positions(start.X)
        for seed in range(5):
            there = similarity(seed)
            moved = eg.gauge.transform(start, there)
            found = normal_frame(moved.vectors, moved.X).positions(moved.X)
            assert distance(found @ there.rotation, points) < 1e-8


def _moved(prior: Any, there: Similarity) -> Any:
    if isinstance(prior, eg.IntrinsicPrior):
        return prior
    if isinstance(prior, eg.RotationPrior):  # deviations are in the camera's frame
        return replace(prior, rotation=prior.rotation @ there.rotation.T)
    C = prior.covariance
    C = np.diag(np.square(prior.sigma)) if C is None else C
    C = there.scale**2 * there.rotation @ C @ there.rotation.T
    place = there.positions(np.array([prior.position]))[0]
    return replace(prior, position=place, sigma=None, covariance=0.5 * (C + C.T))
