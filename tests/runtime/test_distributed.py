"""Bundle adjustment by the workers of a Dask cluster: as in one process, wherever points are."""

from __future__ import annotations

import json
import os
import signal
import warnings
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from clusters import cluster, metric
from epigauge.distributed.sums import Rows, combined, whole

distributed = pytest.importorskip("distributed")


def the_same(found: Any, expected: Any, tolerance: float = 1e-12) -> None:
    assert found.cost == pytest.approx(expected.cost, rel=tolerance)
    assert (found.nit, found.status, found.success) == (
        expected.nit,
        expected.status,
        expected.success,
    )
    assert (found.flags, found.rank) == (expected.flags, expected.rank)
    assert found.n_behind == expected.n_behind
    np.testing.assert_allclose(found.fun, expected.fun, rtol=0.0, atol=1e-7)


OPTIONS: list[dict[str, Any]] = [
    {"refine": ("f",), "fixed_views": [0, 3], "fixed_points": [1, 2, 40], "loss": "cauchy"},
    {},
    {"refine": "pose"},
    {"embedded": False},
    {"method": "marquardt", "max_iter": 4},
    {"priors": [eg.PositionPrior(0, [0.0, 0.0, -5.0], 0.01)], "max_iter": 4},
    {"solver": "cg", "max_iter": 1},
]
QUICK, *SLOW = OPTIONS


@pytest.mark.parametrize(
    "options",
    [QUICK, *(pytest.param(own, marks=pytest.mark.slow) for own in SLOW)],
    ids=lambda options: "-".join(options) or "default",
)
def test_a_metric_adjustment_is_that_of_one_process(client: Any, options: dict[str, Any]) -> None:
    tracks, start = metric()
    found = eg.distributed.bundle_adjust(tracks, client, start, **options)
    here = {name: value for name, value in options.items() if name != "solver"}
    # Conjugate gradients end at a relative 1e-10.
    tolerance = 1e-9 if "solver" in options else 1e-12
    the_same(found, eg.bundle_adjust(tracks, start, **here), tolerance)


def off(points: Any, others: Any) -> float:
    """Return the largest distance after a similarity, over the size of the points."""
    A, B = points - points.mean(axis=0), others - others.mean(axis=0)
    U, values, Vt = np.linalg.svd(B.T @ A)  # far from a reflection
    return float(np.abs(A - B @ (U @ Vt) * (values.sum() / np.vdot(B, B))).max() / np.abs(A).max())


def test_points_differ_by_rounding_and_a_similarity(client: Any) -> None:
    # Nothing holds the gauge, which rounding moves: by some 1e-10 of the scene.
    tracks, start = metric()
    for options in ({}, {"ftol": 0.0, "max_iter": 3}):
        found = eg.distributed.bundle_adjust(tracks, client, start, **options)
        expected = eg.bundle_adjust(tracks, start, **options)
        assert found.nit == expected.nit
        # Measured: 2e-14.
        assert off(expected.reconstruction.X, found.reconstruction.X) < 1e-12
        sizes = np.abs(expected.fun).max()
        assert np.abs(found.fun - expected.fun).max() < 1e-10 * sizes


@pytest.mark.slow
def test_projective_and_affine_adjustments_are_those_of_one_process(client: Any) -> None:
    tracks = eg.multi_view_scene(n_points=60, seed=2).tracks
    for start in (eg.initialize(tracks), eg.initialize_affine(tracks)):
        found = eg.distributed.bundle_adjust(tracks, client, start)
        the_same(found, eg.bundle_adjust(tracks, start))


@pytest.mark.slow
def test_measurements_with_covariances_and_gross_errors_are_adjusted_alike(client: Any) -> None:
    tracks, start = metric()
    spread = np.array([[1.0, 0.3], [0.3, 0.5]])
    parts = tracks.view, tracks.point, tracks.xy
    oblong = eg.Tracks(*parts, covariance=spread)
    the_same(eg.distributed.bundle_adjust(oblong, client, start), eg.bundle_adjust(oblong, start))
    xy = tracks.xy.copy()
    xy[[5, 77]] += 40.0
    wrong = eg.Tracks(tracks.view, tracks.point, xy)
    found = eg.distributed.bundle_adjust(wrong, client, start, robust=True)
    assert found.rejected[[5, 77]].all()
    the_same(found, eg.bundle_adjust(wrong, start, robust=True))


@pytest.mark.slow
def test_the_callback_is_told_each_step_and_stops(client: Any) -> None:
    tracks, start = metric()
    rows: list[Any] = []

    def stop(row: Any) -> bool:
        rows.append(row)
        return len(rows) == 2

    found = eg.distributed.bundle_adjust(tracks, client, start, callback=stop)
    assert found.status == -2
    assert [row.cost for row in rows] == [row.cost for row in found.history]


