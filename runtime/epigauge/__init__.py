"""Geometry of uncalibrated images: maximum-likelihood fundamental matrices and reconstructions.

>>> import epigauge as eg
>>> result = eg.refine_fundamental(x1, x2)  # doctest: +SKIP
>>> result.F, result.rms_px, result.covariance  # doctest: +SKIP
>>> bundle = eg.bundle_adjust(eg.load_tracks("tracks.csv"))  # doctest: +SKIP
>>> bundle.reconstruction, bundle.rms_px  # doctest: +SKIP
"""

from threading import RLock
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # what a name stands for; `_WHERE` says the same to Python
    from epigauge import (
        arrays,
        casadi,
        colmap,
        datasets,
        distributed,
        interop,
        kernels,
        samples,
        verdicts,
    )
    from epigauge.bundle.prior_kinds import (
        Distance,
        IntrinsicPrior,
        PointPrior,
        PositionPrior,
        RotationPrior,
    )
    from epigauge.cameras import AffineReconstruction, Cameras, MetricReconstruction
    from epigauge.errors import ArgumentError, BackendError, EpigaugeError, FileFormatError
    from epigauge.images import ImageMatches, load_image, match_images
    from epigauge.images.pairwise import PairwiseMatches, match_photographs
    from epigauge.images.tracks import build_tracks
    from epigauge.io import (
        Matches,
        load_line_tracks,
        load_matches,
        load_reconstruction,
        load_result,
        load_scene,
        load_tracks,
        save_line_tracks,
        save_matches,
        save_reconstruction,
        save_result,
        save_scene,
        save_tracks,
    )
    from epigauge.kernels import backend, set_backend
    from epigauge.line_scenes import LineScene, line_scene
    from epigauge.metric.pair import FocalLengths, focal_lengths
    from epigauge.metric.result import MetricUpgrade
    from epigauge.metric.upgrade import metric_upgrade
    from epigauge.multi_view import gauge
    from epigauge.multi_view.adjust import BundleResult, bundle_adjust
    from epigauge.multi_view.affine_start import initialize_affine
    from epigauge.multi_view.compare import Comparison, compare
    from epigauge.multi_view.initialize import initialize
    from epigauge.multi_view.line_start import triangulate_lines
    from epigauge.multi_view.line_tracks import LineTracks
    from epigauge.multi_view.reconstruction import Reconstruction
    from epigauge.multi_view.reconstruction_covariance import ReconstructionCovariance
    from epigauge.multi_view.tracks import Tracks
    from epigauge.multi_view.uncertainty import covariance
    from epigauge.scenes import MultiViewScene, TwoViewScene, multi_view_scene, two_view_scene
    from epigauge.two_view.batch import refine_fundamental_batch
    from epigauge.two_view.batch_result import BATCH_STATUS, FundamentalBatch
    from epigauge.two_view.calibrated import estimate_essential
    from epigauge.two_view.geometry import (
        canonical_cameras,
        reprojection_distances,
        sampson_distances,
        triangulate,
    )
    from epigauge.two_view.homography_refine import refine_homography
    from epigauge.two_view.homography_result import HomographyResult
    from epigauge.two_view.homography_search import estimate_homography
    from epigauge.two_view.initial import fundamental_7point, fundamental_8point
    from epigauge.two_view.model import TwoViewResult, estimate_two_view
    from epigauge.two_view.refine import refine_fundamental
    from epigauge.two_view.result import FundamentalResult
    from epigauge.two_view.robust import RobustResult, estimate_fundamental
    from epigauge.two_view.robust_batch import RobustBatch, estimate_fundamental_batch
    from epigauge.uncertainty.affine import AffineCovariance
    from epigauge.uncertainty.covariance import MetricCovariance

__version__ = "0.1.0"

