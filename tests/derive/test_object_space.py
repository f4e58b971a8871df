"""The pseudo object space error beside the errors it lies between."""

from __future__ import annotations

import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive.kernel import Input
from epigauge_derive.models.camera import project
from epigauge_derive.models.object_space import pseudo_object_space

P, X, q = (Input(*a).matrix() for a in (("P", (3, 4)), ("X", (3,)), ("q", (2,))))
ETA = sp.Symbol("eta", positive=True)


def test_object_space_error_is_the_reprojection_error_times_the_depth():
    Q = X.col_join(sp.Matrix([1]))
    r = pseudo_object_space(P, X, q, sp.S.Zero)
    expected = (P * Q)[2] * (project(P, Q) - q)
    assert (r[:2, :] - expected).applyfunc(sp.simplify) == sp.zeros(2, 1)
    assert r[2:, :] == sp.zeros(2, 1)


def test_of_an_affine_camera_all_of_it_is_the_reprojection_error():
    affine = P.subs({P[2, 0]: 0, P[2, 1]: 0, P[2, 2]: 0, P[2, 3]: 1})
    r = pseudo_object_space(affine, X, q, ETA)
    error = project(affine, X.col_join(sp.Matrix([1]))) - q
    assert sp.simplify(r.dot(r) - error.dot(error)) == 0


def test_residuals_are_linear_in_the_camera_and_in_the_point():
    for r in pseudo_object_space(P, X, q, ETA):
        assert sp.hessian(r, list(P)) == sp.zeros(12, 12)
        assert sp.hessian(r, list(X)) == sp.zeros(3, 3)
