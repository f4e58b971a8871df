"""From the expressions of a kernel to straight-line code: common subexpressions, lowered powers.

All emitters print the same program, so that languages differ in spelling only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import sympy as sp

from epigauge_derive.kernel import Kernel, Let, Loop

Assignments = tuple[tuple[sp.Symbol, sp.Expr], ...]


@dataclass(frozen=True)
class Repeat:
    """A loop of fixed length: initial states, then the body `passes` times."""

    start: Assignments
    body: Assignments
    states: Assignments
    passes: int


@dataclass(frozen=True)
class Program:
    """Statements of a kernel in order, then one expression an output entry."""

    kernel: Kernel
    statements: tuple[Assignments | Repeat, ...]
    results: tuple[tuple[sp.Expr, ...], ...]

    def operations(self) -> int:
        """Count arithmetic operations for one observation."""
        count = sum(map(_operations, (e for entries in self.results for e in entries)))
        for statement in self.statements:
            if isinstance(statement, Repeat):
                count += sum(_operations(e) for _, e in statement.start)
                inner = [*statement.body, *statement.states]
                count += statement.passes * sum(_operations(e) for _, e in inner)
            else:
                count += sum(_operations(e) for _, e in statement)
        return count

    def temporaries(self) -> int:
        """Count the named intermediate results."""
        return sum(
            len(s.start) + len(s.body) if isinstance(s, Repeat) else len(s) for s in self.statements
        )

    def symbols_used(self) -> set[sp.Symbol]:
        """Return every symbol that some expression reads."""
        expressions = [e for entries in self.results for e in entries]
        expressions += [e for statement in self.statements for _, e in _blocks(statement)]
        return set().union(*(expression.free_symbols for expression in expressions))


def compile_kernel(kernel: Kernel) -> Program:
    """Turn a kernel into a program and check that every symbol it reads is defined."""
    names = _temporary_names()
    statements: list[Assignments | Repeat] = []
    pending: dict[sp.Symbol, sp.Expr] = {}
    summed = any(output.summed for output in kernel.outputs)
    for stage in kernel.stages:
        if isinstance(stage, Let):
            pending |= stage.values
            # Results that are not summed belong to the last stage.
            if kernel.staged and (summed or stage is not kernel.stages[-1]):
                statements.append(_straight(pending, [], names)[0])
                pending = {}
            continue
        block, start = _straight(pending, list(stage.start.values()), names)
        pending = {}
        statements += [block] if block else []
        statements.append(_repeat(stage, start, names))
    flat = [entry for output in kernel.outputs for entry in output.entries]
    block, reduced = _straight(pending, flat, names)
    # The results of a staged kernel are a stage of their own, also where it names nothing.
    statements += [block] if block or kernel.staged else []
    results, position = [], 0
    for output in kernel.outputs:
        results.append(tuple(reduced[position : position + len(output.entries)]))
        position += len(output.entries)
    program = Program(kernel, tuple(statements), tuple(results))
    _check_names(program)
    return program


def _temporary_names() -> Iterator[sp.Symbol]:
    index = 0
    while True:
        yield sp.Symbol(f"t{index}", real=True)
        index += 1


def _straight(
    named: Mapping[sp.Symbol, sp.Expr], wanted: list[sp.Expr], names: Iterator[sp.Symbol]
) -> tuple[Assignments, list[sp.Expr]]:
    """Share subexpressions among named and wanted values; order every name before its use."""
    replacements, reduced = sp.cse([*named.values(), *wanted], symbols=names, order="canonical")
    definitions = dict(replacements)
    definitions |= dict(zip(named, reduced[: len(named)], strict=True))
    definitions, results = _name_bases(definitions, reduced[len(named) :], names)
    ordered: dict[sp.Symbol, sp.Expr] = {}

    def place(expression: sp.Expr) -> None:
        for symbol in sorted(expression.free_symbols & set(definitions), key=str):
            if symbol not in ordered:
                place(definitions[symbol])
                ordered[symbol] = definitions[symbol]

    for expression in results:
        place(expression)
    for symbol in named:
        place(symbol)
    return tuple(ordered.items()), results


def _name_bases(
    definitions: dict[sp.Symbol, sp.Expr], results: list[sp.Expr], names: Iterator[sp.Symbol]
) -> tuple[dict[sp.Symbol, sp.Expr], list[sp.Expr]]:
    """Give a name to every base of an integer power, which prints as a product."""
    bases: dict[sp.Expr, sp.Symbol] = {}

    def lower(expression: sp.Expr) -> sp.Expr:
        if not expression.args:
            return expression
        arguments = [lower(argument) for argument in expression.args]
        if expression.is_Pow and not arguments[0].is_Atom and abs(arguments[1]) > 1:
            if arguments[0] not in bases:
                bases[arguments[0]] = next(names)
            arguments[0] = bases[arguments[0]]
        return expression.func(*arguments)

    lowered = {symbol: lower(expression) for symbol, expression in definitions.items()}
    results = [lower(expression) for expression in results]
    return lowered | {symbol: base for base, symbol in bases.items()}, results


def _repeat(loop: Loop, start: list[sp.Expr], names: Iterator[sp.Symbol]) -> Repeat:
    body, updates = _straight(loop.body, list(loop.update.values()), names)
    # All states change at once: a new value that reads a state gets a name first.
    states, late = [], []
    for state, value in zip(loop.update, updates, strict=True):
        if not value.is_Symbol or value in loop.update:
            late.append((next(names), value))
            value = late[-1][0]
        states.append((state, value))
    return Repeat(
        start=tuple(zip(loop.start, start, strict=True)),
        body=(*body, *late),
        states=tuple(states),
        passes=loop.passes,
    )


def _check_names(program: Program) -> None:
    kernel = program.kernel
    entries = [entry for argument in kernel.inputs for entry in argument.entries()]
    computed = {symbol for statement in program.statements for symbol, _ in _blocks(statement)}
    # Names that C gives to arrays, to the number of observations and to the loop over them.
    taken = {argument.name for argument in kernel.inputs if argument.shape} | {"n", "i"}
    for name in [*(entry.name for entry in entries), *sorted(symbol.name for symbol in computed)]:
        if name in taken:
            raise ValueError(f"kernel {kernel.name}: two symbols are named {name}, or it is taken")
        taken.add(name)
    known = {*entries, *computed}
    names = {symbol.name for symbol in known}
    for output in kernel.outputs:
        if output.name in names:
            raise ValueError(f"kernel {kernel.name}: output {output.name} is also a symbol")
    for symbol in sorted(program.symbols_used() - known, key=str):
        raise ValueError(f"kernel {kernel.name}: symbol {symbol} is neither input nor computed")


def _blocks(statement: Assignments | Repeat) -> Assignments:
    if isinstance(statement, Repeat):
        return (*statement.start, *statement.body, *statement.states)
    return statement


def _operations(expression: sp.Expr) -> int:
    return int(sp.count_ops(expression))
