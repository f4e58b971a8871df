"""LaTeX formulas of the same programs, one file a kernel, for documentation and papers.

Subscripts count from zero, as in the code.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from epigauge_derive.camera_model import CameraModel
from epigauge_derive.emitters._text import file_header, indices, kernel_header, mostly_zero
from epigauge_derive.program import Assignments, Program, Repeat


def emit(programs: list[Program], models: Sequence[CameraModel] = ()) -> dict[str, str]:
    """Write one ``align*`` a kernel."""
    return {f"latex/{program.kernel.name}.tex": _text(program) for program in programs}


def _text(program: Program) -> str:
    kernel = program.kernel
    lines = []
    for statement in program.statements:
        if isinstance(statement, Repeat):
            lines += _equations(statement.start)
            lines.append(rf"&\text{{repeat {statement.passes} times:}}")
            lines += _equations(statement.body)
            lines += _equations(statement.states, arrow=r"\leftarrow")
        else:
            lines += _equations(statement)
    for output, results in zip(kernel.outputs, program.results, strict=True):
        sparse = mostly_zero(output, results)
        if sparse:
            lines.append(rf"{_entry(output.name, (), output.summed)} 0 \text{{ but for}}")
        for index, expression in zip(indices(output.shape), results, strict=True):
            if sparse and expression.is_zero:
                continue
            lines.append(f"{_entry(output.name, index, output.summed)} {sp.latex(expression)}")
    body = " \\\\\n".join(lines)
    header = "".join(f"% {line}\n" for line in kernel_header(program))
    top = file_header(kernel.family, "% {}")
    return f"{top}{header}\\begin{{align*}}\n{body}\n\\end{{align*}}\n"


def _equations(assignments: Assignments, arrow: str = "=") -> list[str]:
    return [f"{sp.latex(symbol)} &{arrow} {sp.latex(value)}" for symbol, value in assignments]


def _entry(name: str, index: tuple[int, ...], summed: bool) -> str:
    # Counted from zero, as symbols of inputs are; a comma tells two-digit positions apart.
    separator = "," if any(position > 9 for position in index) else ""
    subscript = separator.join(map(str, index))
    text = rf"\mathtt{{{name.replace('_', chr(92) + '_')}}}"
    text += f"_{{{subscript}}}" if subscript else ""
    return text + (r" &= \sum" if summed else " &=")
