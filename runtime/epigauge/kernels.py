"""The generated functions, one table a backend, allocated outputs and any batch shape.

``table().sampson(F, q1, q2)`` calls the kernel of the active backend. Arrays carry their batch
axes last: a kernel that takes one point of shape (2,) takes n of them as (2, n). All backends take
and return NumPy arrays.

- ``numpy``: the reference, always there.
- ``c``: the same expressions compiled, used by default when the library is there.
- ``casadi``: CasADi functions, for embedding and as an independent check.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import math
import threading
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np
from epigauge_generated.signatures import SIGNATURES, Argument, Signature
from numpy.typing import NDArray

from epigauge._arguments import as_choice
from epigauge._library import NOT_COMPILED, address, failed, library
from epigauge._options import Backend
from epigauge.errors import BackendError

__all__ = ["NAMES", "Table", "available", "backend", "set_backend", "table"]

NAMES = ("c", "numpy", "casadi")

Array = NDArray[np.float64]
Kernel = Callable[..., Any]

_lock = threading.Lock()
_active: str | None = None


class Table:
    """The kernels of one backend as attributes.

    Parameters
    ----------
    name : {"c", "numpy", "casadi"}
        The backend.

    Examples
    --------
    >>> import epigauge as eg
    >>> table = eg.kernels.Table("numpy")
    >>> table.name
    'numpy'
    """

    def __init__(self, name: str) -> None:
        self.name = cast(Backend, name)
        wrap = {"c": _wrap_c, "numpy": _wrap_numpy, "casadi": _wrap_casadi}[name]
        for kernel, signature in SIGNATURES.items():
            setattr(self, kernel, wrap(kernel, signature))

    @property
    def compiled(self) -> bool:
        """Tell whether the passes over observations of runtime/c belong to this back end."""
        return self.name == "c"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the name alone: compiled functions have no other form."""
        return _restored, (self.name,)

    def __getattr__(self, kernel: str) -> Kernel:
        raise AttributeError(f"no kernel is named {kernel!r}; there are: {', '.join(SIGNATURES)}")


def available() -> dict[str, str | None]:
    """Tell which backends can be used here.

    Returns
    -------
    dict of str to str or None
        For each backend None where it can be used, else the reason why not.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.kernels.available()["numpy"] is None
    True
    """
    reasons: dict[str, str | None] = {"numpy": None}
    try:
        library()
        reasons["c"] = None
    except BackendError as error:
        reasons["c"] = error.reason
    found = importlib.util.find_spec("casadi") is not None
    reasons["casadi"] = None if found else "needs the package casadi, which is not installed"
    return {name: reasons[name] for name in NAMES}


def backend() -> str:
    """Return the name of the active backend: ``"c"`` where the library is there, else ``"numpy"``.

    Returns
    -------
    str
        One of ``"c"``, ``"numpy"``, ``"casadi"``.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.backend() in ("c", "numpy", "casadi")
    True
    """
    global _active
    with _lock:
        if _active is None:
            reason = available()["c"]
            _active = "c" if reason is None else "numpy"
            if reason is not None and failed():
                warnings.warn(NOT_COMPILED, RuntimeWarning, stacklevel=2)
        return _active


def set_backend(name: str) -> None:
    """Choose the backend of all later calls that do not name one.

    Parameters
    ----------
    name : {"c", "numpy", "casadi"}
        The backend.

    Raises
    ------
    ArgumentError
        If there is no backend of this name.
    BackendError
        If it cannot be used here; the message says how to get it.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.set_backend(eg.backend())
    """
    global _active
    chosen = table(name).name
    with _lock:
        _active = chosen


def table(name: str | None = None) -> Table:
    """Return the kernels of a backend, by default of the active one.

    Parameters
    ----------
    name : {"c", "numpy", "casadi"}, optional
        The backend.

    Returns
    -------
    Table
        One callable attribute a kernel; see ``epigauge_generated.signatures`` for arguments.

    Raises
    ------
    ArgumentError
        If there is no backend of this name.
    BackendError
        If it cannot be used here; the message says how to get it.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.kernels.table("numpy").name
    'numpy'
    """
    chosen = backend() if name is None else as_choice("backend", name, NAMES)
    if chosen == "c":
        library()
    elif chosen == "casadi" and available()["casadi"] is not None:
        raise BackendError(chosen, "needs the package casadi", "pip install 'epigauge[casadi]'")
    return _table(chosen)


def _restored(name: str) -> Table:
    """Return the table of a backend, or NumPy's where that is not here."""
    return table(name if available()[name] is None else "numpy")


