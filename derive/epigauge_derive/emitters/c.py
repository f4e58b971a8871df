"""C99 functions over a batch: observation-last arrays, one SIMD loop, no allocation, no state.

Entry k of observation i stands at ``a[k*n + i]``; a shared input and a summed output have no
batch axis. The library carries a digest of its own sources, so that the Python side notices a
library that was built from other formulas.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

import sympy as sp

from epigauge_derive.camera_model import CameraModel
from epigauge_derive.emitters._staged import Part, parts
from epigauge_derive.emitters._text import (
    families,
    file_header,
    kernel_header,
    module,
    mostly_zero,
    quoted,
    used_entries,
)
from epigauge_derive.kernel import Input, Kernel
from epigauge_derive.printer import Printer
from epigauge_derive.program import Assignments, Program, Repeat

_printer = Printer(
    {
        "sqrt": "sqrt",
        "sin": "sin",
        "cos": "cos",
        "atan2": "atan2",
        "abs": "fabs",
        "floor": "floor",
        "log1p": "log1p",
    },
    select="({condition} > 0.0 ? {then} : {other})",
)

# Loops up to this many statements are unrolled inside the SIMD loop; longer ones run one
# observation at a time.
_UNROLL = 200

# A staged kernel keeps intermediate results of a chunk of observations between its loops: so many
# doubles, that they stay in the nearest cache. It adds up so many sums in one of these loops, few
# enough for the registers.
_KEPT, _CHUNK, _SUMS = 4096, 256, 18

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

/* Digest of the generated sources: the same as DIGEST in epigauge_generated/c_backend. */
EG_EXPORT const char *eg_digest(void);

/* Digest of all sources that the library was built from, by CMakeLists.txt. */
EG_EXPORT const char *eg_sources(void);

"""


_DIGEST = """#include "epigauge_kernels.h"

#ifndef EG_SOURCES
#define EG_SOURCES ""
#endif

const char *eg_digest(void)
{{
    return "{digest}";
}}

const char *eg_sources(void)
{{
    return EG_SOURCES;
}}
"""

_TABLE = """/* A camera model: sizes of camera, update and point, and its kernels. */
typedef struct {
    const char *name;
    int camera_size, tangent_size, point_size;
    void (*residual)(
        ptrdiff_t n,
        const double *EG_RESTRICT camera,
        const double *EG_RESTRICT X,
        const double *EG_RESTRICT q,
        double *EG_RESTRICT r);
    void (*observe)(
        ptrdiff_t n,
        const double *EG_RESTRICT camera,
        const double *EG_RESTRICT X,
        const double *EG_RESTRICT q,
        double *EG_RESTRICT r,
        double *EG_RESTRICT J_camera,
        double *EG_RESTRICT J_point);
    void (*sight)(
        ptrdiff_t n,
        const double *EG_RESTRICT camera,
        const double *EG_RESTRICT X,
        const double *EG_RESTRICT q,
        double *EG_RESTRICT r,
        double *EG_RESTRICT J_point);
    void (*retract)(
        ptrdiff_t n,
        const double *EG_RESTRICT camera,
        const double *EG_RESTRICT delta,
        double *EG_RESTRICT moved);
} eg_camera_model;

/* All models; a row without name ends the table. */
EG_EXPORT extern const eg_camera_model eg_camera_models[];

"""


def emit(programs: list[Program], models: Sequence[CameraModel] = ()) -> dict[str, str]:
    """Write one source file a family, header, table of models, and the digest of them all."""
    files = {}
    for family, members in families(programs).items():
        text = file_header(family, "/* {} */")
        text += '#include "epigauge_kernels.h"\n\n#include <math.h>\n#include <string.h>\n'
        text += "".join(_function(program) for program in members)
        files[f"c/{module(family)}.c"] = text
    prototypes = "".join(f"{_prototype(program.kernel)};\n\n" for program in programs)
    header = file_header("", "/* {} */") + _HEADER + prototypes + _TABLE + "#endif\n"
    files["c/epigauge_kernels.h"] = header
    files["c/camera_models.c"] = _table(models)
    digest = _digest(files)
    files["c/digest.c"] = file_header("", "/* {} */") + _DIGEST.format(digest=digest)
    files["epigauge_generated/c_backend/__init__.py"] = (
        file_header("", "# {}") + f"DIGEST = {quoted(digest)}\n"
    )
    return files


