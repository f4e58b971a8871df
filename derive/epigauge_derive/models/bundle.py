"""Many views: what one observation adds to the normal equations, and one point's own 4x4 algebra.

With h = P Q, the image point q_hat(h) and a = d q_hat / d h (2x3), the Jacobians are J_P = a x Q^T
and J_Q = a P: every camera block is a sum of (3x3) x (Q Q^T), every coupling is (3x4) x Q. The
kernels give the small factors, the accumulation multiplies them out (math: Kronecker structure of
the projective Schur complement).
"""

from __future__ import annotations

import sympy as sp

from epigauge_derive.kernel import (
    Input,
    Kernel,
    Let,
    Loop,
    Output,
    at,
    jacobian,
    select,
    upper,
)

P, Q, MEASURED, WEIGHT = Input("P", (3, 4)), Input("Q", (4,)), Input("q", (2,)), Input("weight")
T = Input("T", (4, 4))

#: Squarings of an inverse 4x4 matrix, and what is added to its diagonal, relative to the trace.
_SQUARINGS, _SHIFT = 8, 1e-13

N, W, G, LAM = Input("N", (10,)), Input("W", (10,)), Input("g", (4,)), Input("lam")
N3 = Input("N", (6,))


def kernels() -> list[Kernel]:
    """Return the factors of one observation's normal equations, and the 4x4 systems of points."""
    return [*_observation(), *_point()]


def _observation() -> list[Kernel]:
    h = sp.Matrix(sp.symbols("h0:3", real=True))
    u, v, nearness = sp.symbols("u v nearness", real=True)
    a = jacobian([h[0] / h[2], h[1] / h[2]], list(h))
    # The derivative of log |depth| by h.
    log_depth = sp.Matrix([[sp.diff(h[2], entry) / h[2] for entry in h]])
    # By the image point (u, v) and 1 / h2, so that there is one division.
    depths = {h[0]: u / nearness, h[1]: v / nearness, h[2]: 1 / nearness}
    a, log_depth = at(a, depths), at(log_depth, depths)
    image = Let(
        dict(zip(h, P.matrix() * Q.matrix(), strict=True))
        | {nearness: 1 / h[2], u: h[0] * nearness, v: h[1] * nearness}
    )
    weight = WEIGHT.symbol()
    r = MEASURED.matrix() - sp.Matrix([u, v])
    squared = Output.of("squared", (r.T * r)[0])
    J_Q, Z_Q = a * P.matrix(), log_depth * P.matrix()
    return [
        Kernel(
            "squared_distance",
            "squared distance |q - q_hat|^2 of a projected point to its measurement.",
            (P, Q, MEASURED),
            (squared,),
            (image,),
        ),
        Kernel(
            "point_normal",
            "what an observation adds to its point's normal equations: w J_Q^T J_Q and "
            "w Z_Q^T Z_Q (upper triangles; Z = d log depth), -w J_Q^T (q - q_hat), and "
            "|q - q_hat|^2.",
            (P, Q, MEASURED, WEIGHT),
            (
                Output.of("N", upper(weight * J_Q.T * J_Q)),
                Output.of("D", upper(weight * Z_Q.T * Z_Q)),
                Output.of("g", -weight * J_Q.T * r),
                squared,
            ),
            (image,),
        ),
        Kernel(
            "camera_normal",
            "the factors of what an observation adds to its camera's normal equations: "
            "J_P^T J_P = A x Q Q^T (A: upper triangle of 3x3, with weight), "
            "Z_P^T Z_P = depth Q Q^T for the last row of P and zero for the others, "
            "-w J_P^T (q - q_hat) = e x Q.",
            (P, Q, MEASURED, WEIGHT),
            (
                Output.of("A", upper(weight * a.T * a)),
                Output.of("depth", weight * log_depth[2] ** 2),
                Output.of("e", -weight * a.T * r),
            ),
            (image,),
        ),
        Kernel(
            "sight_normal",
            "what a line of sight adds to its point's homogeneous equations: sum of w n n^T over "
            "the two unit normals n ~ q_k p3 - p_k (upper triangle).",
            (P, MEASURED, WEIGHT),
            (Output.of("N", upper(weight * _planes())),),
        ),
        Kernel(
            "coupling",
            "the factor of camera and point coupled by an observation, w J_P^T J_Q T = Y x Q with "
            "Y = w a^T a P T, T a change of the point's parameters.",
            (P, Q, WEIGHT, T),
            (Output.of("Y", weight * a.T * (a * P.matrix() * T.matrix())),),
            (image,),
        ),
    ]


def _planes() -> sp.Matrix:
    """Return the sum of n n^T / n^T n over the two planes of a line of sight."""
    total = sp.zeros(4, 4)
    for k, coordinate in enumerate(MEASURED.entries()):
        plane = (coordinate * P.matrix()[2, :] - P.matrix()[k, :]).T
        total += plane * plane.T / (plane.T * plane)[0]
    return total


