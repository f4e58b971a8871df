"""Lines of space as a feature beside points: update, gauge, projection, residual.

The representation is that of `epigauge_derive.pluecker`.
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.camera_model import POSE, CameraModel, H, camera_models
from epigauge_derive.gauge import gauge
from epigauge_derive.kernel import Input, Kernel, Let, Output, at, cross, jacobian
from epigauge_derive.pluecker import (
    DELTA,
    LINE,
    ORIGIN,
    carried,
    coordinates,
    halves,
    line_velocity,
    local,
    seen,
    sides,
    tangent,
    turned_line,
    turned_tangent,
    unit_tangent,
    updated,
)

SEGMENT = Input("segment", (4,), names=("x1", "y1", "x2", "y2"))
#: Covariances (xx, xy, yy) of both end points, where a residual of one has the weight one.
SPREAD = Input("spread", (6,), names=("xx1", "xy1", "yy1", "xx2", "xy2", "yy2"))

#: Names of the line in the camera frame.
_SEEN = sp.symbols("seen0:3", real=True)


def _measures() -> list[Kernel]:
    """Return what is measured between points and lines of space, and its derivatives."""
    n, v = halves(LINE.matrix())
    X = Input("X", (3,), names=("x", "y", "z"))
    other = Input("other", (6,), names=("mx", "my", "mz", "ux", "uy", "uz"))
    _, u = halves(other.matrix())
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
    n, v = halves(LINE.matrix())
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
    n, v = halves(LINE.matrix())
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
    by_line = jacobian(list(image(M, *halves(sp.Matrix(moving)))), moving)
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
            (stage, Let(directions), named, *((local(),) if pose else sides())),
        ),
    ]


def _rigid(M: sp.Matrix, n: sp.Matrix, v: sp.Matrix) -> sp.Matrix:
    """Return `seen` of a pose (R | t), where cof(R) = R."""
    R, t = M[:, :3], M[:, 3]
    return R * n + cross(list(t)) * (R * v)


def kernels() -> list[Kernel]:
    """Return image, update, generators, and residuals of the cameras that map lines to lines."""
    P = Input("P", (3, 4))
    n, v = halves(LINE.matrix())
    models = [model for model in camera_models() if straight(model)]
    pose, other = (
        gauge(next(model for model in models if (model.frame is POSE) == rigid))
        for rigid in (True, False)
    )
    velocities, others = (
        sp.Matrix.hstack(*(line_velocity(B) for _, B in fields)) for fields in (pose, other)
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
            (Output.of("moved", updated(DELTA.entries())),),
            (local(),),
        ),
        Kernel(
            "line_tangent",
            "derivative of the line by that update, at none.",
            (LINE, ORIGIN),
            (Output.of("T", tangent()),),
            (local(),),
        ),
        Kernel(
            "line_unit_tangent",
            "derivative by that update, at none, of the line over the length of its direction.",
            (LINE, ORIGIN),
            (Output.of("T", unit_tangent()),),
            (local(),),
        ),
        *_measures(),
        Kernel(
            "line_generators",
            f"updates of a line by the gauge of poses: {', '.join(name for name, _ in pose)}.",
            (LINE, ORIGIN),
            (Output.of("N", coordinates(velocities)),),
            (local(),),
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
            (Output.of("moved", turned_line(DELTA.entries())),),
            sides(),
        ),
        Kernel(
            "projective_line_tangent",
            "derivative of the line of length one by that update, at none.",
            (LINE,),
            (Output.of("T", turned_tangent()),),
            sides(),
        ),
        Kernel(
            "projective_line_generators",
            "updates of a line of length one by the gauge of projective cameras: "
            f"{', '.join(name for name, _ in other)}.",
            (LINE,),
            # The columns of the tangent are orthogonal to one another and to the line.
            (Output.of("N", 2 * turned_tangent().T * others),),
            sides(),
        ),
        *(kernel for model in models for kernel in _of_camera(model)),
    ]
