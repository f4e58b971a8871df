"""Laws of the derived lines: update, image, residuals, gauge; alike in all back ends."""

from __future__ import annotations

import numpy as np
import pytest

from epigauge import kernels
from epigauge.cameras import camera_model

MODELS = {"pinhole": (900.0, 950.0, 20.0, -30.0), "simple_pinhole": (900.0, 20.0, -30.0)}


def places(count: int = 30, seed: int = 0):
    """Return cameras (12, count), lines (6, count) and origins off them; some lines special."""
    random = np.random.default_rng(seed)
    Q = np.linalg.qr(random.standard_normal((count, 3, 3)))[0]
    R = Q * np.linalg.det(Q)[:, None, None]
    X, v = random.uniform(-1, 1, (count, 3)), random.standard_normal((count, 3))
    X[:5] = 0.0  # through the origin of space
    v[3:6] = np.eye(3)  # along the axes
    X[6:9], v[6:9] = np.eye(3), np.eye(3)  # the axes themselves
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    t = np.array([0.0, 0.0, 5.0]) + 0.3 * random.standard_normal((count, 3))
    origin = -np.einsum("nji,nj->ni", R, t)
    camera = np.concatenate([R, t[:, :, None]], axis=2).reshape(count, 12)
    return camera.T, np.column_stack([np.cross(X, v), v]).T, origin.T, X.T


def measured(camera, line, origin, X, prefix, seed=1):
    """Return cameras with intrinsics, segments near the images of the lines, and covariances."""
    random = np.random.default_rng(seed)
    count = line.shape[1]
    full = np.concatenate([camera, np.tile(np.array(MODELS[prefix])[:, None], count)])
    project = camera_model(prefix.upper()).kernel("project")
    ends = [project(full, X + s * line[3:])[0] for s in (-0.4, 0.5)]
    segment = np.concatenate(ends) + random.standard_normal((4, count))
    spread = np.array([1.5, 0.3, 0.8, 0.7, -0.2, 1.2])[:, None] * np.ones(count)
    return full, segment, spread


@pytest.mark.parametrize("backend", ["numpy", "c", "casadi"])
def test_back_ends_agree(backend):
    if kernels.available()[backend] is not None:
        pytest.skip(str(kernels.available()[backend]))
    reference, table = kernels.table("numpy"), kernels.table(backend)
    camera, line, origin, X = places()
    delta = 0.1 * np.random.default_rng(2).standard_normal((4, line.shape[1]))
    for name, inputs in (
        ("line_retract", (line, origin, delta)),
        ("line_tangent", (line, origin)),
        ("line_generators", (line, origin)),
        ("line_project", (camera.reshape(3, 4, -1), line)),
    ):
        found, wanted = getattr(table, name)(*inputs), getattr(reference, name)(*inputs)
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-11)
    for prefix in MODELS:
        full, segment, spread = measured(camera, line, origin, X, prefix)
        inputs = full, line, origin, segment, spread
        pair = (getattr(each, f"{prefix}_line_observe")(*inputs) for each in (table, reference))
        for found, wanted in zip(*pair, strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-8)


def test_the_image_of_a_line_holds_the_images_of_its_points():
    camera, line, _, X = places()
    P = camera.reshape(3, 4, -1) + 0.1  # any matrix, not a pose alone
    image = kernels.table().line_project(P, line)
    for s in (-2.0, 0.0, 3.0):
        Y = np.concatenate([X + s * line[3:], np.ones((1, X.shape[1]))])
        x = np.einsum("ijn,jn->in", P, Y)
        scale = np.linalg.norm(image, axis=0) * np.linalg.norm(x, axis=0)
        assert np.abs(np.sum(image * x, axis=0) / scale).max() < 1e-12


