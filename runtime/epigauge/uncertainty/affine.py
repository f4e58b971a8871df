"""Covariances of affine cameras and points, to first order in the noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._arguments import as_count, as_positive
from epigauge._results import Result
from epigauge.bundle.jobs import uncalibrated_job
from epigauge.bundle.moves import best_conditioned
from epigauge.bundle.numpy_linearizer import NumpyLinearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.bundle.refinement import listed
from epigauge.bundle.run import bundle_problem
from epigauge.cameras import AffineReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.gauge import five_points, inner
from epigauge.multi_view.tracks import Tracks
from epigauge.two_view.losses import Loss
from epigauge.uncertainty.datum import Projection, onto
from epigauge.uncertainty.inverse import Inverse, Motions
from epigauge.uncertainty.metric import redundancy_of

__all__ = ["AffineCovariance", "AffineStd", "affine_covariance"]

Array = NDArray[np.float64]

#: Points that fix an affine frame.
_FRAME = 4


@dataclass(frozen=True)
class AffineStd(Result):
    """Standard deviations.

    Attributes
    ----------
    cameras : ndarray, shape (n, 2, 4)
        Of the entries of each camera.
    points : ndarray, shape (m, 3)
        Of the points, in the unit of the scene.
    """

    cameras: Array
    points: Array


@dataclass(frozen=True, eq=False)
class AffineCovariance(Result):
    """Covariances of an affine reconstruction in a datum.

    `camera`, `point` and `between` give any block; each is computed when it is asked for.

    Attributes
    ----------
    reconstruction : AffineReconstruction
        The estimate.
    noise_px : float
        Standard deviation of an image coordinate of weight one: given, or estimated.
    redundancy : int
        Observations beyond what the unknowns need.
    gauge : object
        The datum.
    open : int
        How many of the twelve motions of the gauge the datum has to hold; fixed views and points
        hold the rest.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> rng = np.random.default_rng(0)
    >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
    >>> view, point = np.divmod(np.arange(80), 20)
    >>> X = np.column_stack([affine.X, np.ones(20)])[point]
    >>> xy = np.einsum("nij,nj->ni", affine.P[view][:, :2], X) + rng.normal(0, 0.1, (80, 2))
    >>> tracks = eg.Tracks(view, point, xy)
    >>> spread = eg.covariance(tracks, affine)
    >>> spread.camera(0).shape, spread.point(3).shape
    ((8, 8), (3, 3))
    """

    reconstruction: AffineReconstruction
    noise_px: float
    redundancy: int
    gauge: Any
    open: int
    _inverse: Inverse
    _projection: Projection
    _back: tuple[Array, Array]

    def in_gauge(self, gauge: Any) -> AffineCovariance:
        """Return the covariance in another datum, from the same inverse.

        Parameters
        ----------
        gauge : "inner" or an object of eg.gauge
            `inner` over all or some points, or `five_points`, the first four of which stay.

        Returns
        -------
        AffineCovariance
            In the datum; the reconstruction is the same.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
        >>> view, point = np.divmod(np.arange(80), 20)
        >>> blank = eg.Tracks(view, point, np.zeros((80, 2)))
        >>> xy = affine.project(blank) + rng.normal(0, 0.1, (80, 2))
        >>> spread = eg.covariance(eg.Tracks(view, point, xy), affine)
        >>> spread.in_gauge(eg.gauge.inner([0, 1, 2, 3])).point(0).shape
        (3, 3)
        """
        there = _projection(gauge, self.reconstruction, self._inverse, self._back[1])
        return replace(self, gauge=gauge, _projection=there)

    def camera(self, i: int) -> Array:
        """Return the covariance of a camera.

        Parameters
        ----------
        i : int
            View.

        Returns
        -------
        ndarray, shape (8, 8)
            Of the first two rows of P, row by row.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
        >>> view, point = np.divmod(np.arange(80), 20)
        >>> blank = eg.Tracks(view, point, np.zeros((80, 2)))
        >>> xy = affine.project(blank) + rng.normal(0, 0.1, (80, 2))
        >>> spread = eg.covariance(eg.Tracks(view, point, xy), affine)
        >>> spread.camera(0).shape
        (8, 8)
        """
        return self.between(("camera", i), ("camera", i))

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
        >>> import epigauge as eg, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
        >>> view, point = np.divmod(np.arange(80), 20)
        >>> blank = eg.Tracks(view, point, np.zeros((80, 2)))
        >>> xy = affine.project(blank) + rng.normal(0, 0.1, (80, 2))
        >>> spread = eg.covariance(eg.Tracks(view, point, xy), affine)
        >>> spread.point(3).shape
        (3, 3)
        """
        return self.between(("point", j), ("point", j))

    def between(self, a: tuple[str, int], b: tuple[str, int]) -> Array:
        """Return the covariance of any two parts.

        Parameters
        ----------
        a, b : tuple of str and int
            Such as ``("camera", 3)`` and ``("point", 17)``.

        Returns
        -------
        ndarray
            Eight numbers a camera, three a point.

        Raises
        ------
        ArgumentError
            On parts that do not exist.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
        >>> view, point = np.divmod(np.arange(80), 20)
        >>> blank = eg.Tracks(view, point, np.zeros((80, 2)))
        >>> xy = affine.project(blank) + rng.normal(0, 0.1, (80, 2))
        >>> spread = eg.covariance(eg.Tracks(view, point, xy), affine)
        >>> spread.between(("camera", 0), ("point", 3)).shape
        (8, 3)
        """
        (first, low1, out1), (second, low2, out2) = self._part("a", a), self._part("b", b)
        block = self._inverse.block(first, second) + low1 @ self._projection.M @ low2.T
        return np.asarray(self.noise_px**2 * out1 @ block @ out2.T)

    @cached_property
    def std(self) -> AffineStd:
        """Standard deviations of all entries of cameras and points."""
        found = []
        low = self._projection.cameras, self._projection.points
        for X, L, out in zip(self._inverse.diagonals, low, self._back, strict=True):
            blocks = out @ (X + L @ self._projection.M @ np.swapaxes(L, 1, 2))
            variances = np.einsum("nij,nij->ni", blocks, out)
            found.append(self.noise_px * np.sqrt(np.maximum(variances, 0.0)))
        return AffineStd(found[0].reshape(-1, 2, 4), found[1])

    def _part(self, name: str, value: Any) -> tuple[tuple[int | None, int | None], Array, Array]:
        """Return a part of the inverse, its columns of the projection, and the way out."""
        kind, k = value if isinstance(value, tuple) and len(value) == 2 else (None, None)
        counts = {"camera": self.reconstruction.n_views, "point": self.reconstruction.n_points}
        if kind not in counts:
            raise ArgumentError(name, f"is {value!r:.60}", "('camera', i) or ('point', j)")
        k = as_count(name, k, at_least=0)
        if k >= counts[kind]:
            raise ArgumentError(name, f"is {value!r:.60}", f"a number below {counts[kind]}")
        if kind == "camera":
            return (k, None), self._projection.cameras[k], self._back[0][k]
        return (None, k), self._projection.points[k], self._back[1][k]


