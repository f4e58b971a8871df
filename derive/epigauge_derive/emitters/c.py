"""C99 functions over a batch: observation-last arrays, one SIMD loop, no allocation, no state.

Entry k of observation i stands at ``a[k*n + i]``; a shared input and a summed output have no
batch axis. The library carries a digest of its own sources, so that the Python side notices a
library that was built from other formulas.
"""

from __future__ import annotations

import hashlib

import sympy as sp

from epigauge_derive.emitters._text import (
    families,
    file_header,
    kernel_header,
    mostly_zero,
    used_entries,
)
from epigauge_derive.kernel import Input, Kernel
from epigauge_derive.printer import Printer
from epigauge_derive.program import Assignments, Program, Repeat

_printer = Printer(
    {"sqrt": "sqrt", "sin": "sin", "cos": "cos", "atan2": "atan2", "abs": "fabs", "log1p": "log1p"},
    select="({condition} > 0.0 ? {then} : {other})",
)

# Loops up to this many statements are unrolled inside the SIMD loop; longer ones run one
# observation at a time.
_UNROLL = 200

_HEADER = """#ifndef EPIGAUGE_KERNELS_H
#define EPIGAUGE_KERNELS_H

#include <stddef.h>

#if defined(_WIN32)
#define EG_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EG_EXPORT __attribute__((visibility("default")))
#else
#define EG_EXPORT
#endif

#if defined(_MSC_VER)
#define EG_RESTRICT __restrict
#define EG_SIMD
#else
#define EG_RESTRICT restrict
#define EG_SIMD _Pragma("omp simd")
#endif

/* Digest of the sources: the same as C_DIGEST in epigauge_generated/signatures.py. */
EG_EXPORT const char *eg_digest(void);

"""


def emit(programs: list[Program]) -> dict[str, str]:
    """Write one source file a family, their common header, and the digest of them all."""
    files = {}
    for family, members in families(programs).items():
        text = file_header(family, "/* {} */")
        text += '#include "epigauge_kernels.h"\n\n#include <math.h>\n#include <string.h>\n'
        text += "".join(_function(program) for program in members)
        files[f"c/{family}.c"] = text
    prototypes = "".join(f"{_prototype(program.kernel)};\n\n" for program in programs)
    header = file_header("", "/* {} */") + _HEADER + prototypes + "#endif\n"
    files["c/epigauge_kernels.h"] = header
    files["c/digest.c"] = (
        file_header("", "/* {} */")
        + '#include "epigauge_kernels.h"\n\n'
        + f'const char *eg_digest(void)\n{{\n    return "{digest(files)}";\n}}\n'
    )
    return files


def digest(files: dict[str, str]) -> str:
    """Return the digest of the C sources, without the file that holds it."""
    sources = "".join(files[name] for name in sorted(files) if name != "c/digest.c")
    return hashlib.sha256(sources.encode()).hexdigest()[:16]


def _prototype(kernel: Kernel) -> str:
    arguments = ["ptrdiff_t n"]
    arguments += [f"const double *EG_RESTRICT {_pointer(argument)}" for argument in kernel.inputs]
    arguments += [f"double *EG_RESTRICT {output.name}" for output in kernel.outputs]
    return f"EG_EXPORT void eg_{kernel.name}(\n    " + ",\n    ".join(arguments) + ")"


def _pointer(argument: Input) -> str:
    """Name the array of an input; a scalar's own name is its value."""
    return argument.name if argument.shape else f"{argument.name}_array"


def _function(program: Program) -> str:
    kernel = program.kernel
    lines = ["", f"/* {kernel_header(program)[0]}"]
    lines += [f"   {line}" for line in kernel_header(program)[1:]]
    lines[-1] += " */"
    lines += [_prototype(kernel), "{"]
    sums = _sums(program)
    for argument in kernel.inputs:
        if not used_entries(program, argument):
            lines.append(f"    (void){_pointer(argument)};")
        if argument.shared:
            for position, _, name in used_entries(program, argument):
                lines.append(f"    const double {name} = {_pointer(argument)}[{position}];")
    for name in sums.values():
        lines.append(f"    double {name} = 0.0;")
    for output, results in zip(kernel.outputs, program.results, strict=True):
        if mostly_zero(output, results):
            fill = f"memset({output.name}, 0, {len(results)} * (size_t)n * sizeof(double));"
            lines.append(f"    {fill}")
    unrolled = all(
        statement.passes * len(statement.body) <= _UNROLL
        for statement in program.statements
        if isinstance(statement, Repeat)
    )
    if unrolled:
        lines.append(_pragma(list(sums.values())))
    lines.append("    for (ptrdiff_t i = 0; i < n; ++i) {")
    for argument in kernel.inputs:
        if not argument.shared:
            lines += _loads(program, argument)
    for statement in program.statements:
        lines += _statement(statement, unrolled)
    for output, results in zip(kernel.outputs, program.results, strict=True):
        sparse = mostly_zero(output, results)
        for position, expression in enumerate(results):
            if sparse and expression.is_zero:
                continue
            if not output.summed:
                value = _printer(expression)
                lines.append(f"        {output.name}[{_place(position)}] = {value};")
    for expression, name in sums.items():
        lines.append(f"        {name} += {_printer(expression)};")
    lines.append("    }")
    for output, results in zip(kernel.outputs, program.results, strict=True):
        if output.summed:
            for position, expression in enumerate(results):
                lines.append(f"    {output.name}[{position}] = {sums[expression]};")
    return "\n".join([*lines, "}"]) + "\n"


def _sums(program: Program) -> dict[sp.Expr, str]:
    """Name the accumulator of each summed expression; equal entries share one."""
    names: dict[sp.Expr, str] = {}
    for output, results in zip(program.kernel.outputs, program.results, strict=True):
        if output.summed:
            for position, expression in enumerate(results):
                names.setdefault(expression, f"sum_{output.name}{position}")
    return names


def _pragma(sums: list[str]) -> str:
    if not sums:
        return "    EG_SIMD"
    clause = f"omp simd reduction(+ : {', '.join(sums)})"
    return f"#ifndef _MSC_VER\n#pragma {clause}\n#endif"


def _place(position: int) -> str:
    return {0: "i", 1: "n + i"}.get(position, f"{position}*n + i")


def _loads(program: Program, argument: Input) -> list[str]:
    return [
        f"        const double {name} = {_pointer(argument)}[{_place(position)}];"
        for position, _, name in used_entries(program, argument)
    ]


def _statement(statement: Assignments | Repeat, unrolled: bool) -> list[str]:
    indent = " " * 8
    if not isinstance(statement, Repeat):
        return [f"{indent}const double {s.name} = {_printer(e)};" for s, e in statement]
    lines = [f"{indent}double {s.name} = {_printer(e)};" for s, e in statement.start]
    block = [f"{indent}    const double {s.name} = {_printer(e)};" for s, e in statement.body]
    block += [f"{indent}    {s.name} = {_printer(e)};" for s, e in statement.states]
    if unrolled:
        return lines + [f"{indent}{{", *block, f"{indent}}}"] * statement.passes
    head = f"{indent}for (int pass = 0; pass < {statement.passes}; ++pass) {{"
    return [*lines, head, *block, f"{indent}}}"]
