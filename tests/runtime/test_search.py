"""The search for F: compiled and NumPy alike, planes, wrong matches of repeated structure."""

from __future__ import annotations

from types import SimpleNamespace

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.two_view.conditioning import condition
from epigauge.two_view.front_ends import _is_sharp
from epigauge.two_view.neighbours import accord, ranked
from epigauge.two_view.search import search
from two_views import algebraic

NUMPY = kernels.table("numpy")
K = np.array([[1000.0, 0.0, 700.0], [0.0, 1000.0, 500.0], [0.0, 0.0, 1.0]])
R = np.array([[np.cos(0.2), 0.0, np.sin(0.2)], [0.0, 1.0, 0.0], [-np.sin(0.2), 0.0, np.cos(0.2)]])


def compiled():
    if kernels.available()["c"]:
        pytest.skip("no compiled library")
    return kernels.table("c")


def projected(X, rng, noise_px=0.3):
    """Return noisy matches of points, and their noise-free ones."""
    views = (X @ K.T, (X @ R.T + [-1.0, 0.1, 0.2]) @ K.T)
    x1, x2 = (h[:, :2] / h[:, 2:] for h in views)
    noisy = (x + noise_px * rng.standard_normal(x.shape) for x in (x1, x2))
    return *noisy, x1, x2


def facade(seed, off=60, on=240, wrong=300):
    """Return matches of a wall, of some points before it, and wrong ones along its rows."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-3, 3, on), rng.uniform(-2, 2, on), np.full(on, 6.0)])
    free = np.column_stack(
        [rng.uniform(-2, 2, off), rng.uniform(-1.5, 1.5, off), rng.uniform(3.5, 5.5, off)]
    )
    x1, x2, true1, true2 = projected(np.concatenate([wall, free]), rng)
    rows = rng.integers(0, on, wrong)
    # A window is taken for another of its row: near the epipolar line, far along it.
    shifted = wall[rows] + np.column_stack(
        [rng.uniform(-2.0, 2.0, wrong), rng.normal(0.0, 0.1, wrong), np.zeros(wrong)]
    )
    more1, more2 = projected(wall[rows], rng)[0], projected(shifted, rng)[1]
    return np.concatenate([x1, more1]), np.concatenate([x2, more2]), true1, true2


def near_planar(seed, wrong=0.3):
    """Return 500 matches, 25 of them off a plane, which are wrong, and noise-free ones."""
    rng = np.random.default_rng(seed)
    rays = np.column_stack([*rng.uniform(-0.5, 0.5, (2, 500)), np.ones(500)])
    X = 6.0 * rays / (rays @ [*rng.uniform(-0.4, 0.4, 2), 1.0])[:, None]
    X[:25] = rays[:25] * rng.uniform(4.0, 5.0, (25, 1))
    x1, x2, true1, true2 = projected(X, rng, noise_px=0.5)
    chosen = rng.permutation(500)[: round(wrong * 500)]
    for x in (x1, x2):
        x[chosen] = rng.uniform(0.0, 1000.0, (len(chosen), 2))
    return x1, x2, true1, true2, np.setdiff1d(np.arange(25), chosen)


@pytest.mark.parametrize(
    ("scene", "seed"), [(facade, 0), (facade, 1), (facade, 2), (near_planar, 0), (near_planar, 1)]
)
def test_compiled_and_numpy_search_are_the_same(scene, seed):
    table = compiled()
    x1, x2 = scene(seed)[:2]
    q = condition(x1, x2).forward(x1, x2)
    order = ranked(table, *q)
    np.testing.assert_array_equal(order, ranked(NUMPY, *q))
    for own in (order, None):
        one, other = (search(t, *q, own, seed=seed) for t in (table, NUMPY))
        assert one.samples == other.samples
        assert one.score == pytest.approx(other.score, rel=1e-9)
        assert min(np.abs(one.F - other.F).max(), np.abs(one.F + other.F).max()) < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_wrong_matches_of_repeated_structure_do_not_move_a_facade(seed):
    x1, x2, true1, true2 = facade(seed)
    result = eg.estimate_fundamental(x1, x2, seed=seed)
    errors = eg.reprojection_distances(result.F, true1, true2)[0]
    assert np.sqrt(np.mean(errors**2)) < 0.3
    assert np.mean(result.inlier[:300]) > 0.9
    assert result.start == "native"


def windows(seed, off=30, on=400, shifted=100, wrong=200):
    """Return matches of a wall, of points before it, of windows of one row that are taken for each
    other, and wrong ones; and noise-free right ones."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-3, 3, on), rng.uniform(-2, 2, on), np.full(on, 6.0)])
    free = np.column_stack([rng.uniform(1, 2, off), rng.uniform(0, 1, off), np.full(off, 4.5)])
    free += rng.uniform(-0.2, 0.2, free.shape)
    x1, x2, true1, true2 = projected(np.concatenate([wall, free]), rng)
    rows = rng.integers(0, on, shifted)
    other = wall[rows] + [1.0, 0.0, 0.0] * rng.choice([-2.0, -1.0, 1.0, 2.0], (shifted, 1))
    more1, more2 = projected(wall[rows], rng)[0], projected(other, rng)[1]
    noise1, noise2 = rng.uniform(0.0, 1000.0, (2, wrong, 2))
    x1, x2 = np.concatenate([x1, more1, noise1]), np.concatenate([x2, more2, noise2])
    return x1, x2, true1, true2


