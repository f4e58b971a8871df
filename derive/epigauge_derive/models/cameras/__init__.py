"""The cameras: each module has `MODEL`, one camera model; its file is named like its kernels."""

from __future__ import annotations

from dataclasses import replace

from epigauge_derive.camera_model import camera_models
from epigauge_derive.kernel import Kernel


def kernels() -> list[Kernel]:
    """Return the kernels of all cameras."""
    return [
        replace(kernel, family=f"cameras/{model.prefix}")
        for model in camera_models()
        for kernel in model.kernels()
    ]
