"""Names that options take, for type checkers and the command line, and options that are passed on.

A test compares the names with the tables that the solvers look them up in.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, TypedDict

from numpy.typing import ArrayLike

from epigauge.lm import Row

__all__ = [
    "AdjustOptions",
    "Backend",
    "BundleDamping",
    "CameraGroups",
    "Criterion",
    "Detector",
    "FrontEnd",
    "GaugeMode",
    "GaugeName",
    "Hessian",
    "HomographyOptions",
    "Initialization",
    "Loss",
    "Method",
    "PairDamping",
    "PairOptions",
    "Pairing",
    "Parameterization",
    "Part",
    "RefineOptions",
    "Repeated",
    "Rigs",
    "Schedule",
    "Structure",
    "TwoViewModel",
    "UpgradeModel",
    "known_options",
]

Backend = Literal["c", "numpy", "casadi"]
Loss = Literal["linear", "huber", "soft_l1", "cauchy", "truncated"]

Parameterization = Literal["ortho", "block", "maps", "parfree", "free", "normalized"]
Criterion = Literal["reprojection", "sampson", "epipolar"]
Structure = Literal["eliminated", "joint"]
PairDamping = Literal["levenberg", "seber"]
Hessian = Literal["exact", "gauss-newton"]
Part = Literal["epipole1", "epipole2", "epipolar_transformation"]
FrontEnd = Literal["auto", "native", "poselib", "opencv"]
TwoViewModel = Literal["auto", "F", "E", "H"]

Method = Literal[
    "covariant",
    "free",
    "hartley",
    "bartoli",
    "faugeras",
    "mclauchlan",
    "kanatani",
    "gauge_invariant",
    "gauge_invariant_factor",
    "levenberg",
    "marquardt",
]
BundleDamping = Literal[
    "levenberg", "marquardt", "covariant", "gauge_invariant", "gauge_invariant_factor", "none"
]
GaugeMode = Literal["explicit", "implicit"]
Schedule = Literal["auto", "classic", "nielsen", "adaptive"]
Initialization = Literal["auto", "registration", "factorization"]
Repeated = Literal["first", "best", "drop"]
Rigs = Literal["keep", "drop"]
GaugeName = Literal["reference_camera", "two_cameras", "five_points", "normalized"]

Detector = Literal["sift", "orb", "akaze", "brisk", "kaze"]
Pairing = Literal["all", "sequential", "ranked"]

UpgradeModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"
]
CameraGroups = Literal["auto", "one", "own", "size"]


class PairOptions(TypedDict, total=False):
    """Options of `refine_fundamental` that are the same for many pairs."""

    parameterization: Parameterization
    criterion: Criterion
    structure: Structure
    damping: PairDamping
    hessian: Hessian
    starts: int
    fix: Part | Sequence[Part]
    essential: bool
    K1: ArrayLike | None
    K2: ArrayLike | None
    loss: Loss
    loss_scale_px: float | Literal["auto"]
    noise_px: float | None
    covariance1: ArrayLike | None
    covariance2: ArrayLike | None
    bias_correction: bool
    ftol: float
    xtol: float
    gtol: float
    max_iter: int
    backend: Backend | Literal["array"] | None
    callback: Callable[[Row], object] | None


class RefineOptions(PairOptions, total=False):
    """Options of `refine_fundamental`, but for `F0`."""

    weights: ArrayLike | None


class HomographyOptions(TypedDict, total=False):
    """Options of `refine_homography`, but for `H0`."""

    loss: Loss
    loss_scale_px: float | Literal["auto"]
    noise_px: float | None
    weights: ArrayLike | None
    covariance1: ArrayLike | None
    covariance2: ArrayLike | None
    ftol: float
    xtol: float
    gtol: float
    max_iter: int
    backend: Backend | None
    callback: Callable[[Row], object] | None


class AdjustOptions(TypedDict, total=False):
    """Options of `bundle_adjust`, but for `method`."""

    refine: str | Sequence[str]
    fixed_views: Iterable[int]
    fixed_points: Iterable[int]
    priors: Iterable[Any] | None
    noise_px: float | Literal["tracks"] | None
    gauge: Any
    gauge_mode: GaugeMode
    damping: BundleDamping | None
    embedded: bool
    schedule: Schedule
    robust: bool
    loss: Loss
    loss_scale_px: float | Literal["auto"]
    ftol: float
    xtol: float
    gtol: float
    max_iter: int
    workers: int
    backend: Backend | None
    callback: Callable[[Row], object] | None


def known_options(
    function: str, options: Mapping[str, Any], form: type, also: Sequence[str] = ()
) -> dict[str, Any]:
    """Return options, of which none is unknown; those of `also` are refused elsewhere.

    Raises
    ------
    TypeError
        As Python does for arguments, at once, with a similar name that exists.
    """
    known = form.__annotations__
    for name in options:
        if name not in known and name not in also:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else f"; it has {', '.join(known)}"
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}{hint}")
    return dict(options)
