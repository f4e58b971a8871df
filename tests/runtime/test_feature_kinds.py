"""Features of several kinds in one problem: what all take off the cameras is added up."""

from __future__ import annotations

import pickle

import epigauge as eg
import numpy as np
import pytest
from epigauge.bundle import native_linearizer, numpy_linearizer
from epigauge.bundle.dampings import Covariant, Marquardt
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.kernels import table
from epigauge.multi_view.line_adjust import line_problem

BACKENDS = [
    pytest.param(name, marks=[] if why is None else pytest.mark.skip(why))
    for name, why in eg.kernels.available().items()
    if name != "casadi"
]


def seen_by(n_views, window, step=1):
    """Return a scene whose points are each seen by a few neighbours, lines by views far apart."""
    scene = eg.line_scene(
        n_views=n_views, n_points=10 * n_views, n_lines=min(2 * n_views, 30), seed=1
    )
    tracks, lines = scene.tracks, scene.line_tracks
    near = (tracks.view - tracks.point) % n_views < window
    tracks = eg.Tracks(tracks.view[near], tracks.point[near], tracks.xy[near], min_points=1)
    far = (lines.view - lines.line) % n_views % step == 0
    lines = eg.LineTracks(lines.view[far], lines.line[far], lines.segments[far])
    return tracks, lines, scene.true


def linearized(tracks, lines, start, backend, **options):
    job = line_problem(tracks, start, lines, table(backend), **options)
    return job, job.problem.linearize(job.problem.evaluate(job.start))


def dense_step(job, system, damping, lam):
    """Return the step by the whole matrix, from the Jacobians of points and lines."""
    problem, own, (at,) = job.problem, job.problem.linearizer, job.start.others
    (lines,), cameras, features = problem.kinds, system.cameras, system.points
    measured = own.graph, own.q, own.weights, own.loss
    points = NumpyLinearizer(problem.model, table("numpy"), *measured)
    parts = [(points, features, 0), (lines, at, features.size)]
    (n, d), total = system.normal.g_cameras.shape, features.size + 4 * len(at)
    J, e = [], []
    for own, rows, offset in parts:
        r, A, B = own.observe(cameras, rows)
        block = np.zeros((2, r.shape[1], n * d + total))
        for k, (i, j) in enumerate(zip(own.graph.view, own.graph.point, strict=True)):
            block[:, k, d * i : d * (i + 1)] = A[..., k]
            b, first = B.shape[1], n * d + offset
            block[:, k, first + b * j : first + b * (j + 1)] = B[..., k]
        J.append(block.reshape(-1, n * d + total))
        e.append(-r.ravel())
    J, e = np.concatenate(J), np.concatenate(e)
    ties = system.ties
    A = np.broadcast_to(np.eye(d), (n, d, d)) if ties.A is None else ties.A
    a, r = A.shape[2], ties.n_shared
    T = np.zeros((n * d + total, n * a + r + total))
    for i in range(n):
        T[d * i : d * (i + 1), a * i : a * (i + 1)] = A[i]
    T[: n * d, n * a : n * a + r] = ties.border(n, d).reshape(n * d, r)
    T[n * d :, n * a + r :] = np.eye(total)
    W, blocks = np.zeros((T.shape[1],) * 2), damping.blocks(system)
    diagonal = [*blocks.cameras, np.diag(blocks.shared), *blocks.points, *blocks.others[0]]
    start = 0
    for block in diagonal:
        W[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    N = T.T @ J.T @ J @ T
    frozen = ~T.any(axis=0)
    N[frozen, frozen] = 1.0
    return T @ np.linalg.solve(N + lam * W, -T.T @ J.T @ e)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("damping", [Covariant(), Marquardt()])
@pytest.mark.parametrize("refine", ["all", "pose"])
def test_a_step_of_points_and_lines_is_that_of_the_whole_matrix(backend, damping, refine):
    tracks, lines, start = seen_by(5, 3)
    job, system = linearized(tracks, lines, start, backend, refine=refine, fixed_views=[1])
    found = np.asarray(system.damped_step(damping.blocks(system), 1e-3))
    wanted = dense_step(job, system, damping, 1e-3)
    assert np.abs(found - wanted).max() < 1e-8 * np.abs(wanted).max()


def steps(tracks, lines, start, backend):
    system = linearized(tracks, lines, start, backend, refine="pose")[1]
    return np.asarray(system.damped_step(Covariant().blocks(system), 1e-4))


@pytest.mark.parametrize("n_views", [14, 60])
def test_lines_couple_views_that_share_no_point(n_views):
    scene = seen_by(n_views, 3, n_views // 2)
    reference = steps(*scene, "numpy")
    assert np.abs(steps(*scene, None) - reference).max() < 1e-8 * np.abs(reference).max()


@pytest.mark.parametrize("backend", BACKENDS)
def test_conjugate_gradients_make_the_same_step(backend, monkeypatch):
    scene = seen_by(6, 3, 2)
    direct = steps(*scene, backend)
    monkeypatch.setattr(numpy_linearizer, "DENSE_CAMERAS", 1)
    monkeypatch.setattr(native_linearizer, "is_direct", lambda *_: False)
    assert np.abs(steps(*scene, backend) - direct).max() < 1e-6 * np.abs(direct).max()


def test_a_problem_goes_to_other_processes():
    if eg.kernels.available()["c"] is not None:
        pytest.skip(str(eg.kernels.available()["c"]))
    job, system = linearized(*seen_by(14, 3, 7), "c")
    own = pickle.loads(pickle.dumps(job.problem.linearizer))  # noqa: S301 - its own bytes
    normal, alone = own.linearize(system.cameras, system.points), system.normal.alone()
    np.testing.assert_allclose(normal.U, alone.U, rtol=1e-9, atol=1e-9 * np.abs(alone.U).max())
    assert own.skyline.blocks == job.problem.linearizer.skyline.blocks
