"""Lines of space as a feature beside points: orthonormal representation, projection, residual.

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

from epigauge_derive.camera_model import POSE, CameraModel, H, camera_models
from epigauge_derive.gauge import gauge
from epigauge_derive.kernel import Input, Kernel, Let, Output, at, cross, jacobian, select
from epigauge_derive.models.rotations import euler_rotation

LINE = Input("line", (6,), names=("nx", "ny", "nz", "vx", "vy", "vz"))
ORIGIN = Input("origin", (3,), names=("ox", "oy", "oz"))
DELTA = Input("delta", (4,))
SEGMENT = Input("segment", (4,), names=("x1", "y1", "x2", "y2"))
#: Covariances (xx, xy, yy) of both end points, where a residual of one has the weight one.
SPREAD = Input("spread", (6,), names=("xx1", "xy1", "yy1", "xx2", "xy2", "yy2"))

#: Names of the line in the camera frame, of its image, and of the line about the origin.
_SEEN = sp.symbols("seen0:3", real=True)
_IMAGE = sp.symbols("image0:3", real=True)
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


def _halves(line: sp.Matrix) -> tuple[sp.Matrix, sp.Matrix]:
    return line[:3, :], line[3:, :]


def _local() -> Let:
    """Name the moment about the origin, its length, and that of v."""
    n, v = _halves(LINE.matrix())
    moment = n - cross(ORIGIN.entries()) * v
    lengths = {
        _DISTANCE: sp.sqrt(sum(m**2 for m in _MOMENT)),
        _LENGTH: sp.sqrt(sum(entry**2 for entry in v)),
    }
    return Let({**dict(zip(_MOMENT, moment, strict=True)), **lengths})


def _updated(delta: list[sp.Symbol]) -> sp.Matrix:
    """Return the line after U <- U R(x), W <- W R(phi), about the origin."""
    _, v = _halves(LINE.matrix())
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
    return at(jacobian(list(_updated(delta)), delta), dict.fromkeys(delta, sp.S.Zero))


def _unit_tangent() -> sp.Matrix:
    """Return the derivative by its update of the line over the length of its direction, 6x4."""
    delta = DELTA.entries()
    moved = _updated(delta)
    length = sp.sqrt(sum(entry**2 for entry in moved[3:, :]))
    unit = list(moved / length)
    return at(jacobian(unit, delta), dict.fromkeys(delta, sp.S.Zero))


def _measures() -> list[Kernel]:
    """Return what is measured between points and lines of space, and its derivatives."""
    n, v = _halves(LINE.matrix())
    X = Input("X", (3,), names=("x", "y", "z"))
    other = Input("other", (6,), names=("mx", "my", "mz", "ux", "uy", "uz"))
    _, u = _halves(other.matrix())
    apart, across = sp.symbols("apart0:3", real=True), sp.symbols("across0:3", real=True)
    offset = cross(X.entries()) * v - n
    turned = cross(list(v)) * u
    distance = sp.sqrt(sum(a**2 for a in apart)) / sp.sqrt(sum(entry**2 for entry in v))
    by_apart = jacobian([distance], apart)
    by_offset = jacobian(list(offset), [*X.entries(), *LINE.entries()])
    direct = jacobian([distance], list(v))
    slope = by_apart * by_offset
    slope[:, 6:] += direct
    cosine = sum(a * b for a, b in zip(v, u, strict=True))
    sine = sp.sqrt(sum(a**2 for a in across))
    angle = sp.atan2(sine, sp.sqrt(cosine**2))
    # Of unit directions: d angle = -(sign of the cosine) / sine times the change of the cosine.
    size = sum(entry**2 for entry in v), sum(entry**2 for entry in u)
    side = cosine / sp.sqrt(cosine**2)
    by_v = -(u - cosine / size[0] * v).T * side / sine
    by_u = -(v - cosine / size[1] * u).T * side / sine
    none = sp.zeros(1, 3)
    return [
        Kernel(
            "point_line_distance",
            "distance |X x v - n| / |v| of a point from a line, and its derivatives by the point "
            "and the line.",
            (X, LINE),
            (Output.of("d", [distance]), Output.of("J", list(slope))),
            (Let(dict(zip(apart, offset, strict=True))),),
        ),
        Kernel(
            "line_angle",
            "angle of two lines, at most 90 degrees, and its derivatives by both lines.",
            (LINE, other),
            (
                Output.of("a", [angle]),
                Output.of("J", list(none.row_join(by_v).row_join(none).row_join(by_u))),
            ),
            (Let(dict(zip(across, turned, strict=True))),),
        ),
    ]


def _coordinates(velocity: sp.Matrix) -> sp.Matrix:
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


def _velocity(B: sp.Matrix) -> sp.Matrix:
    """Return how the line moves with points that move by B X."""
    epsilon = sp.Symbol("epsilon")
    both = carried(sp.eye(4) + epsilon * B, *_halves(LINE.matrix()))
    return at(both.diff(epsilon), {epsilon: sp.S.Zero}).expand()


def _sides() -> tuple[Let, ...]:
    """Name the directions n + v and n - v, then axes that are orthonormal with each."""
    n, v = _halves(LINE.matrix())
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


def _turned(delta: list[sp.Symbol]) -> sp.Matrix:
    """Return the line, of length one, after both directions are turned by two numbers each."""
    sides = []
    for side, axes, own in zip(_SIDES, _AXES, (delta[:2], delta[2:]), strict=True):
        sides.append((side + axes * sp.Matrix(own)) / sp.sqrt(1 + own[0] ** 2 + own[1] ** 2))
    return ((sides[0] + sides[1]) / 2).col_join((sides[0] - sides[1]) / 2)


def turned_tangent() -> sp.Matrix:
    """Return the derivative of the line of length one by that update, 6x4."""
    delta = DELTA.entries()
    return at(jacobian(list(_turned(delta)), delta), dict.fromkeys(delta, sp.S.Zero))


def _distances(model: CameraModel) -> list[sp.Expr]:
    """Return the distances of both end points to the image of the line, over their deviations.

    For a camera K h the image is K^-T (R n + t x R v). By the matrix of covariances S the
    deviation of a distance is sqrt(a^T S a) / |a|, a = (l0, l1): l^T (x, y, 1) / sqrt(a^T S a).
    """
    K = _calibration(model)
    l0, l1, l2 = K.inv().T * sp.Matrix(_SEEN)
    x1, y1, x2, y2 = SEGMENT.entries()
    spread = SPREAD.entries()
    found = []
    for x, y, (xx, xy, yy) in ((x1, y1, spread[:3]), (x2, y2, spread[3:])):
        found.append((l0 * x + l1 * y + l2) / sp.sqrt(l0**2 * xx + 2 * l0 * l1 * xy + l1**2 * yy))
    return found


def _calibration(model: CameraModel) -> sp.Matrix:
    """Return K of a camera whose image is K h, by differentiation on the plane h2 = 1."""
    h, k = H.entries(), model.intrinsics().entries()
    image = sp.Matrix(model.image(sp.Matrix([h[0], h[1], 1]), k))
    slope = jacobian(list(image), h[:2])
    centre = image - slope * sp.Matrix(h[:2])
    return slope.row_join(centre.applyfunc(sp.simplify)).col_join(sp.Matrix([[0, 0, 1]]))


def straight(model: CameraModel) -> bool:
    """Tell whether a camera maps lines to lines: its image is linear in h0, h1 where h2 is one.

    Of cameras that are a pose, or any matrix.
    """
    if not (model.frame is POSE or model.point_size == 4) or model.corrects:
        return False
    h = H.entries()
    image = model.image(sp.Matrix([h[0], h[1], 1]), model.intrinsics().entries())
    # The slope is the same everywhere.
    slopes = (sp.diff(sp.sympify(value), entry) for value in image for entry in h[:2])
    return not any(slope.has(*h[:2]) for slope in slopes)


def _velocities(model: CameraModel) -> tuple[sp.Matrix, dict[sp.Symbol, sp.Expr]]:
    """Return the derivative of the seen line by the update of a camera, and what it names."""
    n, v = _halves(LINE.matrix())
    M = model.matrix()
    if model.frame is not POSE:  # an additive update
        return jacobian(list(seen(M, n, v)), list(M)), {}
    # An update of the camera moves what it sees, (seen, R v).
    delta = sp.symbols(f"delta0:{len(POSE.unknowns)}", real=True)
    zero = {symbol: value for symbol, (_, value) in POSE.even(delta).items()}
    h, X = sp.symbols("h0:3", real=True), sp.symbols("X0:4", real=True)
    act = list(POSE.act(sp.Matrix(h), sp.Matrix(X), delta))
    E, f = jacobian(act, h), jacobian(act, [X[3]])
    turned = sp.Matrix(sp.symbols("turned0:3", real=True))
    moved = seen(E.row_join(f), sp.Matrix(_SEEN), turned)
    velocity = at(at(jacobian(list(moved), delta), dict.fromkeys(delta, sp.S.Zero)), zero)
    return velocity, dict(zip(turned, M[:, :3] * v, strict=True))


def _of_camera(model: CameraModel) -> list[Kernel]:
    """Return residual and Jacobians of a segment in a camera that maps lines to lines."""
    camera, _ = model.inputs()
    n, v = _halves(LINE.matrix())
    M = model.matrix()
    pose = model.frame is POSE
    image = _rigid if pose else seen
    stage = Let(dict(zip(_SEEN, image(M, n, v), strict=True)))
    distances = _distances(model)
    by_seen = jacobian(distances, _SEEN)
    slopes = sp.Matrix(2, 3, lambda i, j: sp.Symbol(f"slope{i}{j}", real=True))
    named = Let(dict(zip(slopes, by_seen, strict=True)))
    velocity, directions = _velocities(model)
    intrinsics = dict(zip(model.parameters, model.intrinsics().entries(), strict=True))
    by_k = jacobian(distances, [intrinsics[name] for name in model.adjusted])
    own = -slopes * velocity
    moving = sp.symbols("m0:6", real=True)
    by_line = jacobian(list(image(M, *_halves(sp.Matrix(moving)))), moving)
    by_line = by_line * (tangent() if pose else turned_tangent())
    r = Output.of("r", sp.Matrix(distances))
    inputs = SEGMENT, SPREAD
    where = "about an origin" if pose else "in four dimensions"
    return [
        Kernel(
            f"{model.prefix}_line_residual",
            "signed distances of both end points of a segment to the image of a line in the camera "
            f"{model.name}, over their standard deviations.",
            (camera, LINE, *inputs),
            (r,),
            (stage,),
        ),
        Kernel(
            f"{model.prefix}_line_observe",
            f"{model.prefix}_line_residual, and minus its derivatives by the update of the camera "
            f"({', '.join(model.unknowns)}) and by that of the line {where}.",
            (camera, LINE, *((ORIGIN,) if pose else ()), *inputs),
            (
                r,
                Output.of("J_camera", own.row_join(-by_k) if by_k.cols else own),
                Output.of("J_line", -slopes * by_line),
            ),
            (stage, Let(directions), named, *((_local(),) if pose else _sides())),
        ),
    ]


def _rigid(M: sp.Matrix, n: sp.Matrix, v: sp.Matrix) -> sp.Matrix:
    """Return `seen` of a pose (R | t), where cof(R) = R."""
    R, t = M[:, :3], M[:, 3]
    return R * n + cross(list(t)) * (R * v)


def kernels() -> list[Kernel]:
    """Return image, update, generators, and residuals of the cameras that map lines to lines."""
    P = Input("P", (3, 4))
    n, v = _halves(LINE.matrix())
    models = [model for model in camera_models() if straight(model)]
    pose, other = (
        gauge(next(model for model in models if (model.frame is POSE) == rigid))
        for rigid in (True, False)
    )
    velocities, others = (
        sp.Matrix.hstack(*(_velocity(B) for _, B in fields)) for fields in (pose, other)
    )
    return [
        Kernel(
            "line_project",
            "image cof(A) n + b x A v of a line (n, v) by a camera P = (A | b), projective or not.",
            (P, LINE),
            (Output.of("l", seen(P.matrix(), n, v)),),
        ),
        Kernel(
            "line_retract",
            "line moved by U <- U R(x), W <- W R(phi) of its orthonormal representation about an "
            "origin off it, in units of its distance from there (Bartoli & Sturm, CVIU 2005).",
            (LINE, ORIGIN, DELTA),
            (Output.of("moved", _updated(DELTA.entries())),),
            (_local(),),
        ),
        Kernel(
            "line_tangent",
            "derivative of the line by that update, at none.",
            (LINE, ORIGIN),
            (Output.of("T", tangent()),),
            (_local(),),
        ),
        Kernel(
            "line_unit_tangent",
            "derivative by that update, at none, of the line over the length of its direction.",
            (LINE, ORIGIN),
            (Output.of("T", _unit_tangent()),),
            (_local(),),
        ),
        *_measures(),
        Kernel(
            "line_generators",
            f"updates of a line by the gauge of poses: {', '.join(name for name, _ in pose)}.",
            (LINE, ORIGIN),
            (Output.of("N", _coordinates(velocities)),),
            (_local(),),
        ),
        Kernel(
            "line_transform",
            "line (n, v) where points X are moved to T X: the exterior square of T times it.",
            (Input("T", (4, 4)), LINE),
            (Output.of("moved", carried(Input("T", (4, 4)).matrix(), n, v)),),
        ),
        Kernel(
            "projective_line_retract",
            "line of length one, moved by turning the directions n + v and n - v by two numbers "
            "each: the orthonormal representation (Bartoli & Sturm, CVIU 2005) in four dimensions.",
            (LINE, DELTA),
            (Output.of("moved", _turned(DELTA.entries())),),
            _sides(),
        ),
        Kernel(
            "projective_line_tangent",
            "derivative of the line of length one by that update, at none.",
            (LINE,),
            (Output.of("T", turned_tangent()),),
            _sides(),
        ),
        Kernel(
            "projective_line_generators",
            "updates of a line of length one by the gauge of projective cameras: "
            f"{', '.join(name for name, _ in other)}.",
            (LINE,),
            # The columns of the tangent are orthogonal to one another and to the line.
            (Output.of("N", 2 * turned_tangent().T * others),),
            _sides(),
        ),
        *(kernel for model in models for kernel in _of_camera(model)),
    ]
