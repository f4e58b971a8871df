"""Every camera model: its Jacobians, its update and its gauge obey their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge import kernels
from epigauge_generated.signatures import MODELS
from laws import assert_jacobian, distance, orthonormal

NUMPY = kernels.table("numpy")
#: One of each name that is no alias.
NAMES = [name for name, model in MODELS.items() if name.lower() == model.prefix]
NAMES = [name for name in NAMES if name.isupper() or name.upper() not in MODELS]
METRIC = [name for name in NAMES if MODELS[name].metric]

#: The gauge groups that are to be found (math: the gauge follows from the formula).
DIMENSIONS = {"projective": 15, "affine": 12} | dict.fromkeys(METRIC, 7)


def call(model, kernel, *arguments, table=NUMPY):
    """Call a kernel of a model."""
    return getattr(table, f"{model.prefix}_{kernel}")(*arguments)


def parameters(model, rng):
    """Return intrinsic parameters of a sensible size: focal lengths near one, a weak distortion."""
    focal = {"f", "fx", "fy", "c", "R0", "width", "height"}
    return np.array(
        [
            rng.uniform(0.8, 1.3) if name in focal else rng.uniform(-0.05, 0.05)
            for name in model.params
        ]
    )


def scene(model, rng, n=1, m=1, behind=False):
    """Return cameras (c, n) and points (b, m) in front of all of them, or behind."""
    X = rng.uniform(-0.7, 0.7, (model.point_size, m))
    if model.homogeneous:
        X[3] = rng.uniform(0.7, 1.3, m)
    cameras = []
    for _ in range(n):
        if not model.metric:
            M = rng.uniform(-0.4, 0.4, (3, 4)) + np.eye(3, 4)
            M[2, 3] += 4.0 * (-1.0 if behind else 1.0)
            if not model.homogeneous:
                M[2] = 0.0, 0.0, 0.0, 1.0
        else:
            R = orthonormal(rng)
            t = rng.uniform(-0.5, 0.5, 3)
            t[2] += facing(model) * (-2.2 if behind else 2.2)
            M = np.column_stack([R, t])
        cameras.append(np.concatenate([M.ravel(), parameters(model, rng)]))
    return np.stack(cameras, axis=1), X


def facing(model):
    """Return the sign of h2 in front of the camera."""
    camera = np.concatenate([np.eye(3, 4).ravel(), np.ones(len(model.params))])
    return float(np.sign(call(model, "project", camera, [0.1, 0.2, 1.0])[1]))


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_jacobians_are_differences_through_the_update(table, name, behind):
    model = MODELS[name]
    for seed in range(3):
        camera, X = (a[:, 0] for a in scene(model, np.random.default_rng(seed), behind=behind))
        q = np.array([0.3, -0.2])
        r, J_camera, J_point = call(model, "observe", camera, X, q, table=table)

        def seen(delta, X, camera=camera, model=model, q=q):
            there = call(model, "retract", camera, delta, table=table)
            return -call(model, "residual", there, X, q, table=table)

        zero = np.zeros(model.tangent_size)
        assert_jacobian(lambda delta, X=X, seen=seen: seen(delta, X), zero, J_camera)
        assert_jacobian(lambda X, seen=seen: seen(zero, X), X, J_point)
        q_hat, _ = call(model, "project", camera, X, table=table)
        assert distance(r, call(model, "residual", camera, X, q, table=table)) <= 1e-15
        if model.corrects:
            corrected, ideal = (call(model, "correct", p, camera[12:])[0] for p in (q, q_hat))
            assert distance(r, corrected - ideal) <= 1e-14
        elif name != "spherical":
            assert distance(r, q - q_hat) <= 1e-15


@pytest.mark.parametrize("name", [name for name in NAMES if MODELS[name].corrects])
def test_correction_has_its_derivative_and_is_undone_by_the_image(table, name):
    model = MODELS[name]
    rng = np.random.default_rng(8)
    cameras, X = scene(model, rng, m=50)
    k, q = cameras[12:, 0], np.array([0.3, -0.2])
    corrected, slope = call(model, "correct", q, k, table=table)
    assert distance(corrected, q) > 1e-3
    assert_jacobian(lambda q: call(model, "correct", q, k, table=table)[0], q, slope)
    q_hat, _ = call(model, "project", cameras, X, table=table)
    r = call(model, "residual", cameras, X, q_hat, table=table)
    assert distance(r, np.zeros_like(r)) <= 1e-14


@pytest.mark.parametrize("name", NAMES)
def test_image_is_the_projection_from_the_camera_frame(table, name):
    model = MODELS[name]
    camera, X = (a[:, 0] for a in scene(model, np.random.default_rng(4)))
    h = camera[:12].reshape(3, 4) @ np.append(X, 1.0)[:4]
    k = [camera[12:]] if model.params else []
    q_hat, a = call(model, "image", h, *k, table=table)
    assert distance(q_hat, call(model, "project", camera, X, table=table)[0]) <= 1e-14
    assert_jacobian(lambda h: call(model, "image", h, *k, table=table)[0], h, a)


@pytest.mark.parametrize("name", NAMES)
def test_generators_are_the_null_space_of_many_views(name):
    model = MODELS[name]
    # Zero skew alone leaves the eight further freedoms of a projective frame to fewer than 8 views.
    n, m, d, b = 10, 30, model.tangent_size, model.point_size
    rng = np.random.default_rng(5)
    cameras, X = scene(model, rng, n, m)
    J = np.zeros((n, m, 2, n * d + m * b))
    for i in range(n):
        q = rng.uniform(-0.5, 0.5, (2, m)) * model.corrects
        _, J_camera, J_point = call(model, "observe", cameras[:, i, None], X, q)
        J[i, :, :, i * d : (i + 1) * d] = np.moveaxis(J_camera, 2, 0)
        for j in range(m):
            J[i, j, :, n * d + j * b : n * d + (j + 1) * b] = J_point[:, :, j]
    J = J.reshape(-1, n * d + m * b)
    N = np.concatenate(
        [
            np.moveaxis(call(model, "camera_generators", cameras), 2, 0).reshape(n * d, -1),
            np.moveaxis(call(model, "point_generators", X), 2, 0).reshape(m * b, -1),
        ]
    )
    assert N.shape[1] == model.gauge_dimension == len(model.gauge_names) == DIMENSIONS[name]
    assert np.linalg.matrix_rank(N) == model.gauge_dimension
    assert distance(J @ N, np.zeros((len(J), model.gauge_dimension))) <= 1e-13
    # Nothing else is free, but for the scales of homogeneous cameras and points.
    scales = (n + m if model.homogeneous else 0)
    values = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    free = model.gauge_dimension + scales
    assert values[-free] <= 1e-14 < 1e-11 < values[-free - 1]


def similarity(rng):
    """Return s, Q, b of x -> s Q x + b, far from the identity."""
    return 10.0 ** rng.uniform(-1.0, 1.0), orthonormal(rng), rng.uniform(-5.0, 5.0, 3)


def carried(camera, s, Q, b):
    """Return the camera that sees s Q x + b as the given one sees x, scaled by s."""
    R, t = camera[:12].reshape(3, 4)[:, :3], camera[:12].reshape(3, 4)[:, 3]
    there = R @ Q.T
    return np.concatenate([np.column_stack([there, s * t - there @ b]).ravel(), camera[12:]])


@pytest.mark.parametrize("name", METRIC)
def test_update_is_equivariant_under_similarities(table, name):
    """retract(g x, dg delta) = g retract(x, delta) with dg = diag(1, s, 1)."""
    model = MODELS[name]
    rng = np.random.default_rng(6)
    camera = scene(model, rng)[0][:, 0]
    s, Q, b = similarity(rng)
    for size in (1e-12, 1e-6, 1e-2, 1.0, 3.0):
        delta = size * rng.standard_normal(model.tangent_size)
        there = delta.copy()
        there[3:6] *= s
        expected = carried(call(model, "retract", camera, delta, table=table), s, Q, b)
        actual = call(model, "retract", carried(camera, s, Q, b), there, table=table)
        assert distance(actual, expected) <= 1e-13


@pytest.mark.parametrize("name", METRIC)
@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-25, 1e-20, 1e-12, 1e-8, 1e-3, 1.0, 3.1, 40.0])
def test_update_is_the_exponential_map_at_any_angle(table, name, size):
    scipy = pytest.importorskip("scipy.spatial.transform")
    model = MODELS[name]
    rng = np.random.default_rng(7)
    camera = scene(model, rng)[0][:, 0]
    delta = np.zeros(model.tangent_size)
    w = size * np.array([0.6, -0.48, 0.64])
    move = rng.standard_normal(3)
    delta[:3], delta[3:6], delta[6:] = w, move, 0.1
    M = camera[:12].reshape(3, 4)
    turn = scipy.Rotation.from_rotvec(w).as_matrix()
    expected = np.column_stack([turn @ M[:, :3], turn @ (M[:, 3] - move)])
    k = camera[12:] + 0.1 * np.array([name not in model.constants for name in model.params])
    actual = call(model, "retract", camera, delta, table=table)
    assert distance(actual, np.concatenate([expected.ravel(), k])) <= 1e-14