def _table(models: Sequence[CameraModel]) -> str:
    """Return the table of camera models, over which compiled loops run."""
    rows = []
    for model in models:
        sizes = [model.camera_size, model.tangent_size, model.point_size]
        names = ("residual", "observe", "sight", "retract")
        functions = [f"eg_{model.prefix}_{name}" for name in names]
        entries = [quoted(model.prefix), *map(str, sizes), *functions]
        rows.append(f"    {{{', '.join(entries)}}},\n")
    return (
        file_header("", "/* {} */")
        + '#include "epigauge_kernels.h"\n\n#include <stddef.h>\n\n'
        + "const eg_camera_model eg_camera_models[] = {\n"
        + "".join(rows)
        + "    {NULL, 0, 0, 0, NULL, NULL, NULL, NULL},\n};\n"
    )


def _digest(files: dict[str, str]) -> str:
    """Return the digest of the C sources."""
    sources = "".join(files[name] for name in sorted(files))
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
    body = _staged_body(program) if program.kernel.staged else _body(program)
    return "\n".join([*_head(program), *body, "}"]) + "\n"


def _head(program: Program) -> list[str]:
    """Return comment, prototype and shared inputs."""
    kernel = program.kernel
    lines = ["", f"/* {kernel_header(program)[0]}"]
    lines += [f"   {line}" for line in kernel_header(program)[1:]]
    lines[-1] += " */"
    lines += [_prototype(kernel), "{"]
    for argument in kernel.inputs:
        if not used_entries(program, argument):
            lines.append(f"    (void){_pointer(argument)};")
        if argument.shared:
            for position, _, name in used_entries(program, argument):
                lines.append(f"    const double {name} = {_pointer(argument)}[{position}];")
    return lines


def _body(program: Program) -> list[str]:
    """Return one loop over the observations."""
    kernel = program.kernel
    lines = []
    sums = _sums(program)
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
    return lines


def _staged_body(program: Program) -> list[str]:
    """Return a loop over chunks of the observations, and in it one for each part."""
    cut = parts(program, _SUMS)
    kept = sorted({symbol.name for part in cut for symbol in part.keeps})
    chunk = min(_CHUNK, 2 ** int(math.log2(_KEPT / max(len(kept), 1))))
    lines, copies = [], []
    first: dict[sp.Expr, str] = {}
    for output, results in zip(program.kernel.outputs, program.results, strict=True):
        if not output.summed:
            continue
        lines.append(f"    memset({output.name}, 0, {len(results)} * sizeof(double));")
        for position, expression in enumerate(results):
            place = f"{output.name}[{position}]"
            if first.setdefault(expression, place) != place:
                copies.append(f"    {place} = {first[expression]};")
    lines.append(f"    for (ptrdiff_t begin = 0; begin < n; begin += {chunk}) {{")
    lines.append(f"        const ptrdiff_t end = n - begin < {chunk} ? n : begin + {chunk};")
    lines += [f"        double kept_{name}[{chunk}];" for name in kept]
    for part in cut:
        lines += [line if line.startswith("#") else f"    {line}" for line in _part(program, part)]
    return [*lines, "    }", *copies]


def _part(program: Program, part: Part) -> list[str]:
    """Return one loop of a staged kernel."""
    names = [f"sum_{output}{position}" for output, position, _ in part.sums]
    lines = ["    {", *(f"    double {name} = 0.0;" for name in names)] if names else []
    lines += [*_pragma(names).split("\n"), "    for (ptrdiff_t i = begin; i < end; ++i) {"]
    kept = {symbol.name for symbol in part.reads}
    for argument in program.kernel.inputs:
        loads = _loads(program, argument)
        for (*_, name), load in zip(used_entries(program, argument), loads, strict=True):
            lines += [load] if name in kept and not argument.shared else []
            kept.discard(name)
    # A state of a loop is assigned more than once: nothing here is const.
    lines += [f"        double {name} = kept_{name}[i - begin];" for name in sorted(kept)]
    for symbol, expression in part.assignments:
        kind = "" if symbol.name in kept else "double "
        lines.append(f"        {kind}{symbol.name} = {_printer(expression)};")
        kept.add(symbol.name)
    lines += [f"        kept_{symbol.name}[i - begin] = {symbol.name};" for symbol in part.keeps]
    for output, position, expression in part.values:
        lines.append(f"        {output}[{_place(position)}] = {_printer(expression)};")
    for name, (*_, expression) in zip(names, part.sums, strict=True):
        lines.append(f"        {name} += {_printer(expression)};")
    lines.append("    }")
    for name, (output, position, _) in zip(names, part.sums, strict=True):
        lines.append(f"    {output}[{position}] += {name};")
    return [*lines, "    }"] if names else lines


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
