"""Two views with points as unknowns (B&S Table 1): the normal equations with the points eliminated.

With h = P Q, the image point q_hat(h) and a = d q_hat / d h (2x3), the Jacobian of the residual
q - q_hat by a camera is -a x Q^T: whatever a point adds to the equations of the cameras is a sum of
products L x (Q Q^T) and e x Q, L and e with three rows a moving camera. The kernels give L and e
("left") and the products of Q ("right"), so that the sums need no Jacobian in memory.

Two problems: the canonic one, P = (I | 0) fixed and points (a, b, 1, c); and the free one, all
entries of both cameras and of homogeneous points. Where the points are bound to a normalised basis,
by constraints on their steps with multipliers Z (4x4) and couplings Z Q, then Z moves along with
the cameras: four rows more of L and e.
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp

from epigauge_derive.kernel import Input, Kernel, Let, Output, at, jacobian, select, upper

MEASURED, WEIGHT = Input("q", (4,)), Input("weight")
#: lam W is plain + relative max(V_ii, floor); bind (Q Q^T) is a part of V.
DAMPING = Input("damping", (4,), shared=True)
_DAMPED = (
    "damping = (plain, relative, floor, bind): V has bind Q Q^T added, then plain + relative "
    "max(V_ii, floor) on its diagonal."
)

Values = dict[sp.Symbol, sp.Expr]


def kernels() -> list[Kernel]:
    """Return what a match adds to either problem, and the step of its point."""
    S, P2 = Input("S", (3,)), Input("P2", (3, 4), shared=True)
    a, b, c = S.entries()
    fixed = sp.eye(3).row_join(sp.zeros(3, 1))
    canonic = _Problem("canonic", P2, S, sp.Matrix([a, b, 1, c]), (fixed, P2.matrix()), (1,))
    Q, both = Input("Q", (4,)), Input("cameras", (6, 4), shared=True)
    views = (both.matrix()[:3, :], both.matrix()[3:, :])
    free = _Problem("free", both, Q, Q.matrix(), views, (0, 1))
    return [
        *canonic.kernels(),
        *free.kernels(),
        free.reduced("normalized_reduced", bound=True),
        _products("factor_products", "the products of its points' coordinates", 10),
        _products("factor_points", "its points", 4),
    ]


def _products(name: str, what: str, size: int) -> Kernel:
    factor, right = Input("factor"), Input("right", (size,))
    sums = [factor.symbol() * entry for entry in right.entries()]
    return Kernel(
        name,
        f"an entry of the factors L or e times {what}.",
        (factor, right),
        (Output.of("sums", sums, summed=True),),
    )


class _Problem:
    """Two views of a point: which cameras move, and what is unknown of the point."""

    def __init__(
        self,
        name: str,
        cameras: Input,
        unknowns: Input,
        Q: sp.Matrix,
        views: tuple[sp.Matrix, sp.Matrix],
        moving: tuple[int, ...],
    ) -> None:
        self.name, self.moving = name, moving
        self.cameras, self.unknowns, self.Q = cameras, unknowns, Q
        image: Values = {}
        derivatives: Values = {}
        points = [_image_point(P * Q, k, image) for k, P in enumerate(views)]
        self.a = [_derivative(*point) for point in points]
        by_unknowns = Q.jacobian(unknowns.entries())
        J = -sp.Matrix.vstack(*(a * P * by_unknowns for a, P in zip(self.a, views, strict=True)))
        self.J = _named("J", J, derivatives)
        self.r = MEASURED.matrix() - sp.Matrix([entry for u, v, _ in points for entry in (u, v)])
        self.image, self.derivatives = Let(image), Let(derivatives)
        self.right = Output.of("right", [*upper(Q * Q.T), *Q])

    def kernels(self) -> list[Kernel]:
        """Return the kernels of each pass over the matches."""
        weight, r, J = WEIGHT.symbol(), self.r, self.J
        known = (self.cameras, self.unknowns, MEASURED)
        stages = (self.image, self.derivatives)
        own = [entry for matrix in self._own() for entry in upper(matrix)]
        move = Input("move", (10 if len(self.moving) == 2 else 3, 4), shared=True)
        step = Input("step", self.unknowns.shape)
        change = J * step.matrix() + self._moved(move)
        return [
            Kernel(
                f"{self.name}_squared",
                "squared distance of both images of a point to their measurements.",
                known,
                (Output.of("squared", (r.T * r)[0]),),
                (self.image,),
            ),
            Kernel(
                f"{self.name}_normal",
                "gradient and diagonal of V, by the point, and the factors of U = L x Q Q^T (upper "
                "triangle of L for each moving camera) and of its gradient e x Q: left = (L, e), "
                "right = (upper triangle of Q Q^T, Q).",
                (*known, WEIGHT),
                (
                    Output.of("gradient", weight * J.T * r),
                    Output.of("diagonal", [(weight * J.T * J)[i, i] for i in range(J.cols)]),
                    Output.of("left", [*own, *sp.Matrix.vstack(*self._own_gradient())]),
                    self.right,
                ),
                stages,
            ),
            self.reduced(f"{self.name}_reduced"),
            self._step(move),
            Kernel(
                f"{self.name}_change",
                "w |J step|^2 for a step of the cameras (move) and of the point.",
                (self.cameras, self.unknowns, WEIGHT, move, step),
                (Output.of("squared_change", weight * (change.T * change)[0], summed=True),),
                stages,
            ),
        ]

    def reduced(self, name: str, *, bound: bool = False) -> Kernel:
        """Return the factors of the reduced normal equations and of their right-hand side."""
        own, gradient = self._own(), self._own_gradient()
        coupling = [-WEIGHT.symbol() * self._of(k, self.J).T * self.a[k] for k in self.moving]
        if bound:
            own, gradient = [*own, sp.zeros(4, 4)], [*gradient, sp.zeros(4, 1)]
            coupling.append(sp.eye(4))
        values, V = self._damped()
        sides = sp.Matrix.hstack(*coupling, WEIGHT.symbol() * self.J.T * self.r)
        half = V.forward("Y", sides, values)
        scaled = _named("scaledY", V.scaled(half), values)
        eliminated = half[:, :-1].T * scaled
        return Kernel(
            name,
            "factors of the Schur complement U - W V^-1 W^T = L x Q Q^T and of the gradient "
            "g - W V^-1 g_point = e x Q: left = (upper triangle of L, e), right = (upper triangle "
            f"of Q Q^T, Q); {_DAMPED}" + " The last four rows are those of Z." * bound,
            (self.cameras, self.unknowns, MEASURED, WEIGHT, DAMPING),
            (
                Output.of(
                    "left",
                    [
                        *upper(sp.diag(*own) - eliminated[:, :-1]),
                        *(sp.Matrix.vstack(*gradient) - eliminated[:, -1]),
                    ],
                ),
                self.right,
            ),
            (self.image, self.derivatives, Let(values)),
        )

    def _step(self, move: Input) -> Kernel:
        values, V = self._damped()
        side = WEIGHT.symbol() * self.J.T * (self.r + self._moved(move))
        if len(self.moving) == 2:
            side += move.matrix()[6:, :] * self.Q
        half = V.forward("y", side, values)
        step = V.backward("x", V.scaled(half), values)
        return Kernel(
            f"{self.name}_step",
            "step -V^-1 (g_point + W^T move) of a point for a step of the cameras, and Z Q beside "
            f"W^T move for the last four rows where there are ten; {_DAMPED}",
            (self.cameras, self.unknowns, MEASURED, WEIGHT, DAMPING, move),
            (Output.of("step", -step),),
            (self.image, self.derivatives, Let(values)),
        )

    def _own(self) -> list[sp.Matrix]:
        """Return the factor of each moving camera's own block."""
        return [WEIGHT.symbol() * self.a[k].T * self.a[k] for k in self.moving]

    def _own_gradient(self) -> list[sp.Matrix]:
        return [-WEIGHT.symbol() * self.a[k].T * self._of(k, self.r) for k in self.moving]

    @staticmethod
    def _of(k: int, rows: sp.Matrix) -> sp.Matrix:
        """Return the rows of image k."""
        return rows[2 * k : 2 * k + 2, :]

    def _moved(self, move: Input) -> sp.Matrix:
        """Return the change of the residual with a step of the cameras."""
        change = sp.zeros(4, 1)
        for row, k in enumerate(self.moving):
            camera = move.matrix()[3 * row : 3 * row + 3, :]
            change[2 * k : 2 * k + 2, 0] = -self.a[k] * (camera * self.Q)
        return change

    def _damped(self) -> tuple[Values, _Factors]:
        """Return the factors of the damped V, and what defines them."""
        plain, relative, floor, bind = DAMPING.entries()
        values: Values = {}
        V = WEIGHT.symbol() * self.J.T * self.J
        if len(self.moving) == 2:
            V += bind * self.Q * self.Q.T
        for i in range(V.rows):
            entry = sp.Symbol(f"V{i}{i}", real=True)
            values[entry] = V[i, i]
            V[i, i] = entry + plain + relative * select(entry - floor, entry, floor)
        return values, _Factors.of(V, values)