# The F of their row agrees with more matches than the scene's
@pytest.mark.parametrize("seed", range(3))
def test_windows_taken_for_others_of_their_row_do_not_outvote_the_scene(seed):
    x1, x2, true1, true2 = windows(seed)
    result = eg.estimate_fundamental(x1, x2)
    assert np.median(np.abs(eg.reprojection_distances(result.F, true1, true2)[0][400:])) < 1.0
    assert np.mean(result.inlier[400:430]) > 0.8
    rows = np.r_[:400, 430:530]
    row = eg.estimate_fundamental(x1[rows], x2[rows])
    assert np.count_nonzero(row.inlier) > 480 > np.count_nonzero(result.inlier)


def test_accord_is_the_share_of_neighbours_in_both_images():
    rng = np.random.default_rng(0)
    q1 = rng.uniform(-1.7, 1.7, (2, 150))
    q2 = q1 + 0.1 * rng.standard_normal(q1.shape)
    q2[:, :30] = rng.uniform(-1.7, 1.7, (2, 30))
    q2[:, 149] = 9.0
    q1[:, 149] = 9.0
    near1, near2 = (np.abs(q[:, :, None] - q[:, None]).max(axis=0) < 0.3 for q in (q1, q2))
    both = np.count_nonzero(near1 & near2, axis=1) - 1
    expected = (both + 0.5) / np.count_nonzero(near1 | near2, axis=1)
    for table in (NUMPY, compiled()):
        found = accord(table, np.asfortranarray(q1), q2)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert expected[149] == 0.5
    assert expected[:30].mean() < 0.2 < expected[30:149].mean()


# Any F of the plane fits nearly all; a sample of seven avoids it with two or more off it alone.
@pytest.mark.parametrize("backend", ["c", "numpy"])
@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_few_matches_off_a_plane_decide(wrong, backend):
    table = compiled() if backend == "c" else NUMPY
    found = []
    for seed in range(6 if backend == "c" else 2):
        x1, x2, true1, true2, off = near_planar(seed, wrong)
        frame = condition(x1, x2)
        q = frame.forward(x1, x2)
        F = frame.to_pixels(search(table, *q, ranked(table, *q), seed=seed).F)
        errors = np.abs(eg.reprojection_distances(F, true1[off], true2[off])[0])
        found.append(np.mean(errors < 2.0) > 0.9)
    assert all(found)


@pytest.mark.parametrize("seed", range(5))
def test_matches_on_a_wall_and_few_off_it_give_f(seed):
    x1, x2, true1, true2 = facade(seed, off=25, on=275, wrong=150)
    result = eg.estimate_fundamental(x1, x2)
    assert np.count_nonzero(result.inlier[275:300]) >= 23
    assert np.abs(eg.reprojection_distances(result.F, true1[275:], true2[275:])[0]).max() < 2.0


def test_estimate_keeps_the_few_off_a_plane():
    x1, x2, _, _, off = near_planar(3, 0.3)
    result = eg.estimate_fundamental(x1, x2)
    assert np.mean(result.inlier[off]) > 0.9
    assert "nearly planar" in result.flags


