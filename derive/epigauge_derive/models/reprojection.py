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

from collections.abc import Callable
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
# Up to this much of the way to the poles +-1 / s1, sums over a common denominator lose no digit.
_FAR_FROM_POLES = sp.Rational(1, 2)
# The bracket ends this far (relative) inside the poles, so that nothing divides by zero.
_INSIDE = 1 - sp.Rational(1, 2**46)
# Keeps 0/0 out of matches that lie on both epipoles, where C and its gradient vanish together.
_TINY = sp.Float("1e-300")


Term = Callable[[sp.Expr, sp.Expr], sp.Expr]
Names = dict[sp.Symbol, sp.Expr]


def _symbols(*names: str) -> list[sp.Symbol]:
    return [sp.Symbol(name, real=True) for name in names]


A1, A2 = _symbols("a1_0", "a1_1"), _symbols("a2_0", "a2_1")
C0 = sp.Symbol("C0", real=True)
SQUARES = _symbols("hh0", "hh1", "hh2", "hh3")
RECIPROCALS = _symbols("r0", "r1", "r2", "r3")
# Sum and half the difference of the h^2 of kappa = +-s1 and of kappa = +-s2, and 1 - (l s)^2.
SUMS, DIFFERENCES = _symbols("sum0", "sum1"), _symbols("difference0", "difference1")
DENOMINATORS = _symbols("D0", "D1")
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


def reciprocals(l: sp.Expr, over: sp.Expr = sp.S.One) -> Names:
    """Name r = over / (1 + l kappa) for the four kappa, with one division for all."""
    names: Names = {}
    pairs = _symbols("pair0", "pair1")
    inverse = sp.Symbol("inverse", real=True)
    for k, pair in enumerate(pairs):
        above, below = _symbols(f"above{k}", f"below{k}")
        names |= {above: 1 + l * KAPPA[2 * k], below: 1 + l * KAPPA[2 * k + 1]}
        names[pair] = above * below
    names[inverse] = over / (pairs[0] * pairs[1])
    for k, (plus, minus) in enumerate((RECIPROCALS[:2], RECIPROCALS[2:])):
        above, below = _symbols(f"above{k}", f"below{k}")
        own = sp.Symbol(f"inverse{k}", real=True)
        names |= {own: inverse * pairs[1 - k], plus: below * own, minus: above * own}
    return names


def phi_term(h: sp.Expr, r: sp.Expr) -> sp.Expr:
    """Return the part of a kappa in 2 (C0 - phi) / l."""
    return h * r + h * r * r


def slope_term(h: sp.Expr, r: sp.Expr) -> sp.Expr:
    """Return the part of a kappa in -phi'."""
    return h * r * r * r


def square_term(h: sp.Expr, r: sp.Expr) -> sp.Expr:
    """Return the part of a kappa in the squared gradient at the foot point."""
    return h * r * r


def total(term: Term) -> sp.Expr:
    """Return the sum of a term over the four kappa."""
    return sum(term(h, r) for h, r in zip(SQUARES, RECIPROCALS, strict=True))


