"""What the engine asks of an evaluation: costs, normal equations, products with them.

Two classes answer: `NumpyLinearizer` over the generated kernels of any back end, which stores all
Jacobians, and `NativeLinearizer` in C, which stores none. Cameras are rows (n, c) of a model's
storage, points rows (m, b); steps are in own tangents, d numbers a camera and b a point.

Features of other kinds than points, as lines, have observations and an evaluation of their own, a
`FeatureKind`. They are eliminated as points are: what all kinds take off the cameras is added up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.observations import ObservationGraph
from epigauge.cameras import CameraModel
from epigauge.two_view.losses import Loss

__all__ = [
    "LEAST_WEIGHT",
    "CameraBlocks",
    "Coupling",
    "Factor",
    "FactorInverse",
    "FeatureKind",
    "Linearizer",
    "Normal",
    "Pairs",
    "PointRefinement",
    "point_damping",
]

Array = NDArray[np.float64]

#: Least weight in the normal equations, of the largest: what only observations without weight (or
#: beyond a truncated loss) determine stays determined, and does not influence the rest.
LEAST_WEIGHT = 1e-8


@dataclass(frozen=True)
class PointRefinement:
    """How a point is moved, all cameras kept: damped Gauss-Newton of its own.

    Attributes
    ----------
    iterations : int
        Most steps tried.
    lam, factor : float
        First lambda, and what it is divided or multiplied by.
    tolerance : float
        A point is done where a step promises to lower its cost by less than this share.
    """

    iterations: int = 5
    lam: float = 1e-3
    factor: float = 10.0
    tolerance: float = 1e-12


class CameraBlocks(Protocol):
    """Blocks of the cameras' part of an inverse: of all pairs of views that see common points."""

    @property
    def diagonal(self) -> Array:
        """Return the blocks of the views themselves, (n, d, d)."""

    def block(self, i: int, k: int) -> Array | None:
        """Return the block of two views, (d, d); None where it was not computed."""


class FactorInverse(Protocol):
    """The selected blocks of the inverse of a reduced system S, in its unknowns."""

    @property
    def diagonals(self) -> tuple[Array, Array]:
        """Return those of S and S^-1, (n, a)."""

    def spread(self, A: Array | None, K: Array) -> CameraBlocks:
        """Return the blocks of A S^-1 A^T + K K^T for A (n, d, a) and K (n, d, k)."""


class Factor(Protocol):
    """A factor of the reduced system of the cameras."""

    def solve(self, right: Array) -> Array:
        """Return the solution for right-hand sides (n, a, k)."""

    def inverse(self) -> FactorInverse:
        """Return the blocks of the inverse of all pairs of views that see common points."""


class Pairs(Protocol):
    """P = W T T^T W^T, what the points take off the cameras' blocks."""

    def without(self, F: Array) -> Pairs:
        """Return P - F F^T, F (n, d, k); only blocks that P has are kept."""

    def factor(self, U: Array, A: Array | None) -> Factor:
        """Return a factor of U - A^T P A, blocks U (n, a, a) and A (n, d, a).

        Raises
        ------
        numpy.linalg.LinAlgError
            If it is not positive definite.
        """

    def plus(self, other: Pairs) -> Pairs:
        """Return the sum with what features of another kind take off; P has its blocks."""

    def times(self, x: Array) -> Array:
        """Return P x for x (n, d, k)."""

    def dense(self) -> Array:
        """Return P, (n, d, n, d)."""


class Coupling(Protocol):
    """The blocks W of J^T J that couple cameras (d) and points (b)."""

    @property
    def direct(self) -> bool:
        """Tell whether the reduced system is to be stored and factored, or only iterated with."""

    def to_points(self, T: Array | None, x: Array) -> Array:
        """Return T^T W^T x, (m, b, ...), for x (n, d) or (n, d, k) and T (m, b, b), or one."""

    def to_cameras(self, T: Array | None, y: Array) -> Array:
        """Return W T y, (n, d, ...), for y (m, b) or (m, b, k) and T (m, b, b), or one."""

    def schur(self, T: Array, half: Array | None) -> tuple[Pairs, Array]:
        """Return P = W T T^T W^T, and W T half (n, d); half None is zero."""

    def diagonal(self, T: Array) -> Array:
        """Return the diagonal blocks of P, (n, d, d)."""

    def cliques(self) -> NDArray[np.bool_]:
        """Return some sets of views, (c, n), large ones: all blocks of a set are stored."""

    def marginals(self, T: Array, cameras: CameraBlocks, coupled: bool) -> tuple[Array, Array]:
        """Return the blocks of the whole inverse that belong to points.

        Parameters
        ----------
        T : ndarray, shape (m, b, b)
            T T^T is the inverse of a point's own block.
        cameras : CameraBlocks
            The cameras' part X of the inverse.
        coupled : bool
            Whether the second result is asked for.

        Returns
        -------
        ndarray, shape (m, b, b)
            T T^T + Y^T X Y with Y = W T T^T, of each point.
        ndarray, shape (N, d, b) or (0, d, b)
            -X Y, of the view and the point of each observation.
        """


