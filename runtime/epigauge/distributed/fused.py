"""The passes of the compiled loop over a partition: what a step costs in one process, and no more.

The default method's damping is made within the pass: lam tr(V) / b of metric cameras,
lam (V + Z^T Z) of homogeneous points in the factored route.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge._library import address
from epigauge._native import BLOCK, TRACE, aligned_zeros, checked, function
from epigauge.bundle.linearizer import Linearizer, Normal
from epigauge.bundle.native_coupling import NativePairs
from epigauge.bundle.native_linearizer import NativeLinearizer

__all__ = ["Elimination", "eliminate", "fits"]

Array = NDArray[np.float64]


class Elimination(NamedTuple):
    """Normal equations, and points eliminated with a damping.

    Attributes
    ----------
    normal : Normal
        The normal equations.
    T, half : ndarray, shape (m, b, b), (m, b)
        Inverse roots of the damped blocks of points, and T^T g.
    singular : bool
        Whether the block of a point is not positive definite.
    pairs, right : NativePairs, ndarray of shape (n, d), or None
        W T T^T W^T, and W T half, where asked for.
    D : ndarray, shape (m, b, b), or None
        The damping, where it is not that of the pass.
    """

    normal: Normal
    T: Array
    half: Array
    singular: bool = False
    pairs: NativePairs | None = None
    right: Array | None = None
    D: Array | None = None

    def point_steps(self, step: Array) -> tuple[Array, float]:
        """Return the points' part y of a step of the cameras (n, d), and y . D y."""
        normal, D = self.normal, self.D
        coupled = normal.coupling.to_points(self.T, step)
        if D is not None:
            y = -np.einsum("mij,mj->mi", self.T, self.half + coupled)
            return y, float(np.einsum("mi,mij,mj->", y, D, y))
        (m, b), y = self.half.shape, np.empty(self.half.shape)
        D = np.einsum("mii->m", normal.V) / b  # of a multiple of I
        if normal.depth_blocks is not None:
            D = normal.V + normal.depth_blocks[1]
        before = map(address, (self.T, self.half, coupled, D))
        energy = function("bundle_point_steps")(m, b, *before, D[0].size, address(y))
        return y, float(energy)


def fits(linearizer: Linearizer) -> bool:
    """Tell whether the passes know the linearizer and the damping of its camera."""
    if not isinstance(linearizer, NativeLinearizer):
        return False
    return linearizer.model.metric or linearizer.factored


def eliminate(
    own: NativeLinearizer, cameras: Array, points: Array, lam: float, pairs: bool
) -> Elimination:
    """Linearise and eliminate the points, each observation evaluated once.

    Parameters
    ----------
    own : NativeLinearizer
        The observations, with one thread.
    cameras, points : ndarray, shape (n, c), (m, b)
        The estimate.
    lam : float
        Of the damping.
    pairs : bool
        Whether pairs of cameras are asked for. All else has the same bits without.
    """
    skyline, (m, b) = own.skyline, points.shape
    inner, points = own.layout.inward(cameras), np.ascontiguousarray(points)
    V, depths, g = own.room(points)
    T, half = np.empty((m, b, b)), np.empty((m, b))
    sums = aligned_zeros((skyline.n, own.camera_sums))
    # Those of many views, of which only products are asked for, would take all the memory.
    taken = aligned_zeros((skyline.blocks, own.pair_sums.size)) if pairs else None
    right = np.zeros((skyline.n, own.width))
    status = function("bundle_eliminate")(
        *(own.reference, 0, len(own.layout.lanes) - 1, address(inner), address(points), lam),
        TRACE if own.model.metric else BLOCK,
        skyline.reference,
        *map(address, (V, depths, g, T, half, sums, taken, right)),
    )
    checked(status & 1)
    normal = own.gathered((inner, points), sums, V, depths, g)
    if taken is None:
        return Elimination(normal, T, half, bool(status))
    there = NativePairs(own, skyline, taken, own.pair_sums)
    return Elimination(normal, T, half, bool(status), there, own.wide(right))
