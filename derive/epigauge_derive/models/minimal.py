"""Seven matches: the fundamental matrices that they satisfy exactly, in closed form.

In affine coordinates of both images in which the first three matches are (0, 0), (1, 0), (0, 1),
three of the seven equations are solved by inspection, and four are left for six entries of F.
"""

from __future__ import annotations

import itertools

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Loop, Output, select

Q1, Q2 = Input("sample1", (2, 7)), Input("sample2", (2, 7))

#: Columns of the four equations: those of the entries that are solved for, and of the two free
#: ones. The latter vanish together only where the first match lies on the epipole.
_SOLVED, _FREE = ((0, 1), (1, 0), (0, 2), (1, 2)), ((2, 0), (2, 1))

#: Newton steps to the root of largest size, from a bound at most twice as far.
_STEPS = 9


def kernels() -> list[Kernel]:
    """Return the seven-point algorithm with the oriented epipolar constraint."""
    stages: list[Let | Loop] = []
    u1, back1 = _affine(Q1, "1", stages)
    u2, back2 = _affine(Q2, "2", stages)
    pencil = _pencil(u1, u2, stages)
    roots, discriminant = _roots(pencil, stages)
    solutions, votes = [], []
    for k, root in enumerate(roots):
        F = sp.Matrix(3, 3, sp.symbols(f"f{k}_:9", real=True))
        value = pencil[0] + root * pencil[1]
        stages.append(Let(dict(zip(F, value, strict=True))))
        votes.append(_votes(F, k, u1, u2, stages))
        solutions.append((back2.T * F * back1).tolist())
    return [
        Kernel(
            "seven_points",
            "F of seven matches (R. Hartley, A. Zisserman, Multiple View Geometry, 2003, 11.1.2): "
            "the roots of det(F1 + a F2) = 0, the first always real, the others where the "
            "discriminant is positive. Votes are 7 or -7 where all matches have one sign of "
            "(e' x q') . (F q), the oriented epipolar constraint.",
            (Q1, Q2),
            (
                Output.of("F", solutions),
                Output.of("votes", votes),
                Output.of("discriminant", discriminant),
            ),
            tuple(stages),
            staged=True,
        )
    ]


def _affine(q: Input, tag: str, stages: list[Let | Loop]) -> tuple[list[sp.Matrix], sp.Matrix]:
    """Return the seven points in the coordinates of the first three, and the map to them."""
    x, y = q.entries()[:7], q.entries()[7:]
    a, b, c, d = (x[1] - x[0], x[2] - x[0], y[1] - y[0], y[2] - y[0])
    names = sp.symbols(f"a{tag} b{tag} c{tag} d{tag} area{tag}", real=True)
    stages.append(Let(dict(zip(names, (a, b, c, d, a * d - b * c), strict=True))))
    a, b, c, d, area = names
    inverse = sp.Matrix(2, 2, sp.symbols(f"i{tag}_:4", real=True))
    value = sp.Matrix([[d, -b], [-c, a]]) / area
    stages.append(Let(dict(zip(inverse, value, strict=True))))
    points = [sp.Matrix([0, 0, 1]), sp.Matrix([1, 0, 1]), sp.Matrix([0, 1, 1])]
    moved = {}
    for k in range(3, 7):
        own = sp.Matrix(sp.symbols(f"u{tag}_{k} v{tag}_{k}", real=True))
        moved |= dict(zip(own, inverse * sp.Matrix([x[k] - x[0], y[k] - y[0]]), strict=True))
        points.append(sp.Matrix([*own, 1]))
    stages.append(Let(moved))
    shift = -inverse * sp.Matrix([x[0], y[0]])
    return points, sp.Matrix([[*inverse[0, :], shift[0]], [*inverse[1, :], shift[1]], [0, 0, 1]])


