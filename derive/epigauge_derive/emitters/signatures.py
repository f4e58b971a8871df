"""The table of kernels that the runtime reads: arguments, shapes, digest of the C sources."""

from __future__ import annotations

import sympy as sp

from epigauge_derive.emitters import c
from epigauge_derive.emitters._text import file_header
from epigauge_derive.program import Program

_PROLOGUE = '''from typing import NamedTuple


class Argument(NamedTuple):
    """An array of a kernel, without its batch axis."""

    name: str
    shape: tuple[int, ...]
    batched: bool


class Signature(NamedTuple):
    """A kernel: its module in each backend, inputs and outputs in call order."""

    family: str
    inputs: tuple[Argument, ...]
    outputs: tuple[Argument, ...]
    formula: str


'''


def emit(programs: list[Program]) -> dict[str, str]:
    """Write signatures.py, the package around it and the provenance file."""
    rows = []
    for program in programs:
        kernel = program.kernel
        inputs = [(a.name, a.shape, not a.shared) for a in kernel.inputs]
        outputs = [(o.name, o.shape, not o.summed) for o in kernel.outputs]
        rows.append(
            f"    {_quoted(kernel.name)}: Signature(\n"
            f"        {_quoted(kernel.family)},\n"
            f"        ({''.join(map(_argument, inputs))}),\n"
            f"        ({''.join(map(_argument, outputs))}),\n"
            f"        {_quoted(kernel.formula)},\n"
            "    ),\n"
        )
    text = file_header("", "# {}") + _PROLOGUE
    text += f"C_DIGEST = {_quoted(c.digest(c.emit(programs)))}\n\n"
    text += "SIGNATURES = {\n" + "".join(rows) + "}\n"
    package = file_header("", "# {}")
    provenance = file_header("", "# {}") + f"sympy = {_quoted(sp.__version__)}\n"
    return {
        "epigauge_generated/signatures.py": text,
        "epigauge_generated/__init__.py": package,
        "epigauge_generated/c_backend/__init__.py": package,
        "epigauge_generated/py.typed": "",
        "provenance.toml": provenance,
    }


def _quoted(text: str) -> str:
    return f'"{text}"'


def _argument(argument: tuple[str, tuple[int, ...], bool]) -> str:
    name, shape, batched = argument
    return f"Argument({_quoted(name)}, {shape}, {batched}), "