def _least_eigenvector() -> Kernel:
    """Return the unit eigenvector of N to its least eigenvalue.

    N^-1 is squared until only one eigenvalue is left: the columns are then multiples of the vector,
    of which the longest is taken. A shift of rounding size keeps a singular N invertible.
    """
    N_matrix = _symmetric(N.entries())
    values: dict[sp.Symbol, sp.Expr] = {}
    trace = sp.Symbol("trace", real=True)
    values[trace] = N_matrix.trace()
    shifted = N_matrix / trace + sp.Float(_SHIFT) * sp.eye(4)
    across = _cholesky("L", shifted, values)
    inverse = across.T * across
    power = _symmetric([sp.Symbol(f"power{k}", real=True) for k in range(10)])
    size = sp.Symbol("size", real=True)
    scaled = power / size
    squares = Loop(
        start=dict(zip(upper(power), upper(inverse), strict=True)),
        body={size: power.trace()},
        update=dict(zip(upper(power), upper(scaled * scaled), strict=True)),
        passes=_SQUARINGS,
    )
    column = [power[i, 0] for i in range(4)]
    longest = power[0, 0]
    for k in range(1, 4):
        longer = power[k, k] - longest
        column = [select(longer, power[i, k], column[i]) for i in range(4)]
        longest = select(longer, power[k, k], longest)
    names = sp.symbols("x0:4", real=True)
    length = sp.sqrt(sum(name**2 for name in names))
    return Kernel(
        "least_eigenvector",
        "unit eigenvector of N (upper triangle) to its least eigenvalue, by squaring N^-1 "
        f"{_SQUARINGS} times.",
        (N,),
        (Output.of("X", [name / length for name in names]),),
        (Let(values), squares, Let(dict(zip(names, column, strict=True)))),
    )


def _symmetric(entries: list[sp.Symbol]) -> sp.Matrix:
    """Unpack an upper triangle of three or four rows."""
    index: dict[tuple[int, int], int] = {}
    size = 3 if len(entries) == 6 else 4
    for i in range(size):
        for j in range(i, size):
            index[i, j] = index[j, i] = len(set(index.values()))
    return sp.Matrix(size, size, lambda i, j: entries[index[i, j]])


def _cholesky(name: str, matrix: sp.Matrix, values: dict[sp.Symbol, sp.Expr]) -> sp.Matrix:
    """Define the factor L, A = L L^T, and return L^-1; both by symbols, entry by entry."""
    size = matrix.rows
    L, inverse = sp.zeros(size, size), sp.zeros(size, size)
    reciprocal = []
    for j in range(size):
        for i in range(j, size):
            rest = matrix[i, j] - sum(L[i, k] * L[j, k] for k in range(j))
            symbol = sp.Symbol(f"{name}{i}{j}", real=True)
            values[symbol] = sp.sqrt(rest) if i == j else rest * reciprocal[j]
            L[i, j] = symbol
            if i == j:
                reciprocal.append(sp.Symbol(f"{name}_inverse{i}{i}", real=True))
                values[reciprocal[j]] = 1 / symbol
    for j in range(size):
        inverse[j, j] = reciprocal[j]
        for i in range(j + 1, size):
            symbol = sp.Symbol(f"{name}_inverse{i}{j}", real=True)
            values[symbol] = -reciprocal[i] * sum(L[i, k] * inverse[k, j] for k in range(j, i))
            inverse[i, j] = symbol
    return inverse


def _point() -> list[Kernel]:
    N_matrix, W_matrix = (_symmetric(argument.entries()) for argument in (N, W))
    lam, g = LAM.symbol(), G.matrix()
    plain: dict[sp.Symbol, sp.Expr] = {}
    root = _cholesky("L", N_matrix, plain).T

    # Whitened first: where W = 1 the condition is about 1 / lam whatever the basis.
    values: dict[sp.Symbol, sp.Expr] = {}
    across = _cholesky("L", W_matrix, values)
    product = across * N_matrix * across.T
    white = sp.zeros(4, 4)
    for i in range(4):
        for j in range(i, 4):
            symbol = sp.Symbol(f"white{i}{j}", real=True)
            values[symbol] = product[i, j]
            white[i, j] = white[j, i] = symbol
    damped_root = across.T * _cholesky("M", white + lam * sp.eye(4), values).T

    own: dict[sp.Symbol, sp.Expr] = {}
    inverse = _cholesky("L", N_matrix + lam * (N_matrix + W_matrix), own)
    half = sp.Matrix(sp.symbols("y0:4", real=True))
    own |= dict(zip(half, inverse * g, strict=True))
    return [
        _least_eigenvector(),
        Kernel(
            "inverse_root",
            "upper triangular T with T T^T = N^-1, from the upper triangle of N.",
            (N,),
            (Output.of("T", root),),
            (Let(plain),),
        ),
        Kernel(
            "damped_inverse_root",
            "upper triangular T with T T^T = (N + lam W)^-1, found where W = 1; upper triangles.",
            (N, W, Input("lam", (), shared=True)),
            (Output.of("T", damped_root),),
            (Let(values),),
        ),
        Kernel(
            "point_step",
            "a point's own damped step -(N + lam (N + W))^-1 g and the decrease of the cost that "
            "it promises at most, g^T (N + lam (N + W))^-1 g; upper triangles.",
            (N, W, G, LAM),
            (
                Output.of("step", -inverse.T * half),
                Output.of("promised", (half.T * half)[0]),
            ),
            (Let(own),),
        ),
        _euclidean(),
    ]


def _euclidean() -> Kernel:
    """Return the same root for points of three coordinates."""
    plain: dict[sp.Symbol, sp.Expr] = {}
    root = _cholesky("L", _symmetric(N3.entries()), plain).T
    return Kernel(
        "inverse_root3",
        "upper triangular T with T T^T = N^-1 for a 3x3 matrix, from its upper triangle.",
        (N3,),
        (Output.of("T", root),),
        (Let(plain),),
    )
