"""Measured image points of many views, checked once."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge._arguments import MAX_PX, MIN_PX, as_array, as_choice, as_count, as_double, as_weights
from epigauge._results import Result
from epigauge.errors import ArgumentError
from epigauge.multi_view.labels import image_sizes, point_colours, view_names
from epigauge.multi_view.measured import measured, merged_sums

if TYPE_CHECKING:
    from epigauge.io._common import PathLike

__all__ = ["Tracks"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: A view needs this many points, a point this many views, for its parameters to be determined.
MIN_POINTS, MIN_VIEWS = 6, 2


class Tracks(Result):
    """Observations: point `point[k]` is measured at `xy[k]` in view `view[k]`.

    Parameters
    ----------
    view, point : array_like of int, shape (N,)
        Indices from 0, each of them used.
    xy : array_like, shape (N, 2)
        Pixels.
    n_views, n_points : int, optional
        Numbers of views and points; by default the largest index plus one.
    weights : array_like, shape (N,), optional
        Factor of each squared residual.
    sigma : float or array_like, shape (N,) or (N, 2), optional
        Standard deviation of each measurement, or of its two coordinates, in the unit of `xy`.
        Weights are multiplied by (unit / sigma)^2, and priors count by their own `sigma` beside.
    covariance : array_like, shape (2, 2) or (N, 2, 2), optional
        Covariance of the two coordinates of each measurement instead, in the unit squared.
    names : sequence of str, optional
        Names of the views, as those of their files; all different.
    sizes : array_like of int, shape (n_views, 2), optional
        Width and height of each image in pixels.
    colours : array_like of int, shape (n_points, 3), optional
        Red, green, blue of each point, 0 to 255.
    repeated : bool
        Accept several observations of a point in one view, as COLMAP does.
    min_points : int
        Observations that a view needs: 6 for a projective camera, fewer for a calibrated one.
    source : object, optional
        What the file they come from said beyond this, for who writes them back.

    Attributes
    ----------
    view, point, xy, weights : ndarray
        The same, sorted by point, then view; read-only. The weights include `sigma`.
    unit : float
        Standard deviation of a coordinate of weight one: the median of `sigma`, or of the fourth
        roots of the determinants of `covariance`; 1 without.
    whitening : ndarray, shape (2, 2, N), or None
        What a residual is multiplied by beside its weight, matrices of determinant one; None where
        both coordinates are measured alike.
    names, sizes, colours, source
        As given, or None.
    order : ndarray of int, shape (N,)
        Row of the input that each sorted row comes from.
    n_repeated : int
        Observations of a point beyond the first in the same view.

    Raises
    ------
    ArgumentError
        On bad shapes, NaN, indices out of range or never used, a (view, point) pair given twice, a
        point seen in fewer than 2 views, a view with fewer than 6 points, tracks that fall
        into parts without a common point, and names, sizes or colours of another number; the
        message names rows. `Tracks.pruned` drops what is too weak instead.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.multi_view_scene(n_points=20, seed=1).tracks
    >>> eg.Tracks(scene.view, scene.point, scene.xy, names=list("abcde")).names
    ('a', 'b', 'c', 'd', 'e')
    """

    def __init__(
        self,
        view: ArrayLike,
        point: ArrayLike,
        xy: ArrayLike,
        n_views: int | None = None,
        n_points: int | None = None,
        weights: ArrayLike | None = None,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        sizes: ArrayLike | None = None,
        colours: ArrayLike | None = None,
        repeated: bool = False,
        min_points: int = MIN_POINTS,
        source: object = None,
    ) -> None:
        views, points = _indices("view", view), _indices("point", point)
        pixels = as_array("xy", xy, "an (N, 2) array")
        if pixels.dtype.kind not in "iuf" or pixels.shape != (len(views), 2):
            raise ArgumentError(
                "xy", f"is {pixels.dtype} {pixels.shape}", f"real numbers, ({len(views)}, 2)"
            )
        pixels = as_double(pixels)
        if len(points) != len(views):
            raise ArgumentError("point", f"has {len(points)} rows", f"{len(views)}, as view")
        if not len(views):
            raise ArgumentError("view", "is empty", "at least one observation")
        bad = np.flatnonzero(~(np.abs(pixels) <= MAX_PX).all(axis=1))
        if len(bad):
            what = "too large" if np.isfinite(pixels[bad[0]]).all() else "not finite"
            raise ArgumentError("xy", f"is {what} in row {bad[0]}", f"pixels below {MAX_PX:g}")
        if 0.0 < np.abs(pixels).max() < MIN_PX:
            raise ArgumentError("xy", f"is nowhere beyond {MIN_PX:g}", "another unit of length")
        self.n_views = _extent("view", views, n_views)
        self.n_points = _extent("point", points, n_points)
        self.order: Indices = np.lexsort((views, points))
        self.view: Indices = views[self.order]
        self.point: Indices = points[self.order]
        self.xy: Array = np.ascontiguousarray(pixels[self.order])
        w = np.ones(len(views)) if weights is None else as_weights(weights, len(views))
        self.unit, factors, whitening = measured(sigma, covariance, len(views))
        self.weights: Array = (w * factors)[self.order]
        self.whitening: Array | None = None if whitening is None else whitening[:, :, self.order]
        self.source = source
        self.n_repeated = int(self._again().sum())
        self._check(repeated, as_count("min_points", min_points, at_least=0))
        for array in (self.order, self.view, self.point, self.xy, self.weights):
            array.setflags(write=False)
        self.names = None if names is None else view_names(names, self.n_views)
        self.sizes = None if sizes is None else image_sizes(sizes, self.n_views)
        self.colours = None if colours is None else point_colours(colours, self.n_points)

    @classmethod
    def pruned(
        cls,
        view: ArrayLike,
        point: ArrayLike,
        xy: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        repeated: str | None = None,
    ) -> tuple[Tracks, Indices, Indices]:
        """Drop views and points with too few observations and renumber the rest.

        Parameters
        ----------
        view, point, xy, weights : array_like
            As for the constructor, with gaps allowed.
        repeated : {"first", "best", "drop"}, optional
            Of a point measured several times in one view, keep the first measurement, the one
            nearest to where the point's other views put it (by a reconstruction without the
            repeated ones; the first where that knows no such point), or none. By default such a
            pair is refused. Which rows are left: `order` of the tracks refers to the rows kept.

        Returns
        -------
        tracks : Tracks
            What is left.
        views, points : ndarray of int
            Old numbers of the views and points left.

        Raises
        ------
        ArgumentError
            As the constructor, of what is left.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> view, point = np.divmod(np.arange(60), 20)
        >>> tracks, views, points = eg.Tracks.pruned(view, 2 * point, np.ones((60, 2)))
        >>> views, points[:3]
        (array([0, 1, 2]), array([0, 2, 4]))
        """
        views, points = _indices("view", view), _indices("point", point)
        pixels = as_array("xy", xy, "an (N, 2) array")
        w = np.ones(len(views)) if weights is None else as_weights(weights, len(views))
        lengths = len(views), len(points), len(np.atleast_1d(pixels))
        if len(set(lengths)) > 1:
            have = "have {}, {} and {} rows".format(*lengths)
            raise ArgumentError("view, point, xy", have, "one row an observation")
        keep = np.ones(len(views), dtype=np.bool_)
        if repeated is not None:
            as_choice("repeated", repeated, ("first", "best", "drop"))
            keep = _once(views, points, repeated)
            if repeated == "best" and not keep.all():
                keep = _nearest(views, points, pixels, w, keep)
        # Without gaps first: what is counted below has one entry a number.
        all_views, views = np.unique(views, return_inverse=True)
        all_points, points = np.unique(points, return_inverse=True)
        while keep.any():
            per_view, per_point = np.bincount(views[keep]), np.bincount(points[keep])
            strong = keep.copy()
            strong[keep] = (per_view[views[keep]] >= MIN_POINTS) & (
                per_point[points[keep]] >= MIN_VIEWS
            )
            if (strong == keep).all():
                break
            keep = strong
        old_views, new_views = np.unique(views[keep], return_inverse=True)
        old_points, new_points = np.unique(points[keep], return_inverse=True)
        tracks = cls(new_views, new_points, pixels[keep], weights=w[keep])
        return tracks, all_views[old_views], all_points[old_points]

    def subset(
        self, keep: ArrayLike, *, min_points: int = MIN_POINTS
    ) -> tuple[Tracks, Indices, Indices]:
        """Return some of the observations; views and points without any are left out.

        Names, sizes, colours, weights and what whitens observations go along.

        Parameters
        ----------
        keep : array_like of bool, shape (N,)
            Which, in the order of the tracks (not of their input).
        min_points : int
            Observations that a view left needs, as for the constructor.

        Returns
        -------
        tracks : Tracks
            Those, renumbered; `order` refers to the rows kept.
        views, points : ndarray of int
            Old numbers of the views and points left.

        Raises
        ------
        ArgumentError
            If it is no mask, and as the constructor, of what is left.

        Examples
        --------
        >>> import epigauge as eg
        >>> tracks = eg.multi_view_scene(n_points=20, seed=1).tracks
        >>> some, views, points = tracks.subset(tracks.point < 12)
        >>> some, int(points.max())
        (Tracks(5 views, 12 points, 60 observations), 11)
        """
        mask = as_array("keep", keep, "a mask (N,)")
        if mask.dtype != np.bool_ or mask.shape != (len(self),):
            was = f"is {mask.dtype} {mask.shape}"
            raise ArgumentError("keep", was, f"a bool an observation, ({len(self)},)")
        if not mask.any():
            raise ArgumentError("keep", "keeps no observation", "at least one")
        views, view = np.unique(self.view[mask], return_inverse=True)
        points, point = np.unique(self.point[mask], return_inverse=True)
        tracks = Tracks(
            view,
            point,
            self.xy[mask],
            weights=self.weights[mask],
            names=None if self.names is None else [self.names[i] for i in views],
            sizes=None if self.sizes is None else self.sizes[views],
            colours=None if self.colours is None else self.colours[points],
            repeated=bool(self.n_repeated),
            min_points=min_points,
        )
        tracks.unit = self.unit
        tracks.whitening = None if self.whitening is None else self.whitening[:, :, mask]
        return tracks, views, points

    def weighted(self, weights: ArrayLike) -> Tracks:
        """Return the same observations with other weights.

        Parameters
        ----------
        weights : array_like, shape (N,)
            Factor of each squared residual, in the order of the tracks (not of their input).

        Returns
        -------
        Tracks
            All else is shared.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
        >>> tracks.weighted(np.full(len(tracks), 2.0)).weights[:2]
        array([2., 2.])
        """
        other = copy.copy(self)
        other.weights = as_weights(weights, len(self)).copy()
        other.weights.setflags(write=False)
        return other

    def __len__(self) -> int:
        """Return the number of observations."""
        return len(self.view)

    def __repr__(self) -> str:
        return f"Tracks({self.n_views} views, {self.n_points} points, {len(self)} observations)"

    def save(self, path: PathLike, **more: Any) -> None:
        """Write them in a form that `load_tracks` reads.

        Parameters
        ----------
        path : str or path
            As for `save_tracks`: ``.npz`` or ``.csv``.
        **more
            Of `save_tracks`: `start`.

        Examples
        --------
        >>> eg.multi_view_scene().tracks.save("tracks.csv")  # doctest: +SKIP
        """
        from epigauge.io import save_tracks

        save_tracks(path, self, **more)

    def _contents(self) -> dict[str, Any]:
        names = ("n_views", "n_points", "view", "point", "xy", "weights", "names", "sizes")
        return {name: getattr(self, name) for name in (*names, "colours")}

    def _summary_rows(self) -> dict[str, str]:
        seen = np.bincount(self.point, minlength=self.n_points)
        text = f"{seen.min()} to {seen.max()}, {seen.mean():.3g} on the average"
        return {"views of a point": text}

    def _heading(self) -> str:
        return repr(self)

    def merged(self) -> tuple[Tracks, float]:
        """Put observations of one point in one view together: their mean by their information.

        Returns
        -------
        tracks : Tracks
            One observation of a point in a view.
        constant : float
            With residuals ``xy - prediction``, half their weighted sum of squares is that of the
            new tracks plus this, whatever is predicted: both have the same least squares solution.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
        >>> merged, constant = tracks.merged()
        >>> len(merged) == len(tracks), constant
        (True, 0.0)
        """
        if not self.n_repeated:
            return self, 0.0
        first = np.flatnonzero(~self._again())
        alike = np.repeat(np.eye(2)[:, :, None], len(self), 2)
        W = alike if self.whitening is None else self.whitening
        xy, weights, whitening, constant = merged_sums(first, self.xy, self.weights, W)
        tracks = Tracks(
            self.view[first],
            self.point[first],
            xy,
            self.n_views,
            self.n_points,
            weights,
            names=self.names,
            sizes=self.sizes,
            colours=self.colours,
            min_points=1,
        )
        tracks.unit = self.unit
        tracks.whitening = None if self.whitening is None else whitening
        return tracks, constant

    def _again(self) -> NDArray[np.bool_]:
        """Return which sorted rows have the view and the point of the row before."""
        again = (np.diff(self.point) == 0) & (np.diff(self.view) == 0)
        return np.concatenate([[False], again])

    def _check(self, repeated: bool, min_points: int) -> None:
        if self.n_repeated and not repeated:
            k = int(np.argmax(self._again())) - 1
            rows = f"rows {self.order[k]} and {self.order[k + 1]}"
            raise ArgumentError(
                "view, point",
                f"name view {self.view[k]}, point {self.point[k]} twice ({rows})",
                "one observation of a point in a view, or repeated=True",
            )
        for name, indices, least in (
            ("point", self.point, MIN_VIEWS),
            ("view", self.view, min_points),
        ):
            once = indices[~self._again()]
            counts = np.bincount(once, minlength=getattr(self, f"n_{name}s"))
            weak = np.flatnonzero(counts < least)
            if len(weak):
                named = ", ".join(map(str, weak[:5])) + (", ..." if len(weak) > 5 else "")
                fewer = "min_points=3 if its camera is calibrated, " if name == "view" else ""
                raise ArgumentError(
                    name,
                    f"{named} has fewer than {least} observations ({counts[weak[0]]})",
                    f"more observations, {fewer}or Tracks.pruned(...) to drop such {name}s",
                )
        parts = self._components()
        if parts.max() > 0:
            lonely = np.flatnonzero(parts != parts[0])
            raise ArgumentError(
                "view, point",
                f"fall into {parts.max() + 1} parts: views {lonely[:5].tolist()} share no point "
                "with view 0",
                "connected tracks; reconstruct the parts one by one",
            )

    def _components(self) -> Indices:
        """Return for each view the number of the connected part it belongs to."""
        label = np.arange(self.n_views)
        while True:
            lowest = np.full(self.n_points, self.n_views)
            np.minimum.at(lowest, self.point, label[self.view])
            spread = label.copy()
            np.minimum.at(spread, self.view, lowest[self.point])
            if (spread == label).all():
                return np.unique(label, return_inverse=True)[1]
            label = spread


def _once(view: Indices, point: Indices, repeated: str) -> NDArray[np.bool_]:
    """Return the first row of each point in each view; with "drop", those that are alone."""
    order = np.lexsort((view, point))
    new = (np.diff(point[order], prepend=-1) != 0) | (np.diff(view[order], prepend=-1) != 0)
    if repeated == "drop":
        new &= np.append(new[1:], True)
    keep = np.zeros(len(view), dtype=np.bool_)
    keep[order[new]] = True
    return keep


def _nearest(
    view: Indices, point: Indices, xy: Array, weights: Array, keep: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the rows to keep, of repeated ones those nearest to a reconstruction without them."""
    from epigauge.multi_view.initialize import initialize

    alone = _once(view, point, "drop")
    tracks, views, points = Tracks.pruned(view[alone], point[alone], xy[alone], weights[alone])
    found = initialize(tracks, robust=True)
    rows = np.flatnonzero(~alone & np.isin(view, views) & np.isin(point, points))
    i, j = np.searchsorted(views, view[rows]), np.searchsorted(points, point[rows])
    h = np.einsum("nij,nj->ni", found.P[i], found.Q[j])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        away = np.linalg.norm(h[:, :2] / h[:, 2:] - xy[rows], axis=1)
    order = np.lexsort((np.nan_to_num(away, nan=np.inf), view[rows], point[rows]))
    rows = rows[order]
    new = (np.diff(point[rows], prepend=-1) != 0) | (np.diff(view[rows], prepend=-1) != 0)
    kept = keep.copy()
    kept[rows] = new
    return kept


