"""The compared methods as rows of parts: what is free, in which gauge, damped and solved how."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.freedom import Freedom
from epigauge.bundle.linearizer import Normal
from epigauge.bundle.moves import Move, move_into
from epigauge.bundle.null_space import scales
from epigauge.bundle.solve import Border
from epigauge.bundle.ties import Ties
from epigauge.cameras import CameraModel
from epigauge.kernels import Table
from epigauge.multi_view.gauge import Gauge, five_points, normalized, reference_camera, two_cameras
from epigauge.scatter import scatter_constraints
from epigauge.two_view.parameterizations import Ortho, OrthonormalF

__all__ = [
    "STRATEGIES",
    "InGauge",
    "ReferenceOfMetric",
    "ReferenceOfProjective",
    "Strategy",
    "freedom_of",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InGauge(Freedom):
    """The estimate is moved into a gauge after steps.

    Attributes
    ----------
    model : CameraModel
        The camera.
    gauge : Gauge
        Where to.
    every : int
        Move after every so many steps (KANATANI: periodically).
    with_constraints : bool
        Add the first-order constraints that keep the normalised frame (MCLAUCHLAN).
    """

    model: CameraModel | None = None
    gauge: Gauge | None = None
    every: int = 1
    with_constraints: bool = False

    def moving(self, cameras: Array, points: Array, steps: int) -> Move | None:
        """Return what moves the estimate into the gauge, each so many steps."""
        if steps % self.every:
            return None
        assert self.gauge is not None
        assert self.model is not None
        return move_into(self.gauge, self.model, cameras, points)

    def constrained(
        self, normal: Normal, cameras: Array, points: Array
    ) -> tuple[Normal, Border | None]:
        """Return the normal equations, constrained where asked for.

        Homogeneous: unit norms, and sum Q Q^T fixed (ten conditions). Metric: the points' mean and
        their mean square distance from it (four). Affine: their mean and covariance (nine).
        """
        assert self.model is not None
        if not self.with_constraints:
            return normal, None
        weight = float(np.mean(np.einsum("nii->ni", normal.V)))
        none = np.zeros((*normal.g_cameras.shape, 0))
        if not self.model.homogeneous:
            moved = points[:, :, None] if self.model.metric else _squares(points)
            columns = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), moved], 2)
            border = np.sqrt(weight / len(points)) * columns
            return normal, Border(np.zeros((*none.shape[:2], border.shape[2])), border)
        p, q = scales(cameras, points)
        border = np.sqrt(weight) * scatter_constraints(points)
        normal = replace(
            normal,
            U=normal.U + weight * p[:, :, None] * p[:, None, :],
            V=normal.V + weight * q[:, :, None] * q[:, None, :],
        )
        return normal, Border(np.zeros((*none.shape[:2], border.shape[2])), border)


def _squares(points: Array) -> Array:
    """Return the derivatives (m, 3, 6) of the distinct entries of X X^T."""
    i, j = np.triu_indices(3)
    columns = np.zeros((len(points), 3, 6))
    for k, (a, b) in enumerate(zip(i.tolist(), j.tolist(), strict=True)):
        columns[:, a, k] += points[:, b]
        columns[:, b, k] += points[:, a]
    return columns


@dataclass(frozen=True)
class ReferenceOfProjective(Freedom):
    """Frozen parameters of projective cameras or points.

    Attributes
    ----------
    kernels : Table
        Back end.
    reference : str
        "camera" (HARTLEY), "cameras" (BARTOLI) or "points" (FAUGERAS).
    chosen : tuple of int
        The reference points.
    """

    kernels: Table | None = None
    reference: str = ""
    chosen: tuple[int, ...] = ()

    def ties_at(self, cameras: Array, points: Array) -> Ties:
        """Return the ties at an estimate: B&S's A_perp for the second camera of BARTOLI."""
        n, m = len(cameras), len(points)
        A, C = np.tile(np.eye(12), (n, 1, 1)), np.tile(np.eye(4), (m, 1, 1))
        if self.reference == "points":
            C[list(self.chosen)] = 0.0
            return Ties(C=C)
        A[0] = 0.0
        C[:, 2, 2] = 0.0
        if self.reference == "cameras":
            assert self.kernels is not None
            A[1] = 0.0
            factors = canonic_factors(cameras[1].reshape(3, 4))
            A[1, :, :7] = self.kernels.canonical_camera_derivatives(*factors)[1]
        return Ties(A=A, C=C)

    def retracted(self, cameras: Array, moved: Array, own: Array) -> Array:
        """Return cameras after a step; BARTOLI's second one by its orthonormal representation."""
        if self.reference != "cameras":
            return moved
        assert self.kernels is not None
        factors = canonic_factors(cameras[1].reshape(3, 4))
        A_perp = self.kernels.canonical_camera_derivatives(*factors)[1]
        # The own tangent is A_perp times the minimal update, A_perp of full rank.
        delta = np.linalg.lstsq(A_perp, own[1], rcond=None)[0]
        moved = moved.copy()
        turned = Ortho(self.kernels).retract(factors, delta)
        moved[1] = np.asarray(self.kernels.canonical_camera(*turned)).ravel()
        return moved


