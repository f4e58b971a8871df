"""A first reconstruction by registration: two views, then the other cameras in turn."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.bundle.dampings import Covariant
from epigauge.bundle.linearizer import Linearizer
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import Estimate
from epigauge.bundle.run import REFINEMENT, bundle_problem
from epigauge.cameras import camera_model
from epigauge.errors import ArgumentError
from epigauge.kernels import Table
from epigauge.multi_view.agreement import agreed_camera, agreed_fundamental, agreed_points
from epigauge.multi_view.first_pair import (
    MIN_MATCHES,
    TooFewInCommon,
    best_pair,
    common_points,
    rows_of,
)
from epigauge.multi_view.frame import Frame, counted
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.resection import resect
from epigauge.multi_view.tracks import MIN_POINTS, MIN_VIEWS, Tracks
from epigauge.scatter import spread
from epigauge.two_view.geometry import canonical_cameras
from epigauge.two_view.losses import EFFICIENT, Loss, robust_scale
from epigauge.two_view.refine import refine_fundamental

__all__ = ["registered"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


#: Known views whose matches a camera without known points is found from, at most.
_PARTNERS = 10

#: A camera found from points that half are held by so many views already bends nothing: with gross
#: errors, everything is then adjusted when there are so many times the views only.
_HELD, _GROWN = 8, 1.2


def registered(
    tracks: Tracks, frame: Frame, kernels: Table, incremental: bool, robust: bool
) -> Reconstruction:
    """Reconstruct from two views and the others in turn.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    frame : Frame
        Image coordinates to compute in.
    kernels : Table
        Backend.
    incremental : bool
        Adjust everything known with each camera.
    robust : bool
        Take what most observations agree on, and adjust everything known with each camera that
        sees points which few others hold.

    Returns
    -------
    Reconstruction
        All cameras and points.

    Raises
    ------
    ArgumentError
        If no two views have enough points in common, or a view too few with those before it.
    """
    tracks = counted(tracks)
    builder = _Builder(tracks, frame.conditioned(tracks), kernels, robust)
    builder.begin(*best_pair(tracks, frame, robust))
    while not builder.registered.all():
        view = builder.next_view()
        builder.register(view)
        # Gross errors bend what hangs on a few cameras, and at the end of a long sequence it does.
        if incremental or (robust and not builder.held(view)):
            builder.adjust()
    return Reconstruction(frame.cameras_out(builder.P), builder.Q)


class _Builder:
    """Cameras and points known so far."""

    def __init__(self, tracks: Tracks, q: Array, kernels: Table, robust: bool) -> None:
        self.tracks, self.q, self.kernels, self.robust = tracks, q, kernels, robust
        self.P = np.zeros((tracks.n_views, 3, 4))
        self.Q = np.zeros((tracks.n_points, 4))
        self.registered = np.zeros(tracks.n_views, dtype=np.bool_)
        self.known = np.zeros(tracks.n_points, dtype=np.bool_)
        self.adjusted = 0

    def begin(self, i: int, k: int) -> None:
        """Start with two views."""
        rows = rows_of(self.tracks, i), rows_of(self.tracks, k)
        F, Q, points = self._pair(i, k, np.flatnonzero((rows[0] >= 0) & (rows[1] >= 0)))
        self.P[i], self.P[k] = canonical_cameras(F)
        self.Q[points] = Q
        self.registered[[i, k]] = True
        self.known[points] = True
        self._spread()

    def next_view(self) -> int:
        """Return the view outside that sees the most known points.

        Where none sees enough, the one with matches in most known views, at least two.
        """
        tracks = self.tracks
        seen = self.known[tracks.point] & ~self.registered[tracks.view]
        counts = np.bincount(tracks.view[seen], minlength=tracks.n_views)
        view = int(np.argmax(counts))
        if counts[view] >= MIN_POINTS:
            return view
        pairs = (self.common >= MIN_MATCHES) & self.registered
        pairs[self.registered] = False
        view = int(np.argmax(np.where(pairs, self.common, 0.0).sum(axis=1) * pairs.sum(axis=1)))
        if np.count_nonzero(pairs[view]) < 2:
            outside = np.flatnonzero(~self.registered)[:5].tolist()
            raise TooFewInCommon(
                "tracks",
                f"leave views {outside} with fewer than {MIN_POINTS} points in common with the "
                f"others, and with {MIN_MATCHES} matches in fewer than two of them",
                "longer or more tracks, fewer views, or method='factorization'",
            )
        return view

    @cached_property
    def common(self) -> Array:
        """Return the number of points that two views have in common, (n, n)."""
        above = common_points(self.tracks)
        return np.asarray(above + above.T)

    def register(self, view: int) -> None:
        """Find the camera of a view from known points, then the points it completes."""
        rows = np.flatnonzero((self.tracks.view == view) & self.known[self.tracks.point])
        by_points = len(rows) >= MIN_POINTS
        if by_points:
            q, Q = self.q[:, rows], self.Q[self.tracks.point[rows]].T
            start = agreed_camera(q, Q) if self.robust else None
            self.P[view] = resect(self.kernels, q, Q, start)
        else:
            self.P[view] = self._from_pairs(view)
        self.registered[view] = True
        # Points that it does not see are left as they are, but for a last round with all views.
        self._triangulate(None if self.registered.all() else view)
        self._spread()
        if not by_points:
            self.adjust()

    def _from_pairs(self, view: int) -> Array:
        """Return the camera that fits the fundamental matrices with known views.

        P_k^T F P_i is skew-symmetric for all of them: linear in P_k.
        """
        others = np.flatnonzero(self.registered & (self.common[view] >= MIN_MATCHES))
        others = others[np.argsort(-self.common[view, others], kind="stable")][:_PARTNERS]
        equations = []
        own = rows_of(self.tracks, view)
        for i in others.tolist():
            rows = rows_of(self.tracks, i)
            points = np.flatnonzero((rows >= 0) & (own >= 0))
            F, _, _ = self._pair(i, view, points)
            G = F @ self.P[i]
            # Entry (j, l) of G^T P + P^T G, as a linear map of P (3, 4).
            half = np.einsum("aj,lm->jlam", G, np.eye(4))
            both = (half + half.swapaxes(0, 1))[np.triu_indices(4)]
            equations.append(float(np.sqrt(len(points))) * both.reshape(10, 12))
        P = np.linalg.svd(np.concatenate(equations))[2][-1].reshape(3, 4)
        return np.asarray(P)

    def _pair(self, i: int, k: int, points: Indices) -> tuple[Array, Array, Indices]:
        """Return F from view i to view k, and the points that agree with it."""
        x1, x2 = (self.q[:, rows_of(self.tracks, view)[points]].T for view in (i, k))
        try:
            F, agrees = None, np.ones(len(points), dtype=np.bool_)
            if self.robust:
                with suppress(ArgumentError):  # then the loss alone has to do
                    F, agrees = agreed_fundamental(self.kernels, x1, x2)
            result = refine_fundamental(
                x1[agrees],
                x2[agrees],
                F,
                loss="cauchy",
                max_iter=200,
                backend=self.kernels.name,
            )
        except ArgumentError as error:
            raise ArgumentError(
                "tracks",
                f"have common points in views {i} and {k} that do not determine F "
                f"({error.argument} {error.was})",
                "points spread over two dimensions in both",
            ) from None
        return result.F, result.points, points[agrees]

    def held(self, view: int) -> bool:
        """Tell whether a new view hangs on many others, nearly as many as when last adjusted."""
        count = np.count_nonzero(self.registered)
        if self.registered.all() or count >= _GROWN * self.adjusted:
            return False
        known = self.registered[self.tracks.view]
        views = np.bincount(self.tracks.point[known], minlength=self.tracks.n_points)
        return bool(np.median(views[self.tracks.point[self.tracks.view == view]]) >= _HELD)

    def adjust(self) -> None:
        """Adjust all registered cameras and known points by a few robust covariant steps."""
        self.adjusted = int(np.count_nonzero(self.registered))
        rows = np.flatnonzero(self.registered[self.tracks.view] & self.known[self.tracks.point])
        views, local_views = np.unique(self.tracks.view[rows], return_inverse=True)
        points, local_points = np.unique(self.tracks.point[rows], return_inverse=True)
        graph = ObservationGraph(local_views, local_points, len(views), len(points))
        q = np.ascontiguousarray(self.q[:, rows])
        estimate = Estimate(self.P[views].reshape(-1, 12), self.Q[points])
        parts = camera_model("projective"), self.kernels, graph, q, np.ones(len(rows))
        problem = bundle_problem(*parts, embedded=True)
        distances = problem.linearizer.distances(estimate.cameras, estimate.points)
        scale = EFFICIENT["cauchy"] * robust_scale(distances)
        robust = problem.linearizer.with_loss(Loss("cauchy", max(scale, 1e-12)))
        stopping = lm.Stopping(ftol=1e-3, xtol=0.0, gtol=0.0, max_iter=5)
        found = lm.minimize(
            replace(problem, linearizer=robust), estimate, Covariant(), lm.Classic(), stopping
        ).state
        self.P[views], self.Q[points] = found.cameras.reshape(-1, 3, 4), found.points
        self._spread()

    def _triangulate(self, view: int | None) -> None:
        """Triangulate the points of a view, or all, that two or more registered views see."""
        tracks = self.tracks
        rows = np.flatnonzero(self.registered[tracks.view])
        if view is not None:
            seen = np.zeros(tracks.n_points, dtype=np.bool_)
            seen[tracks.point[tracks.view == view]] = True
            rows = rows[seen[tracks.point[rows]]]
        counts = np.bincount(tracks.point[rows], minlength=tracks.n_points)
        rows = rows[counts[tracks.point[rows]] >= MIN_VIEWS]
        points, local = np.unique(tracks.point[rows], return_inverse=True)
        graph = ObservationGraph(tracks.view[rows], local, tracks.n_views, len(points))
        q = np.ascontiguousarray(self.q[:, rows])
        parts = self.kernels, graph, q, np.ones(len(rows))
        linearizer = bundle_problem(camera_model("projective"), *parts).linearizer
        start = self.P, self.Q[points], self.known[points]
        self.Q[points], scale = _triangulated(*start, linearizer)
        if self.robust:
            self.Q[points] = agreed_points(*parts, self.P, self.Q[points], scale)
        self.known[points] = True

    def _spread(self) -> None:
        """Move to the basis in which the known points are spread evenly, scales of norm one."""
        self.Q[self.known], T = spread(self.Q[self.known])
        P = self.P[self.registered] @ T
        self.P[self.registered] = P / np.linalg.norm(P, axis=(1, 2), keepdims=True)


def _triangulated(
    P: Array, Q: Array, known: NDArray[np.bool_], linearizer: Linearizer
) -> tuple[Array, float]:
    """Return points triangulated linearly where new, then refined, and the robust loss's scale."""
    cameras = P.reshape(-1, 12)
    linear = linearizer.intersect(cameras)
    Q = np.where(known[:, None], Q, linear)
    distances = linearizer.distances(cameras, linear)
    scale = max(EFFICIENT["cauchy"] * robust_scale(np.nan_to_num(distances, posinf=1e3)), 1e-12)
    robust = linearizer.with_loss(Loss("cauchy", scale))
    # A known point may have been led astray by the new view's error: keep the better start.
    costs = [np.nan_to_num(robust.point_costs(cameras, start), nan=np.inf) for start in (Q, linear)]
    Q = np.where((costs[0] <= costs[1])[:, None], Q, linear)
    return robust.refine_points(cameras, Q, REFINEMENT)[0], scale
