"""Rotations by Euler angles and the update U <- U R(x) of B&S eqs. (1) and (3)."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Output, derivatives_at


def euler_rotation(theta: Sequence[sp.Expr]) -> sp.Matrix:
    """Return R(theta) = Rx Ry Rz of B&S eq. (1)."""
    a, b, c = theta
    r_x = sp.Matrix([[1, 0, 0], [0, sp.cos(a), -sp.sin(a)], [0, sp.sin(a), sp.cos(a)]])
    r_y = sp.Matrix([[sp.cos(b), 0, sp.sin(b)], [0, 1, 0], [-sp.sin(b), 0, sp.cos(b)]])
    r_z = sp.Matrix([[sp.cos(c), -sp.sin(c), 0], [sp.sin(c), sp.cos(c), 0], [0, 0, 1]])
    return r_x * r_y * r_z


def kernels() -> list[Kernel]:
    """Return R(theta), U R(theta) and the derivatives of the latter at theta = 0."""
    theta, U = Input("theta", (3,)), Input("U", (3, 3))
    angles = theta.entries()
    moved = U.matrix() * euler_rotation(angles)
    first, second = derivatives_at(list(moved), angles, dict.fromkeys(angles, 0))
    return [
        Kernel(
            "rotation",
            "R(theta) = Rx Ry Rz from Euler angles (B&S eq. 1).",
            (theta,),
            (Output.of("R", euler_rotation(angles)),),
        ),
        Kernel(
            "rotate_columns",
            "update U R(theta) of an orthonormal matrix (B&S eqs. 1, 3).",
            (U, theta),
            (Output.of("U_new", moved),),
        ),
        Kernel(
            "rotation_derivatives",
            "first and second derivatives of U R(theta) at theta = 0 (from B&S eqs. 1, 3).",
            (U,),
            (
                Output.of("dU", first, shape=(3, 3, 3)),
                Output.of("d2U", second, shape=(3, 3, 3, 3)),
            ),
        ),
    ]