@cache
def _table(name: str) -> Table:
    return Table(name)


def _prepare(signature: Signature, inputs: tuple[Any, ...]) -> tuple[list[Array], tuple[int, ...]]:
    """Convert the inputs and find their common batch shape."""
    if len(inputs) != len(signature.inputs):
        names = ", ".join(argument.name for argument in signature.inputs)
        raise TypeError(f"{len(inputs)} inputs given, needed: {names}")
    arrays = [np.asarray(value, dtype=np.float64) for value in inputs]
    batch: tuple[int, ...] = ()
    for argument, array in zip(signature.inputs, arrays, strict=True):
        own = array.shape[len(argument.shape) :]
        if array.shape[: len(argument.shape)] != argument.shape or (own and not argument.batched):
            raise TypeError(f"{argument.name} has shape {array.shape}, needed: {argument.shape}")
        if own and own != batch:
            batch = np.broadcast_shapes(batch, own) if batch else own
    if len(batch) != 1 and not all(argument.batched for argument in signature.outputs):
        raise TypeError("a kernel that sums over observations needs exactly one batch axis")
    return arrays, batch


def _outputs(signature: Signature, batch: tuple[int, ...]) -> list[Array]:
    return [np.empty(a.shape + batch if a.batched else a.shape) for a in signature.outputs]


def _result(outputs: list[Array]) -> Array | tuple[Array, ...]:
    return outputs[0] if len(outputs) == 1 else tuple(outputs)


def _wrap_numpy(name: str, signature: Signature) -> Kernel:
    module = importlib.import_module(f"epigauge_generated.numpy_backend.{signature.family}")
    function = getattr(module, name)

    def call(*inputs: Any) -> Any:
        arrays, batch = _prepare(signature, inputs)
        outputs = _outputs(signature, batch)
        function(*arrays, *outputs)
        return _result(outputs)

    return call


def _wrap_c(name: str, signature: Signature) -> Kernel:
    function = getattr(library(), f"eg_{name}")
    function.restype = None
    count = len(signature.inputs) + len(signature.outputs)
    function.argtypes = [ctypes.c_ssize_t] + [ctypes.c_void_p] * count

    def call(*inputs: Any) -> Any:
        arrays, batch = _prepare(signature, inputs)
        arrays = [
            _whole(array, argument, batch)
            for argument, array in zip(signature.inputs, arrays, strict=True)
        ]
        outputs = _outputs(signature, batch)
        function(math.prod(batch), *map(address, (*arrays, *outputs)))
        return _result(outputs)

    return call


def _whole(array: Array, argument: Argument, batch: tuple[int, ...]) -> Array:
    """Return a contiguous array with all its batch axes, aligned as C needs it."""
    shape = argument.shape + batch if argument.batched else argument.shape
    if array.shape != shape:
        missing = len(batch) - (array.ndim - len(argument.shape))
        own = array.shape[len(argument.shape) :]
        array = np.broadcast_to(array.reshape(argument.shape + (1,) * missing + own), shape)
    return np.ascontiguousarray(array if array.flags.aligned else array.copy())


def _wrap_casadi(name: str, signature: Signature) -> Kernel:
    module = importlib.import_module(f"epigauge_generated.casadi_backend.{signature.family}")
    build = getattr(module, name)

    def call(*inputs: Any) -> Any:
        arrays, batch = _prepare(signature, inputs)
        count = math.prod(batch)
        columns = []
        for argument, array in zip(signature.inputs, arrays, strict=True):
            if argument.batched:
                flat = _whole(array, argument, batch).reshape(*_rows_columns(argument), count)
                array = np.moveaxis(flat, 2, 1).reshape(flat.shape[0], -1)
            columns.append(array)
        outputs = _outputs(signature, batch)
        if not count:  # a sum over no observations is zero
            return _result([np.zeros_like(output) for output in outputs])
        results = build()(*columns)
        results = results if len(outputs) > 1 else (results,)
        for argument, output, result in zip(signature.outputs, outputs, results, strict=True):
            rows, width = _rows_columns(argument)
            values = np.moveaxis(np.asarray(result).reshape(rows, -1, width), 1, 2)
            if argument.batched:
                output[...] = values.reshape(argument.shape + batch)
            else:
                output[...] = values.sum(axis=2).reshape(argument.shape)
        return _result(outputs)

    return call


def _rows_columns(argument: Argument) -> tuple[int, int]:
    """Return the shape of an argument in CasADi, which knows matrices only."""
    return (argument.shape[0], math.prod(argument.shape[1:])) if argument.shape else (1, 1)
