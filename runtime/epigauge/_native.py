"""The functions of runtime/c as ctypes calls them, and the structures it shares with Python."""

from __future__ import annotations

import ctypes
import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address, library
from epigauge.errors import BackendError

__all__ = [
    "BLOCK",
    "CAMERA",
    "FACTORED",
    "LANES",
    "MOST_TANGENT",
    "PAIR",
    "PANEL",
    "TRACE",
    "Blocks",
    "Bundle",
    "BundleOptions",
    "Envelope",
    "NormalArrays",
    "Part",
    "Refinement",
    "Share",
    "aligned_zeros",
    "check_sizes",
    "checked",
    "function",
]

Array = NDArray[np.float64]

#: As in bundle.h.
LANES, CAMERA, PAIR = 8, 96, 112

#: Rows of a panel, as in panels.h, and the widest tangent of a camera, as in skyline.h.
PANEL, MOST_TANGENT = 12, 32

_P, _N, _D, _I = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_double, ctypes.c_int


class Bundle(ctypes.Structure):
    """The eg_bundle of bundle.h."""

    _fields_ = (
        ("n_views", _N),
        ("n_points", _N),
        ("n_chunks", _N),
        ("lanes", _P),
        ("rows", _P),
        ("point", _P),
        ("count", _P),
        ("view", _P),
        ("q", _P),
        ("weights", _P),
        ("least", _D),
        ("scale2", _D),
        ("loss", _N),
        ("model", _N),
        ("width", _N),
        ("columns", _P),
    )


#: The model of projective cameras by the factors of their Jacobian.
FACTORED = -1


class Envelope(ctypes.Structure):
    """The eg_envelope of skyline.h."""

    _fields_ = (("n", _N), ("first", _P), ("slot", _P))


class Blocks(ctypes.Structure):
    """The eg_blocks of skyline.h."""

    _fields_ = tuple((name, _N) for name in ("d", "size", "length"))

    @staticmethod
    def dense(d: int) -> Blocks:
        """Return (d, d) blocks row by row."""
        return Blocks(d, d * d, d)


class Refinement(ctypes.Structure):
    """The eg_refinement of bundle.h."""

    _fields_ = (
        ("iterations", _N),
        ("damping", _N),
        ("lam", _D),
        ("factor", _D),
        ("tolerance", _D),
    )


#: The eg_part and the eg_share of bundle.h.
Part = ctypes.CFUNCTYPE(None, _P, _N)
Share = ctypes.CFUNCTYPE(None, _P, _P, _N)


class BundleOptions(ctypes.Structure):
    """The eg_bundle_options of bundle.h."""

    _fields_ = (
        ("refinement", Refinement),
        *((name, _D) for name in ("ftol", "xtol", "gtol", "start", "least", "floor")),
        ("max_iter", _N),
        ("focal", _P),
        ("focals", _N),
        ("min_focal", _D),
        ("max_focal", _D),
        ("share", Share),
        ("n_passes", _N),
        ("n_pairs", _N),
        ("passes", _P),
        ("pairs", _P),
        ("stop", _P),
        ("adaptive", _I),
    )


class NormalArrays(ctypes.Structure):
    """The eg_bundle_normal of bundle.h."""

    _fields_ = tuple((name, _P) for name in ("U", "V", "g", "g_points"))


#: The damping of a refinement: by the trace of a point's block, or by the block.
TRACE, BLOCK = 0, 1


#: Results and arguments. The first three of most are the bundle and a range of its chunks.
_RANGE = (_P, _N, _N)
_TYPES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "bundle_chunks": (_N, (_N, _N, *[_P] * 7)),
    "bundle_pack": (None, (_P,) * 8),
    "camera_model_row": (_N, (ctypes.c_char_p,)),
    "bundle_widths": (None, (_P, _P, _P)),
    "bundle_costs": (_I, (*_RANGE, *[_P] * 3)),
    "bundle_linearize": (_I, (*_RANGE, *[_P] * 6)),
    "bundle_refine_points": (_I, (*_RANGE, *[_P] * 5)),
    "bundle_inverse_roots": (_I, (_N, _N, _P, _P, _N, _D, _P, _P, _P)),
    "bundle_schur": (_I, (*_RANGE, *[_P] * 7)),
    "bundle_eliminate": (_I, (*_RANGE, _P, _P, _D, _I, *[_P] * 9)),
    "bundle_couple": (_I, (*_RANGE, *[_P] * 3, _N, *[_P] * 4)),
    "bundle_marginals": (_I, (*_RANGE, *[_P] * 8)),
    "bundle_point_steps": (_D, (_N, _N, *[_P] * 4, _N, _P)),
    "bundle_camera_blocks": (None, (_P,) * 5),
    "bundle_pair_blocks": (None, (_P, _N, _P, _P)),
    "bundle_neighbours": (None, (_P, _P)),
    "bundle_intersect": (_I, (*_RANGE, _P, _P)),
    "bundle_distances": (_I, (*_RANGE, *[_P] * 4)),
    "spreading_basis": (_I, (_N, _P, _P)),
    "change_basis": (_I, (_N, _N, _P, _I, *[_P] * 6)),
    "image_frame": (_D, (_N, _N, *[_P] * 3)),
    "resect": (_I, (_N, _P, _P, _D, _D, _N, _P)),
    "bundle_minimize": (_I, (_P,) * 10),
    "envelope_factor": (_I, (_P, _P)),
    "envelope_invert": (_I, (_P, _P)),
    "envelope_solve": (None, (_P, _P, _N, _P)),
    "skyline_reduce": (None, (_P, _P, _P, _N, _P, _P, _P, _P)),
    "skyline_spread": (None, (_P, _P, _P, _N, _P, _N, _P, _P, _P)),
}


def check_sizes(structures: dict[str, type[ctypes.Structure]]) -> None:
    """Compare structures with those of the C library by their names there.

    Raises
    ------
    BackendError
        If one has another size.
    """
    size = library().eg_shared_size
    size.restype, size.argtypes = _N, (ctypes.c_char_p,)
    for name, structure in structures.items():
        if size(name.encode()) != ctypes.sizeof(structure):
            remedy = "install epigauge again to rebuild it"
            raise BackendError("c", f"has another {name} than this Python code", remedy)


@cache
def _checked_library() -> ctypes.CDLL:
    check_sizes(
        {
            "eg_bundle": Bundle,
            "eg_envelope": Envelope,
            "eg_blocks": Blocks,
            "eg_refinement": Refinement,
            "eg_bundle_options": BundleOptions,
            "eg_bundle_normal": NormalArrays,
        }
    )
    return library()


@cache
def function(name: str) -> Any:
    """Return a function of the C library; calls release the global interpreter lock."""
    found = getattr(_checked_library(), f"eg_{name}")
    found.restype, found.argtypes = _TYPES[name]
    return found


def checked(status: int) -> None:
    """Raise what a status other than zero means: there was no memory."""
    if status:
        raise MemoryError("no memory for the observations of a few points")


def aligned_zeros(shape: tuple[int, ...]) -> Array:
    """Return zeros that begin at a cache line."""
    size = math.prod(shape)
    whole = np.zeros(size + 8)
    begin = -int(address(whole) or 0) // 8 % 8
    return whole[begin : begin + size].reshape(shape)
