"""Measured segments of lines in many views, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import MAX_PX, MIN_PX, as_array, as_count, as_real
from epigauge._results import Result
from epigauge.errors import ArgumentError
from epigauge.multi_view.labels import view_names

if TYPE_CHECKING:
    from epigauge.cameras import MetricReconstruction
    from epigauge.multi_view.reconstruction import Reconstruction

__all__ = ["LineTracks"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Views that a line needs: one plane through a camera holds many lines.
MIN_VIEWS = 2

#: Shortest segment, in standard deviations of its end points: a shorter one has no direction.
_SHORT = 3.0


class LineTracks(Result):
    """Observations of lines: a segment of line `line[k]` is measured in view `view[k]`.

    The end points of a segment are on the image of the line, but need not be those of another view.

    Parameters
    ----------
    view, line : array_like of int, shape (N,)
        Indices from 0; every line is seen by two views at least.
    segments : array_like, shape (N, 4)
        Pixels x1, y1, x2, y2 of both end points.
    n_lines : int, optional
        Number of lines; by default the largest index plus one.
    sigma : float or array_like, shape (N,), optional
        Standard deviation of each coordinate of the end points, in pixels; one by default.
    covariance : array_like, shape (N, 2, 2, 2), optional
        Covariances of the two end points instead, in square pixels.
    names : sequence of str, optional
        Names of the lines, all different.

    Attributes
    ----------
    view, line, segments : ndarray
        The same, sorted by line, then view; read-only.
    spread : ndarray, shape (N, 6)
        Covariances xx, xy, yy of the first and of the second end point.
    order : ndarray of int, shape (N,)
        Row of the input that each sorted row comes from.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN, indices out of range or never used, a line given twice in a view or in
        fewer than two views, segments shorter than three standard deviations of their end points,
        and covariances that are not positive definite; the message names rows or lines.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.LineTracks([0, 1], [0, 0], [[10, 20, 300, 40], [12, 50, 310, 60]])
    LineTracks(1 lines, 2 observations)
    """

    def __init__(
        self,
        view: ArrayLike,
        line: ArrayLike,
        segments: ArrayLike,
        n_lines: int | None = None,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        views, lines = _indices("view", view), _indices("line", line)
        ends = np.array(as_real("segments", segments, "an (N, 4) array"), dtype=np.float64)
        if ends.shape != (len(views), 4):
            raise ArgumentError("segments", f"has shape {ends.shape}", f"({len(views)}, 4)")
        if len(lines) != len(views):
            raise ArgumentError("line", f"has {len(lines)} rows", f"{len(views)}, as view")
        if not len(views):
            raise ArgumentError("view", "is empty", "at least two observations of a line")
        bad = np.flatnonzero(~(np.abs(ends) <= MAX_PX).all(axis=1))
        if len(bad):
            what = "too large" if np.isfinite(ends[bad[0]]).all() else "not finite"
            raise ArgumentError(
                "segments", f"is {what} in row {bad[0]}", f"pixels below {MAX_PX:g}"
            )
        self.n_lines = int(lines.max()) + 1 if n_lines is None else as_count("n_lines", n_lines)
        if self.n_lines <= lines.max():
            raise ArgumentError("line", f"names {lines.max()}", f"0 to {self.n_lines - 1}")
        spread = _spread(sigma, covariance, len(views))
        _check_lengths(ends, spread)
        self.order: Indices = np.lexsort((views, lines))
        self.view: Indices = views[self.order]
        self.line: Indices = lines[self.order]
        self.segments: Array = ends[self.order]
        self.spread: Array = spread[self.order]
        again = (np.diff(self.line) == 0) & (np.diff(self.view) == 0)
        if again.any():
            k = int(np.argmax(again))
            was = f"name view {self.view[k]}, line {self.line[k]} twice"
            rows = f" (rows {self.order[k]} and {self.order[k + 1]})"
            raise ArgumentError("view, line", was + rows, "one segment of a line in a view")
        # Of more lines than rows some of the first are seen too rarely: no longer array is made.
        few = min(self.n_lines, len(lines))
        weak = np.flatnonzero(np.bincount(lines[lines < few], minlength=few) < MIN_VIEWS)
        if len(weak):
            named = ", ".join(map(str, weak[:5])) + (", ..." if len(weak) > 5 else "")
            needed = "lines seen by two views at least: one view leaves a plane of lines"
            raise ArgumentError("line", f"{named} is seen by fewer than two views", needed)
        self.names = None if names is None else view_names(names, self.n_lines)
        for array in (self.order, self.view, self.line, self.segments, self.spread):
            array.setflags(write=False)

    def pieces(self, reconstruction: MetricReconstruction | Reconstruction) -> Array:
        """Return what the segments show of each line, to be drawn.

        Parameters
        ----------
        reconstruction : MetricReconstruction or Reconstruction
            Cameras and lines.

        Returns
        -------
        ndarray, shape (L, 2, 3) or (L, 2, 4)
            Ends of a piece of each line: a quarter of the views sees more at either end. In a
            projective basis homogeneous, of length one.

        Raises
        ------
        ArgumentError
            If it has other lines, or fewer views.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.line_scene(seed=1)
        >>> scene.line_tracks.pieces(scene.true).shape
        (60, 2, 3)
        """
        from epigauge.multi_view.line_segments import line_pieces

        return line_pieces(self, reconstruction)

    def __len__(self) -> int:
        """Return the number of observations."""
        return len(self.view)

    def __repr__(self) -> str:
        return f"LineTracks({self.n_lines} lines, {len(self)} observations)"

    def _contents(self) -> dict[str, Any]:
        names = ("n_lines", "view", "line", "segments", "spread", "names")
        return {name: getattr(self, name) for name in names}

    def _summary_rows(self) -> dict[str, str]:
        seen = np.bincount(self.line, minlength=self.n_lines)
        text = f"{seen.min()} to {seen.max()}, {seen.mean():.3g} on the average"
        return {"views of a line": text}

    def _heading(self) -> str:
        return repr(self)


def _indices(name: str, value: ArrayLike) -> Indices:
    array = as_array(name, value, "integers (N,)")
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise ArgumentError(name, f"is {array.dtype} {array.shape}", "integers (N,)")
    if array.size and array.min() < 0:
        raise ArgumentError(name, f"is {array.min()} in row {array.argmin()}", "indices from 0")
    return array.astype(np.intp)


def _spread(sigma: ArrayLike | None, covariance: ArrayLike | None, count: int) -> Array:
    """Return covariances of end points as rows (N, 6)."""
    if covariance is None:
        array = np.asarray(as_real("sigma", 1.0 if sigma is None else sigma, "a number or (N,)"))
        if array.shape not in ((), (count,)):
            raise ArgumentError("sigma", f"has shape {array.shape}", f"({count},)")
        both = np.broadcast_to(array, (count,))
        bad = np.flatnonzero(~((both >= MIN_PX) & (both <= MAX_PX)))
        if len(bad):
            needed = f"positive numbers, {MIN_PX:g} to {MAX_PX:g}"
            raise ArgumentError("sigma", f"is {both[bad[0]]} in row {bad[0]}", needed)
        return np.asarray(both[:, None] ** 2 * np.array([1.0, 0.0, 1.0, 1.0, 0.0, 1.0]))
    if sigma is not None:
        raise ArgumentError("covariance", "is given beside sigma", "one of them")
    S = np.asarray(as_real("covariance", covariance, "an (N, 2, 2, 2) array"))
    if S.shape != (count, 2, 2, 2):
        raise ArgumentError("covariance", f"has shape {S.shape}", f"({count}, 2, 2, 2)")
    even = np.abs(S - np.swapaxes(S, 2, 3)).max(axis=(1, 2, 3)) <= 1e-9 * np.abs(S).max((1, 2, 3))
    positive = np.isfinite(S).all(axis=(1, 2, 3)) & even
    values = np.linalg.eigvalsh(S[positive])
    positive[positive] = (values >= MIN_PX**2).all((1, 2)) & (values <= MAX_PX**2).all((1, 2))
    if not positive.all():
        was = f"is no covariance in row {int(np.argmin(positive))}"
        raise ArgumentError("covariance", was, "symmetric, positive definite matrices")
    return np.asarray(S.reshape(count, 8)[:, [0, 1, 3, 4, 5, 7]])


def _check_lengths(ends: Array, spread: Array) -> None:
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    least = _SHORT * np.sqrt(np.maximum(spread[:, [0, 3]], spread[:, [2, 5]]).max(axis=1))
    short = np.flatnonzero(length < least)
    if len(short):
        k = short[0]
        was = f"is {length[k]:.3g} px long in row {k}"
        raise ArgumentError("segments", was, f"at least {least[k]:.3g} px, three deviations")
