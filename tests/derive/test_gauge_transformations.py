"""T~ of B03 eq. (5), and the damping of eq. (9): what is right, and what the paper prints."""

from __future__ import annotations

import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive.models import gauge_transformations as gauge

# A change of basis that is neither orthonormal nor symmetric; scales that come from elsewhere.
T = sp.Matrix([[2, 1, 0, 1], [0, 1, 3, 0], [1, 0, 1, 2], [0, 2, 0, 1]])
GAMMA, ALPHA = sp.Rational(3, 2), sp.Rational(-5, 7)
A = T.T * T


def thrice(block):
    """Return diag(block, block, block)."""
    return sp.diag(block, block, block)


def test_blocks_of_the_transformation_are_those_of_eq5():
    assert gauge.camera_block(T, GAMMA) == thrice(GAMMA * T.T)
    assert gauge.point_block(T.inv(), ALPHA) == ALPHA * T.inv()


def eq9():
    """Return the blocks of W' = T~^-T T~^-1 by eq. (8), from W = I."""
    camera = gauge.moved_damping(sp.eye(12), gauge.camera_block(T.inv(), 1 / GAMMA))
    return camera, gauge.moved_damping(sp.eye(4), gauge.point_block(T, 1 / ALPHA))


def test_eq8_moves_the_damping_as_the_transformation_moves_the_parameters():
    # delta'^T W' delta' = delta^T W delta for delta' = T~ delta: the trust region is the same set.
    for W_moved, block in zip(
        eq9(), (gauge.camera_block(T, GAMMA), gauge.point_block(T.inv(), ALPHA)), strict=True
    ):
        assert block.T * W_moved * block == sp.eye(block.rows)


def test_eq9_holds_with_the_scales_inverse_and_not_as_printed():
    camera, point = eq9()
    assert camera == thrice(A.inv() / GAMMA**2)
    assert point == A / ALPHA**2
    # The paper prints gamma^2 A^-1 and alpha^2 A.
    assert camera != thrice(GAMMA**2 * A.inv())
    assert point != ALPHA**2 * A


def test_kernel_computes_eq9():
    by_name = {kernel.name: kernel for kernel in gauge.kernels()}
    kernel = by_name["implicit_damping"]
    point = dict(zip(gauge.T.entries(), T, strict=True))
    point |= dict(zip(gauge.INVERSE.entries(), T.inv(), strict=True))
    point |= {gauge.GAMMA.symbol(): GAMMA, gauge.ALPHA.symbol(): ALPHA}
    for output, expected in zip(kernel.outputs, eq9(), strict=True):
        assert sp.Matrix(*output.shape, [e.subs(point) for e in output.entries]) == expected
