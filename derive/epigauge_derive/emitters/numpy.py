"""NumPy functions: trailing batch axes, results written into the arrays that are given."""

from __future__ import annotations

from collections.abc import Sequence

from epigauge_derive.camera_model import CameraModel
from epigauge_derive.emitters._text import (
    argument_names,
    families,
    file_header,
    indices,
    kernel_header,
    module,
    mostly_zero,
    python_statement,
    used_entries,
)
from epigauge_derive.printer import Printer
from epigauge_derive.program import Program

_printer = Printer(
    {
        "sqrt": "np.sqrt",
        "sin": "np.sin",
        "cos": "np.cos",
        "atan2": "np.arctan2",
        "abs": "np.abs",
        "floor": "np.floor",
        "log1p": "np.log1p",
    },
    select="np.where({condition} > 0.0, {then}, {other})",
)


def emit(programs: list[Program], models: Sequence[CameraModel] = ()) -> dict[str, str]:
    """Write one module a family."""
    files = {"epigauge_generated/numpy_backend/__init__.py": file_header("", "# {}")}
    for family, members in families(programs).items():
        text = file_header(family, "# {}") + "import numpy as np\n"
        text += "".join(_function(program) for program in members)
        files[f"epigauge_generated/numpy_backend/{module(family)}.py"] = text
    return files


def _function(program: Program) -> str:
    kernel = program.kernel
    lines = ["", "", f"def {kernel.name}({', '.join(argument_names(kernel))}):"]
    lines += [f"    # {line}" for line in kernel_header(program)]
    for argument in kernel.inputs:
        if argument.shape:
            for _, index, name in used_entries(program, argument):
                lines.append(f"    {name} = {argument.name}[{', '.join(map(str, index))}]")
    for statement in program.statements:
        lines += python_statement(statement, _printer)
    for output, results in zip(kernel.outputs, program.results, strict=True):
        sparse = mostly_zero(output, results)
        if sparse:
            lines.append(f"    {output.name}[...] = 0.0")
        for index, expression in zip(indices(output.shape), results, strict=True):
            if sparse and expression.is_zero:
                continue
            place = ", ".join(map(str, index)) or "..."
            value = _printer(expression)
            if output.summed:
                value = f"np.add.reduce({value}, axis=-1)"
            lines.append(f"    {output.name}[{place}] = {value}")
    return "\n".join(lines) + "\n"
