"""The compared methods as rows of parts: what is free, in which gauge, damped and solved how."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view import dampings
from epigauge.multi_view.gauge import Gauge, five_points, normalized, reference_camera, two_cameras
from epigauge.multi_view.null_space import scales
from epigauge.multi_view.problem import BundleProblem, BundleState, Linearized
from epigauge.scatter import scatter_constraints
from epigauge.two_view.parameterizations import Ortho, OrthonormalF

__all__ = ["STRATEGIES", "ExplicitProblem", "RestrictedProblem", "Strategy"]

Array = NDArray[np.float64]


class ExplicitProblem(BundleProblem):
    """A problem whose estimate is moved into a gauge before each iteration.

    Attributes
    ----------
    gauge : Gauge
        Where to.
    every : int
        Move after every so many accepted or rejected steps (KANATANI: periodically).
    constrained : bool
        Add the first-order constraints that keep the normalised basis (MCLAUCHLAN).
    """

    gauge: Gauge
    every: int = 1
    constrained: bool = False
    _steps: int = 0

    def moved(self, P: Array, Q: Array) -> tuple[Array, Array]:
        """Return cameras and points in the gauge."""
        return self.gauge.transformation(P, Q).apply(P, Q)

    def linearize(self, state: BundleState) -> Linearized:
        """Return the normal equations, constrained where asked for."""
        system = super().linearize(state)
        return _normalization_constraints(system, state) if self.constrained else system

    def retract(self, state: BundleState, step: Array) -> tuple[Array, Array]:
        """Return the estimate that a step leads to, in the gauge."""
        P, Q = super().retract(state, step)
        self._steps += 1
        return self.moved(P, Q) if self._steps % self.every == 0 else (P, Q)


class RestrictedProblem(BundleProblem):
    """A problem with frozen parameters: those of reference cameras or points.

    Attributes
    ----------
    reference : str
        "camera" (HARTLEY), "cameras" (BARTOLI) or "points" (FAUGERAS).
    points : list of int
        The reference points.
    """

    reference: str
    points: list[int]

    def linearize(self, state: BundleState) -> Linearized:
        """Return the normal equations by the free parameters."""
        system = super().linearize(state).transformed(*self._bases(state))
        assert isinstance(system, Linearized)
        return system

    def retract(self, state: BundleState, step: Array) -> tuple[Array, Array]:
        """Return the estimate that a step of the free parameters leads to."""
        B_cameras, B_points = self._bases(state)
        x = step[: state.P.size].reshape(-1, 12)
        y = step[state.P.size :].reshape(-1, 4)
        moved_x = np.einsum("nij,nj->ni", B_cameras, x).reshape(state.P.shape)
        moved_y = np.einsum("nij,nj->ni", B_points, y)
        P, Q = state.P + moved_x, state.Q + moved_y
        if self.reference == "cameras":
            P[1] = self._second_camera(state.P[1], x[1, :7])
        return P, Q

    def depth_blocks(self, state: BundleState) -> tuple[Array, Array]:
        """Return the diagonal blocks of Z^T Z by the free parameters."""
        parts = zip(self._bases(state), super().depth_blocks(state), strict=True)
        cameras, points = (np.swapaxes(B, 1, 2) @ blocks @ B for B, blocks in parts)
        return cameras, points

    def _bases(self, state: BundleState) -> tuple[Array, Array]:
        n, m = len(state.P), len(state.Q)
        cameras = np.tile(np.eye(12), (n, 1, 1))
        points = np.tile(np.eye(4), (m, 1, 1))
        if self.reference == "points":
            points[self.points] = 0.0
            return cameras, points
        cameras[0] = 0.0
        points[:, 2, 2] = 0.0
        if self.reference == "cameras":
            cameras[1] = 0.0
            _, A_perp = self.kernels.canonical_camera_derivatives(*_factors(state.P[1]))
            cameras[1, :, :7] = A_perp
        return cameras, points

    def _second_camera(self, P2: Array, delta: Array) -> Array:
        moved = Ortho(self.kernels).retract(_factors(P2), delta)
        return np.asarray(self.kernels.canonical_camera(*moved))


def _factors(P2: Array) -> OrthonormalF:
    """Return U, V, sigma of a canonic camera P' = (u2 v1^T - sigma u1 v2^T | u3) (B&S eq. 5)."""
    U, values, Vt = np.linalg.svd(P2[:, :3])
    # H = u2 v1^T - sigma u1 v2^T: its left vectors are u2, -u1 and, up to sign, u3. The singular
    # value one belongs to u2; it is the second where a step has taken sigma beyond one.
    one, other = (0, 1) if abs(values[0] - 1.0) <= abs(values[1] - 1.0) else (1, 0)
    factors = np.column_stack([-U[:, other], U[:, one], P2[:, 3]])
    return OrthonormalF(factors, Vt[[one, other, 2]].T, np.asarray(values[other] / values[one]))