@pytest.mark.slow
def test_the_number_of_workers_does_not_change_a_bit() -> None:
    tracks, start = metric(shared=False)
    found = set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for count in (1, 2, 3):
            with cluster(count) as workers, distributed.Client(workers) as client:
                result = eg.distributed.bundle_adjust(tracks, client, start, partitions=7)
                found.add(result.reconstruction.X.tobytes() + result.fun.tobytes())
    assert len(found) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("when", "times"),
    [
        ("linearize_state", 3),
        ("advance", 3),
        ("linearize_state", 6),
        ("advance", 7),
        ("points_of_state", 1),
        ("advance", 11),
    ],
)
def test_a_worker_that_dies_costs_a_step(
    when: str, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from epigauge.distributed import dispatch

    tracks, start = metric()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with cluster(2) as workers, distributed.Client(workers) as client:
            # Points are fetched after the fourth step: what is lost later begins there.
            how: dict[str, Any] = {"ftol": 0.0, "max_iter": 6}
            expected = eg.distributed.bundle_adjust(tracks, client, start, **how)
            assert expected.nit == 6
            assert sum(row.accepted for row in expected.history) > 5
            victim = next(iter(client.run(os.getpid).values()))
            calls, killed, submitted = [], [], dispatch.Dispatch.submitted

            def killing(self: Any, address: str, name: str, *rest: Any) -> Any:
                calls.append(name)
                future = submitted(self, address, name, *rest)
                # In the second step or a later one: both workers are called in each.
                if calls.count(when) >= times and not killed:
                    killed.append(victim)
                    os.kill(victim, signal.SIGKILL)
                return future

            monkeypatch.setattr(dispatch.Dispatch, "submitted", killing)
            found = eg.distributed.bundle_adjust(tracks, client, start, **how)
            assert killed
            assert victim not in client.run(os.getpid).values()
    assert found.nit == expected.nit
    np.testing.assert_array_equal(found.fun, expected.fun)
    np.testing.assert_array_equal(found.reconstruction.X, expected.reconstruction.X)


def test_what_cannot_be_used_is_named(client: Any) -> None:
    tracks, start = metric()
    with pytest.raises(eg.ArgumentError, match="client is of type int"):
        eg.distributed.bundle_adjust(tracks, 4, start)
    with pytest.raises(eg.ArgumentError, match="solver"):
        eg.distributed.bundle_adjust(tracks, client, start, solver="lu")
    with pytest.raises(eg.ArgumentError, match="partitions"):
        eg.distributed.bundle_adjust(tracks, client, start, partitions=0)
    with pytest.raises(eg.ArgumentError, match="workers"):
        eg.distributed.bundle_adjust(tracks, client, start, workers=2)
    scene = eg.line_scene(n_views=3, n_points=8, n_lines=4)
    with pytest.raises(eg.ArgumentError, match="lines is given beside a client"):
        eg.distributed.bundle_adjust(scene.tracks, client, scene.true, lines=scene.line_tracks)


def test_a_closed_client_is_named(client: Any) -> None:
    tracks, start = metric()
    other = distributed.Client(client.scheduler.address)
    other.close()
    with pytest.raises(eg.ArgumentError, match="not connected"):
        eg.distributed.bundle_adjust(tracks, other, start)


@pytest.mark.slow
def test_the_command_line_adjusts_by_a_scheduler(client: Any, tmp_path: Path, run: Any) -> None:
    path = tmp_path / "scene.npz"
    eg.save_scene(path, *metric())
    _, out, _ = run("bundle", path, "--json")
    here = json.loads(out)
    code, out, _ = run("bundle", path, "--json", "--scheduler", client.scheduler.address)
    there = json.loads(out)
    assert code == 0
    assert there["cost"] == pytest.approx(here["cost"], rel=1e-12)
    assert (there["flags"], there["rank"]) == (here["flags"], here["rank"])
    code, _, told = run("bundle", path, "--scheduler", "nonsense://place")
    assert code == 2
    assert "--scheduler" in told


@pytest.mark.slow
def test_products_by_workers_solve_as_products_here_do(
    client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from epigauge.bundle import native_linearizer

    if eg.kernels.available()["c"] is not None:
        pytest.skip("the C library is not there")
    tracks, start = metric(shared=False)
    found = eg.distributed.bundle_adjust(tracks, client, start, solver="cg", max_iter=1)
    monkeypatch.setattr(native_linearizer, "is_direct", lambda *_: False)
    here = eg.bundle_adjust(tracks, start, max_iter=1)
    assert found.cost == pytest.approx(here.cost, rel=1e-12)
    assert found.nit == here.nit


@pytest.mark.parametrize("count", [1, 2, 5, 8, 13])
def test_sums_do_not_depend_on_where_they_are_made(count: int) -> None:
    rng = np.random.default_rng(count)

    def rows() -> Rows:
        index = np.flatnonzero(rng.random(9) < 0.7)
        return Rows(index, rng.normal(size=(len(index), 2)) * 10.0 ** rng.integers(-8, 8))

    terms: Any = {(0, k): (rows(), float(rng.normal())) for k in range(count)}
    (expected, number) = whole(terms, count)
    total = sum(one.spread(9) for one, _ in terms.values())
    np.testing.assert_allclose(expected.spread(9), total, rtol=1e-9, atol=1e-6)
    for cut in range(count + 1):
        parts = [{k: v for k, v in terms.items() if (k[1] < cut) is left} for left in (True, False)]
        joined = combined(parts[0], count) | combined(parts[1], count)
        again, other = whole(joined, count)
        assert other == number
        np.testing.assert_array_equal(again.spread(9), expected.spread(9))
