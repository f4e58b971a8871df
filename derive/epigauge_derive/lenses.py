"""What camera models share: a direction of sight, and the distortions of lenses."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

#: Squared tangent of an angle of sight below which an angle is no longer resolved.
_TINY = sp.Float("1e-40")


def direction(h: sp.Matrix) -> tuple[sp.Expr, sp.Expr]:
    """Return u, v = h0/h2, h1/h2: where the sight meets the plane at unit distance."""
    return h[0] / h[2], h[1] / h[2]


def polynomial(x: sp.Expr, coefficients: Sequence[sp.Expr]) -> sp.Expr:
    """Return 1 + k1 x + k2 x^2 + ... by Horner's rule."""
    value = sp.S.Zero
    for coefficient in reversed(coefficients):
        value = x * (coefficient + value)
    return 1 + value


def balanced(squared: sp.Expr, A: Sequence[sp.Expr], R0: sp.Expr) -> sp.Expr:
    """Return A1 (r^2 - R0^2) + A2 (r^4 - R0^4) + ...: a radial distortion that is none at R0."""
    zero = R0**2
    return sum(a * (squared**n - zero**n) for n, a in enumerate(A, start=1))


def tangential(u: sp.Expr, v: sp.Expr, p1: sp.Expr, p2: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Return the shift of a point by a lens off its axis (Brown): to p2 along u, p1 along v."""
    squared = u**2 + v**2
    return p2 * (squared + 2 * u**2) + 2 * p1 * u * v, p1 * (squared + 2 * v**2) + 2 * p2 * u * v


def fisheye(h: sp.Matrix, coefficients: Sequence[sp.Expr]) -> tuple[sp.Expr, sp.Expr]:
    """Return a point at distance theta (1 + k1 theta^2 + ...) from the centre, theta the angle.

    theta = atan2(|(h0, h1)|, h2) goes on beyond 90 degrees. The term added keeps theta / |(h0, h1)|
    defined on the axis.
    """
    distance = sp.sqrt(h[0] ** 2 + h[1] ** 2 + _TINY * h[2] ** 2)
    theta = sp.atan2(distance, h[2])
    scale = theta * polynomial(theta**2, coefficients) / distance
    return h[0] * scale, h[1] * scale
