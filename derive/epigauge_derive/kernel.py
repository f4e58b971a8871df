"""What a model hands to the emitters: named functions with named inputs and outputs.

A kernel describes the work for *one* observation (or one estimate). The emitters add the batch
axis, which is always the last one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import sympy as sp

Shape = tuple[int, ...]


class select(sp.Function):
    """``select(c, a, b)`` is a where c > 0 and b elsewhere; the only branch a kernel may have.

    An undefined SymPy function rather than a Piecewise, whose printing depends on the version.
    """

    nargs = 3

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return the derivative of the side that is taken."""
        sides = {1: (0, 0), 2: (1, 0), 3: (0, 1)}[argindex]
        return select(self.args[0], *map(sp.Integer, sides)) if argindex > 1 else sp.S.Zero


class floor(sp.Function):
    """The largest whole number that is not above x; a step, of which no derivative is taken."""

    nargs = 1


class log1p(sp.Function):
    """log(1 + x), exact for small x."""

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return 1 / (1 + x)."""
        return 1 / (1 + self.args[0])


@dataclass(frozen=True)
class Input:
    """An array argument. A shared one has the same value for all observations of a call.

    Its entries may have names of their own, row by row.
    """

    name: str
    shape: Shape = ()
    shared: bool = False
    names: tuple[str, ...] = ()

    def entries(self) -> list[sp.Symbol]:
        """Return one real symbol an entry, row by row.

        Without own names: ``F00 F01 ...``, ``delta_0 delta_1 ... delta_11``, and ``sigma`` of a
        scalar.
        """
        if self.names:
            if len(self.names) != math.prod(self.shape):
                raise ValueError(f"input {self.name}: {len(self.names)} names for {self.shape}")
            return [sp.Symbol(name, real=True) for name in self.names]
        long = any(extent > 10 for extent in self.shape)
        first = "_" if self.shape and (long or self.name[-1].isdigit()) else ""
        return [
            sp.Symbol(self.name + first + ("_" * long).join(map(str, index)), real=True)
            for index in itertools.product(*map(range, self.shape))
        ]

    def matrix(self) -> sp.Matrix:
        """Return the entries as a matrix; a vector becomes a column."""
        rows = self.shape[0]
        return sp.Matrix(rows, self.shape[1] if len(self.shape) > 1 else 1, self.entries())

    def symbol(self) -> sp.Symbol:
        """Return the symbol of a scalar input."""
        (entry,) = self.entries()
        return entry


@dataclass(frozen=True)
class Output:
    """An array result, its entries row by row. A summed one is added up over the observations."""

    name: str
    shape: Shape
    entries: tuple[sp.Expr, ...]
    summed: bool = False

    @staticmethod
    def of(name: str, value: object, *, summed: bool = False, shape: Shape | None = None) -> Output:
        """Make an output of a scalar, a matrix (a column is a vector) or nested sequences."""
        if isinstance(value, sp.MatrixBase):
            own: Shape = value.shape if value.cols > 1 else (value.rows,)
            entries = tuple(value)
        elif isinstance(value, sp.NDimArray):
            own, entries = tuple(value.shape), tuple(sp.flatten(value.tolist()))
        elif isinstance(value, Sequence):
            array = sp.Array(value)
            own, entries = tuple(array.shape), tuple(sp.flatten(array.tolist()))
        else:
            own, entries = (), (sp.sympify(value),)
        return Output(name, shape or own, entries, summed)


@dataclass(frozen=True)
class Let:
    """A stage that names intermediate results."""

    values: Mapping[sp.Symbol, sp.Expr]


@dataclass(frozen=True)
class Loop:
    """A stage that updates its state a fixed number of times, all states at once.

    `body` names intermediate results of one pass in order; `update` may use them.
    """

    start: Mapping[sp.Symbol, sp.Expr]
    body: Mapping[sp.Symbol, sp.Expr]
    update: Mapping[sp.Symbol, sp.Expr]
    passes: int


@dataclass(frozen=True)
class Kernel:
    """A function to generate.

    Attributes
    ----------
    name : str
        Name of the generated function.
    formula : str
        One sentence with the source equation; it becomes header and docstring.
    inputs, outputs : tuple
        Arguments in call order.
    stages : tuple of Let or Loop
        What is computed before the outputs, in order.
    staged : bool
        Whether C computes stage after stage for a chunk of observations, in loops short enough for
        the registers, rather than all stages in one loop. A pass of a `Loop` is a stage, too.
    family : str
        Model file the kernel comes from, below `models/` and without ending; filled in by the
        registry.
    """

    name: str
    formula: str
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    stages: tuple[Let | Loop, ...] = ()
    staged: bool = False
    family: str = field(default="", compare=False)


def jacobian(values: Sequence[sp.Expr], variables: Sequence[sp.Symbol]) -> sp.Matrix:
    """Differentiate a list of expressions by a list of symbols."""
    return sp.Matrix([[sp.diff(value, variable) for variable in variables] for value in values])


def derivatives_at(
    values: Sequence[sp.Expr], variables: Sequence[sp.Symbol], point: Mapping[sp.Symbol, sp.Expr]
) -> tuple[sp.Matrix, sp.Array]:
    """Return first derivatives (values, variables) and second ones (values, variables, variables).

    Both evaluated at a point.
    """
    size = len(variables)
    first = [[sp.diff(value, variable) for variable in variables] for value in values]
    second = [[[sp.S.Zero] * size for _ in variables] for _ in values]
    for k, row in enumerate(first):
        for i, derivative in enumerate(row):
            for j in range(i, size):
                second[k][i][j] = at(sp.diff(derivative, variables[j]), point)
                second[k][j][i] = second[k][i][j]
    return at(sp.Matrix(first), point), sp.Array(second)


def cross(w: Sequence[sp.Expr]) -> sp.Matrix:
    """Return [w]_x, the matrix of the cross product with w."""
    return sp.Matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def upper(matrix: sp.Matrix) -> list[sp.Expr]:
    """Pack a symmetric matrix: its upper triangle, row by row."""
    return [matrix[i, j] for i in range(matrix.rows) for j in range(i, matrix.cols)]


def at(expression: sp.Expr, point: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    """Evaluate an expression or a matrix at a point, all symbols replaced at once."""
    return expression.xreplace({symbol: sp.sympify(value) for symbol, value in point.items()})


def kernels() -> Iterator[Kernel]:
    """Yield the kernels of all models, family by family, in the order the models list them."""
    import importlib
    import pkgutil
    from dataclasses import replace

    from epigauge_derive import models

    seen: set[str] = set()
    for family in sorted(module.name for module in pkgutil.iter_modules(models.__path__)):
        for kernel in importlib.import_module(f"epigauge_derive.models.{family}").kernels():
            if kernel.name in seen:
                raise ValueError(f"two kernels are named {kernel.name}")
            seen.add(kernel.name)
            yield replace(kernel, family=kernel.family or family)