@dataclass(frozen=True)
class _Factors:
    """V = L D L^T: unit lower L, and the reciprocals of D.

    Without square roots a pivot that rounding has made negative does no harm: it is that of a
    homogeneous point's own scale, where there is nothing to solve for.
    """

    L: sp.Matrix
    reciprocals: tuple[sp.Symbol, ...]

    @staticmethod
    def of(V: sp.Matrix, values: Values) -> _Factors:
        """Factorise; the entries are defined by name."""
        L, pivots, reciprocals = sp.eye(V.rows), [], []
        for j in range(V.rows):
            pivot, reciprocal = (sp.Symbol(f"{name}{j}", real=True) for name in ("D", "inverseD"))
            values[pivot] = V[j, j] - sum(L[j, k] ** 2 * pivots[k] for k in range(j))
            values[reciprocal] = 1 / pivot
            pivots.append(pivot)
            reciprocals.append(reciprocal)
            for i in range(j + 1, V.rows):
                rest = V[i, j] - sum(L[i, k] * L[j, k] * pivots[k] for k in range(j))
                L[i, j] = sp.Symbol(f"L{i}{j}", real=True)
                values[L[i, j]] = rest * reciprocal
        return _Factors(L, tuple(reciprocals))

    def forward(self, name: str, B: sp.Matrix, values: Values) -> sp.Matrix:
        """Return L^-1 B, its entries defined by name."""
        X = sp.zeros(*B.shape)
        for i in range(B.rows):
            X[i, :] = _named(f"{name}{i}", B[i, :] - self.L[i, :i] * X[:i, :], values)
        return X

    def scaled(self, B: sp.Matrix) -> sp.Matrix:
        """Return D^-1 B."""
        return sp.diag(*self.reciprocals) * B

    def backward(self, name: str, B: sp.Matrix, values: Values) -> sp.Matrix:
        """Return L^-T B, its entries defined by name."""
        X = sp.zeros(*B.shape)
        for i in reversed(range(B.rows)):
            X[i, :] = _named(f"{name}{i}", B[i, :] - self.L[i + 1 :, i].T * X[i + 1 :, :], values)
        return X


