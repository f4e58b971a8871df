"""Geometry of uncalibrated images: maximum-likelihood fundamental matrices and their uncertainty.

>>> import epigauge as eg
>>> result = eg.refine_fundamental(x1, x2)  # doctest: +SKIP
>>> result.F, result.rms_px, result.covariance  # doctest: +SKIP
"""

from epigauge import casadi, kernels
from epigauge.errors import ArgumentError, BackendError, EpigaugeError, FileFormatError
from epigauge.io import Matches, load_matches, save_matches, save_result
from epigauge.kernels import backend, set_backend
from epigauge.multi_view import gauge
from epigauge.multi_view.adjust import BundleResult, bundle_adjust
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.tracks import Reconstruction, Tracks
from epigauge.scenes import TwoViewScene, two_view_scene
from epigauge.two_view.batch import BATCH_STATUS, FundamentalBatch, refine_fundamental_batch
from epigauge.two_view.geometry import (
    canonical_cameras,
    reprojection_distances,
    sampson_distances,
    triangulate,
)
from epigauge.two_view.initial import fundamental_7point, fundamental_8point
from epigauge.two_view.refine import refine_fundamental
from epigauge.two_view.result import FundamentalResult
from epigauge.two_view.robust import RobustResult, estimate_fundamental

__version__ = "0.1.0"

__all__ = [
    "BATCH_STATUS",
    "ArgumentError",
    "BackendError",
    "BundleResult",
    "EpigaugeError",
    "FileFormatError",
    "FundamentalBatch",
    "FundamentalResult",
    "Matches",
    "Reconstruction",
    "RobustResult",
    "Tracks",
    "TwoViewScene",
    "backend",
    "bundle_adjust",
    "canonical_cameras",
    "casadi",
    "estimate_fundamental",
    "fundamental_7point",
    "fundamental_8point",
    "gauge",
    "initialize",
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