def _pencil(
    u1: list[sp.Matrix], u2: list[sp.Matrix], stages: list[Let | Loop]
) -> tuple[sp.Matrix, sp.Matrix]:
    """Return F1 and F2, all combinations of which satisfy the seven equations."""
    entries = sp.Matrix(3, 3, sp.symbols("g:9", real=True))
    # q'^T F q = 0 of the first three matches.
    known = {
        entries[2, 2]: 0,
        entries[0, 0]: -entries[0, 2] - entries[2, 0],
        entries[1, 1]: -entries[1, 2] - entries[2, 1],
    }
    F = entries.xreplace(known)
    unknowns = [entries[index] for index in (*_SOLVED, *_FREE)]
    rows = [
        [sp.diff((second.T * F * first)[0], unknown) for unknown in unknowns]
        for first, second in zip(u1[3:], u2[3:], strict=True)
    ]
    names = sp.Matrix(4, 6, sp.symbols("m:24", real=True))
    stages.append(Let(dict(zip(names, sp.Matrix(rows), strict=True))))
    # Determinants of four columns by Laplace's expansion over two rows.
    minors: dict[sp.Symbol, sp.Expr] = {}
    upper, lower = {}, {}
    for i, j in itertools.combinations(range(6), 2):
        for half, top in ((upper, 0), (lower, 2)):
            symbol = sp.Symbol(f"minor{top}_{i}{j}", real=True)
            minors[symbol] = names[top, i] * names[top + 1, j] - names[top, j] * names[top + 1, i]
            half[i, j] = symbol
    stages.append(Let(minors))

    def determinant(columns: list[int]) -> sp.Expr:
        total = sp.S.Zero
        for i, j in itertools.combinations(range(4), 2):
            k, m = (n for n in range(4) if n not in (i, j))
            total += (
                (-1) ** (i + j + 1)
                * _signed(upper, columns[i], columns[j])
                * _signed(lower, columns[k], columns[m])
            )
        return total

    determinants: dict[sp.Symbol, sp.Expr] = {}
    whole = sp.Symbol("whole", real=True)
    determinants[whole] = determinant([0, 1, 2, 3])
    members = []
    for free in (4, 5):
        solution = dict.fromkeys(unknowns, sp.S.Zero)
        solution[unknowns[free]] = whole
        for k in range(4):  # Cramer's rule
            symbol = sp.Symbol(f"cramer{free}_{k}", real=True)
            columns = [free if n == k else n for n in range(4)]
            determinants[symbol] = -determinant(columns)
            solution[unknowns[k]] = symbol
        members.append(F.xreplace(solution))
    stages.append(Let(determinants))
    return members[0], members[1]


def _signed(half: dict[tuple[int, int], sp.Symbol], i: int, j: int) -> sp.Expr:
    return half[i, j] if i < j else -half[j, i]


def _roots(
    pencil: tuple[sp.Matrix, sp.Matrix], stages: list[Let | Loop]
) -> tuple[list[sp.Expr], sp.Expr]:
    """Return three roots of det(F1 + a F2), and what is positive where all are real."""
    a = sp.Symbol("a", real=True)
    cubic = sp.Poly(sp.expand((pencil[0] + a * pencil[1]).det(method="berkowitz")), a)
    c0, c1, c2, c3 = coefficients = sp.symbols("c0 c1 c2 c3", real=True)
    stages.append(Let(dict(zip(coefficients, reversed(cubic.all_coeffs()), strict=True))))
    # With a = t - middle: t^3 - 3 D t + g = 0.
    middle, D, g, p, q = sp.symbols("middle D g p q", real=True)
    stages.append(Let({middle: c2 / (3 * c3), p: c1 / c3, q: c0 / c3}))
    stages.append(Let({D: middle**2 - p / 3, g: 2 * middle**3 - middle * p + q}))
    # The root of largest size is within 2 sqrt(D) + |g|^(1/3), on the other side of g. The power
    # is that of 85 / 256, a product of nested square roots, and a little more.
    size, t, side, bound = sp.symbols("size t side bound", real=True)
    halved = [size, *sp.symbols("halved:8", real=True)]
    stages.append(Let({size: sp.Abs(g), side: select(g, sp.Integer(-1), sp.Integer(1))}))
    for before, after in itertools.pairwise(halved):
        stages.append(Let({after: sp.sqrt(before)}))
    third = sp.Float(1.05) * sp.prod(halved[2::2])
    stages.append(Let({bound: third + 2 * sp.sqrt(select(D, D, sp.Integer(0)))}))
    step = (t**3 - 3 * D * t + g) / (3 * t**2 - 3 * D)
    stages.append(Loop({t: side * bound}, {}, {t: t - step}, _STEPS))
    left, rest = sp.symbols("left rest", real=True)
    stages.append(Let({rest: 12 * D - 3 * t**2}))
    stages.append(Let({left: sp.sqrt(select(rest, rest, sp.Integer(0)))}))
    return [t - middle, (left - t) / 2 - middle, -(left + t) / 2 - middle], rest


def _votes(
    F: sp.Matrix, k: int, u1: list[sp.Matrix], u2: list[sp.Matrix], stages: list[Let | Loop]
) -> sp.Expr:
    """Return the sum of the signs of (e' x q') . (F q)."""
    # The epipole is across two columns; of two pairs of columns the longer product is taken.
    first, second = F[:, 0].cross(F[:, 1]), F[:, 1].cross(F[:, 2])
    one, two = (sp.Matrix(sp.symbols(f"e{k}{n}_:3", real=True)) for n in "ab")
    stages.append(Let(dict(zip((*one, *two), (*first, *second), strict=True))))
    longer = one.dot(one) - two.dot(two)
    e2 = sp.Matrix(sp.symbols(f"e{k}_:3", real=True))
    chosen = [select(longer, a, b) for a, b in zip(one, two, strict=True)]
    stages.append(Let(dict(zip(e2, chosen, strict=True))))
    return sum(
        select(e2.cross(second).dot(F * first), sp.Integer(1), sp.Integer(-1))
        for first, second in zip(u1, u2, strict=True)
    )
