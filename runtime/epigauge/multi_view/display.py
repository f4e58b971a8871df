"""A basis in which a projective reconstruction looks like the scene, for pictures and exchange.

A projective reconstruction has no angles and no lengths. To be looked at it needs a plane at
infinity and a conic on it; `plausible_basis` guesses them from what most cameras and scenes have.
This is **no calibration**: nothing is estimated to any accuracy, and no number must be measured
in it.

Left and right are not guessed. A mirrored scene in front of mirrored cameras gives the same image
points, but a camera takes no mirror images: where all depths are positive the determinant of P's
left 3x3 part is, too, provided that the images have x to the right and y down. Only the caller
can know that; with y up it is the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import AffineReconstruction, AnyReconstruction, MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import normalized
from epigauge.multi_view.plausible import camera_deviations, depth_signs, plausible_basis
from epigauge.multi_view.tracks import Tracks

__all__ = ["Display", "camera_spacing", "display", "is_sequence"]

Array = NDArray[np.float64]

#: Points farther from the middle are not shown, cameras farther away moved in.
FAR_POINT, FAR_CAMERA = 8.0, 6.0
#: A median camera farther from a usual one, in usual deviations, makes no plausible picture.
_DISTORTED = 2.0


@dataclass(frozen=True)
class Display:
    """Points and cameras to look at; no calibration.

    The unit of length is the usual distance of a point from their middle, which is the origin. The
    cameras' mean up is z, and they look along y on the average; x, y, z are right-handed.

    Attributes
    ----------
    points : ndarray, shape (m, 3)
        Points; not finite at infinity.
    centres : ndarray, shape (n, 3)
        Centres of the cameras; those farther than `FAR_CAMERA` are put there, in their direction.
    corners : ndarray, shape (n, 4, 3)
        For each camera the directions in which it sees the corners of its image, or where its size
        is not known of what the views show: left top, right top, right bottom, left bottom.
    ahead : ndarray of bool, shape (m,)
        Finite points in front of all cameras that see them.
    shown : ndarray of bool, shape (m,)
        Those of them near the others.
    deviation : float
        How far the median camera is from a usual one, in usual deviations.
    T : ndarray, shape (4, 4)
        Change of basis: cameras P T, points T^-1 Q.
    y_up : bool
        Whether y points up in the images.
    """

    points: Array
    centres: Array
    corners: Array
    ahead: NDArray[np.bool_]
    shown: NDArray[np.bool_]
    deviation: float
    T: Array
    y_up: bool

    def placed(self, X: Array) -> Array:
        """Return where points (k, 3), or homogeneous ones (k, 4), are shown, (k, 3)."""
        if X.shape[1] == 3:
            X = np.concatenate([X, np.ones((len(X), 1))], axis=1)
        Q = np.linalg.solve(self.T, X.T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(Q[:, :3] / Q[:, 3:])

    def placed_pieces(self, pieces: Array) -> Array:
        """Return where pieces of lines are shown, (l, 2, 3), without those that go far away."""
        ends = self.placed(pieces.reshape(-1, pieces.shape[-1])).reshape(-1, 2, 3)
        return ends[(np.abs(ends) < FAR_POINT).all(axis=(1, 2))]

    @property
    def distorted(self) -> bool:
        """Whether so many cameras look unusual that the scene must be distorted, or they are."""
        return self.deviation > _DISTORTED


def display(reconstruction: AnyReconstruction, tracks: Tracks, *, y_up: bool = False) -> Display:
    """Choose a basis in which a reconstruction looks plausible and is not mirrored.

    Parameters
    ----------
    reconstruction : Reconstruction or MetricReconstruction
        Cameras and points, in any basis. A metric one keeps its shape.
    tracks : Tracks
        What they were made from.
    y_up : bool
        Whether the y axis of the images points up, as in BAL files, rather than down. Given
        wrongly, the scene is mirrored.

    Returns
    -------
    Display
        What to draw. It is no calibration.

    Raises
    ------
    ArgumentError
        If the cameras or points are too degenerate, or the cameras affine.

    Notes
    -----
    Where the views are nearly affine (a small scene far away) many bases are as plausible: the one
    chosen may stretch the scene in depth.
    """
    if isinstance(reconstruction, AffineReconstruction):
        was = "has affine cameras, which have no centres to show"
        needed = "eg.bundle_adjust(tracks, reconstruction.to_projective()).reconstruction"
        raise ArgumentError("reconstruction", was, needed)
    low, high = tracks.xy.min(axis=0), tracks.xy.max(axis=0)
    unit = float(np.sum(high - low))
    to_pixels = np.diag([unit, -unit if y_up else unit, 1.0])
    to_pixels[:2, 2] = (low + high) / 2.0
    half = (high - low) / 2.0 / unit
    box = half * [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    if tracks.sizes is not None and not y_up:  # all that the images show
        sides = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * np.asarray(tracks.sizes)[:, None, :]
        box = (sides - 0.5 - (low + high) / 2.0) / unit
    if isinstance(reconstruction, MetricReconstruction):
        seen = reconstruction.to_projective()
        P, behind = np.linalg.solve(to_pixels, seen.P), ~(reconstruction.depths(tracks) > 0.0)
        return _placed(np.asarray(P), seen.Q, tracks, behind, box, np.eye(4), y_up, 0.0)
    there = normalized().transformation(reconstruction.P, reconstruction.Q)
    P, Q = there.apply(np.asarray(np.linalg.solve(to_pixels, reconstruction.P)), reconstruction.Q)
    try:
        T = plausible_basis(P, Q, tracks.view, tracks.point)
    except np.linalg.LinAlgError:
        raise ArgumentError(
            "reconstruction", "cannot be shown", "cameras of rank 3, points in different places"
        ) from None
    P, Q = P @ T, np.asarray(np.linalg.solve(T, Q.T).T)
    behind = depth_signs(P, Q[tracks.point], tracks.view) <= 0.0
    deviation = float(np.median(np.linalg.norm(camera_deviations(P), axis=0)))
    return _placed(P, Q, tracks, behind, box, there.T @ T, y_up, deviation)


def _placed(
    P: Array,
    Q: Array,
    tracks: Tracks,
    behind: NDArray[np.bool_],
    box: Array,
    T: Array,
    y_up: bool,
    deviation: float,
) -> Display:
    """Put cameras and points of a basis T upright about the middle of the points."""
    ahead = np.bincount(tracks.point, behind, minlength=len(Q)) == 0
    upright = _upright(P, Q[ahead] if ahead.any() else Q)
    P, Q = P @ upright, np.asarray(np.linalg.solve(upright, Q.T).T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = Q[:, :3] / Q[:, 3:]
        near = np.linalg.norm(points, axis=1) < FAR_POINT
    centres, corners = _pyramids(P, box)
    distances = np.linalg.norm(centres, axis=1, keepdims=True)
    return Display(
        points=points,
        centres=centres * (FAR_CAMERA / np.maximum(distances, FAR_CAMERA)),
        corners=corners,
        ahead=ahead,
        shown=ahead & near,
        deviation=deviation,
        T=T @ upright,
        y_up=y_up,
    )


def camera_spacing(centres: Array) -> float:
    """Return the median distance of a camera from the nearest other one."""
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    return float(np.median(distances.min(axis=0)))


def is_sequence(centres: Array) -> bool:
    """Return whether cameras follow one another, as in a film, so that a line may join them."""
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    return bool(np.median(steps) < 2.0 * camera_spacing(centres))


def _upright(P: Array, Q: Array) -> Array:
    """Return the similarity to the points' middle, their usual distance from it, and z up."""
    points = Q[:, :3] / Q[:, 3:]
    middle = np.median(points, axis=0)
    size = float(np.median(np.linalg.norm(points - middle, axis=1)))
    M = P[:, :, :3] * np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    ahead = np.mean(M[:, 2] / np.linalg.norm(M[:, 2], axis=1, keepdims=True), axis=0)
    # Down the image is the second row of the rotation.
    z, y = M[:, 2], M[:, 1]
    down = y - np.sum(y * z, axis=1, keepdims=True) / np.sum(z * z, axis=1, keepdims=True) * z
    up = -np.mean(down / np.linalg.norm(down, axis=1, keepdims=True), axis=0)
    # ahead ~ y as far as up = z allows, and a fixed axis where cameras look all around.
    up = up / (np.linalg.norm(up) or 1.0)
    if np.linalg.norm(np.cross(up, ahead)) < 1e-3:
        ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(ahead, up)
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = size * np.column_stack([x, np.cross(up, x), up])
    T[:3, 3] = middle
    return T


def _pyramids(P: Array, box: Array) -> tuple[Array, Array]:
    """Return centres, and directions to the corners of a box in the images, or one in each."""
    M = P[:, :, :3] * np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    centres = -(np.linalg.inv(P[:, :, :3]) @ P[:, :, 3:])[:, :, 0]
    box = np.broadcast_to(box, (len(P), 4, 2))
    corners = np.concatenate([box, np.ones((len(P), 4, 1))], axis=2)
    directions = np.einsum("nij,ncj->nci", np.linalg.inv(M), corners)
    return centres, directions / np.linalg.norm(directions, axis=2, keepdims=True)