def affine_covariance(
    tracks: Tracks,
    reconstruction: AffineReconstruction,
    gauge: Any = "inner",
    noise_px: float | None = None,
    *,
    fixed_views: Iterable[int] = (),
    fixed_points: Iterable[int] = (),
    backend: str | None = None,
) -> AffineCovariance:
    """Return the covariance of an adjusted affine reconstruction; see `eg.covariance`."""
    tracks = tracks.merged()[0]
    job = uncalibrated_job(
        tracks,
        reconstruction,
        refine="all",
        fixed_views=listed("fixed_views", fixed_views),
        fixed_points=listed("fixed_points", fixed_points),
        priors=None,
    )
    table = kernels.table(backend)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    home, at_cameras, at_points = best_conditioned(job.model, job.cameras, job.points)
    parts = job.model, table, graph, job.q, np.asarray(tracks.weights), Loss()
    problem = bundle_problem(*parts, whitening=job.whitening, freedom=job.freedom)
    state = problem.evaluate(Estimate(at_cameras, at_points))
    reference = NumpyLinearizer(*parts, job.whitening)
    system = problem.linearize(state)
    inverse = Inverse.of(system, reference, None, Motions.of(system, None, table))
    redundancy = redundancy_of(np.asarray(tracks.weights), None, system, inverse.motions)
    if noise_px is not None:
        noise_px = as_positive("noise_px", noise_px)
    elif redundancy <= 0:
        raise ArgumentError("noise_px", "is not given", "a number: nothing is redundant")
    else:
        noise_px = job.scale_px * float(np.sqrt(2.0 * state.cost / redundancy))
    sizes = len(job.cameras), len(job.points), job.model.tangent_size
    cameras, points = home.inverse().blocks(*sizes)
    # The images are computed with in units of scale_px.
    back = np.asarray(cameras), np.asarray(points) / job.scale_px
    there = _projection(gauge, reconstruction, inverse, back[1])
    count = inverse.motions.open.shape[1]
    return AffineCovariance(
        reconstruction, noise_px, redundancy, gauge, count, inverse, there, back
    )


