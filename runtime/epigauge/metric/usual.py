"""What usual cameras are like: where a search begins, and what is known of what it holds.

Focal lengths and principal points are in units of width plus height of the images.
"""

from __future__ import annotations

import numpy as np

__all__ = ["BENDS", "BEND_KNOWN", "CENTRE_KNOWN", "FOCALS", "GUESSES", "TURNING_FOCALS"]

#: Focal lengths from a very wide lens to a long one.
FOCALS = np.geomspace(0.2, 5.0, 14)

#: Those that a scene grows from where nothing better is known, the most usual one first.
GUESSES = (0.7, 0.4, 1.2)

#: Those, and distortions, that views are turned onto one another with. Through longer lenses nearly
#: all views look as if turned.
TURNING_FOCALS, BENDS = np.geomspace(0.25, 2.0, 7), np.array([-0.3, -0.15, 0.0, 0.1])

#: Intrinsics are refined if their standard deviations are below this (principal points), and this
#: number (coefficients of distortion); others are known to as much.
CENTRE_KNOWN, BEND_KNOWN = 0.02, 0.1