def secular(l: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """Return phi(l) and -phi'(l) in terms of C0, h^2 and the reciprocals r = 1 / (1 + l kappa).

    phi is C along the stationary curve. Its derivative is -sum h^2 r^3, and integrating from
    phi(0) = C(z) gives sum h^2 l (1 + l kappa / 2) r^2 = (l / 2) sum h^2 r (1 + r), a form without
    cancellation where kappa vanishes.
    """
    return C0 - l / 2 * total(phi_term), total(slope_term)


def over_denominators(l: sp.Expr) -> tuple[Names, Callable[[Term, int], sp.Expr]]:
    """Return names, and sums of a term over the four kappa times (D0 D1)^power, D = 1 - (l s)^2.

    The reciprocals of kappa = +-s have the common denominator D, so that a pass needs one division.
    What cancels near the poles is not added up apart here, as it is with the `reciprocals`.
    """
    u, v, D = _symbols("u0", "u1"), _symbols("v0", "v1"), DENOMINATORS
    names: Names = {}
    for k, s in enumerate(S.entries()):
        names |= {u[k]: l * s, v[k]: u[k] ** 2, D[k]: 1 - v[k]}

    def one(term: Term, power: int, k: int) -> sp.Expr:
        a, b = SUMS[k], DIFFERENCES[k]
        pair = term(a / 2 + b, 1 / (1 + u[k])) + term(a / 2 - b, 1 / (1 - u[k]))
        over = sp.expand(sp.cancel(pair * (1 - u[k] ** 2) ** power))
        even, odd = (
            sp.horner(part.subs(u[k], sp.sqrt(v[k])))
            for part in (over.coeff(a), sp.expand(over.coeff(b) / u[k]))
        )
        return a * even + b * u[k] * odd

    def both(term: Term, power: int) -> sp.Expr:
        return one(term, power, 0) * D[1] ** power + one(term, power, 1) * D[0] ** power

    return names, both


def _start() -> tuple[Let, sp.Symbol]:
    """Name C and squared gradient at the measurement, and the Sampson correction."""
    start = sp.Symbol("start", real=True)
    names = {C0: bilinear(A1, A2)}
    names |= {symbol: h**2 for symbol, h in zip(SQUARES, gradient_at_measurement(), strict=True)}
    return Let(names | {start: C0 / (sum(SQUARES) + _TINY)}), start


def foot_point_fast(passes: int) -> tuple[tuple[Let | Loop, ...], sp.Symbol, sp.Symbol, sp.Expr]:
    """Return Newton's iteration for phi(l) = 0 from the Sampson correction.

    Returns the stages, the root, its last change and |n|. Where the root comes near the poles, the
    change is the root itself: not found.
    """
    l, change, newton, last, start = _symbols("l", "change", "newton", "last", "start")
    gradient = [sp.diff(bilinear(A1, A2), z) for z in (*A1, *A2)]
    names = {C0: bilinear(A1, A2)}
    for k in (0, 1):
        names |= {SUMS[k]: gradient[k] ** 2 + gradient[2 + k] ** 2}
        names |= {DIFFERENCES[k]: gradient[k] * gradient[2 + k]}
    begin = Let(rotate_match().values | names | {start: C0 / (sum(SUMS) + _TINY)})
    shared, over = over_denominators(l)
    D = DENOMINATORS[0] * DENOMINATORS[1]
    phi = C0 * D**2 - l * over(lambda h, r: phi_term(h, r) / 2, 2)
    loop = Loop(
        start={l: start, change: sp.Integer(0)},
        body=shared | {newton: phi * D / (over(slope_term, 3) + _TINY)},
        update={l: l + newton, change: newton},
        passes=passes,
    )
    near = select(_FAR_FROM_POLES - sp.Abs(l) * S.entries()[0], change, l)
    length = sp.sqrt(over(square_term, 2)) / D
    return (begin, loop, Let(shared | {last: near})), l, last, length


def foot_point_more(passes: int) -> tuple[tuple[Let | Loop, ...], sp.Symbol, sp.Symbol, sp.Expr]:
    """Return the same in a form that is exact up to the poles."""
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
    return (rotate_match(), begin, loop, inside, Let(reciprocals(l))), l, last, _length()


def foot_point_safe(passes: int) -> tuple[tuple[Let | Loop, ...], sp.Symbol, sp.Symbol, sp.Expr]:
    """Return the same with bracketed Newton iterations."""
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
    return (rotate_match(), begin, ends, loop, Let(reciprocals(l))), l, change, _length()


def _length() -> sp.Expr:
    return sp.sqrt(total(square_term))


def half_reciprocals() -> Names:
    """Name 1 / (2 + 2 l kappa) for the four kappa, at the multiplier that is given."""
    return reciprocals(MULTIPLIER.symbol(), sp.Rational(1, 2))


def stationary_point() -> tuple[list[sp.Expr], list[sp.Expr], list[sp.Expr]]:
    """Return the corrected rotated image points and the gradient of C there.

    As functions of l and of the `half_reciprocals`: the turn into the diagonal coordinates and the
    one back have a factor sqrt(1/2) each.
    """
    l = MULTIPLIER.symbol()
    turned = [sp.expand(sp.sqrt(2) * value) for value in gradient_at_measurement()]
    plus1, minus1, plus2, minus2 = (h * r for h, r in zip(turned, RECIPROCALS, strict=True))
    n = [plus1 + minus1, plus2 + minus2, plus1 - minus1, plus2 - minus2]
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
        ("foot_point_more", foot_point_more, MORE_PASSES, "Newton"),
        ("foot_point_safe", foot_point_safe, SAFE_PASSES, "bracketed Newton"),
    ):
        stages, l, change, length = found(passes)
        made.append(
            Kernel(
                name,
                f"multiplier l of the foot point by {passes} passes of {how} from "
                "the Sampson correction, its last change, and the signed distance d = l |n|.",
                (*FRAME, Q1, Q2),
                (
                    Output.of("multiplier", l),
                    Output.of("last_change", change),
                    Output.of("d", l * length),
                ),
                stages,
                staged=found is foot_point_fast,
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
                half_reciprocals()
                | dict(zip((*p1, *p2), (*q1, *q2), strict=True))
                | {length: sp.sqrt(sum(entry**2 for entry in n) + _TINY)}
            ),
        ),
    )


