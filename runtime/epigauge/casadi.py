"""The generated formulas as CasADi functions, to embed in optimal control and other programs.

>>> import epigauge as eg
>>> project = eg.casadi.functions()["project"]  # doctest: +SKIP
>>> project(P=P, Q=Q)["q_hat"]  # doctest: +SKIP
"""

from __future__ import annotations

import importlib
from typing import Any

from epigauge_generated.signatures import SIGNATURES

from epigauge import kernels
from epigauge.errors import BackendError

__all__ = ["functions"]


def functions() -> dict[str, Any]:
    """Return every kernel as a ``casadi.Function`` over SX with named inputs and outputs.

    Returns
    -------
    dict of str to casadi.Function
        One observation a call (use ``map`` for many). An array with more than two axes has its
        first axis as rows and the others, row by row, as columns; an output that the other
        backends sum up is the contribution of one observation.

    Raises
    ------
    BackendError
        If CasADi is not installed; the message says how to get it.

    Examples
    --------
    >>> F = eg.casadi.functions()  # doctest: +SKIP
    >>> F["sampson"]  # doctest: +SKIP
    """
    reason = kernels.available()["casadi"]
    if reason is not None:
        raise BackendError("casadi", reason, "pip install 'epigauge[casadi]'")
    modules = {
        family: importlib.import_module(f"epigauge_generated.casadi_backend.{family}")
        for family in sorted({signature.family for signature in SIGNATURES.values()})
    }
    return {
        name: getattr(modules[signature.family], name)() for name, signature in SIGNATURES.items()
    }
