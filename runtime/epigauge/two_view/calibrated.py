"""Essential matrices of raw matches."""

from __future__ import annotations

from typing import Any, Literal

from numpy.typing import ArrayLike

from epigauge._options import FrontEnd
from epigauge.errors import ArgumentError
from epigauge.two_view.robust import RobustResult, estimate_fundamental

__all__ = ["estimate_essential"]


def estimate_essential(
    x1: ArrayLike,
    x2: ArrayLike,
    K1: ArrayLike,
    K2: ArrayLike | None = None,
    *,
    robust: FrontEnd = "auto",
    threshold_px: float | Literal["auto"] = "auto",
    score: ArrayLike | None = None,
    seed: int = 0,
    **options: Any,
) -> RobustResult:
    """Find the essential matrix of raw matches of calibrated cameras, and the motion behind it.

    This is `estimate_fundamental` with ``essential=True``: solutions of five matches give starts,
    and the one with the best likelihood for points in front of both cameras is refined over its
    five parameters.

    Parameters
    ----------
    x1, x2 : array_like, shape (m, 2)
        At least eight different matches in pixels.
    K1, K2 : array_like, shape (3, 3)
        Calibration matrices; `K2` is `K1` by default.
    robust, threshold_px, score, seed : optional
        As for `estimate_fundamental`.
    **options
        Of `refine_fundamental`, but for `F0`, `essential`, `K1` and `K2`.

    Returns
    -------
    RobustResult
        With ``E``, ``R``, ``t`` (of unit length, ``x2 = R x1 + t``), and ``in_front``, the number
        of inliers in front of both cameras: where these are not all, the flag "behind the cameras"
        says so.

    Raises
    ------
    ArgumentError
        On bad arguments.

    Examples
    --------
    >>> import numpy as np
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(n_points=200, noise_px=0.2, seed=1)
    >>> result = eg.estimate_essential(scene.x1, scene.x2, scene.K)
    >>> bool(result.in_front == np.count_nonzero(result.inlier)), result.t.shape
    (True, (3,))
    """
    if K1 is None:  # which refine_fundamental takes for coordinates on the retina
        raise ArgumentError("K1", "is None", "a calibration matrix; np.eye(3) of rays x / z, y / z")
    return estimate_fundamental(
        x1,
        x2,
        robust=robust,
        threshold_px=threshold_px,
        score=score,
        seed=seed,
        essential=True,
        K1=K1,
        K2=K2,
        **options,
    )