def test_the_update_has_rank_four_everywhere_and_stays_on_the_quadric():
    table = kernels.table()
    _, line, origin, _ = places()
    T = table.line_tangent(line, origin).transpose(2, 0, 1)

    moment = line[:3] - np.cross(origin.T, line[3:].T).T
    shift = np.stack([np.eye(6)] * len(T))
    for k, o in enumerate(origin.T):
        shift[k, :3, 3:] = -np.cross(np.eye(3), o)
        shift[k, :3] /= np.linalg.norm(moment[:, k])
    values = np.linalg.svd(shift @ T, compute_uv=False)
    np.testing.assert_allclose(values, np.sqrt([2.0, 2.0, 1.0, 1.0]) * np.ones((len(T), 4)))
    moved = table.line_retract(line, origin, 0.3 * np.ones((4, line.shape[1])))
    assert np.abs(np.sum(moved[:3] * moved[3:], axis=0)).max() < 1e-12
    np.testing.assert_allclose(table.line_retract(line, origin, np.zeros((4, 1))), line, atol=1e-13)


def test_the_update_against_differences():
    table = kernels.table()
    _, line, origin, _ = places()
    T, h = table.line_tangent(line, origin), 1e-6
    for k in range(4):
        delta = np.zeros((4, line.shape[1]))
        delta[k] = h
        slope = table.line_retract(line, origin, delta) - table.line_retract(line, origin, -delta)
        np.testing.assert_allclose(slope / (2 * h), T[:, k], atol=1e-8)


@pytest.mark.parametrize("prefix", MODELS)
def test_residuals_are_distances_and_their_slopes_are_right(prefix):
    table, model = kernels.table(), camera_model(prefix.upper())
    camera, line, origin, X = places()
    full, segment, spread = measured(camera, line, origin, X, prefix)
    residual = getattr(table, f"{prefix}_line_residual")
    r, A, B = getattr(table, f"{prefix}_line_observe")(full, line, origin, segment, spread)
    # Between two points of the image of the line, by hand.
    p, q = (model.kernel("project")(full, X + s * line[3:])[0] for s in (-0.2, 0.3))
    a = np.array([q[1] - p[1], p[0] - q[0]])
    for k in (0, 1):
        xx, xy, yy = spread[3 * k : 3 * k + 3]
        distance = np.sum(a * (segment[2 * k : 2 * k + 2] - p), axis=0)
        distance /= np.sqrt(a[0] ** 2 * xx + 2 * a[0] * a[1] * xy + a[1] ** 2 * yy)
        np.testing.assert_allclose(np.abs(r[k]), np.abs(distance), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(residual(full, line, segment, spread), r, atol=1e-9)
    h, retract = 1e-6, model.kernel("retract")
    for k in range(model.tangent_size):
        delta = np.zeros((model.tangent_size, line.shape[1]))
        delta[k] = h
        pair = (residual(retract(full, s * delta), line, segment, spread) for s in (1, -1))
        slope = np.subtract(*pair) / (2 * h)
        np.testing.assert_allclose(-slope, A[:, k], rtol=1e-6, atol=2e-4)
    for k in range(4):
        delta = np.zeros((4, line.shape[1]))
        delta[k] = h
        moved = (table.line_retract(line, origin, s * delta) for s in (1, -1))
        slope = np.subtract(*(residual(full, L, segment, spread) for L in moved)) / (2 * h)
        np.testing.assert_allclose(-slope, B[:, k], rtol=1e-6, atol=2e-4)


@pytest.mark.parametrize("prefix", MODELS)
def test_no_residual_changes_along_the_gauge(prefix):
    table = kernels.table()
    camera, line, origin, X = places()
    # About another place than the centre of the camera.
    origin = origin + 0.3
    full, segment, spread = measured(camera, line, origin, X, prefix)
    _, A, B = getattr(table, f"{prefix}_line_observe")(full, line, origin, segment, spread)
    of_camera = getattr(table, f"{prefix}_camera_generators")(full)
    of_line = table.line_generators(line, origin)
    along = np.einsum("kdn,dgn->kgn", A, of_camera) + np.einsum("kbn,bgn->kgn", B, of_line)
    assert np.abs(along).max() < 1e-8 * np.abs(A).max() * np.abs(of_camera).max()
    assert np.abs(of_line).max() > 0.1