def _normalization_constraints(system: Linearized, state: BundleState) -> Linearized:
    """Add first-order constraints: unit norms, and sum Q Q^T fixed (ten of them)."""
    weight = float(np.mean(np.einsum("nii->ni", system.V)))
    p, q = scales(state.P, state.Q)
    border = np.sqrt(weight) * scatter_constraints(state.Q)
    return replace(
        system,
        U=system.U + weight * p[:, :, None] * p[:, None, :],
        V=system.V + weight * q[:, :, None] * q[:, None, :],
        border=(np.zeros((len(p), 12, border.shape[2])), border),
    )


@dataclass(frozen=True)
class Strategy:
    """A method of the 2003 paper, or ours.

    Attributes
    ----------
    damping : callable
        Makes its damping.
    gauge : Gauge or None
        Gauge it starts in and, where `explicit`, returns to; None leaves the caller's basis.
    explicit : bool
        Move into the gauge after every step.
    reference : str
        What is frozen, as in `RestrictedProblem`.
    every : int
        How often to move.
    constrained : bool
        First-order constraints.
    embedded : bool
        Whether re-triangulation after each step is the default.
    what : str
        One sentence for reports.
    """

    damping: Callable[[], object]
    what: str
    gauge: Gauge | None = None
    explicit: bool = False
    reference: str = ""
    every: int = 1
    constrained: bool = False
    embedded: bool = False


#: The strategies by name; the order is that of tables.
STRATEGIES: dict[str, Strategy] = {
    "free": Strategy(dampings.PseudoInverse, "all free, pseudo-inverse"),
    "levenberg": Strategy(dampings.Levenberg, "all free, damping lambda I"),
    "marquardt": Strategy(dampings.Marquardt, "all free, damping lambda diag(N)"),
    "hartley": Strategy(
        dampings.Levenberg, "one reference camera", reference_camera(), reference="camera"
    ),
    "bartoli": Strategy(
        dampings.Levenberg, "two reference cameras", two_cameras(), reference="cameras"
    ),
    "faugeras": Strategy(
        dampings.Levenberg, "five reference points", five_points(), reference="points"
    ),
    "mclauchlan": Strategy(
        dampings.Levenberg,
        "normalised basis and first-order constraints",
        normalized(),
        explicit=True,
        constrained=True,
    ),
    "kanatani": Strategy(
        dampings.Levenberg, "all free, periodically normalised", normalized(), True, every=5
    ),
    "gauge_invariant": Strategy(dampings.GaugeInvariant, "Table 1 of the 2003 paper as printed"),
    "gauge_invariant_factor": Strategy(
        lambda: dampings.GaugeInvariant("factor"), "Table 1 solved by a singular vector: rank one"
    ),
    "covariant": Strategy(
        dampings.Covariant, "covariant damping, points re-triangulated", embedded=True
    ),
}
