"""The tables of kernels and of camera models that the runtime reads."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from epigauge_derive.camera_model import CameraModel
from epigauge_derive.emitters._text import file_header, module, quoted
from epigauge_derive.gauge import gauge
from epigauge_derive.program import Program

_PROLOGUE = '''from dataclasses import dataclass
from typing import NamedTuple


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


@dataclass(frozen=True)
class Model:
    """A camera model.

    Kernels are named ``<prefix>_project``, ``_residual``, ``_observe``, ``_retract``, ``_image``,
    ``_camera_generators`` and ``_point_generators``; ``_correct`` where the model `corrects`
    measured points before they are compared. A camera is stored as its 3x4 matrix row by row, then
    `params`. Those of `constants` are given once: no entry of an update belongs to them.
    """

    name: str
    prefix: str
    title: str
    params: tuple[str, ...]
    units: tuple[str, ...]
    constants: tuple[str, ...]
    camera_size: int
    tangent_size: int
    point_size: int
    tangent_names: tuple[str, ...]
    tangent_units: tuple[str, ...]
    gauge_dimension: int
    gauge_names: tuple[str, ...]
    metric: bool
    homogeneous: bool
    corrects: bool


'''


def emit(programs: list[Program], models: Sequence[CameraModel] = ()) -> dict[str, str]:
    """Write signatures.py, the package around it and the provenance file."""
    rows = []
    for program in programs:
        kernel = program.kernel
        inputs = [(a.name, a.shape, not a.shared) for a in kernel.inputs]
        outputs = [(o.name, o.shape, not o.summed) for o in kernel.outputs]
        rows.append(
            f"    {quoted(kernel.name)}: Signature(\n"
            f"        {quoted(module(kernel.family))},\n"
            f"        ({''.join(map(_argument, inputs))}),\n"
            f"        ({''.join(map(_argument, outputs))}),\n"
            f"        {quoted(kernel.formula)},\n"
            "    ),\n"
        )
    text = file_header("", "# {}") + _PROLOGUE
    text += "SIGNATURES = {\n" + "".join(rows) + "}\n\n"
    text += "MODELS = {\n" + "".join(map(_model, models)) + "}\n"
    package = file_header("", "# {}")
    provenance = file_header("", "# {}") + f"sympy = {quoted(sp.__version__)}\n"
    return {
        "epigauge_generated/signatures.py": text,
        "epigauge_generated/__init__.py": package,
        "epigauge_generated/py.typed": "",
        "provenance.toml": provenance,
    }


def _argument(argument: tuple[str, tuple[int, ...], bool]) -> str:
    name, shape, batched = argument
    return f"Argument({quoted(name)}, {shape}, {batched}), "


def _model(model: CameraModel) -> str:
    """Return a row for each name of a camera model."""
    generators = [name for name, _ in gauge(model)]
    values = {
        "prefix": model.prefix,
        "title": model.title,
        "params": tuple(model.parameters),
        "units": tuple(model.parameters.values()),
        "constants": model.constants,
        "camera_size": model.camera_size,
        "tangent_size": model.tangent_size,
        "point_size": model.point_size,
        "tangent_names": tuple(model.unknowns),
        "tangent_units": tuple(model.unknowns.values()),
        "gauge_dimension": len(generators),
        "gauge_names": tuple(generators),
        "metric": bool(model.frame.relations),
        "homogeneous": model.frame.point_size == 4,
        "corrects": model.corrects,
    }
    text = ""
    for name in (model.name, *model.aliases):
        text += f"    {quoted(name)}: Model(\n        name={quoted(name)},\n"
        text += "".join(f"        {key}={value!r},\n" for key, value in values.items())
        text += "    ),\n"
    return text
