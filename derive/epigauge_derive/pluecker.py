"""Lines of space in Pluecker coordinates: orthonormal representation, update, motion, image.

A line through X with direction v has the Pluecker coordinates (n, v), n = X x v. Bartoli & Sturm
(CVIU 100, 2005, section 4) write n = w1 u1, v = w2 u2 with U = (u1 u2 u1 x u2) in SO(3) and w the
first column of W in SO(2), and update U <- U R(x), W <- W R(phi): four numbers. About the origin
of space this has rank three for lines through it, and depends on the frame. Here it is written
about another origin, a place that goes along with the scene and off the line, with the distance
of the line from there for unit of length: W is then a rotation by 45 degrees, the rank is four,
and the update means the same in all frames that a similarity changes into one another.

A projective basis has no such places. There U and W are those of four dimensions: a rotation of the
four homogeneous coordinates is a pair of rotations, of n + v and of n - v, which are equally long
as n and v are orthogonal. Each of these two directions is turned by two numbers. The rank is four
for every line, through the origin or infinitely far, and orthonormal changes of basis change
nothing.
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import Input, Let, at, cross, jacobian, select
from epigauge_derive.models.rotations import euler_rotation

__all__ = [
    "DELTA",
    "LINE",
    "ORIGIN",
    "carried",
    "coordinates",
    "halves",
    "line_velocity",
    "local",
    "seen",
    "sides",
    "tangent",
    "turned_line",
    "turned_tangent",
    "unit_tangent",
    "updated",
]

LINE = Input("line", (6,), names=("nx", "ny", "nz", "vx", "vy", "vz"))
ORIGIN = Input("origin", (3,), names=("ox", "oy", "oz"))
DELTA = Input("delta", (4,))

#: Names of the line about the origin.
_MOMENT = sp.symbols("moment0:3", real=True)
_DISTANCE, _LENGTH = sp.symbols("distance length", positive=True)
#: The directions n + v and n - v, and two axes across each of them.
_SIDES = tuple(sp.Matrix(sp.symbols(f"{name}0:3", real=True)) for name in ("sum", "rest"))
_AXES = tuple(
    sp.Matrix(3, 2, sp.symbols(f"across_{name}0:3(0:2)", real=True)) for name in ("sum", "rest")
)


def seen(M: sp.Matrix, n: sp.Matrix, v: sp.Matrix) -> sp.Matrix:
    """Return the line of the image that M = (A | b) takes a line of space to: cof(A) n + b x A v.

    (A X + b) x (A v) for every X of the line: it holds for any 3x4 matrix.
    """
    A, b = M[:, :3], M[:, 3]
    return A.cofactor_matrix() * n + cross(list(b)) * (A * v)


def halves(line: sp.Matrix) -> tuple[sp.Matrix, sp.Matrix]:
    """Return (n, v)."""
    return line[:3, :], line[3:, :]


def local() -> Let:
    """Name the moment about the origin, its length, and that of v."""
    n, v = halves(LINE.matrix())
    moment = n - cross(ORIGIN.entries()) * v
    lengths = {
        _DISTANCE: sp.sqrt(sum(m**2 for m in _MOMENT)),
        _LENGTH: sp.sqrt(sum(entry**2 for entry in v)),
    }
    return Let({**dict(zip(_MOMENT, moment, strict=True)), **lengths})


def updated(delta: list[sp.Symbol]) -> sp.Matrix:
    """Return the line after U <- U R(x), W <- W R(phi), about the origin."""
    _, v = halves(LINE.matrix())
    u1, u2 = sp.Matrix(_MOMENT) / _DISTANCE, v / _LENGTH
    U = sp.Matrix.hstack(u1, u2, cross(list(u1)) * u2) * euler_rotation(delta[:3])
    c, s = sp.cos(delta[3]), sp.sin(delta[3])
    # W = R(45 degrees); its factor 1 / sqrt 2 goes into the lengths.
    w1, w2 = c - s, s + c
    v_new = w2 * _LENGTH * U[:, 1]
    return (w1 * _DISTANCE * U[:, 0] + cross(ORIGIN.entries()) * v_new).col_join(v_new)


def tangent() -> sp.Matrix:
    """Return the derivative of the line by its update, 6x4."""
    delta = DELTA.entries()
    return at(jacobian(list(updated(delta)), delta), dict.fromkeys(delta, sp.S.Zero))


def unit_tangent() -> sp.Matrix:
    """Return the derivative by its update of the line over the length of its direction, 6x4."""
    delta = DELTA.entries()
    moved = updated(delta)
    length = sp.sqrt(sum(entry**2 for entry in moved[3:, :]))
    unit = list(moved / length)
    return at(jacobian(unit, delta), dict.fromkeys(delta, sp.S.Zero))


def coordinates(velocity: sp.Matrix) -> sp.Matrix:
    """Return the update that a velocity (n', v') of the line is; a change of scale is none.

    About the origin, n in units of the distance and v in those of its length, the columns of the
    tangent are orthogonal to one another and to the line, of squared lengths 1, 1, 2, 2.
    """
    shift = sp.eye(6)
    shift[:3, 3:] = -cross(ORIGIN.entries())
    near = sp.diag(*([1 / _DISTANCE] * 3), *([1 / _LENGTH] * 3)) * shift
    return sp.diag(1, 1, sp.S.Half, sp.S.Half) * (near * tangent()).T * near * velocity


def carried(T: sp.Matrix, n: sp.Matrix, v: sp.Matrix) -> sp.Matrix:
    """Return the line where points X are moved to T X: the exterior square of T, by (n, v).

    A line through A and B is the matrix A B^T - B A^T = -([n] v; -v^T 0), which T L T^T moves.
    """
    L = cross(list(n)).row_join(v).col_join((-v.T).row_join(sp.zeros(1, 1)))
    moved = T * L * T.T
    return sp.Matrix([moved[2, 1], moved[0, 2], moved[1, 0], *moved[:3, 3]])


def line_velocity(B: sp.Matrix) -> sp.Matrix:
    """Return how the line moves with points that move by B X."""
    epsilon = sp.Symbol("epsilon")
    both = carried(sp.eye(4) + epsilon * B, *halves(LINE.matrix()))
    return at(both.diff(epsilon), {epsilon: sp.S.Zero}).expand()


def sides() -> tuple[Let, ...]:
    """Name the directions n + v and n - v, then axes that are orthonormal with each."""
    n, v = halves(LINE.matrix())
    first: dict[sp.Symbol, sp.Expr] = {}
    then: dict[sp.Symbol, sp.Expr] = {}
    for side, axes, whole in zip(_SIDES, _AXES, (n + v, n - v), strict=True):
        first.update(zip(side, whole / sp.sqrt(sum(entry**2 for entry in whole)), strict=True))
        x, y, z = side
        sign = select(z, sp.S.One, sp.S.NegativeOne)
        a = -1 / (sign + z)
        one = sp.Matrix([1 + sign * x**2 * a, sign * x * y * a, -sign * x])
        two = sp.Matrix([x * y * a, sign + y**2 * a, -y])
        then.update(zip(axes, one.row_join(two), strict=True))
    return Let(first), Let(then)


def turned_line(delta: list[sp.Symbol]) -> sp.Matrix:
    """Return the line, of length one, after both directions are turned by two numbers each."""
    sides = []
    for side, axes, own in zip(_SIDES, _AXES, (delta[:2], delta[2:]), strict=True):
        sides.append((side + axes * sp.Matrix(own)) / sp.sqrt(1 + own[0] ** 2 + own[1] ** 2))
    return ((sides[0] + sides[1]) / 2).col_join((sides[0] - sides[1]) / 2)


def turned_tangent() -> sp.Matrix:
    """Return the derivative of the line of length one by that update, 6x4."""
    delta = DELTA.entries()
    return at(jacobian(list(turned_line(delta)), delta), dict.fromkeys(delta, sp.S.Zero))
