"""What follows from lines of a calibrated scene: distances of points from them, and angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge.errors import ArgumentError
from epigauge.uncertainty.gauge_free import GaugeFree

__all__ = ["GaugeFreeLines"]

Array = NDArray[np.float64]

#: Smaller ones, of the length of what they are differences of, are rounding.
_ROUNDING = 1e-12


class GaugeFreeLines(GaugeFree):
    """Propagation of the covariances of lines and points."""

    def line_distance(self, point: int, line: int) -> tuple[float, float]:
        """Return the distance of a point from a line and its standard deviation.

        Parameters
        ----------
        point, line : int
            Which.

        Returns
        -------
        tuple of float
            In the unit of the scene. As of `distance`, the deviation is the same in every datum
            where the scale is held. It is that of a distance that is large beside its deviation.

        Raises
        ------
        ArgumentError
            On parts that do not exist, or a point on the line.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> lines = scene.line_tracks
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose")
        >>> found = result.reconstruction
        >>> spread = eg.covariance(scene.tracks, found, lines=lines, refine="pose")
        >>> distance, deviation = spread.line_distance(0, 1)
        >>> 0.0 < deviation < distance
        True
        """
        self._part("point", ("point", point))
        X, L = self.reconstruction.X[point], self._one("line", line)
        distance, slope = (part.ravel() for part in kernels.table().point_line_distance(X, L))
        if not distance[0] > _ROUNDING * (np.linalg.norm(X) + np.linalg.norm(L[:3])):
            raise ArgumentError(
                "point", f"is {point}, which is on the line {line}", "one beside it"
            )
        return float(distance[0]), self._sigma([("point", point), ("line", line)], slope)

    def line_angle(self, i: int, j: int) -> tuple[float, float]:
        """Return the angle of two lines, at most 90 degrees, and its deviation, in any datum.

        Parameters
        ----------
        i, j : int
            Lines.

        Returns
        -------
        tuple of float
            In radians. The deviation is that of an angle that is large beside it, and as far from
            a right one, where it turns around.

        Raises
        ------
        ArgumentError
            On lines that do not exist, or parallel ones.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(n_views=4, n_lines=2)
        >>> lines = scene.line_tracks
        >>> result = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose")
        >>> found = result.reconstruction
        >>> spread = eg.covariance(scene.tracks, found, lines=lines, refine="pose")
        >>> angle, deviation = spread.line_angle(0, 1)
        >>> 0.0 < deviation < angle
        True
        """
        first, second = self._one("i", i), self._one("j", j)
        if not np.linalg.norm(np.cross(first[3:], second[3:])) > _ROUNDING:
            raise ArgumentError("i, j", f"are parallel lines ({i}, {j})", "lines at an angle")
        angle, slope = (part.ravel() for part in kernels.table().line_angle(first, second))
        return float(angle[0]), self._sigma([("line", i), ("line", j)], slope)

    def _one(self, name: str, index: int) -> Array:
        self._part(name, ("line", index))
        lines = self.reconstruction.lines
        assert lines is not None
        return np.asarray(lines[index])
