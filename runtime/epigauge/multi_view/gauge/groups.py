"""The gauge groups of camera models, as derived from their formulas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import AffineReconstruction, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.multi_view.reconstruction import Reconstruction

__all__ = ["Group", "group"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Group:
    """The gauge group of a camera model: what moves cameras and points and changes no image.

    Attributes
    ----------
    model : str
        Name of the camera model.
    dimension : int
        Of the group, beside the scales of homogeneous cameras and points.
    names : tuple of str
        What its generators are.

    Examples
    --------
    >>> import epigauge as eg
    >>> found = eg.gauge.group("PINHOLE")
    >>> found.dimension, found.names[-1]
    (7, 'scale')
    """

    model: str
    dimension: int
    names: tuple[str, ...]

    def generators(
        self, reconstruction: Reconstruction | MetricReconstruction | AffineReconstruction
    ) -> tuple[Array, Array]:
        """Return the velocities of cameras and points along the group.

        Parameters
        ----------
        reconstruction : Reconstruction, MetricReconstruction or AffineReconstruction
            Where, with cameras of this model.

        Returns
        -------
        cameras, points : ndarray, shape (n, d, dimension), (m, b, dimension)
            In each camera's own tangent (turn and move in its own frame, intrinsics; all entries of
            a projective one, two rows of an affine one) and in the coordinates of each point. The
            Jacobian of the images times them is zero.

        Raises
        ------
        ArgumentError
            If the reconstruction has other cameras.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene().true
        >>> cameras, points = eg.gauge.group("SIMPLE_PINHOLE").generators(scene)
        >>> cameras.shape[2], points.shape[1:]
        (7, (3, 7))
        """
        model = camera_model(self.model)
        if isinstance(reconstruction, MetricReconstruction):
            name, rows, points = (
                reconstruction.cameras.model,
                reconstruction.vectors,
                reconstruction.X,
            )
        elif isinstance(reconstruction, AffineReconstruction):
            name, rows, points = "affine", reconstruction.vectors, reconstruction.X
        else:
            name, rows, points = "projective", reconstruction.P.reshape(-1, 12), reconstruction.Q
        if name != model.name:
            raise ArgumentError("reconstruction", f"has {name} cameras", f"{model.name} cameras")
        of_cameras, of_points = (
            model.kernel(f"{what}_generators")(array.T)
            for what, array in (("camera", rows), ("point", points))
        )
        return of_cameras.transpose(2, 0, 1), of_points.transpose(2, 0, 1)


def group(model: str) -> Group:
    """Return the gauge group of a camera model, as derived from its formula.

    Parameters
    ----------
    model : str
        Name of the camera model, as ``"projective"`` or ``"SIMPLE_RADIAL"``.

    Returns
    -------
    Group
        Dimension, names and generators.

    Raises
    ------
    ArgumentError
        On an unknown model.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.gauge.group("projective").dimension, eg.gauge.group("bal").dimension
    (15, 7)
    """
    found = camera_model(model)
    return Group(found.name, found.gauge_dimension, found.gauge_names)
