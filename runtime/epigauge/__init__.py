"""Geometry of uncalibrated images: maximum-likelihood fundamental matrices and their uncertainty.

>>> import epigauge as eg
>>> result = eg.refine_fundamental(x1, x2)  # doctest: +SKIP
>>> result.F, result.rms_px, result.covariance  # doctest: +SKIP
"""

from epigauge import casadi, kernels
from epigauge.errors import ArgumentError, BackendError, EpigaugeError, FileFormatError
from epigauge.io import Matches, load_matches, save_matches, save_result
from epigauge.kernels import backend, set_backend
from epigauge.scenes import TwoViewScene, two_view_scene
from epigauge.two_view.batch import BATCH_STATUS, FundamentalBatch, refine_fundamental_batch
from epigauge.two_view.geometry import (
    canonical_cameras,
    reprojection_distances,
    sampson_distances,
    triangulate,
)
from epigauge.two_view.initial import fundamental_8point
from epigauge.two_view.refine import refine_fundamental
from epigauge.two_view.result import FundamentalResult

__version__ = "0.1.0"

__all__ = [
    "BATCH_STATUS",
    "ArgumentError",
    "BackendError",
    "EpigaugeError",
    "FileFormatError",
    "FundamentalBatch",
    "FundamentalResult",
    "Matches",
    "TwoViewScene",
    "backend",
    "canonical_cameras",
    "casadi",
    "fundamental_8point",
    "kernels",
    "load_matches",
    "refine_fundamental",
    "refine_fundamental_batch",
    "reprojection_distances",
    "sampson_distances",
    "save_matches",
    "save_result",
    "set_backend",
    "triangulate",
    "two_view_scene",
]
