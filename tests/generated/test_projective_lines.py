"""Laws of lines in a projective basis: update, residuals, gauge, changes of basis; all back ends."""

from __future__ import annotations

import numpy as np
import pytest

from epigauge import kernels
from epigauge.cameras import camera_model

COUNT = 30


def joined(a, b):
    """Return the lines through points (4, k), as Pluecker coordinates of length one."""
    n = np.cross(a[:3].T, b[:3].T).T
    v = a[3] * b[:3] - b[3] * a[:3]
    line = np.concatenate([n, v])
    return line / np.linalg.norm(line, axis=0)


def places(seed=0):
    """Return cameras (12, k) and two points (4, k) of each line; some of the lines are special."""
    random = np.random.default_rng(seed)
    a, b = random.standard_normal((2, 4, COUNT))
    a[:, :3] = np.array([0.0, 0.0, 0.0, 1.0])[:, None]  # through the origin
    a[3, 3:6] = b[3, 3:6] = 0.0  # infinitely far
    a[:, 6:10], b[:, 6:10] = np.eye(4), np.roll(np.eye(4), 1, axis=1)  # edges of the frame
    return random.standard_normal((12, COUNT)), a, b


def measured(camera, a, b, seed=1):
    """Return segments near the images of lines, and covariances."""
    random = np.random.default_rng(seed)
    P = camera.reshape(3, 4, -1)
    ends = []
    for s in (-0.4, 0.5):
        h = np.einsum("ijn,jn->in", P, a + s * b)
        ends.append(h[:2] / h[2])
    segment = np.concatenate(ends) + 0.1 * random.standard_normal((4, COUNT))
    spread = np.array([1.5, 0.3, 0.8, 0.7, -0.2, 1.2])[:, None] * np.ones(COUNT)
    return segment, spread


@pytest.mark.parametrize("backend", ["numpy", "c", "casadi"])
def test_back_ends_agree(backend):
    if kernels.available()[backend] is not None:
        pytest.skip(str(kernels.available()[backend]))
    reference, table = kernels.table("numpy"), kernels.table(backend)
    camera, a, b = places()
    line, T = joined(a, b), np.random.default_rng(3).standard_normal((4, 4, COUNT))
    delta = 0.1 * np.random.default_rng(2).standard_normal((4, COUNT))
    segment = measured(camera, a, b)
    for name, inputs in (
        ("projective_line_retract", (line, delta)),
        ("projective_line_tangent", (line,)),
        ("projective_line_generators", (line,)),
        ("line_transform", (T, line)),
        ("projective_line_residual", (camera, line, *segment)),
        ("projective_line_observe", (camera, line, *segment)),
    ):
        pair = (getattr(each, name)(*inputs) for each in (table, reference))
        found, wanted = (part if isinstance(part, tuple) else (part,) for part in pair)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)


def test_the_update_has_rank_four_everywhere_and_stays_on_the_quadric():
    table = kernels.table()
    _, a, b = places()
    line = joined(a, b)
    T = table.projective_line_tangent(line).transpose(2, 0, 1)
    values = np.linalg.svd(T, compute_uv=False)
    np.testing.assert_allclose(values, np.sqrt(0.5), rtol=1e-12)
    along = np.einsum("nkm,kn->nm", T, line)
    assert np.abs(along).max() < 1e-14
    moved = table.projective_line_retract(line, 0.3 * np.ones((4, COUNT)))
    assert np.abs(np.sum(moved[:3] * moved[3:], axis=0)).max() < 1e-14
    np.testing.assert_allclose(np.linalg.norm(moved, axis=0), 1.0, rtol=1e-14)
    still = table.projective_line_retract(line, np.zeros((4, COUNT)))
    np.testing.assert_allclose(still, line, atol=1e-14)


def test_the_update_against_differences():
    table = kernels.table()
    _, a, b = places()
    line, h = joined(a, b), 1e-6
    T = table.projective_line_tangent(line)
    for k in range(4):
        delta = np.zeros((4, COUNT))
        delta[k] = h
        pair = (table.projective_line_retract(line, s * delta) for s in (1, -1))
        np.testing.assert_allclose(np.subtract(*pair) / (2 * h), T[:, k], atol=1e-9)