def _indices(name: str, value: ArrayLike) -> Indices:
    indices = as_array(name, value, "an (N,) array")
    if indices.ndim != 1 or indices.dtype.kind not in "iu":
        raise ArgumentError(name, f"is {indices.dtype} {indices.shape}", "integers, (N,)")
    bad = np.flatnonzero((indices < 0) | (indices > np.iinfo(np.intp).max))
    if len(bad):
        raise ArgumentError(name, f"is {indices[bad[0]]} in row {bad[0]}", "indices from 0")
    return indices.astype(np.intp)


def _extent(name: str, indices: Indices, given: int | None) -> int:
    extent = int(indices.max()) + 1
    if given is not None and given < extent:
        row = int(np.argmax(indices))
        raise ArgumentError(name, f"is {indices[row]} in row {row}", f"indices below {given}")
    extent = extent if given is None else given
    # No more indices than there are rows can be used: nothing longer is allocated.
    counts = np.bincount(indices[indices < len(indices)], minlength=min(extent, len(indices)))
    unused = np.flatnonzero(counts[:extent] == 0)
    if len(unused) or extent > len(indices):
        first = unused[0] if len(unused) else len(indices)
        raise ArgumentError(
            name, f"never is {first}", "every index used, or Tracks.pruned(...) to renumber"
        )
    return extent
