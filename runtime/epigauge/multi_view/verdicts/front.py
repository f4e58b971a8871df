"""Which observations are of points behind the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.seen import Seen

__all__ = ["BEHIND", "behind"]

Array = NDArray[np.float64]

#: Share of the observations that may lie behind a camera before it is told: chance, and far points.
BEHIND = 0.01


def behind(seen: Seen, third: Array) -> int:
    """Return the number of observations whose point is behind the camera.

    The third coordinate of P Q is the depth times the scales of camera and point: there are signs
    of these for which all are positive, or else some point is behind a camera that sees it.
    """
    view, point, sign = seen.view, seen.point, np.sign(third)
    of_view = np.zeros(seen.n)
    of_view[np.argmax(np.bincount(view))] = 1.0
    before = -1
    for _ in range(seen.n + 20):
        of_point = np.sign(np.bincount(point, weights=sign * of_view[view]))
        of_view = np.sign(np.bincount(view, weights=sign * of_point[point]))
        wrong = int(np.count_nonzero(sign * of_view[view] * of_point[point] <= 0.0))
        if wrong in (0, before):
            break
        before = wrong
    return wrong
