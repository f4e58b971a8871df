"""Covariances of calibrated cameras, their intrinsics and points, to first order in the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._results import Result
from epigauge.bundle.similarity import Similarity
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.uncertainty.datum import Projection, projection
from epigauge.uncertainty.gauge_free_lines import GaugeFreeLines
from epigauge.uncertainty.inverse import Inverse, Part, spread
from epigauge.uncertainty.sandwich import Sandwich

__all__ = ["MetricCovariance", "Std"]

Array = NDArray[np.float64]

#: Numbers of a camera's own tangent before its intrinsics: turn and move.
_POSE = 6


@dataclass(frozen=True)
class Std(Result):
    """Standard deviations.

    Attributes
    ----------
    rotations, centres : ndarray, shape (n, 3)
        Of the small rotation of each view about the axes of the scene, in radians, and of its
        centre, in the unit of the scene.
    intrinsics : ndarray, shape (c, k)
        Of the parameters of each camera, in their units; zero where they are not refined.
    points : ndarray, shape (m, 3)
        Of the points; infinite for one whose observations leave it open along its ray.
    lines : ndarray, shape (L, 6), or None
        Of the Pluecker coordinates of the lines; infinite for one that its segments leave open.
    """

    rotations: Array
    centres: Array
    intrinsics: Array
    points: Array
    lines: Array | None = None


@dataclass(frozen=True, eq=False)
class MetricCovariance(GaugeFreeLines, Result):
    """Covariances of a calibrated reconstruction in a datum.

    A view has six numbers: its small rotation about the axes of the scene (radians), and its
    centre. `camera`, `intrinsics`, `point`, `line` and `between` give any block; each is computed
    when it is asked for, and no matrix of all unknowns is formed. `distance`, `ratio`, `angle`,
    `relative_pose`, `line_distance`, `line_angle` and projections are propagated from these.

    Attributes
    ----------
    reconstruction : MetricReconstruction
        The estimate.
    noise_px : float
        Standard deviation of an image coordinate of weight one (in the unit of the tracks): given,
        or estimated as sqrt(sum of weighted squares / redundancy), priors included; under a robust
        loss from the right observations alone.
    redundancy : int
        Observations and priors beyond what the unknowns need.
    gauge : object
        The datum.
    open : int
        How many of the seven motions of the gauge the datum has to hold; priors and fixed views or
        points hold the rest.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.line_scene(n_views=4, n_lines=2)
    >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="pose")
    >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="pose")
    >>> spread.camera(0).shape, spread.point(3).shape
    ((6, 6), (3, 3))
    """

    reconstruction: MetricReconstruction
    noise_px: float
    redundancy: int
    gauge: Any
    open: int
    _inverse: Inverse | Sandwich
    _home: Similarity
    _rows: tuple[Array, Array]
    _of_lines: Array | None = None

    def _contents(self) -> dict[str, Any]:
        known = {name: getattr(self, name) for name in ("noise_px", "redundancy", "open")}
        gauge = self.gauge if isinstance(self.gauge, str) else type(self.gauge).__name__
        return known | {"gauge": gauge, "reconstruction": self.reconstruction, "std": self.std}

    def _summary_rows(self) -> dict[str, str]:
        known, std = self._contents(), self.std
        rows = {name: f"{known[name]}" for name in ("redundancy", "gauge", "open")}
        for name, unit in (("rotations", "rad"), ("centres", "units"), ("points", "units")):
            rows[f"std of {name}"] = f"{np.median(getattr(std, name)):.4g} {unit} in the median"
        if std.lines is not None:
            rows["std of lines"] = f"{np.median(std.lines[:, 3:]):.4g} of directions in the median"
        return {"noise_px": f"{self.noise_px:.6g}"} | rows

    def in_gauge(self, gauge: Any) -> MetricCovariance:
        """Return the covariance in another datum, from the same inverse.

        Parameters
        ----------
        gauge : "inner" or an object of eg.gauge
            As in `covariance`.

        Returns
        -------
        MetricCovariance
            In the datum; the reconstruction is the same.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.in_gauge(eg.gauge.inner([0, 1, 2])).point(0).shape
        (3, 3)
        """
        there = replace(self, gauge=gauge)
        _ = there._projection  # raises where the datum is none
        return there

    @cached_property
    def _projection(self) -> Projection:
        """What takes the inverse to the datum; intrinsics do without."""
        return projection(self.gauge, *self._rows, self._inverse)

    def camera(self, i: int) -> Array:
        """Return the covariance of the small rotation and the centre of a view.

        Parameters
        ----------
        i : int
            View.

        Returns
        -------
        ndarray, shape (6, 6)
            Radians about the axes of the scene, and the unit of the scene.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.camera(1).shape
        (6, 6)
        """
        return self.between(("camera", i), ("camera", i))

    def intrinsics(self, c: int) -> Array:
        """Return the covariance of the adjustable parameters of a camera.

        Parameters
        ----------
        c : int
            Row of `Cameras.params`.

        Returns
        -------
        ndarray, shape (k, k)
            Zero where a parameter is not refined.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.intrinsics(0).shape
        (3, 3)
        """
        return self.between(("intrinsics", c), ("intrinsics", c))

    def intrinsic_rows(self) -> list[tuple[int, str, float, float, str]]:
        """Return each refined parameter of the cameras with its standard deviation.

        Returns
        -------
        list of tuple
            Camera, name, value, standard deviation, unit.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.intrinsic_rows()[0][:2]
        (0, 'f')
        """
        cameras = self.reconstruction.cameras
        model = camera_model(cameras.model)
        found = []
        for c, (params, std) in enumerate(zip(cameras.params, self.std.intrinsics, strict=True)):
            for name, unit, value, sigma in zip(
                model.adjusted, model.units, params, std, strict=False
            ):
                if sigma > 0.0:
                    found.append((c, name, float(value), float(sigma), unit))
        return found

    @cached_property
    def centre_blocks(self) -> Array:
        """Return the covariances of the centres of all views, (n, 3, 3)."""
        return self.noise_px**2 * self._pose_blocks[:, 3:, 3:]

    @cached_property
    def point_blocks(self) -> Array:
        """Return the covariances of all points, (m, 3, 3); of those at infinity as computed."""
        return np.asarray(self.noise_px**2 * self._space @ self._local_points @ self._space.T)

    @cached_property
    def _local_points(self) -> Array:
        """Blocks of points as computed with, (m, 3, 3), without the noise."""
        return self._local_features[: self.reconstruction.n_points, :3, :3]

    @cached_property
    def _local_features(self) -> Array:
        """Blocks of points, and of lines after them, as computed with, without the noise."""
        low = self._projection
        return spread(self._inverse.diagonals[1], low.points, low.M)

    @cached_property
    def _own_blocks(self) -> Array:
        """Blocks of own tangents of all views, (n, d, d), without the noise."""
        low = self._projection
        return spread(self._inverse.diagonals[0], low.cameras, low.M)

    @cached_property
    def _pose_blocks(self) -> Array:
        own = self._own_blocks[:, :_POSE, :_POSE]
        return np.asarray(self._poses @ own @ np.swapaxes(self._poses, 1, 2))

    def point(self, j: int) -> Array:
        """Return the covariance of a point.

        Parameters
        ----------
        j : int
            Point.

        Returns
        -------
        ndarray, shape (3, 3)
            In the unit of the scene.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.point(3).shape
        (3, 3)
        """
        return self.between(("point", j), ("point", j))

    def line(self, k: int) -> Array:
        """Return the covariance of the Pluecker coordinates (n, v) of a line, v of length one.

        Parameters
        ----------
        k : int
            Line.

        Returns
        -------
        ndarray, shape (6, 6)
            Of rank four: n in the unit of the scene, about its origin.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> lines = scene.line_tracks
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose")
        >>> found = result.reconstruction
        >>> spread = eg.covariance(scene.tracks, found, lines=lines, refine="pose")
        >>> spread.line(1).shape
        (6, 6)
        """
        return self.between(("line", k), ("line", k))

    def line_update(self, k: int) -> Array:
        """Return the covariance of the update of a line in its orthonormal representation.

        It is written about the farthest centre of the cameras that see the line, and in units of
        the distance from there: U <- U R(x), W <- W R(phi) of Bartoli & Sturm (CVIU 2005). A
        similarity that takes scene and datum along leaves it as it is.

        Parameters
        ----------
        k : int
            Line.

        Returns
        -------
        ndarray, shape (4, 4)
            Of x in radians, and of phi: half the share by which the distance changes.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> lines = scene.line_tracks
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose")
        >>> found = result.reconstruction
        >>> spread = eg.covariance(scene.tracks, found, lines=lines, refine="pose")
        >>> spread.line_update(1).shape
        (4, 4)
        """
        self._part("k", ("line", k))
        part = (None, self.reconstruction.n_points + int(k))
        low = self._projection
        around = low.points[part[1]]
        block = self._inverse.block(part, part) + around @ low.M @ around.T
        return np.asarray(self.noise_px**2 * block)

    def between(self, a: tuple[str, int], b: tuple[str, int]) -> Array:
        """Return the covariance of any two parts.

        Parameters
        ----------
        a, b : tuple of str and int
            Such as ``("camera", 3)``, ``("intrinsics", 0)``, ``("point", 17)``, ``("line", 5)``.

        Returns
        -------
        ndarray
            Six numbers a camera, three a point, six a line (its Pluecker coordinates), one an
            adjustable parameter of intrinsics.

        Raises
        ------
        ArgumentError
            On parts that do not exist.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.between(("camera", 0), ("point", 3)).shape
        (6, 3)
        """
        first, second = self._part("a", a), self._part("b", b)
        block = self._inverse.block(first.part, second.part)
        if first.moves or second.moves:  # intrinsics alone are the same in every datum
            block = block + self._low(first) @ self._projection.M @ self._low(second).T
        return np.asarray(self.noise_px**2 * first.out @ block @ second.out.T)

    def joint(self, parts: Sequence[tuple[str, int]]) -> Array:
        """Return the covariance of several parts together.

        Parameters
        ----------
        parts : sequence of tuple of str and int
            As in `between`.

        Returns
        -------
        ndarray, shape (k, k)
            Their numbers one after another; propagate it by derivatives to whatever follows from
            them.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, refine="f")
        >>> spread = eg.covariance(scene.tracks, result.reconstruction, refine="f")
        >>> spread.joint([("camera", 0), ("point", 3)]).shape
        (9, 9)
        """
        return np.block([[self.between(a, b) for b in parts] for a in parts])

    @cached_property
    def std(self) -> Std:
        """Return the standard deviations of everything."""
        d = self._inverse.sizes[1]
        cameras = self.reconstruction.cameras
        first = np.unique(cameras.camera_of_view, return_index=True)[1]
        # The diagonal of S X S^T, X the covariance of a point.
        both = self._space[:, :, None] * self._space[:, None, :]
        turned = self._local_points.reshape(-1, 9) @ both.reshape(3, 9).T
        of_points = np.sqrt(np.maximum(self.noise_px**2 * turned, 0.0))
        of_points[self._inverse.at_infinity[: len(of_points)]] = np.inf
        own = _roots(self._own_blocks)[first, _POSE:d]
        of_poses = self.noise_px * _roots(self._pose_blocks)
        return Std(of_poses[:, :3], of_poses[:, 3:], self.noise_px * own, of_points, self._lines)

    @property
    def _lines(self) -> Array | None:
        """Standard deviations of Pluecker coordinates, (L, 6)."""
        out, m = self._of_lines, self.reconstruction.n_points
        if out is None:
            return None
        found = self.noise_px * _roots(out @ self._local_features[m:] @ np.swapaxes(out, 1, 2))
        found[self._inverse.at_infinity[m:]] = np.inf
        return found

    @cached_property
    def _poses(self) -> Array:
        """From own tangents (turn, move) to small rotation and centre in the scene, (n, 6, 6)."""
        R = np.swapaxes(self.reconstruction.R, 1, 2)
        found = np.zeros((len(R), _POSE, _POSE))
        # x_cam = exp(w) (R X + t - move): the view turns by -R^T w, its centre moves by R^T move.
        found[:, :3, :3] = -R
        found[:, 3:, 3:] = R / self._home.scale
        return found

    @cached_property
    def _space(self) -> Array:
        """From points as computed with to points of the scene, (3, 3)."""
        return np.asarray(self._home.rotation.T / self._home.scale)

    def _low(self, part: _Part) -> Array:
        view, point = part.part
        return np.asarray(
            self._projection.cameras[view] if point is None else self._projection.points[point]
        )

    def _part(self, name: str, value: Any) -> _Part:
        cameras = self.reconstruction.cameras
        counts = {
            "camera": self.reconstruction.n_views,
            "intrinsics": len(cameras),
            "point": self.reconstruction.n_points,
        }
        if self._of_lines is not None:
            counts["line"] = len(self._of_lines)
        try:
            kind, index = value
            count = counts[kind]
        except (TypeError, ValueError, KeyError):
            needed = f"a kind ({', '.join(counts)}) and a number, as ('point', 3)"
            raise ArgumentError(name, f"is {value!r:.60}", needed) from None
        integer = isinstance(index, int | np.integer) and not isinstance(index, bool)
        if not integer or not 0 <= index < count:
            raise ArgumentError(name, f"is {value!r:.60}", f"{kind} 0 to {count - 1}")
        index = int(index)
        if kind == "point":
            # Beside lines the tangent of a point has an entry that moves nothing.
            beside = 0 if self._of_lines is None else 1
            return _Part((None, index), np.pad(self._space, ((0, 0), (0, beside))))
        if kind == "line":
            assert self._of_lines is not None
            return _Part((None, self.reconstruction.n_points + index), self._of_lines[index])
        d = self._inverse.sizes[1]
        if kind == "camera":
            return _Part((index, None), np.pad(self._poses[index], ((0, 0), (0, d - _POSE))))
        first = int(np.argmax(cameras.camera_of_view == index))
        return _Part((first, None), np.eye(d)[_POSE:], moves=False)


def _roots(blocks: Array) -> Array:
    """Return the roots of the diagonals of blocks (k, b, b)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("kii->ki", blocks), 0.0)))


@dataclass(frozen=True)
class _Part:
    """A part of the inverse, and what its own tangents are multiplied by."""

    part: Part
    out: Array
    #: Whether motions of the gauge move it.
    moves: bool = True
