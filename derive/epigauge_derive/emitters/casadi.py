"""CasADi Functions over SX with named inputs and outputs, one observation a call, cached.

CasADi knows vectors and matrices only: an output with more axes has its first axis as rows and
all others, row by row, as columns. A summed output is the contribution of one observation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from epigauge_derive.camera_model import CameraModel
from epigauge_derive.emitters._text import (
    families,
    file_header,
    kernel_header,
    module,
    python_statement,
    quoted,
    used_entries,
)
from epigauge_derive.printer import Printer
from epigauge_derive.program import Program

_printer = Printer(
    {
        "sqrt": "ca.sqrt",
        "sin": "ca.sin",
        "cos": "ca.cos",
        "atan2": "ca.atan2",
        "abs": "ca.fabs",
        "floor": "ca.floor",
        "log1p": "ca.log1p",
    },
    select="ca.if_else({condition} > 0.0, {then}, {other})",
)


def emit(programs: list[Program], models: Sequence[CameraModel] = ()) -> dict[str, str]:
    """Write one module a family."""
    files = {"epigauge_generated/casadi_backend/__init__.py": file_header("", "# {}")}
    for family, members in families(programs).items():
        text = file_header(family, "# {}") + "from functools import cache\n\nimport casadi as ca\n"
        text += "".join(_function(program) for program in members)
        files[f"epigauge_generated/casadi_backend/{module(family)}.py"] = text
    return files


def matrix_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return rows and columns of an array of any number of axes."""
    return (shape[0], math.prod(shape[1:])) if shape else (1, 1)


def _function(program: Program) -> str:
    kernel = program.kernel
    lines = ["", "", "@cache", f"def {kernel.name}():"]
    lines += [f"    # {line}" for line in kernel_header(program)]
    for argument in kernel.inputs:
        rows, columns = matrix_shape(argument.shape)
        lines.append(f'    {argument.name} = ca.SX.sym("{argument.name}", {rows}, {columns})')
        if argument.shape:
            for position, _, name in used_entries(program, argument):
                place = f"{position // columns}, {position % columns}"
                lines.append(f"    {name} = {argument.name}[{place}]")
    for statement in program.statements:
        lines += python_statement(statement, _printer)
    for output, results in zip(kernel.outputs, program.results, strict=True):
        rows, columns = matrix_shape(output.shape)
        lines.append(f"    {output.name} = ca.SX({rows}, {columns})")
        for position, expression in enumerate(results):
            if expression.is_zero:  # structurally zero in a new SX
                continue
            place = f"{position // columns}, {position % columns}"
            lines.append(f"    {output.name}[{place}] = {_printer(expression)}")
    inputs = [argument.name for argument in kernel.inputs]
    outputs = [output.name for output in kernel.outputs]
    lines.append("    return ca.Function(")
    lines.append(f'        "{kernel.name}",')
    for names in (inputs, outputs):
        lines.append(f"        [{', '.join(names)}],")
    for names in (inputs, outputs):
        lines.append(f"        [{', '.join(map(quoted, names))}],")
    return "\n".join([*lines, "    )"]) + "\n"
