"""Scenes between BAL's camera and COLMAP's: the same images, seen with other axes.

BAL's camera looks along -z with y up, and its pixels count from the middle of the image, y up;
COLMAP's looks along z with y down, and its pixels count from the top left corner. The radial
polynomials of both are the same, so that nothing is lost either way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_array
from epigauge.cameras.intrinsics import Cameras
from epigauge.cameras.metric import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.tracks import Tracks

__all__ = ["bal_to_colmap", "colmap_to_bal"]

Array = NDArray[np.float64]

#: Half a turn about x: from the axes of one camera to those of the other.
_TURN = np.diag([1.0, -1.0, -1.0])

#: Coefficients of the models that BAL can express, after f, cx, cy.
_RADIAL = {"SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2}


def bal_to_colmap(
    tracks: Tracks, reconstruction: MetricReconstruction, image_size: ArrayLike | None = None
) -> tuple[Tracks, MetricReconstruction]:
    """Return a scene of BAL's cameras as one of COLMAP's RADIAL.

    Parameters
    ----------
    tracks : Tracks
        Observations in BAL's pixels.
    reconstruction : MetricReconstruction
        Cameras of the model "bal".
    image_size : array_like of int, shape (2,) or (n_views, 2), optional
        Width and height of the images, which BAL files do not tell; by default the tracks' sizes.

    Returns
    -------
    Tracks, MetricReconstruction
        The same images and points with COLMAP's axes, principal points in the middle; with
        residuals of the same size.

    Raises
    ------
    ArgumentError
        If the cameras are others, or no size is known.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.load_scene("problem-49-7776-pre.txt.bz2")  # doctest: +SKIP
    >>> eg.save_scene("sparse", *eg.interop.bal_to_colmap(*scene, (1024, 768)))  # doctest: +SKIP
    """
    cameras = reconstruction.cameras
    if cameras.model != "bal":
        was = f"has cameras of the model {cameras.model!r}"
        raise ArgumentError("reconstruction", was, "'bal'")
    size = tracks.sizes if image_size is None else image_size
    if size is None:
        raise ArgumentError("image_size", "is not known", "(width, height), or tracks with sizes")
    given = as_array("image_size", size, "(width, height)")
    known = given.dtype.kind in "iu" and given.shape in ((2,), (tracks.n_views, 2))
    if not known or (given < 1).any():
        needed = f"positive integers (2,) or ({tracks.n_views}, 2)"
        raise ArgumentError("image_size", f"is {given.dtype} {given.shape}", needed)
    sizes = np.broadcast_to(given, (tracks.n_views, 2))
    # Cameras may have taken images of several sizes.
    both = np.column_stack([cameras.camera_of_view, sizes])
    kinds, camera_of_view = np.unique(both, axis=0, return_inverse=True)
    f, k1, k2 = cameras.params[kinds[:, 0]].T
    params = np.column_stack([f, kinds[:, 1:] / 2.0, k1, k2])
    made = Cameras("RADIAL", params, camera_of_view.reshape(-1))
    xy = tracks.xy * np.array([1.0, -1.0]) + sizes[tracks.view] / 2.0
    labels = {"names": tracks.names, "sizes": sizes, "colours": tracks.colours}
    return _with(tracks, xy, **labels), _turned(reconstruction, made)


def colmap_to_bal(
    tracks: Tracks, reconstruction: MetricReconstruction
) -> tuple[Tracks, MetricReconstruction]:
    """Return a scene of COLMAP's radial cameras as one of BAL's, a camera a view.

    Names, sizes and colours, which a BAL file has no place for, are left out.

    Parameters
    ----------
    tracks : Tracks
        Observations in COLMAP's pixels.
    reconstruction : MetricReconstruction
        Cameras of the model SIMPLE_PINHOLE, SIMPLE_RADIAL or RADIAL.

    Returns
    -------
    Tracks, MetricReconstruction
        The same images, pixels counted from each principal point; with residuals of the same size.

    Raises
    ------
    ArgumentError
        If the cameras are others: BAL's have one focal length and two radial coefficients.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks, scene = eg.load_scene("sparse/0")  # doctest: +SKIP
    >>> eg.save_scene("problem.txt.bz2", *eg.interop.colmap_to_bal(tracks, scene))  # doctest: +SKIP
    """
    cameras = reconstruction.cameras
    if cameras.model not in _RADIAL:
        was = f"has cameras of the model {cameras.model!r}"
        raise ArgumentError("reconstruction", was, f"one of {', '.join(_RADIAL)}")
    of_views = cameras.of_views
    params = np.zeros((tracks.n_views, 3))
    params[:, 0] = of_views[:, 0]
    params[:, 1 : 1 + _RADIAL[cameras.model]] = of_views[:, 3:]
    xy = (tracks.xy - of_views[tracks.view, 1:3]) * np.array([1.0, -1.0])
    made = Cameras("bal", params, np.arange(tracks.n_views))
    return _with(tracks, xy), _turned(reconstruction, made)


def _turned(reconstruction: MetricReconstruction, cameras: Cameras) -> MetricReconstruction:
    R, t = _TURN @ reconstruction.R, reconstruction.t @ _TURN
    return MetricReconstruction(R, t, reconstruction.X, cameras, reconstruction.lines)


def _with(tracks: Tracks, xy: Array, **labels: Any) -> Tracks:
    """Return the tracks at other pixels; what they were read from no longer holds."""
    made = Tracks(
        tracks.view,
        tracks.point,
        xy,
        tracks.n_views,
        tracks.n_points,
        tracks.weights,
        repeated=True,
        min_points=1,
        **labels,
    )
    made.unit, made.whitening = tracks.unit, tracks.whitening
    if made.whitening is not None:  # y is counted the other way
        turn = np.array([1.0, -1.0])
        made.whitening = turn[:, None, None] * made.whitening * turn[:, None]
    return made
