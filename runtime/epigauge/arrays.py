"""The generated functions over any array namespace: PyTorch, JAX, CuPy and others.

Arrays carry their batch axes last, as in `epigauge.kernels`, and broadcast. Nothing is written in
place, so that what a namespace traces or differentiates passes through.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from epigauge_generated.signatures import SIGNATURES, Signature

from epigauge.errors import ArgumentError, BackendError

__all__ = ["ArrayTable", "table"]


class ArrayTable:
    """The kernels over one namespace as attributes.

    Parameters
    ----------
    xp : module
        A namespace of the array API standard.

    Examples
    --------
    >>> import epigauge as eg
    >>> import torch  # doctest: +SKIP
    >>> eg.arrays.table(torch)  # doctest: +SKIP
    """

    def __init__(self, xp: Any) -> None:
        self.xp = xp

    def __getattr__(self, kernel: str) -> Callable[..., Any]:
        if kernel not in SIGNATURES:
            names = ", ".join(SIGNATURES)
            raise AttributeError(f"no kernel is named {kernel!r}; there are: {names}")
        call = _bound(self.xp, kernel, SIGNATURES[kernel])
        setattr(self, kernel, call)
        return call


@cache
def table(xp: Any) -> ArrayTable:
    """Return the kernels over a namespace.

    Parameters
    ----------
    xp : module
        A namespace of the array API standard, as ``array_api_compat.array_namespace(x)`` gives it.

    Returns
    -------
    ArrayTable
        One callable attribute a kernel; arguments as in ``epigauge_generated.signatures``, outputs
        returned as new arrays. Inputs that NumPy's kernels share between observations may have
        batch axes here. Sums are over the last axis.

    Examples
    --------
    >>> import numpy as np
    >>> import epigauge as eg
    >>> F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    >>> q1, q2 = np.array([[0.0, 1], [0, 2]]), np.array([[0.5, 1], [0, 3]])
    >>> residual, _ = eg.arrays.table(np).sampson(F, q1, q2)
    >>> residual.shape
    (1, 2)
    """
    return ArrayTable(xp)


def is_tensor(value: Any) -> bool:
    """Tell whether a value is an array of another library than NumPy, without importing any."""
    root = type(value).__module__.partition(".")[0]
    return root in ("torch", "jax", "jaxlib", "cupy", "array_api_strict", "dask", "ndonnx")


def namespace(*arrays: Any) -> Any:
    """Return the namespace that arrays belong to.

    Raises
    ------
    BackendError
        If the package array-api-compat is not installed.
    ArgumentError
        If arrays of different libraries are mixed.
    """
    if importlib.util.find_spec("array_api_compat") is None:
        raise BackendError(
            "array", "needs the package array-api-compat", "pip install 'epigauge[array]'"
        )
    import array_api_compat

    try:
        return array_api_compat.array_namespace(*arrays)
    except TypeError as error:
        raise ArgumentError("x1, x2", str(error), "arrays of one library") from None


def constant(array: Any) -> Any:
    """Return the values of an array, cut off from what differentiates it."""
    if hasattr(array, "detach"):  # PyTorch
        return array.detach()
    if type(array).__module__.partition(".")[0] in ("jax", "jaxlib"):
        import jax

        return jax.lax.stop_gradient(array)
    return array


def bucket(array: Any, count: int) -> int:
    """Return how long an axis of `count` entries is made, of what computes with an array.

    JAX compiles each operation anew for each shape: there one of few lengths, 2^k
    or 1.5 2^k. Others take any length.
    """
    if type(array).__module__.partition(".")[0] not in ("jax", "jaxlib"):
        return count
    whole = 1 << max(count - 1, 3).bit_length()
    return 3 * whole // 4 if count <= 3 * whole // 4 else whole


def device(array: Any) -> Any:
    """Return where an array lies, None for what JAX traces."""
    return getattr(array, "device", None)


def host(array: Any) -> np.ndarray[Any, np.dtype[Any]]:
    """Return a copy in NumPy of an array on any device.

    Raises
    ------
    ArgumentError
        If its values are not known, as under a compilation by tracing (``jax.jit``).
    """
    array = constant(array)
    try:
        if hasattr(array, "cpu"):  # PyTorch
            return np.asarray(array.cpu())
        if hasattr(array, "get"):  # CuPy
            return np.asarray(array.get())
        return np.array(array)
    except Exception as error:
        if "Tracer" not in type(error).__name__:
            raise
        needed = "arrays with values: call it outside of jit and vmap"
        raise ArgumentError("x1, x2", "are traced", needed) from None


def _bound(xp: Any, name: str, signature: Signature) -> Callable[..., Any]:
    """Return a kernel that stacks the entries of its outputs."""
    module = importlib.import_module(f"epigauge_generated.array_backend.{signature.family}")
    function = getattr(module, name)

    def call(*inputs: Any) -> Any:
        batch: tuple[int, ...] = ()
        like: Any = None
        for argument, value in zip(signature.inputs, inputs, strict=True):
            if not isinstance(value, (int, float)):
                like = value
                batch = np.broadcast_shapes(batch, tuple(value.shape[len(argument.shape) :]))
        found = function(xp, *inputs)
        outputs = tuple(
            _stacked(xp, argument.shape, batch if argument.batched else batch[:-1], entries, like)
            for argument, entries in zip(signature.outputs, found, strict=True)
        )
        return outputs[0] if len(outputs) == 1 else outputs

    return call


def _stacked(
    xp: Any, shape: tuple[int, ...], batch: tuple[int, ...], entries: Sequence[Any], like: Any
) -> Any:
    """Return entries, arrays or numbers, as one array with its own axes first."""
    zero = xp.zeros(batch, dtype=like.dtype, device=device(like))
    whole = [zero + entry if isinstance(entry, (int, float)) else entry for entry in entries]
    stacked = xp.stack([xp.broadcast_to(entry, batch) for entry in whole], axis=0)
    return xp.reshape(stacked, (*shape, *batch))
