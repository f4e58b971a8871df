"""Many views: the parts of normal equations are what the Jacobians give; algebra of 4x4 blocks."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge import kernels
from laws import distance

COUNT = 40
#: The upper triangle of a 4x4 matrix, row by row.
UPPER = np.triu_indices(4)


@pytest.fixture
def observed():
    """Return cameras, points, measurements and weights, observation-last."""
    rng = np.random.default_rng(0)
    P, Q = rng.standard_normal((3, 4, COUNT)), rng.standard_normal((4, COUNT))
    h = np.einsum("ijn,jn->in", P, Q)
    q = h[:2] / h[2] + 0.1 * rng.standard_normal((2, COUNT))
    return P, Q, q, rng.uniform(0.1, 2.0, COUNT)


@pytest.fixture
def definite():
    """Return two batches of positive definite matrices (4, 4, n), one badly scaled."""
    rng = np.random.default_rng(1)
    roots = rng.standard_normal((2, COUNT, 4, 6))
    roots[1] *= np.geomspace(1.0, 1e2, 4)[:, None]
    return [np.moveaxis(root @ root.swapaxes(1, 2), 0, -1) for root in roots]


def relative(actual, expected):
    size = np.abs(expected).max()
    return distance(actual / size, expected / size)


def test_point_normal_is_made_of_the_jacobians(table, observed):
    P, Q, q, w = observed
    q_hat, _, J_Q, _ = table.project(P, Q)
    _, Z_Q = table.log_depth_derivatives(P, Q)
    N, D, g, squared = table.point_normal(P, Q, q, w)
    r = q - q_hat
    assert relative(N, np.einsum("ian,ibn,n->abn", J_Q, J_Q, w)[UPPER]) < 1e-14
    assert relative(D, np.einsum("an,bn,n->abn", Z_Q, Z_Q, w)[UPPER]) < 1e-14
    assert relative(g, -np.einsum("ian,in,n->an", J_Q, r, w)) < 1e-14
    assert relative(squared, np.sum(r**2, axis=0)) < 1e-13
    assert relative(table.squared_distance(P, Q, q), squared) < 1e-15


def test_camera_normal_times_the_point_is_made_of_the_jacobians(table, observed):
    P, Q, q, w = observed
    q_hat, J_P, _, _ = table.project(P, Q)
    Z_P, _ = table.log_depth_derivatives(P, Q)
    packed, depth, e = table.camera_normal(P, Q, q, w)
    A = np.empty((3, 3, COUNT))
    A[np.triu_indices(3)] = packed
    A.swapaxes(0, 1)[np.triu_indices(3)] = packed
    N = np.einsum("abn,in,jn->aibjn", A, Q, Q).reshape(12, 12, COUNT)
    assert relative(N, np.einsum("ian,ibn,n->abn", J_P, J_P, w)) < 1e-14
    Z = np.zeros((12, 12, COUNT))
    Z[8:, 8:] = depth * Q[:, None] * Q
    assert relative(Z, np.einsum("an,bn,n->abn", Z_P, Z_P, w)) < 1e-14
    g = np.einsum("an,in->ain", e, Q).reshape(12, COUNT)
    assert relative(g, -np.einsum("ian,in,n->an", J_P, q - q_hat, w)) < 1e-14


def test_coupling_times_the_point_is_made_of_the_jacobians(table, observed):
    P, Q, _, w = observed
    T = np.random.default_rng(2).standard_normal((4, 4, COUNT))
    _, J_P, J_Q, _ = table.project(P, Q)
    Y = table.coupling(P, Q, w, T)
    W = np.einsum("acn,in->aicn", Y, Q).reshape(12, 4, COUNT)
    assert relative(W, np.einsum("ian,ibn,bcn,n->acn", J_P, J_Q, T, w)) < 1e-14


def test_lines_of_sight_meet_in_the_point(table):
    rng = np.random.default_rng(3)
    P, Q = rng.standard_normal((3, 4, 5)), rng.standard_normal(4)
    h = np.einsum("ijn,j->in", P, Q)
    q = h[:2] / h[2]
    N = np.zeros((4, 4))
    N[UPPER] = table.sight_normal(P, q, np.ones(5)).sum(axis=1)
    N.T[UPPER] = N[UPPER]
    assert np.trace(N) == pytest.approx(10.0)  # unit normals
    assert np.abs(N @ Q).max() < 1e-13
    found = table.least_eigenvector(N[UPPER])
    assert distance(found * np.sign(found @ Q), Q / np.linalg.norm(Q)) < 1e-12


@pytest.mark.parametrize("gap", [1.0, 1e-3, 1e-9, 0.0])
def test_least_eigenvector(table, gap):
    rng = np.random.default_rng(4)
    frames = np.linalg.qr(rng.standard_normal((COUNT, 4, 4)))[0]
    values = np.array([0.5 * gap, gap, 1.0, 3.0]) if gap else np.array([0.0, 1e-6, 1.0, 3.0])
    N = (frames * values) @ frames.swapaxes(1, 2)
    found = table.least_eigenvector(np.moveaxis(N, 0, -1)[UPPER])
    assert distance(np.linalg.norm(found, axis=0), np.ones(COUNT)) < 1e-15
    along = np.abs(np.einsum("ni,in->n", frames[:, :, 0], found))
    # Rounding of N, 1e-16, over the gap to the next eigenvalue.
    assert np.abs(along - 1.0).max() < 1e-12 + (1e-15 / max(gap, 1e-6)) ** 2


def test_inverse_roots(table, definite):
    V, W = definite
    for matrix in (V, W):
        T = table.inverse_root(matrix[UPPER])
        assert not T[np.tril_indices(4, -1)].any()
        product = np.einsum("ian,ijn,jbn->abn", T, matrix, T)
        assert distance(product, np.broadcast_to(np.eye(4)[..., None], T.shape)) < 1e-8
    for lam in (1e-9, 1e-3, 10.0):
        T = table.damped_inverse_root(V[UPPER], W[UPPER], lam)
        product = np.einsum("ian,ijn,jbn->abn", T, V + lam * W, T)
        # Rounding times the condition of the blocks, up to 1e7.
        assert distance(product, np.broadcast_to(np.eye(4)[..., None], T.shape)) < 1e-8


def test_damped_inverse_root_bears_a_singular_block_in_any_basis(table):
    # N = J^T J is singular along the scale of the point; W is not; a basis may be far off.
    rng = np.random.default_rng(5)
    scale = np.geomspace(1.0, 1e4, 4)[:, None]
    root = scale * rng.standard_normal((4, 3))
    other = scale * rng.standard_normal((4, 5))
    V, W = root @ root.T, other @ other.T
    for lam in (1e-3, 1e-8, 1e-11):
        T = table.damped_inverse_root(V[UPPER], W[UPPER], lam)
        product = T.T @ (V / lam + W) @ T * lam
        assert np.isfinite(T).all()
        assert distance(product, np.eye(4)) < 1e-4


def test_what_is_not_positive_definite_is_not_a_number(table):
    with np.errstate(invalid="ignore", divide="ignore"):
        T = table.inverse_root(np.diag([1.0, 1.0, -1.0, 1.0])[UPPER])
    assert np.isnan(T).any()


def test_point_step_solves_its_damped_system(table, definite):
    V, W = definite
    rng = np.random.default_rng(6)
    g, lam = rng.standard_normal((4, COUNT)), rng.uniform(1e-4, 1.0, COUNT)
    step, promised = table.point_step(V[UPPER], W[UPPER], g, lam)
    left = np.einsum("ijn,jn->in", V + lam * (V + W), step)
    assert relative(left, -g) < 1e-9
    assert relative(promised, -np.sum(g * step, axis=0)) < 1e-12


def test_kernels_are_those_of_the_model():
    found = {name for name, s in kernels.SIGNATURES.items() if s.family == "bundle"}
    assert found == {
        "squared_distance",
        "point_normal",
        "camera_normal",
        "sight_normal",
        "coupling",
        "least_eigenvector",
        "inverse_root",
        "inverse_root3",
        "damped_inverse_root",
        "point_step",
    }
