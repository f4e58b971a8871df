r"""The exact reprojection error of a match, structure eliminated (math: foot points).

The squared error minimised over the point in space is the squared distance of z = (q, q') in R^4
to the hypersurface C(z) = q'^T F q = 0. C is bilinear, so one rotation an image, from the SVD of
F's upper left 2x2 block B, makes C_zz = [[0, S], [S, 0]] with S = diag(s1, s2), and the sums and
differences of corresponding coordinates diagonalise it with eigenvalues kappa = +-s1, +-s2.
Stationarity, z_hat = z - l grad C(z_hat), then reads for each of the four coordinates

    w = (omega - l beta) / (1 + l kappa),   grad = h / (1 + l kappa),   h = kappa omega + beta,

and C(z_hat) = 0 is one scalar equation phi(l) = 0, monotone on |l| < 1 / s1, whose root is the
global correction. Newton from l = 0 starts with the Sampson correction.
"""

from __future__ import annotations

from dataclasses import replace

import sympy as sp

from epigauge_derive.kernel import (
    Input,
    Kernel,
    Let,
    Loop,
    Output,
    jacobian,
    select,
    upper,
)

# One evaluation needs F in the rotated images: diag(s), the last column b2, the last row b1, f.
R1, R2 = Input("R1", (2, 2), shared=True), Input("R2", (2, 2), shared=True)
S = Input("s", (2,), shared=True)
B1, B2 = Input("b1", (2,), shared=True), Input("b2", (2,), shared=True)
F22 = Input("f", (), shared=True)
FRAME = (R1, R2, S, B1, B2, F22)
Q1, Q2 = Input("q1", (2,)), Input("q2", (2,))
MULTIPLIER = Input("l")

# Newton passes behind the first, which is the Sampson correction.
FAST_PASSES, MORE_PASSES, SAFE_PASSES = 2, 8, 100
# The bracket ends this far (relative) inside the poles +-1 / s1, so that nothing divides by zero.
_INSIDE = 1 - sp.Rational(1, 2**46)
# Keeps 0/0 out of matches that lie on both epipoles, where C and its gradient vanish together.
_TINY = sp.Float("1e-300")


def _symbols(*names: str) -> list[sp.Symbol]:
    return [sp.Symbol(name, real=True) for name in names]


A1, A2 = _symbols("a1_0", "a1_1"), _symbols("a2_0", "a2_1")
C0 = sp.Symbol("C0", real=True)
SQUARES = _symbols("hh0", "hh1", "hh2", "hh3")
RECIPROCALS = _symbols("r0", "r1", "r2", "r3")
KAPPA = [S.entries()[0], -S.entries()[0], S.entries()[1], -S.entries()[1]]


def rotated_fundamental() -> sp.Matrix:
    """Return F in the rotated images."""
    s, b1, b2 = S.entries(), B1.entries(), B2.entries()
    return sp.Matrix([[s[0], 0, b2[0]], [0, s[1], b2[1]], [b1[0], b1[1], F22.symbol()]])


def rotate_match() -> Let:
    """Name the coordinates of the match in the rotated images, a1 = R1^T q1 and a2 = R2^T q2."""
    a1, a2 = R1.matrix().T * Q1.matrix(), R2.matrix().T * Q2.matrix()
    return Let(dict(zip((*A1, *A2), (*a1, *a2), strict=True)))


def bilinear(a1: list[sp.Expr], a2: list[sp.Expr]) -> sp.Expr:
    """Return C at a pair of rotated image points."""
    return (sp.Matrix([*a2, 1]).T * rotated_fundamental() * sp.Matrix([*a1, 1]))[0]


def diagonal_coordinates(z: list[sp.Expr]) -> list[sp.Expr]:
    """Return sums and differences of corresponding coordinates, an isometry of R^4."""
    x1, y1, x2, y2 = z
    root = sp.sqrt(sp.Rational(1, 2))
    return [root * (x1 + x2), root * (x1 - x2), root * (y1 + y2), root * (y1 - y2)]


def gradient_at_measurement() -> list[sp.Expr]:
    """Return h, the gradient of C at the measured match in the diagonal coordinates."""
    z = [*A1, *A2]
    return diagonal_coordinates([sp.diff(bilinear(A1, A2), v) for v in z])


