"""Whether the noise hides the relief of a scene of affine cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.moves import best_conditioned
from epigauge.cameras import AffineReconstruction, MetricReconstruction, camera_model

__all__ = ["flatness"]

Array = NDArray[np.float64]


def flatness(found: MetricReconstruction | AffineReconstruction, noise_px: float) -> float:
    """Return what noise alone would spread the images of a flat scene in depth, over what does.

    The third singular value of the measurements of affine cameras over that of noise, whose largest
    one is the sum of the roots of both sizes.
    """
    moved = best_conditioned(camera_model("affine"), found.P.reshape(-1, 12), found.X)[1]
    P = moved.reshape(-1, 3, 4)
    rows, m = P[:, :2, :3].reshape(-1, 3), len(found.X)
    third = float(np.linalg.svd(rows, compute_uv=False)[2]) * np.sqrt(m)
    return float(noise_px * (np.sqrt(len(rows)) + np.sqrt(m)) / max(third, 1e-300))
