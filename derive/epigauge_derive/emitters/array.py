"""Functions for any array namespace of the array API standard: nothing is written in place.

They serve what NumPy's in-place functions cannot: arrays on other devices, traced and
differentiated ones. Each takes the namespace first and returns, for each output, the list of its
entries; an input that the others share may have batch axes here, which broadcast.
"""

from __future__ import annotations

from collections.abc import Sequence

from epigauge_derive.camera_model import CameraModel
from epigauge_derive.emitters._text import (
    families,
    file_header,
    kernel_header,
    module,
    python_statement,
    used_entries,
)
from epigauge_derive.printer import Printer
from epigauge_derive.program import Program

_printer = Printer(
    {
        "sqrt": "xp.sqrt",
        "sin": "xp.sin",
        "cos": "xp.cos",
        "atan2": "xp.atan2",
        "abs": "xp.abs",
        "floor": "xp.floor",
        "log1p": "xp.log1p",
    },
    select="xp.where({condition} > 0.0, {then}, {other})",
)


def emit(programs: list[Program], models: Sequence[CameraModel] = ()) -> dict[str, str]:
    """Write one module a family."""
    files = {"epigauge_generated/array_backend/__init__.py": file_header("", "# {}")}
    for family, members in families(programs).items():
        text = file_header(family, "# {}") + "".join(_function(program) for program in members)
        files[f"epigauge_generated/array_backend/{module(family)}.py"] = text
    return files


def _function(program: Program) -> str:
    kernel = program.kernel
    names = ", ".join(["xp", *(argument.name for argument in kernel.inputs)])
    lines = ["", "", f"def {kernel.name}({names}):"]
    lines += [f"    # {line}" for line in kernel_header(program)]
    for argument in kernel.inputs:
        if argument.shape:
            for _, index, name in used_entries(program, argument):
                lines.append(f"    {name} = {argument.name}[{', '.join(map(str, index))}, ...]")
    for statement in program.statements:
        lines += python_statement(statement, _printer)
    lines.append("    return (")
    for output, results in zip(kernel.outputs, program.results, strict=True):
        lines.append("        [")
        for expression in results:
            value = _printer(expression)
            if output.summed:
                value = f"xp.sum({value}, axis=-1)"
            lines.append(f"            {value},")
        lines.append("        ],")
    return "\n".join([*lines, "    )"]) + "\n"