def test_orthonormal_changes_of_basis_take_updates_along():
    table = kernels.table()
    random = np.random.default_rng(4)
    _, a, b = places()
    line = joined(a, b)
    for sign in (1.0, -1.0):
        Q = np.linalg.qr(random.standard_normal((4, 4)))[0]
        Q[0] *= sign * np.sign(np.linalg.det(Q))
        there = np.repeat(Q[..., None], COUNT, axis=2)
        turned = table.line_transform(there, line)
        delta = 0.5 * random.standard_normal((4, COUNT))
        # The same velocity by the axes of the turned line.
        velocity = np.einsum("inm,nm->im", table.projective_line_tangent(line), delta)
        velocity = table.line_transform(there, velocity)
        axes = table.projective_line_tangent(turned)
        own = 2.0 * np.einsum("inm,im->nm", axes, velocity)
        moved = table.line_transform(there, table.projective_line_retract(line, delta))
        np.testing.assert_allclose(table.projective_line_retract(turned, own), moved, atol=1e-12)


def test_a_change_of_basis_moves_the_line_with_its_points():
    random = np.random.default_rng(5)
    _, a, b = places()
    T = random.standard_normal((4, 4, COUNT))
    n, v = np.split(joined(a, b), 2)
    size = np.linalg.norm(
        np.concatenate([np.cross(a[:3].T, b[:3].T).T, a[3] * b[:3] - b[3] * a[:3]]), axis=0
    )
    moved = kernels.table().line_transform(T, np.concatenate([n, v])) * size
    a, b = (np.einsum("ijn,jn->in", T, X) for X in (a, b))
    wanted = np.concatenate([np.cross(a[:3].T, b[:3].T).T, a[3] * b[:3] - b[3] * a[:3]])
    np.testing.assert_allclose(moved, wanted, atol=1e-12)


def test_residuals_are_distances_and_their_slopes_are_right():
    table, model = kernels.table(), camera_model("projective")
    camera, a, b = places()
    line = joined(a, b)
    segment, spread = measured(camera, a, b)
    r, A, B = table.projective_line_observe(camera, line, segment, spread)
    # Between two points of the image of the line, by hand.
    P = camera.reshape(3, 4, -1)
    p, q = (np.einsum("ijn,jn->in", P, a + s * b) for s in (-0.2, 0.3))
    image = np.cross(p.T, q.T).T
    for k in (0, 1):
        xx, xy, yy = spread[3 * k : 3 * k + 3]
        x, y = segment[2 * k : 2 * k + 2]
        size = image[0] ** 2 * xx + 2 * image[0] * image[1] * xy + image[1] ** 2 * yy
        distance = (image[0] * x + image[1] * y + image[2]) / np.sqrt(size)
        np.testing.assert_allclose(np.abs(r[k]), np.abs(distance), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        table.projective_line_residual(camera, line, segment, spread), r, atol=1e-12
    )
    h, retract = 1e-6, model.kernel("retract")
    for moves, J, count in (
        (lambda delta: (retract(camera, delta), line), A, 12),
        (lambda delta: (camera, table.projective_line_retract(line, delta)), B, 4),
    ):
        for k in range(count):
            delta = np.zeros((count, COUNT))
            delta[k] = h
            pair = (
                table.projective_line_residual(*moves(s * delta), segment, spread) for s in (1, -1)
            )
            slope = -np.subtract(*pair) / (2 * h)
            size = np.abs(J).max(axis=(0, 1))
            assert (np.abs(slope - J[:, k]) / size).max() < 1e-6


def test_no_residual_changes_along_the_gauge():
    table = kernels.table()
    camera, a, b = places()
    line = joined(a, b)
    _, A, B = table.projective_line_observe(camera, line, *measured(camera, a, b))
    of_camera = table.projective_camera_generators(camera)
    of_line = table.projective_line_generators(line)
    assert of_line.shape == (4, 15, COUNT)
    along = np.einsum("kdn,dgn->kgn", A, of_camera) + np.einsum("kbn,bgn->kgn", B, of_line)
    size = np.abs(A).max(axis=(0, 1)) + np.abs(B).max(axis=(0, 1))
    assert (np.abs(along) / size).max() < 1e-12
    assert np.abs(of_line).max() > 0.1
