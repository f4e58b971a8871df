"""Gauges: changes of projective basis and scales, and rules that choose one (B03 sections 4, 5).

A `Transformation` is the T~ of B03 eq. (5). A gauge is an object that finds the transformation
which moves a reconstruction to where the gauge wants it. Two reconstructions of the same geometry
are moved to the same place, up to signs and, for the normalised basis, an orthonormal change.
"""

from epigauge.bundle.similarity import Similarity
from epigauge.multi_view.gauge.equivalence import equivalent
from epigauge.multi_view.gauge.gauges import (
    GAUGES,
    five_points,
    identity,
    inner,
    normalized,
    reference_camera,
    two_cameras,
)
from epigauge.multi_view.gauge.groups import Group, group
from epigauge.multi_view.gauge.transformations import Gauge, Transformation, similarity, transform

__all__ = [
    "GAUGES",
    "Gauge",
    "Group",
    "Similarity",
    "Transformation",
    "equivalent",
    "five_points",
    "group",
    "identity",
    "inner",
    "normalized",
    "reference_camera",
    "similarity",
    "transform",
    "two_cameras",
]
