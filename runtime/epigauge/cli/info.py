"""``epigauge info``: what is installed and what is used."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.markup import escape

import epigauge as eg
from epigauge import _library
from epigauge.cli._common import DONE, Json, console, facts, write_json

#: Module and the distributions that may bring it.
_PACKAGES = {
    "numpy": ("numpy",),
    "casadi": ("casadi",),
    "cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python"),
    "matplotlib": ("matplotlib",),
    "rich": ("rich",),
    "sympy": ("sympy",),
    "typer": ("typer",),
}


def info(json: Json = False) -> int:
    """Show versions, backends and processor."""
    known: dict[str, Any] = {
        "epigauge": eg.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "backend": eg.backend(),
        "backends": eg.kernels.available(),
        "c_variant": _library.variant() if eg.kernels.available()["c"] is None else None,
        "c_variants": list(_library.usable()) if eg.kernels.available()["c"] is None else [],
        "packages": {module: version(module) for module in _PACKAGES},
    }
    if json:
        write_json(known)
        return DONE
    rows = {
        name: str(known[name]) for name in ("epigauge", "python", "platform", "processor", "cores")
    }
    for name, reason in known["backends"].items():
        active = ", active" if name == known["backend"] else ""
        rows[f"backend {name}"] = f"available{active}" if reason is None else reason
    if known["c_variant"] is not None:
        others = ", ".join(name for name in known["c_variants"] if name != known["c_variant"])
        rows["c compiled for"] = known["c_variant"] + (f" (also there: {others})" if others else "")
    rows |= {name: version or "not installed" for name, version in known["packages"].items()}
    console().print(facts("", {name: escape(value) for name, value in rows.items()}))
    return DONE


def version(module: str) -> str | None:
    """Return the version of an installed package without importing it."""
    for distribution in _PACKAGES[module]:
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
    return "unknown" if find_spec(module) is not None else None


def processor() -> str:
    """Return the name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
