"""Cameras of every model, and scenes of calibrated and of affine ones."""

from epigauge.cameras.affine import AffineReconstruction
from epigauge.cameras.intrinsics import MAX_FOCAL, MIN_FOCAL, Cameras, check_parameters
from epigauge.cameras.metric import MetricReconstruction
from epigauge.cameras.models import CameraModel, camera_model, models
from epigauge.multi_view.reconstruction import Reconstruction

__all__ = [
    "MAX_FOCAL",
    "MIN_FOCAL",
    "AffineReconstruction",
    "AnyReconstruction",
    "CameraModel",
    "Cameras",
    "MetricReconstruction",
    "camera_model",
    "check_parameters",
    "models",
]

AnyReconstruction = Reconstruction | MetricReconstruction | AffineReconstruction