@dataclass(frozen=True)
class ReferenceOfMetric(Freedom):
    """Frozen parameters of metric cameras or points, in the gauge of that name.

    One reference camera leaves the scale free. Of two, the second keeps its distance along the
    baseline; of three reference points, two stay where they are and the third in the plane.

    Attributes
    ----------
    reference : str
        "camera", "cameras" or "points".
    chosen : tuple of int
        The reference points.
    baseline : ndarray, shape (3,), or None
        From the first of two reference cameras to the second, in the gauge.
    """

    reference: str = ""
    chosen: tuple[int, ...] = ()
    baseline: Array | None = None

    def ties_at(self, cameras: Array, points: Array) -> Ties:
        """Return the ties at an estimate."""
        own = self.ties
        if self.reference == "points":
            C = np.tile(np.eye(3), (len(points), 1, 1))
            first, second, third = self.chosen
            C[[first, second]] = 0.0
            # In the gauge the plane of the three is z = 0.
            C[third] = np.diag([1.0, 1.0, 0.0])
            return own.then(None, C)
        n, d = len(cameras), cameras.shape[1] - 6
        fixed = np.tile(np.eye(d), (n, 1, 1))
        fixed[0, :6] = 0.0
        if self.reference == "cameras":
            # The centre moves by R^T times the tangent: across the baseline only.
            assert self.baseline is not None
            across = np.linalg.svd(self.baseline[None])[2][1:]
            fixed[1, 3:6, 3:5] = cameras[1, :12].reshape(3, 4)[:, :3] @ across.T
            fixed[1, 3:6, 5] = 0.0
        return replace(own, A=fixed if own.A is None else fixed @ own.A)


@dataclass(frozen=True)
class Strategy:
    """A method of the 2003 paper, or ours.

    Attributes
    ----------
    damping : str
        Name of its damping.
    what : str
        One sentence for reports.
    gauge : Gauge or None
        Gauge it starts in and, where `explicit`, returns to; None leaves the caller's basis.
    explicit : bool
        Move into the gauge after every step.
    reference : str
        What is frozen: "camera", "cameras" or "points".
    every : int
        How often to move.
    constrained : bool
        First-order constraints.
    embedded : bool
        Whether re-triangulation after each step is the default.
    """

    damping: str
    what: str
    gauge: Gauge | None = None
    explicit: bool = False
    reference: str = ""
    every: int = 1
    constrained: bool = False
    embedded: bool = False


#: The strategies by name; the order is that of tables.
STRATEGIES: dict[str, Strategy] = {
    "free": Strategy("none", "all free, pseudo-inverse"),
    "levenberg": Strategy("levenberg", "all free, damping lambda I"),
    "marquardt": Strategy("marquardt", "all free, damping lambda diag(N)"),
    "hartley": Strategy(
        "levenberg", "one reference camera", reference_camera(), reference="camera"
    ),
    "bartoli": Strategy("levenberg", "two reference cameras", two_cameras(), reference="cameras"),
    "faugeras": Strategy("levenberg", "five reference points", five_points(), reference="points"),
    "mclauchlan": Strategy(
        "levenberg",
        "normalised basis and first-order constraints",
        normalized(),
        explicit=True,
        constrained=True,
    ),
    "kanatani": Strategy(
        "levenberg", "all free, periodically normalised", normalized(), True, every=5
    ),
    "gauge_invariant": Strategy("gauge_invariant", "Table 1 of the 2003 paper as printed"),
    "gauge_invariant_factor": Strategy(
        "gauge_invariant_factor", "Table 1 solved by a singular vector: rank one"
    ),
    "covariant": Strategy("covariant", "covariant damping, points re-triangulated", embedded=True),
}


def freedom_of(
    strategy: Strategy,
    explicit: Gauge | None,
    model: CameraModel,
    kernels: Table,
    cameras: Array,
    chosen: tuple[int, ...],
    own: Freedom,
) -> Freedom:
    """Return what a strategy leaves free.

    Parameters
    ----------
    strategy : Strategy
        The method.
    explicit : Gauge or None
        A gauge to be kept to.
    model : CameraModel
        The camera.
    kernels : Table
        Back end.
    cameras : ndarray, shape (n, c)
        The start's, in the gauge.
    chosen : tuple of int
        The reference points, where there are any.
    own : Freedom
        What the caller leaves free.
    """
    if strategy.reference and model.homogeneous:
        return ReferenceOfProjective(own.ties, own.kept, kernels, strategy.reference, chosen)
    if strategy.reference:
        pose = cameras[:2, :12].reshape(-1, 3, 4)
        centres = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
        baseline = centres[1] - centres[0]
        return ReferenceOfMetric(own.ties, own.kept, strategy.reference, chosen, baseline)
    if explicit is not None:
        kept_in = model, explicit, strategy.every, strategy.constrained
        return InGauge(own.ties, own.kept, *kept_in)
    return own


def canonic_factors(P2: Array) -> OrthonormalF:
    """Return U, V, sigma of a canonic camera P' = (u2 v1^T - sigma u1 v2^T | u3) (B&S eq. 5)."""
    U, values, Vt = np.linalg.svd(P2[:, :3])
    # H = u2 v1^T - sigma u1 v2^T: its left vectors are u2, -u1 and, up to sign, u3. The singular
    # value one belongs to u2; it is the second where a step has taken sigma beyond one.
    one, other = (0, 1) if abs(values[0] - 1.0) <= abs(values[1] - 1.0) else (1, 0)
    factors = np.column_stack([-U[:, other], U[:, one], P2[:, 3]])
    return OrthonormalF(factors, Vt[[one, other, 2]].T, np.asarray(values[other] / values[one]))