def test_score_says_where_right_matches_are():
    rng = np.random.default_rng(1)
    X = np.column_stack([*rng.uniform(-2, 2, (2, 60)), rng.uniform(4, 8, 60)])
    x1, x2, true1, true2 = projected(X, rng)
    # 8 % right: without a hint, one sample in 50 million is.
    wrong1, wrong2 = (rng.uniform(0.0, 1000.0, (700, 2)) for _ in range(2))
    x1, x2 = np.concatenate([x1, wrong1]), np.concatenate([x2, wrong2])
    score = np.concatenate([rng.uniform(0.5, 1.0, 60), rng.uniform(0.0, 0.9, 700)])
    result = eg.estimate_fundamental(x1, x2, score=score)
    assert np.mean(result.inlier[:60]) > 0.9
    assert np.abs(eg.reprojection_distances(result.F, true1, true2)[0]).max() < 4.0


@pytest.mark.parametrize(
    ("score", "message"),
    [
        (np.ones(3), r"score.*\(300,\)"),
        (np.full(300, np.nan), "score.*nan"),
        ("best", "score"),
    ],
)
def test_bad_scores_are_refused(score, message):
    x1, x2, _, _ = facade(0, wrong=0)
    with pytest.raises(eg.ArgumentError, match=message):
        eg.estimate_fundamental(x1, x2, score=score)


def test_seven_points_are_the_solutions_of_the_public_function():
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 2, 7, 50))
    F, votes, discriminant = kernels.table().seven_points(*x)
    for i in range(50):
        expected = eg.fundamental_7point(x[0, :, :, i].T, x[1, :, :, i].T)
        own = [F[k, :, :, i] for k in range(3 if discriminant[i] > 0.0 else 1)]
        own = [G / np.linalg.norm(G) for G in own]
        assert len(own) == len(expected)
        for G in expected:
            assert min(np.linalg.norm(s * G - H) for H in own for s in (1, -1)) < 1e-6
    assert np.abs(votes).max() <= 7
    scene = eg.two_view_scene(n_points=7, noise_px=0.0, seed=2)
    F, votes, _ = kernels.table().seven_points(scene.x1.T, scene.x2.T)
    residuals = [np.abs(algebraic(G / np.linalg.norm(G), scene.x1, scene.x2)).max() for G in F]
    assert min(residuals) < 1e-6
    assert 7.0 in np.abs(votes)  # the true one has all points in front of both cameras


@pytest.mark.parametrize("name", ["c", "numpy", "casadi"])
def test_kernels_of_the_search_are_those_with_derivatives(name) -> None:
    if kernels.available()[name] is not None:
        pytest.skip(f"needs {name}")
    table, rng = kernels.table(name), np.random.default_rng(5)
    U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
    F, (q1, q2) = U @ np.diag([1.0, 0.4, 0.0]) @ V.T, rng.standard_normal((2, 2, 30))
    e2 = table.epipole(F)
    np.testing.assert_allclose(F.T @ e2, 0.0, atol=1e-15)
    squared, side = table.sampson_side(F, e2, q1, q2)
    np.testing.assert_allclose(squared, table.sampson(F, q1, q2)[0][0] ** 2, rtol=1e-12)
    h1, h2 = (np.vstack([q, np.ones(30)]) for q in (q1, q2))
    np.testing.assert_allclose(side, np.sum(np.cross(e2, h2, axisb=0, axisc=0) * (F @ h1), axis=0))
    factor = table.agreement(F, 0.04, 0.01, q1, q2)
    np.testing.assert_allclose(factor, 1.0 + 0.04 / (squared + 0.01), rtol=1e-12)


def test_distances_are_sharp_where_most_of_the_near_ones_are_nearest() -> None:
    view = eg.two_view_scene(4.0, n_points=300, seed=2)
    frame = condition(view.x1, view.x2)
    q1, q2 = frame.forward(view.x1, view.x2)
    scale, rng = 0.002, np.random.default_rng(1)
    found = SimpleNamespace(F=frame.from_pixels(view.F_true), sigma=scale)
    near = scale * rng.standard_normal(300)
    even = rng.uniform(-12.0 * scale, 12.0 * scale, 300)  # a quarter of them is within three
    assert _is_sharp(NUMPY, q1, q2, found, near, scale)
    assert not _is_sharp(NUMPY, q1, q2, found, even, scale)
    found.sigma = 2.5 * scale
    assert not _is_sharp(NUMPY, q1, q2, found, near, scale)
