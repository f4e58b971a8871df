"""Whether gross errors are left in what was adjusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["has_gross_errors"]

Array = NDArray[np.float64]

#: Root mean square over the noise that the median tells, above which few observations carry the
#: cost: up to five in raw tracks that still lead to their optimum.
_HEAVY = 8.0

#: Noise below this share of the extent of the coordinates is rounding.
_EXACT = 1e-8

#: Least squares bends everything to observations whose residuals, as shares of the extent of the
#: coordinates, are larger than the first: below a fifth in most raw tracks, above with two wrong in
#: a thousand. So few as the second cannot: one of 35000 measured ones is off by a third of the
#: extent, and they lead to the published optimum all the same.
_BEYOND, _TOO_FEW = 0.2, 1e-4


def has_gross_errors(distances: Array, noise_px: float, xy: Array) -> bool:
    """Tell whether few residuals carry the cost, or more than a very few are very large."""
    if distances.max() <= _HEAVY * noise_px:  # the extent can only raise the bounds
        return False
    extent = _extent(xy)
    usual = _HEAVY * max(noise_px, _EXACT * extent)
    heavy = float(np.sqrt(np.mean(distances**2) / 2.0)) > usual
    beyond = np.count_nonzero(distances > max(_BEYOND * extent, usual))
    return bool(heavy or beyond > _TOO_FEW * len(distances))


def _extent(xy: Array) -> float:
    """Return the range of the coordinates, to which a few wild ones add little."""
    low, high = np.quantile(xy, (0.005, 0.995), axis=0)
    return float(np.minimum(np.ptp(xy, axis=0), 1.3 * (high - low)).max())
