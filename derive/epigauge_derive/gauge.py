"""The gauge of a camera model, found and not typed: velocities of space that no image shows.

At some cameras and points, the velocities c' of the cameras and one linear field X' = B X of space
with J_camera c' + J_point B X = 0 are a null space: its fields are the Lie algebra of the gauge.
Evaluated with 40 digits at fixed general places, so that rank is no question of rounding.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import mpmath
import sympy as sp

from epigauge_derive.kernel import Kernel, Output, at, cross

if TYPE_CHECKING:
    from epigauge_derive.camera_model import CameraModel, Frame

# The more parameters a camera has of its own, the more cameras show what its gauge is not.
_DIGITS, _CAMERAS = 40, 6
_ZERO = mpmath.mpf("1e-20")

Rows = list[list[mpmath.mpf]]

#: A name and a 4x4 matrix B.
Field = tuple[str, sp.ImmutableMatrix]


def generator_kernels(model: CameraModel) -> list[Kernel]:
    """Return the kernels of the generators, N with J_camera N_camera + J_point N_point = 0."""
    camera, X = model.inputs()
    fields = gauge(model)
    point = [list((B * model.point())[: model.point_size]) for _, B in fields]
    names = ", ".join(name for name, _ in fields)
    return [
        Kernel(
            f"{model.prefix}_camera_generators",
            f"updates of a {model.name} camera by the gauge: {names}.",
            (camera,),
            (Output.of("N", camera_generators(model)),),
        ),
        Kernel(
            f"{model.prefix}_point_generators",
            f"velocities of a point of {model.name} cameras by the gauge: {names}.",
            (X,),
            (Output.of("N", sp.Matrix(point).T),),
        ),
    ]


def camera_generators(model: CameraModel) -> sp.Matrix:
    """Return the update of a camera that undoes each generator of the gauge, a column each."""
    own = _undoing(model.frame, tuple(B for _, B in gauge(model)))
    return own.col_join(sp.zeros(len(model.adjusted), own.cols))


@cache
def _undoing(frame: Frame, fields: tuple[sp.ImmutableMatrix, ...]) -> sp.Matrix:
    """Return the updates that undo fields, by projection on the fields that updates make."""
    y = sp.Matrix(sp.symbols("y0:4", real=True))
    velocities = frame.velocities(y[:3, :], y)
    made = sp.Matrix.hstack(
        *(sp.Matrix(12, 1, list(velocities[:, i].jacobian(y))) for i in range(velocities.cols))
    )
    undo = -(made.T * made).inv() * made.T
    M = sp.Matrix(3, 4, [sp.Symbol(name, real=True) for name in frame.entries])
    columns = [(undo * sp.Matrix(12, 1, list(frame.seen(M, B)))).expand() for B in fields]
    updates = sp.Matrix.hstack(*columns)
    if frame.relations:
        basis = sp.groebner(frame.relations, *M, order="grevlex").exprs
        updates = updates.applyfunc(lambda e: sp.reduced(e, basis, *M, order="grevlex")[1])
    return updates


@cache
def gauge(model: CameraModel) -> tuple[Field, ...]:
    """Return the generators of the gauge of a model: rotations, translations, scale, others."""
    rng = random.Random(1)
    with mpmath.workdps(_DIGITS):
        evaluate = _evaluator(model)
        size, d = 4 * model.point_size, model.tangent_size
        # Homogeneous points have scales of their own, which are no motion: fields of trace zero.
        hidden: Rows = [[mpmath.mpf(k % 5 == 0) for k in range(size)]] * (size == 16)
        for _ in range(_CAMERAS):
            *_, rest = _reduced(_equations(model, evaluate, rng), d)
            hidden += [row[d:] for row in rest]
        vectors = _null_space(hidden, size)
    found = [_named(sp.Matrix(4, 4, [*vector, *[0] * (16 - size)])) for vector in vectors]
    kinds = ("rotation", "translation", "scale")

    def rank(field: Field) -> tuple[int, str]:
        kind = field[0].split()[0]
        return (kinds.index(kind), field[0]) if kind in kinds else (len(kinds), "")

    return tuple(sorted(found, key=rank))


def _evaluator(model: CameraModel) -> Callable[..., list[mpmath.matrix]]:
    """Return a function of camera, point, measured point: J_camera, J_point with all digits."""
    observe = model.observe()
    matrices = [sp.Matrix(2, output.shape[1], output.entries) for output in observe.outputs[1:]]
    for stage in reversed(observe.stages):
        values: dict[sp.Symbol, sp.Expr] = {}
        for symbol, value in stage.values.items():
            values[symbol] = at(value, values)
        matrices = [at(matrix, values) for matrix in matrices]
    functions = {"select": lambda condition, a, b: a if condition > 0 else b}
    modules = [functions, "mpmath"]
    inputs = [argument.entries() for argument in observe.inputs]
    return sp.lambdify(inputs, matrices, modules=modules, cse=True)


def _place(model: CameraModel, rng: random.Random) -> list[mpmath.mpf]:
    """Return a camera in general position."""
    k = [mpmath.mpf(rng.uniform(0.02, 0.2)) for _ in model.parameters]
    if not model.frame.relations:
        return [mpmath.mpf(rng.uniform(-1, 1)) for _ in range(12)] + k
    S = mpmath.matrix(3, 3)
    S[1, 0], S[2, 0], S[2, 1] = (rng.uniform(-1, 1) for _ in range(3))
    S -= S.T
    one = mpmath.eye(3)
    R = mpmath.inverse(one - S) * (one + S)
    M = [[*(R[i, j] for j in range(3)), rng.uniform(-1, 1) + 3 * (i == 2)] for i in range(3)]
    return [mpmath.mpf(entry) for row in M for entry in row] + k


def _equations(
    model: CameraModel, evaluate: Callable[..., list[mpmath.matrix]], rng: random.Random
) -> Rows:
    """Return [J_camera, J_point B X by the entries of B] of one camera, two rows a point."""
    camera = _place(model, rng)
    wanted = 2 * (model.tangent_size // 2 + 2 * model.point_size + 3)
    rows: Rows = []
    for _ in range(20 * wanted):
        X = [mpmath.mpf(rng.uniform(-1, 1)) for _ in range(model.point_size)]
        q = [mpmath.mpf(rng.uniform(-1, 1)) for _ in range(2)]
        J_camera, J_point = (matrix.tolist() for matrix in evaluate(camera, X, q))
        vector = [*X, mpmath.mpf(1)][:4]
        pair = [
            [*own, *(slope * entry for slope in by_point for entry in vector)]
            for own, by_point in zip(J_camera, J_point, strict=True)
        ]
        # Not every point has an image: a root may be imaginary.
        if all(isinstance(e, mpmath.mpf) and mpmath.isfinite(e) for row in pair for e in row):
            rows += pair
        if len(rows) >= wanted:
            return rows
    raise ValueError(f"{model.name}: points in general position have no image")


def _reduced(rows: Rows, columns: int) -> tuple[list[int], Rows, Rows]:
    """Eliminate the first columns; return pivots, their rows, and the rows that are left."""
    rest = [row[:] for row in rows]
    pivots: list[int] = []
    done: Rows = []
    for column in range(columns):
        sizes = [abs(row[column]) for row in rest]
        if max(sizes, default=0) < _ZERO:
            continue
        best = rest.pop(sizes.index(max(sizes)))
        best = [entry / best[column] for entry in best]
        for group in (done, rest):
            for position, row in enumerate(group):
                group[position] = [a - row[column] * b for a, b in zip(row, best, strict=True)]
        done.append(best)
        pivots.append(column)
    return pivots, done, rest


def _null_space(rows: Rows, columns: int) -> list[list[int]]:
    """Return the null space, one vector a free column, whose entries are found to be integers."""
    pivots, done, _ = _reduced(rows, columns)
    vectors = []
    for free in range(columns):
        if free not in pivots:
            vector = [mpmath.mpf(column == free) for column in range(columns)]
            for pivot, row in zip(pivots, done, strict=True):
                vector[pivot] = -row[free]
            whole = [int(mpmath.nint(entry)) for entry in vector]
            if any(abs(a - b) > _ZERO for a, b in zip(vector, whole, strict=True)):
                raise ValueError(
                    f"a generator of the gauge has other entries than integers: {vector}"
                )
            vectors.append(whole)
    return vectors


def _named(B: sp.Matrix) -> Field:
    """Name a field, and turn a rotation to its positive sense."""
    for axis, name in enumerate("xyz"):
        unit = [int(k == axis) for k in range(3)]
        turn = sp.diag(cross(unit), 0)
        if B in (turn, -turn):
            return f"rotation {name}", turn.as_immutable()
        if B == sp.zeros(4, 3).row_join(sp.Matrix([*unit, 0])):
            return f"translation {name}", B.as_immutable()
    if B == sp.diag(1, 1, 1, 0):
        return "scale", B.as_immutable()
    places = [(i, j) for i in range(4) for j in range(4)]
    plus = [f"+E{i}{j}" for i, j in places if B[i, j] == 1]
    minus = [f"-E{i}{j}" for i, j in places if B[i, j] == -1]
    return "".join(plus + minus).removeprefix("+"), B.as_immutable()