__all__ = [
    "BATCH_STATUS",
    "AffineCovariance",
    "AffineReconstruction",
    "ArgumentError",
    "BackendError",
    "BundleResult",
    "Cameras",
    "Comparison",
    "Distance",
    "EpigaugeError",
    "FileFormatError",
    "FocalLengths",
    "FundamentalBatch",
    "FundamentalResult",
    "HomographyResult",
    "ImageMatches",
    "IntrinsicPrior",
    "LineScene",
    "LineTracks",
    "Matches",
    "MetricCovariance",
    "MetricReconstruction",
    "MetricUpgrade",
    "MultiViewScene",
    "PairwiseMatches",
    "PointPrior",
    "PositionPrior",
    "Reconstruction",
    "ReconstructionCovariance",
    "RobustBatch",
    "RobustResult",
    "RotationPrior",
    "Tracks",
    "TwoViewResult",
    "TwoViewScene",
    "arrays",
    "backend",
    "build_tracks",
    "bundle_adjust",
    "canonical_cameras",
    "casadi",
    "colmap",
    "compare",
    "covariance",
    "datasets",
    "distributed",
    "estimate_essential",
    "estimate_fundamental",
    "estimate_fundamental_batch",
    "estimate_homography",
    "estimate_two_view",
    "focal_lengths",
    "fundamental_7point",
    "fundamental_8point",
    "gauge",
    "initialize",
    "initialize_affine",
    "interop",
    "kernels",
    "line_scene",
    "load_image",
    "load_line_tracks",
    "load_matches",
    "load_reconstruction",
    "load_result",
    "load_scene",
    "load_tracks",
    "match_images",
    "match_photographs",
    "metric_upgrade",
    "multi_view_scene",
    "refine_fundamental",
    "refine_fundamental_batch",
    "refine_homography",
    "reprojection_distances",
    "samples",
    "sampson_distances",
    "save_line_tracks",
    "save_matches",
    "save_reconstruction",
    "save_result",
    "save_scene",
    "save_tracks",
    "set_backend",
    "triangulate",
    "triangulate_lines",
    "two_view_scene",
    "verdicts",
]

#: Modules below this package, and the public names that they define.
_WHERE = {
    "bundle.prior_kinds": "Distance IntrinsicPrior PointPrior PositionPrior RotationPrior",
    "cameras": "AffineReconstruction Cameras MetricReconstruction",
    "errors": "ArgumentError BackendError EpigaugeError FileFormatError",
    "images": "ImageMatches load_image match_images",
    "images.pairwise": "PairwiseMatches match_photographs",
    "images.tracks": "build_tracks",
    "io": (
        "Matches load_line_tracks load_matches load_reconstruction load_result load_scene "
        "load_tracks save_line_tracks save_matches save_reconstruction save_result save_scene "
        "save_tracks"
    ),
    "kernels": "backend set_backend",
    "line_scenes": "LineScene line_scene",
    "metric.pair": "FocalLengths focal_lengths",
    "metric.result": "MetricUpgrade",
    "metric.upgrade": "metric_upgrade",
    "multi_view.adjust": "BundleResult bundle_adjust",
    "multi_view.affine_start": "initialize_affine",
    "multi_view.compare": "Comparison compare",
    "multi_view.initialize": "initialize",
    "multi_view.line_start": "triangulate_lines",
    "multi_view.line_tracks": "LineTracks",
    "multi_view.reconstruction": "Reconstruction",
    "multi_view.tracks": "Tracks",
    "multi_view.reconstruction_covariance": "ReconstructionCovariance",
    "multi_view.uncertainty": "covariance",
    "scenes": "MultiViewScene TwoViewScene multi_view_scene two_view_scene",
    "two_view.batch": "refine_fundamental_batch",
    "two_view.batch_result": "BATCH_STATUS FundamentalBatch",
    "two_view.calibrated": "estimate_essential",
    "two_view.geometry": ("canonical_cameras reprojection_distances sampson_distances triangulate"),
    "two_view.homography_refine": "refine_homography",
    "two_view.homography_result": "HomographyResult",
    "two_view.homography_search": "estimate_homography",
    "two_view.initial": "fundamental_7point fundamental_8point",
    "two_view.model": "TwoViewResult estimate_two_view",
    "two_view.refine": "refine_fundamental",
    "two_view.result": "FundamentalResult",
    "two_view.robust": "RobustResult estimate_fundamental",
    "two_view.robust_batch": "RobustBatch estimate_fundamental_batch",
    "uncertainty.affine": "AffineCovariance",
    "uncertainty.covariance": "MetricCovariance",
}
_MODULES = {
    **{name: name for name in ("arrays", "casadi", "colmap", "datasets", "interop", "kernels")},
    "cameras": "cameras",
    **{
        name: name
        for name in ("errors", "images", "io", "lm", "plots", "reports", "samples", "scenes")
    },
    "distributed": "distributed",
    "verdicts": "verdicts",
    "gauge": "multi_view.gauge",
}
_HOME = {name: module for module, names in _WHERE.items() for name in names.split()}

if not TYPE_CHECKING:  # a checker takes a module with __getattr__ to have every name
    _ONE_THREAD = RLock()

    def __getattr__(name: str) -> object:
        """Import what a public name stands for, when it is first asked for (PEP 562)."""
        from importlib import import_module

        with _ONE_THREAD:  # NumPy's modules import one another in a circle
            import_module("numpy.typing")
        if name in _MODULES:
            value = import_module(f"{__name__}.{_MODULES[name]}")
        elif name in _HOME:
            value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        """List the public names, whether imported yet or not."""
        return sorted({*globals(), *__all__})