def _image_point(h: sp.Matrix, k: int, values: Values) -> tuple[sp.Expr, sp.Expr, sp.Expr]:
    """Return the image point of h and 1 / h2, defined by name where there is a division."""
    if h[2] == 1:
        return h[0], h[1], sp.Integer(1)
    u, v, nearness = (sp.Symbol(f"{name}_{k}", real=True) for name in ("u", "v", "nearness"))
    values |= {nearness: 1 / h[2], u: h[0] * nearness, v: h[1] * nearness}
    return u, v, nearness


def _derivative(u: sp.Expr, v: sp.Expr, nearness: sp.Expr) -> sp.Matrix:
    """Return the derivative of the image point by h, by the image point and 1 / h2."""
    h = sp.Matrix(sp.symbols("h0:3", real=True))
    general = jacobian([h[0] / h[2], h[1] / h[2]], list(h))
    return at(general, {h[0]: u / nearness, h[1]: v / nearness, h[2]: 1 / nearness})


def _named(name: str, matrix: sp.Matrix, values: Values) -> sp.Matrix:
    """Define the entries of a matrix by name, but for numbers, and return it made of the names."""
    result = matrix.copy()
    for i in range(matrix.rows):
        for j in range(matrix.cols):
            if not matrix[i, j].is_Number:
                result[i, j] = sp.Symbol(f"{name}_{i}{j}", real=True)
                values[result[i, j]] = matrix[i, j]
    return result
