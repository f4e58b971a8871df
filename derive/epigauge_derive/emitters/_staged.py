"""The loops of a staged kernel, and what one hands to the next (live variables)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import sympy as sp

from epigauge_derive.program import Assignments, Program, Repeat

#: An output's name, the flat position of an entry, and its expression.
Entry = tuple[str, int, sp.Expr]


@dataclass(frozen=True)
class Part:
    """One loop over the observations.

    Attributes
    ----------
    assignments : Assignments
        Statements in order.
    values, sums : tuple of Entry
        Entries of outputs that are written, and those that are added up.
    reads : frozenset of Symbol
        What it takes from inputs and from earlier parts.
    keeps : tuple of Symbol
        What later parts take from it.
    """

    assignments: Assignments
    values: tuple[Entry, ...] = ()
    sums: tuple[Entry, ...] = ()
    reads: frozenset[sp.Symbol] = frozenset()
    keeps: tuple[sp.Symbol, ...] = ()


def parts(program: Program, most_sums: int) -> list[Part]:
    """Cut a staged kernel at its stages, and its sums into groups.

    Equal sums are added up once, under the first of their places.
    """
    *stages, last = _stages(program)
    values, sums = _results(program)
    cut = [Part(tuple(stage)) for stage in stages]
    if values:
        cut.append(Part(tuple(last), values=tuple(values)))
    for begin in range(0, len(sums), most_sums):
        cut.append(Part(tuple(last), sums=tuple(sums[begin : begin + most_sums])))
    done: list[Part] = []
    live: frozenset[sp.Symbol] = frozenset()
    for part in reversed(cut):
        done.append(_trimmed(part, live))
        live = (live - {symbol for symbol, _ in part.assignments}) | done[-1].reads
    return done[::-1]


def _trimmed(part: Part, live: frozenset[sp.Symbol]) -> Part:
    """Return a part with the statements only that its results or live symbols depend on."""
    keeps = live & {symbol for symbol, _ in part.assignments}
    wanted = set(keeps).union(*(e.free_symbols for *_, e in (*part.values, *part.sums)))
    needed = []
    for symbol, expression in reversed(part.assignments):
        if symbol in wanted:
            wanted = (wanted - {symbol}) | expression.free_symbols
            needed.append((symbol, expression))
    return replace(
        part,
        assignments=tuple(reversed(needed)),
        reads=frozenset(wanted),
        keeps=tuple(sorted(keeps, key=str)),
    )


def _stages(program: Program) -> list[list[tuple[sp.Symbol, sp.Expr]]]:
    """Return the statements of each stage; those of the results are the last."""
    stages: list[list[tuple[sp.Symbol, sp.Expr]]] = []
    for statement in program.statements:
        if isinstance(statement, Repeat):
            stages[-1] += statement.start
            stages += [[*statement.body, *statement.states] for _ in range(statement.passes)]
        else:
            stages.append(list(statement))
    return stages


def _results(program: Program) -> tuple[list[Entry], list[Entry]]:
    """Return the entries of the outputs, and the different ones of those that are summed."""
    values, sums = [], {}
    for output, results in zip(program.kernel.outputs, program.results, strict=True):
        for position, expression in enumerate(results):
            entry = (output.name, position, expression)
            if output.summed:
                sums.setdefault(expression, entry)
            else:
                values.append(entry)
    return values, list(sums.values())