def second_order_parts() -> tuple[list[sp.Symbol], Names, list[sp.Symbol]]:
    """Return names of the corrected rotated match, their values, and the gradient's names."""
    x1, x2 = _symbols("p1_0", "p1_1"), _symbols("p2_0", "p2_1")
    n = _symbols("n0", "n1", "n2", "n3")
    *_, gradient = stationary_point()
    l = MULTIPLIER.symbol()
    values = half_reciprocals() | dict(zip(n, gradient, strict=True))
    z_hat = (z - l * entry for z, entry in zip((*A1, *A2), n, strict=True))
    values |= dict(zip((*x1, *x2), z_hat, strict=True))
    return [*x1, *x2], values, n


def exact_hessian(
    z: list[sp.Symbol], n: list[sp.Symbol], l: sp.Expr, weight: sp.Expr = sp.S.One
) -> tuple[Names, sp.Matrix, sp.Symbol]:
    """Return the exact Hessian of weight d^2/2 by vect(F) of the rotated images, and -phi'(l).

    The distance is the value of min |z - z_hat|^2 / 2 subject to C(z_hat, F) = 0 with multiplier
    l. Differentiating its optimality conditions by F gives H = l C_FF - R^T K^-1 R with
    K = [[M, n], [n^T, 0]], M = I + l C_zz, R = [l C_zF; C_F]. C is linear in F, so C_FF = 0, and
    K^-1 is written out by blocks; the diagonal coordinates give M^-1 by the `half_reciprocals`.
    The first value names what Hessian and slope are made of.
    """
    C_F = sp.Matrix(_point_derivative(z[:2], z[2:]))
    C_zF = jacobian(list(C_F), z).T
    turn = jacobian(diagonal_coordinates(z), z)
    M_inverse = turn.T * sp.diag(*(2 * r for r in RECIPROCALS)) * turn
    slope, outer = _symbols("slope", "outer")
    v = _symbols("v0", "v1", "v2", "v3")
    names = dict(zip(v, M_inverse * sp.Matrix(n), strict=True))
    names |= {slope: sum(a * b for a, b in zip(n, v, strict=True)), outer: weight / slope}
    w = C_F - l * C_zF.T * sp.Matrix(v)
    for k in range(8):  # the last entry of w is 1
        name = sp.Symbol(f"w{k}", real=True)
        names[name], w[k] = sp.collect(w[k], z[2:]), name
    weighted = sp.zeros(4, 4)
    for i, j in ((0, 0), (0, 2), (1, 1), (1, 3)):
        name = sp.Symbol(f"inverse{i}{j}", real=True)
        names[name] = weight * l**2 * M_inverse[i, j]
        weighted[i, j] = weighted[j, i] = weighted[(i + 2) % 4, (j + 2) % 4] = name
    return names, outer * w * w.T - C_zF.T * weighted * C_zF, slope


def _normal_equations() -> list[Kernel]:
    """Return what the solver adds up: gradient with Gauss-Newton matrix or exact Hessian.

    The cost of a match is rho(d^2) / 2: `weight` is rho' and `curvature` 2 rho'', which multiplies
    the square of d * dd/dF = l * C_F. Derivatives are by vect(F) of the rotated images.
    """
    z, values, n = second_order_parts()
    l = MULTIPLIER.symbol()
    weight, curvature = Input("weight"), Input("curvature")
    first, ratio, second = _symbols("first", "ratio", "second")
    values |= {first: weight.symbol() * l}
    values |= {ratio: weight.symbol() / (sum(e**2 for e in n) + _TINY)}
    C_F = sp.Matrix(_point_derivative(z[:2], z[2:]))
    # d * dd/dF = l |n| * C_F / |n|
    gradient = Output.of("g", first * C_F, summed=True)
    normal = Output.of("N", upper(ratio * C_F * C_F.T), summed=True)
    names, hessian, _ = exact_hessian(z, n, l, weight.symbol())
    names |= {second: curvature.symbol() * l**2}
    exact = hessian + second * C_F * C_F.T
    arguments = (*FRAME, Q1, Q2, MULTIPLIER, weight)
    foot = rotate_match().values | values
    return [
        Kernel(
            "reprojection_gauss_newton",
            "gradient and Gauss-Newton matrix (upper triangle) of sum weight d^2 / 2 by vect(F) "
            "of the rotated images.",
            arguments,
            (gradient, normal),
            (Let(foot),),
            staged=True,
        ),
        Kernel(
            "reprojection_newton",
            "gradient, Gauss-Newton matrix and exact Hessian (upper triangles) of a robust sum of "
            "d^2 / 2 by vect(F) of the rotated images, H = l C_FF - R^T K^-1 R for each match.",
            (*arguments, curvature),
            (gradient, normal, Output.of("H", upper(exact), summed=True)),
            (Let(foot | names),),
            staged=True,
        ),
    ]