@dataclass(frozen=True)
class Normal:
    """Normal equations in own tangents.

    Attributes
    ----------
    U, V : ndarray, shape (n, d, d), (m, b, b)
        Blocks of J^T J.
    g_cameras, g_points : ndarray, shape (n, d), (m, b)
        Gradient of the cost.
    coupling : Coupling
        The blocks that couple both.
    depth_blocks : tuple of ndarray, or None
        For homogeneous points the blocks of Z^T Z, Z = d log depth weighted as the residuals.
    others : tuple of Normal
        Those of features of other kinds than points; `U` and `g_cameras` are the sums of all.
    """

    U: Array
    V: Array
    g_cameras: Array
    g_points: Array
    coupling: Coupling
    depth_blocks: tuple[Array, Array] | None = None
    others: tuple[Normal, ...] = ()

    def beside(self, others: Sequence[Normal]) -> Normal:
        """Return the normal equations of these features and those of other kinds."""
        if not others:
            return self
        U, g = (
            sum(parts) for parts in zip(*((own.U, own.g_cameras) for own in others), strict=True)
        )
        U, g = self.U + U, self.g_cameras + g
        return replace(self, U=U, g_cameras=g, others=(*self.others, *others))

    def alone(self) -> Normal:
        """Return the normal equations of points, those of other kinds taken off again."""
        U, g = self.U, self.g_cameras
        for own in self.others:
            U, g = U - own.U, g - own.g_cameras
        return replace(self, U=U, g_cameras=g, others=())


class FeatureKind(Protocol):
    """Evaluates cameras (n, c) and the features (k, f) of one kind, with tangents (k, t)."""

    @property
    def graph(self) -> ObservationGraph:
        """Return which observation belongs to what; features stand for points."""

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return the residuals, (2, N)."""

    def point_costs(self, cameras: Array, points: Array) -> Array:
        """Return the weighted robust sum of each feature, (k,)."""

    def linearize(self, cameras: Array, points: Array) -> Normal:
        """Return the normal equations of these observations alone."""

    def refine_points(
        self, cameras: Array, points: Array, how: PointRefinement
    ) -> tuple[Array, Array]:
        """Return the features moved to where their own observations want them, and their costs."""

    def inverse_roots(self, V: Array, D: Array, lam: float, g: Array) -> tuple[Array, Array]:
        """Return T with T T^T = (V + lam D)^-1 for blocks (k, t, t), and T^T g."""

    def moved(self, cameras: Array, points: Array, step: Array) -> Array:
        """Return the features after a step (k, t) of their tangents at these cameras."""

    def carried(self, move: Any, points: Array) -> Array:
        """Return the features after a `Move` of space."""

    def with_loss(self, loss: Loss) -> FeatureKind:
        """Return the same observations with another loss."""


class Linearizer(Protocol):
    """Evaluates cameras (n, c) and points (m, b)."""

    @property
    def graph(self) -> ObservationGraph:
        """Return which observation belongs to what."""

    @property
    def loss(self) -> Loss:
        """Return the loss of each squared residual."""

    def with_loss(self, loss: Loss) -> Linearizer:
        """Return the same observations with another loss."""

    def residuals(self, cameras: Array, points: Array) -> Array:
        """Return r = q - q_hat, (2, N)."""

    def point_costs(self, cameras: Array, points: Array) -> Array:
        """Return the weighted robust sum of each point, (m,); not finite in a focal plane."""

    def distances(self, cameras: Array, points: Array) -> Array:
        """Return the distance of each observation to its projected point, (N,), in any order."""

    def intersect(self, cameras: Array) -> Array:
        """Return homogeneous points of least algebraic error, unit vectors (m, 4)."""

    def linearize(self, cameras: Array, points: Array) -> Normal:
        """Return the normal equations."""

    def refine_points(
        self, cameras: Array, points: Array, how: PointRefinement
    ) -> tuple[Array, Array]:
        """Return the points moved to where their own observations want them, and their costs."""

    def inverse_roots(self, V: Array, D: Array, lam: float, g: Array) -> tuple[Array, Array]:
        """Return T with T T^T = (V + lam D)^-1 for blocks (m, b, b), and T^T g.

        Raises
        ------
        numpy.linalg.LinAlgError
            If a block is not positive definite.
        """


def point_damping(model: CameraModel, V: Array, depth: Array | None) -> Array:
    """Return the damping blocks of points that a change of gauge leaves as they are, (m, b, b).

    The Gauss-Newton block V alone would damp nothing along the line of sight of a point with
    little parallax: homogeneous points add Z^T Z, and similarities leave tr(V) I as it is. Affine
    cameras have parallel lines of sight, along which nothing can go wrong.

    Parameters
    ----------
    model : CameraModel
        The camera, whose gauge group decides.
    V : ndarray, shape (m, b, b)
        Point blocks of J^T J.
    depth : ndarray, shape (m, b, b), or None
        Those of Z^T Z, for homogeneous points. Lines have none: in a basis that is the same up to
        an orthonormal change, as that of the covariant method, the trace stays as it is.
    """
    if depth is not None:
        return V + depth
    if not (model.metric or model.homogeneous):
        return V
    trace = np.einsum("mii->m", V) / V.shape[1]
    return np.asarray(trace[:, None, None] * np.eye(V.shape[1]))
