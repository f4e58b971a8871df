"""Gaussian priors on positions, rotations, intrinsics, points and distances.

Each adds 0.5 e^T covariance^-1 e to the cost, e the deviation from what is known. Observations
count with the `noise_px` of `bundle_adjust`: by default the `sigma` of the tracks or, without one,
as if measured with one pixel (and weight one).

Rows of points, and their tangents, may be longer than three, as features are where lines stand
beside points: it is the first three entries that priors are on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import as_real
from epigauge.bundle.linearizer import Normal
from epigauge.bundle.prior_kinds import (
    Distance,
    IntrinsicPrior,
    PointPrior,
    PositionPrior,
    Prior,
    RotationPrior,
)
from epigauge.bundle.similarity import Similarity
from epigauge.bundle.solve import Border
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.rotations import as_rotation, quaternion

__all__ = ["Priors"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Least ratio of the axes of a covariance.
_CONDITION = 1e-12


@dataclass(frozen=True)
class Priors:
    """Priors as arrays.

    Attributes
    ----------
    views, positions, view_information : ndarray, shape (k,), (k, 3), (k, 3, 3)
        Known centres with their inverse covariance.
    turned, rotations, turn_information : ndarray, shape (i,), (i, 3, 3), (i, 3, 3)
        Views with known rotations.
    points, places, point_information : ndarray, shape (l,), (l, 3), (l, 3, 3)
        Known points.
    cameras : ndarray of int, shape (j,)
        The first view of each camera with a known parameter: shared by all its views, a prior
        counts once.
    params, values, precisions : ndarray, shape (j,)
        Which parameter, its value and inverse variance.
    ends : ndarray of int, shape (d, 2)
        Points whose distance is known.
    lengths, length_precisions : ndarray, shape (d,)
        Their distances, and inverse variances.
    """

    views: Indices
    positions: Array
    view_information: Array
    turned: Indices
    rotations: Array
    turn_information: Array
    points: Indices
    places: Array
    point_information: Array
    cameras: Indices
    params: Indices
    values: Array
    precisions: Array
    ends: Indices
    lengths: Array
    length_precisions: Array

    @staticmethod
    def of(priors: Sequence[Prior], start: MetricReconstruction) -> Priors:
        """Check priors against the reconstruction that they are on.

        Raises
        ------
        ArgumentError
            On anything but priors, and on priors on what does not exist; the message has their
            number.
        """
        names = camera_model(start.cameras.model).adjusted
        places: dict[type, list[tuple[int, Array, Array]]] = {
            kind: [] for kind in (PositionPrior, RotationPrior, PointPrior)
        }
        intrinsics: list[tuple[int, int, float, float]] = []
        distances: list[tuple[int, int, float, float]] = []
        for number, prior in enumerate(priors):
            what = f"priors[{number}]"
            if isinstance(prior, PositionPrior):
                view = _index(f"{what}.view", prior.view, start.n_views)
                position = _position(f"{what}.position", prior.position)
                places[PositionPrior].append((view, position, _information(what, prior)))
            elif isinstance(prior, RotationPrior):
                view = _index(f"{what}.view", prior.view, start.n_views)
                rotation = as_rotation(f"{what}.rotation", prior.rotation)
                places[RotationPrior].append((view, rotation, _information(what, prior)))
            elif isinstance(prior, PointPrior):
                point = _index(f"{what}.point", prior.point, start.n_points)
                position = _position(f"{what}.position", prior.position)
                places[PointPrior].append((point, position, _information(what, prior)))
            elif isinstance(prior, IntrinsicPrior):
                camera = _index(f"{what}.camera", prior.camera, len(start.cameras))
                if prior.name not in names:
                    known = f"one of {', '.join(names)}" if names else "none: it has no parameters"
                    raise ArgumentError(f"{what}.name", f"is {prior.name!r:.60}", known)
                value = _number(f"{what}.value", prior.value)
                sigma = _positive(f"{what}.sigma", prior.sigma)
                first = int(np.argmax(start.cameras.camera_of_view == camera))
                intrinsics.append((first, names.index(prior.name), value, sigma**-2))
            elif isinstance(prior, Distance):
                first = _index(f"{what}.point1", prior.point1, start.n_points)
                second = _index(f"{what}.point2", prior.point2, start.n_points)
                if np.array_equal(start.X[first], start.X[second]):
                    raise ArgumentError(what, "is between points at one place", "points apart")
                length = _positive(f"{what}.length", prior.length)
                sigma = _positive(f"{what}.sigma", prior.sigma)
                distances.append((first, second, length, sigma**-2))
            else:
                known = "eg.PositionPrior, RotationPrior, IntrinsicPrior, PointPrior or Distance"
                raise ArgumentError(what, f"is a {type(prior).__name__}", known)
        j = np.array([row[:2] for row in intrinsics], np.intp).reshape(-1, 2)
        v = np.array([row[2:] for row in intrinsics]).reshape(-1, 2)
        views = _stacked(places[PositionPrior], (3,))
        turns = _stacked(places[RotationPrior], (3, 3))
        points = _stacked(places[PointPrior], (3,))
        ends = np.array([row[:2] for row in distances], np.intp).reshape(-1, 2)
        of_ends = np.array([row[2:] for row in distances]).reshape(-1, 2)
        at, numbers = (j[:, 0], j[:, 1]), (v[:, 0], v[:, 1])
        lengths = of_ends[:, 0], of_ends[:, 1]
        return Priors(*views, *turns, *points, *at, *numbers, ends, *lengths)

    def __len__(self) -> int:
        """Return how many there are."""
        return sum(map(len, (self.views, self.turned, self.points, self.cameras, self.ends)))

    @property
    def n_numbers(self) -> int:
        """Return how many numbers are known."""
        vectors = len(self.views) + len(self.turned) + len(self.points)
        return 3 * vectors + len(self.cameras) + len(self.ends)

    def weighted(self, weight: float) -> Priors:
        """Return the same where observations of weight one have the variance `weight`."""
        return replace(
            self,
            view_information=weight * self.view_information,
            turn_information=weight * self.turn_information,
            point_information=weight * self.point_information,
            precisions=weight * self.precisions,
            length_precisions=weight * self.length_precisions,
        )

    def moved(self, there: Similarity) -> Priors:
        """Return the same in another frame, moved as the reconstruction is."""
        return replace(
            self,
            positions=there.positions(self.positions),
            rotations=self.rotations @ there.rotation.T,
            places=there.positions(self.places),
            view_information=there.information(self.view_information),
            point_information=there.information(self.point_information),
            lengths=there.scale * self.lengths,
            length_precisions=self.length_precisions / there.scale**2,
        )

    def cost(self, cameras: Array, points: Array) -> float:
        """Return what they add to the cost."""
        c, x, k = self._deviations(cameras, points)
        total = np.einsum("ki,kij,kj->", c, self.view_information, c)
        w = self._turns(cameras)[0]
        total = total + np.einsum("ki,kij,kj->", w, self.turn_information, w)
        total = total + np.einsum("ki,kij,kj->", x, self.point_information, x)
        away = self._along(points)[1] - self.lengths
        total = total + np.sum(self.length_precisions * away**2)
        return 0.5 * float(total + np.sum(self.precisions * k**2))

    def added(self, normal: Normal, cameras: Array, points: Array) -> Normal:
        """Return normal equations with theirs."""
        if not len(self):
            return normal
        U, V = normal.U.copy(), normal.V.copy()
        g_cameras, g_points = normal.g_cameras.copy(), normal.g_points.copy()
        c, x, k = self._deviations(cameras, points)
        # The centre moves by R^T times the camera's move, the tangent's entries 3 to 5.
        R = cameras[self.views, :12].reshape(-1, 3, 4)[:, :, :3]
        moved = R @ self.view_information
        np.add.at(U[:, 3:6, 3:6], self.views, moved @ np.swapaxes(R, 1, 2))
        np.add.at(g_cameras[:, 3:6], self.views, np.einsum("kij,kj->ki", moved, c))
        w, slope = self._turns(cameras)
        turned = np.swapaxes(slope, 1, 2) @ self.turn_information
        np.add.at(U[:, :3, :3], self.turned, turned @ slope)
        np.add.at(g_cameras[:, :3], self.turned, np.einsum("kij,kj->ki", turned, w))
        np.add.at(U, (self.cameras, 6 + self.params, 6 + self.params), self.precisions)
        np.add.at(g_cameras, (self.cameras, 6 + self.params), self.precisions * k)
        np.add.at(V[:, :3, :3], self.points, self.point_information)
        np.add.at(g_points[:, :3], self.points, np.einsum("kij,kj->ki", self.point_information, x))
        along, lengths = self._along(points)
        pull = (self.length_precisions * (lengths - self.lengths))[:, None] * along
        np.add.at(g_points[:, :3], self.ends[:, 0], pull)
        np.add.at(g_points[:, :3], self.ends[:, 1], -pull)
        return replace(normal, U=U, V=V, g_cameras=g_cameras, g_points=g_points)

    def border(self, normal: Normal, points: Array) -> Border | None:
        """Return what known distances add to J^T J: they couple points."""
        if not len(self.ends):
            return None
        count = len(self.ends)
        columns = np.zeros((*normal.g_points.shape, count))
        along = np.sqrt(self.length_precisions)[:, None] * self._along(points)[0]
        columns[self.ends[:, 0], :3, np.arange(count)] = along
        columns[self.ends[:, 1], :3, np.arange(count)] = -along
        return Border(np.zeros((*normal.g_cameras.shape, count)), columns)

    def slopes(self, cameras: Array, points: Array, of_cameras: Array, of_points: Array) -> Array:
        """Return how what is known changes with motions, unweighted.

        Parameters
        ----------
        cameras, points : ndarray, shape (n, c), (m, 3)
            The estimate.
        of_cameras, of_points : ndarray, shape (n, d, g), (m, b, g)
            Motions of the gauge, as own tangents.

        Returns
        -------
        ndarray, shape (k, g)
            Rows: three a place, one any other number.
        """
        R = cameras[self.views, :12].reshape(-1, 3, 4)[:, :, :3]
        centres = np.swapaxes(R, 1, 2) @ of_cameras[self.views, 3:6]
        of_points, g = of_points[:, :3], of_points.shape[2]
        turns = self._turns(cameras)[1] @ of_cameras[self.turned, :3]
        blocks = [centres.reshape(-1, g), turns.reshape(-1, g)]
        blocks.append(of_points[self.points].reshape(-1, g))
        blocks.append(of_cameras[self.cameras, 6 + self.params])
        apart = of_points[self.ends[:, 0]] - of_points[self.ends[:, 1]]
        blocks.append(np.einsum("ki,kig->kg", self._along(points)[0], apart))
        return np.concatenate(blocks)

    def _along(self, points: Array) -> tuple[Array, Array]:
        """Return unit vectors from the second to the first end, and their distances."""
        apart = points[self.ends[:, 0], :3] - points[self.ends[:, 1], :3]
        lengths = np.linalg.norm(apart, axis=1)
        return apart / np.maximum(lengths, 1e-300)[:, None], lengths

    def _turns(self, cameras: Array) -> tuple[Array, Array]:
        """Return deviations of rotations (i, 3), and their derivatives by own turns (i, 3, 3).

        Of the quaternion (s, v) of R R_known^T the deviation is 2 v; turned by w, which is the
        quaternion (1, w / 2) to first order, it becomes 2 v + s w + w x v.
        """
        R = cameras[self.turned, :12].reshape(-1, 3, 4)[:, :, :3]
        q = quaternion(R @ np.swapaxes(self.rotations, 1, 2))
        q = np.where(q[:, :1] < 0.0, -q, q)
        s, v = q[:, 0], q[:, 1:]
        slope = s[:, None, None] * np.eye(3) + np.cross(v[:, None], np.eye(3))
        return 2.0 * v, np.asarray(slope)

    def _deviations(self, cameras: Array, points: Array) -> tuple[Array, Array, Array]:
        pose = cameras[self.views, :12].reshape(-1, 3, 4)
        centres = -np.einsum("kji,kj->ki", pose[:, :, :3], pose[:, :, 3])
        known = cameras[self.cameras, 12 + self.params]
        places = points[self.points, :3]
        return centres - self.positions, places - self.places, known - self.values


def _stacked(
    rows: list[tuple[int, Array, Array]], shape: tuple[int, ...]
) -> tuple[Indices, Array, Array]:
    return (
        np.array([row[0] for row in rows], np.intp),
        np.array([row[1] for row in rows]).reshape(-1, *shape),
        np.array([row[2] for row in rows]).reshape(-1, 3, 3),
    )


def _index(name: str, value: Any, count: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ArgumentError(name, f"is {value!r:.60}", "an integer")
    if not 0 <= value < count:
        raise ArgumentError(name, f"is {value}", f"0 to {count - 1}")
    return int(value)


def _number(name: str, value: Any) -> float:
    array = as_real(name, value, "a number")
    if array.ndim or not np.isfinite(array):
        raise ArgumentError(name, f"is {value!r:.60}", "a finite number")
    return float(array)


def _positive(name: str, value: Any) -> float:
    number = _number(name, value)
    if not number > 0.0:
        raise ArgumentError(name, f"is {number}", "a positive number")
    return number


def _position(name: str, value: ArrayLike) -> Array:
    position = as_real(name, value, "three numbers")
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ArgumentError(name, f"is {value!r:.60}", "three finite numbers")
    return position


def _information(what: str, prior: PositionPrior | RotationPrior | PointPrior) -> Array:
    """Return the inverse covariance, (3, 3)."""
    if (prior.sigma is None) == (prior.covariance is None):
        given = "neither" if prior.sigma is None else "both"
        raise ArgumentError(what, f"has {given} of sigma and covariance", "one of them")
    if prior.sigma is not None:
        sigma = as_real(f"{what}.sigma", prior.sigma, "one or three numbers")
        if sigma.shape not in ((), (3,)) or not (np.isfinite(sigma) & (sigma > 0.0)).all():
            raise ArgumentError(
                f"{what}.sigma", f"is {prior.sigma!r:.60}", "positive, one or three"
            )
        return np.diag(np.broadcast_to(sigma, 3) ** -2.0)
    name = f"{what}.covariance"
    assert prior.covariance is not None
    covariance = as_real(name, prior.covariance, "a (3, 3) matrix")
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise ArgumentError(name, f"has shape {covariance.shape}", "a finite (3, 3) matrix")
    size = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = covariance / np.outer(size, size) if (size > 0.0).all() else np.zeros((3, 3))
    if np.linalg.eigvalsh(unit)[0] <= _CONDITION or not np.allclose(unit, unit.T, atol=1e-9):
        raise ArgumentError(name, "is not symmetric and positive definite", "a covariance")
    return np.asarray(np.linalg.inv(0.5 * (covariance + covariance.T)))