def _projection(
    datum: Any, reconstruction: AffineReconstruction, inverse: Inverse, back: Array
) -> Projection:
    """Return what takes the covariance to a datum in the frame of the reconstruction."""
    motions, m = inverse.motions, reconstruction.n_points
    n, d, _ = inverse.sizes
    count = motions.open.shape[1]
    chosen: Any = None
    C = np.zeros((m, 3, count))
    if isinstance(datum, five_points) or datum is five_points:
        choose = () if datum is five_points else datum.points or ()
        those = _indices(choose or _spread(reconstruction.X), m)[:_FRAME]
        if len(those) < _FRAME:
            raise ArgumentError("gauge", f"has {len(those)} points", f"{_FRAME} points")
        chosen = np.zeros((m, 3, 3 * _FRAME))
        for k, j in enumerate(those):
            chosen[j, :, 3 * k : 3 * k + 3] = np.eye(3)
        # As many of them as there are open motions: those along which the points move.
        C = np.swapaxes(back, 1, 2) @ chosen
        along = np.einsum("mik,mil->kl", C, motions.points @ motions.open)
        C = C @ np.linalg.svd(along)[0][:, :count]
    elif datum is inner or isinstance(datum, inner) or datum in ("inner", None):
        if isinstance(datum, inner) and datum.views is not None:
            raise ArgumentError("gauge.views", "are given", "points: affine cameras are nowhere")
        own = None if not isinstance(datum, inner) or datum.points is None else datum.points
        rows: Any = slice(None) if own is None else _indices(own, m)
        C[rows] = (np.swapaxes(back, 1, 2) @ back @ motions.points @ motions.open)[rows]
    else:
        needed = "'inner', eg.gauge.inner(points=...) or eg.gauge.five_points(points)"
        raise ArgumentError("gauge", f"is {datum!r:.80} for affine cameras", needed)
    if not count:
        return Projection(np.zeros((n, d, 0)), np.zeros((m, 3, 0)), np.zeros((0, 0)))
    return onto((np.zeros((n, d, count)), C), inverse, datum)


def _indices(points: Any, m: int) -> list[int]:
    found = [as_count("gauge.points", j, at_least=0) for j in points]
    if found and max(found) >= m:
        raise ArgumentError("gauge.points", f"has {max(found)}", f"numbers below {m}")
    return found


def _spread(X: Array) -> list[int]:
    """Return four points that span space well: each the farthest from what those before span."""
    rest = X - X.mean(axis=0)
    chosen: list[int] = []
    for _ in range(_FRAME):
        k = int(np.argmax(np.sum(rest**2, axis=1)))
        if not chosen:
            rest = X - X[k]
        else:
            unit = rest[k] / max(float(np.linalg.norm(rest[k])), 1e-300)
            rest = rest - np.outer(rest @ unit, unit)
        chosen.append(k)
    return chosen