def reciprocals(l: sp.Expr) -> dict[sp.Symbol, sp.Expr]:
    """Name r = 1 / (1 + l kappa) for the four kappa, with one division for all."""
    names: dict[sp.Symbol, sp.Expr] = {}
    pairs = _symbols("pair0", "pair1")
    inverse = sp.Symbol("inverse", real=True)
    for k, pair in enumerate(pairs):
        above, below = _symbols(f"above{k}", f"below{k}")
        names |= {above: 1 + l * KAPPA[2 * k], below: 1 + l * KAPPA[2 * k + 1]}
        names[pair] = above * below
    names[inverse] = 1 / (pairs[0] * pairs[1])
    for k, (plus, minus) in enumerate((RECIPROCALS[:2], RECIPROCALS[2:])):
        above, below = _symbols(f"above{k}", f"below{k}")
        own = sp.Symbol(f"inverse{k}", real=True)
        names |= {own: inverse * pairs[1 - k], plus: below * own, minus: above * own}
    return names


def secular(l: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Return phi(l) and -phi'(l) in terms of C0, h^2 and the reciprocals r = 1 / (1 + l kappa).

    phi is C along the stationary curve. Its derivative is -sum h^2 r^3, and integrating from
    phi(0) = C(z) gives sum h^2 l (1 + l kappa / 2) r^2 = (l / 2) sum h^2 r (1 + r), a form without
    cancellation where kappa vanishes.
    """
    terms = list(zip(SQUARES, RECIPROCALS, strict=True))
    slope = sum(h * r * r * r for h, r in terms)
    return C0 - l / 2 * sum(h * r + h * r * r for h, r in terms), slope


def _start() -> tuple[Let, sp.Symbol]:
    """Name C and squared gradient at the measurement, and the Sampson correction."""
    start = sp.Symbol("start", real=True)
    names = {C0: bilinear(A1, A2)}
    names |= {symbol: h**2 for symbol, h in zip(SQUARES, gradient_at_measurement(), strict=True)}
    return Let(names | {start: C0 / (sum(SQUARES) + _TINY)}), start


def foot_point_fast(passes: int) -> tuple[tuple[Let | Loop, ...], sp.Symbol, sp.Symbol]:
    """Return Newton's iteration for phi(l) = 0 from the Sampson correction, root and last change.

    Where it leaves the interval between the poles, the change is the root itself: not found.
    """
    l, change, newton, last = _symbols("l", "change", "newton", "last")
    phi, slope = secular(l)
    begin, start = _start()
    loop = Loop(
        start={l: start, change: sp.Integer(0)},
        body=reciprocals(l) | {newton: phi / (slope + _TINY)},
        update={l: l + newton, change: newton},
        passes=passes,
    )
    inside = Let({last: select(_INSIDE - sp.Abs(l) * S.entries()[0], change, l)})
    return (rotate_match(), begin, loop, inside), l, last


def foot_point_safe(passes: int) -> tuple[tuple[Let | Loop, ...], sp.Symbol, sp.Symbol]:
    """Return the bracketed Newton iteration for phi(l) = 0, the root and its last change."""
    l, low, high, change = _symbols("l", "low", "high", "change")
    value, step, lower, upper_, moved = _symbols("value", "step", "low_new", "high_new", "moved")
    pole = sp.Symbol("pole", real=True)
    phi, slope = secular(l)
    begin, start = _start()

    def bracketed(trial: sp.Expr, lower: sp.Expr, upper: sp.Expr) -> sp.Expr:
        return select((lower - trial) * (upper - trial), (lower + upper) / 2, trial)

    ends = Let({pole: _INSIDE / (S.entries()[0] + sp.Float("1e-140"))})
    loop = Loop(
        start={
            l: bracketed(start, -pole, pole),
            low: select(C0, sp.Integer(0), -pole),
            high: select(C0, pole, sp.Integer(0)),
            change: sp.Integer(0),
        },
        body=reciprocals(l)
        | {
            value: phi,
            step: value / (slope + _TINY),
            lower: select(value, l, low),
            upper_: select(value, high, l),
            moved: bracketed(l + step, lower, upper_),
        },
        update={l: moved, low: lower, high: upper_, change: moved - l},
        passes=passes,
    )
    return (rotate_match(), begin, ends, loop), l, change


def stationary_point() -> tuple[list[sp.Expr], list[sp.Expr], list[sp.Expr]]:
    """Return the corrected rotated image points and the gradient of C there.

    As functions of l and of the reciprocals r.
    """
    l = MULTIPLIER.symbol()
    h = gradient_at_measurement()
    gradient = [value * r for value, r in zip(h, RECIPROCALS, strict=True)]
    plus1, minus1, plus2, minus2 = gradient
    root = sp.sqrt(sp.Rational(1, 2))
    n = [root * (plus1 + minus1), root * (plus2 + minus2)]
    n += [root * (plus1 - minus1), root * (plus2 - minus2)]
    z_hat = [z - l * entry for z, entry in zip([*A1, *A2], n, strict=True)]
    return z_hat[:2], z_hat[2:], n


def kernels() -> list[Kernel]:
    """Return the frame of an F, the foot point, and what the solver sums up at it."""
    feet = [*_foot_points(), _points()]
    return [_frame(), *feet, *map(_with_own_frames, feet), *_normal_equations()]


def _with_own_frames(kernel: Kernel) -> Kernel:
    """Return a kernel for matches that each have an F of their own, as whitening gives them."""
    inputs = tuple(replace(argument, shared=False) for argument in kernel.inputs)
    formula = f"{kernel.formula[:-1]}; each match with its own frame."
    return replace(kernel, name=f"{kernel.name}_each", formula=formula, inputs=inputs)


def _frame() -> Kernel:
    """Return the rotations that diagonalise B (closed-form SVD of a 2x2 matrix)."""
    F = Input("F", (3, 3))
    B = F.matrix()[:2, :2]
    mean, difference = (B[0, 0] + B[1, 1]) / 2, (B[0, 0] - B[1, 1]) / 2
    symmetric, skew = (B[1, 0] + B[0, 1]) / 2, (B[1, 0] - B[0, 1]) / 2
    total, twist = sp.atan2(symmetric, difference), sp.atan2(skew, mean)
    angles = _symbols("angle1", "angle2")
    r1, r2 = (sp.Matrix([[sp.cos(a), -sp.sin(a)], [sp.sin(a), sp.cos(a)]]) for a in angles)
    large, small = sp.sqrt(mean**2 + skew**2), sp.sqrt(difference**2 + symmetric**2)
    return Kernel(
        "bilinear_frame",
        "rotations with R2^T B R1 = diag(s1, s2), s1 >= |s2|, B the upper left 2x2 block of F, "
        "and the last row and column of F in the rotated images (closed-form SVD).",
        (F,),
        (
            Output.of("R1", r1),
            Output.of("R2", r2),
            Output.of("s", [large + small, large - small]),
            Output.of("b1", r1.T * F.matrix()[2, :2].T),
            Output.of("b2", r2.T * F.matrix()[:2, 2]),
            Output.of("f", F.matrix()[2, 2]),
        ),
        (Let({angles[0]: (total - twist) / 2, angles[1]: (total + twist) / 2}),),
    )


def _foot_points() -> list[Kernel]:
    made = []
    for name, found, passes, how in (
        ("foot_point", foot_point_fast, FAST_PASSES, "Newton"),
        ("foot_point_more", foot_point_fast, MORE_PASSES, "Newton"),
        ("foot_point_safe", foot_point_safe, SAFE_PASSES, "bracketed Newton"),
    ):
        stages, l, change = found(passes)
        norm2 = sum(h * r**2 for h, r in zip(SQUARES, RECIPROCALS, strict=True))
        made.append(
            Kernel(
                name,
                f"multiplier l of the foot point by {passes} passes of {how} from "
                "the Sampson correction, its last change, and the signed distance d = l |n|.",
                (*FRAME, Q1, Q2),
                (
                    Output.of("multiplier", l),
                    Output.of("last_change", change),
                    Output.of("d", l * sp.sqrt(norm2)),
                ),
                (*stages, Let(reciprocals(l))),
            )
        )
    return made


def _point_derivative(q1: list[sp.Expr], q2: list[sp.Expr]) -> list[sp.Expr]:
    """Return dC / d vect(F) = vect(q2 q1^T), by differentiation."""
    entries = [sp.Symbol(f"F{i}{j}", real=True) for i in range(3) for j in range(3)]
    C = (sp.Matrix([*q2, 1]).T * sp.Matrix(3, 3, entries) * sp.Matrix([*q1, 1]))[0]
    return [sp.diff(C, entry) for entry in entries]


def _points() -> Kernel:
    a1, a2, n = stationary_point()
    q1, q2 = R1.matrix() * sp.Matrix(a1), R2.matrix() * sp.Matrix(a2)
    p1, p2 = _symbols("p1_0", "p1_1"), _symbols("p2_0", "p2_1")
    length = sp.Symbol("length", real=True)
    derivative = [entry / length for entry in _point_derivative(p1, p2)]
    return Kernel(
        "foot_point_derivative",
        "corrected match, and d d / d vect(F) = vect(q2_hat q1_hat^T) / |n| of the signed "
        "distance (envelope theorem).",
        (*FRAME, Q1, Q2, MULTIPLIER),
        (
            Output.of("q1_hat", p1),
            Output.of("q2_hat", p2),
            Output.of("dd_dF", derivative),
        ),
        (
            rotate_match(),
            Let(
                reciprocals(MULTIPLIER.symbol())
                | dict(zip((*p1, *p2), (*q1, *q2), strict=True))
                | {length: sp.sqrt(sum(entry**2 for entry in n) + _TINY)}
            ),
        ),
    )


def second_order_parts() -> tuple[list[sp.Symbol], dict[sp.Symbol, sp.Expr], list[sp.Symbol]]:
    """Return names of the corrected rotated match, their values, and the gradient's names."""
    x1, x2 = _symbols("p1_0", "p1_1"), _symbols("p2_0", "p2_1")
    n = _symbols("n0", "n1", "n2", "n3")
    a1, a2, gradient = stationary_point()
    values = reciprocals(MULTIPLIER.symbol())
    values |= dict(zip((*x1, *x2, *n), (*a1, *a2, *gradient), strict=True))
    return [*x1, *x2], values, n


def exact_hessian(
    z: list[sp.Symbol], n: list[sp.Symbol], l: sp.Expr
) -> tuple[sp.Matrix, sp.Matrix]:
    """Return the exact Hessian of d^2/2 by vect(F) of the rotated images, and -phi'(l).

    The distance is the value of min |z - z_hat|^2 / 2 subject to C(z_hat, F) = 0 with multiplier
    l. Differentiating its optimality conditions by F gives H = l C_FF - R^T K^-1 R with
    K = [[M, n], [n^T, 0]], M = I + l C_zz, R = [l C_zF; C_F]. C is linear in F, so C_FF = 0, and
    K^-1 is written out by blocks.
    """
    C_F = sp.Matrix(_point_derivative(z[:2], z[2:]))
    C_zF = jacobian(list(C_F), z).T
    C_zz = sp.hessian(bilinear(z[:2], z[2:]), z)
    M_inverse = (sp.eye(4) + l * C_zz).inv().applyfunc(sp.factor)
    v = M_inverse * sp.Matrix(n)
    slope = (sp.Matrix(n).T * v)[0]
    w = C_F - l * C_zF.T * v
    return w * w.T / slope - l**2 * C_zF.T * M_inverse * C_zF, slope


def _normal_equations() -> list[Kernel]:
    """Return what the solver adds up: gradient with Gauss-Newton matrix or exact Hessian.

    The cost of a match is rho(d^2) / 2: `weight` is rho' and `curvature` 2 rho'', which multiplies
    the square of d * dd/dF = l * C_F. Derivatives are by vect(F) of the rotated images.
    """
    z, values, n = second_order_parts()
    l = MULTIPLIER.symbol()
    weight, curvature = Input("weight"), Input("curvature")
    squared = sp.Symbol("length2", real=True)
    C_F = sp.Matrix(_point_derivative(z[:2], z[2:]))
    # d * dd/dF = l |n| * C_F / |n|
    gradient = Output.of("g", weight.symbol() * l * C_F, summed=True)
    gauss_newton = weight.symbol() * C_F * C_F.T / squared
    normal = Output.of("N", upper(gauss_newton), summed=True)
    hessian, _ = exact_hessian(z, n, l)
    exact = weight.symbol() * hessian + curvature.symbol() * l**2 * C_F * C_F.T
    stages = (rotate_match(), Let(values | {squared: sum(e**2 for e in n) + _TINY}))
    arguments = (*FRAME, Q1, Q2, MULTIPLIER, weight)
    return [
        Kernel(
            "reprojection_gauss_newton",
            "gradient and Gauss-Newton matrix (upper triangle) of sum weight d^2 / 2 by vect(F) "
            "of the rotated images.",
            arguments,
            (gradient, normal),
            stages,
        ),
        Kernel(
            "reprojection_newton",
            "gradient, Gauss-Newton matrix and exact Hessian (upper triangles) of a robust sum of "
            "d^2 / 2 by vect(F) of the rotated images, H = l C_FF - R^T K^-1 R for each match.",
            (*arguments, curvature),
            (gradient, normal, Output.of("H", upper(exact), summed=True)),
            stages,
        ),
    ]
