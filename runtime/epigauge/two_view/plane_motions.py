"""The motions of calibrated cameras behind the homography of a plane.

A homography H = R + t n^T / d of rays, d the distance of the plane with normal n, is that of two
motions [1]_. Both explain matches on the plane equally well, whatever the noise. Only one is
possible where some points of the other's plane would be behind the camera.

References
----------
.. [1] Y. Ma, S. Soatto, J. Kosecka, S. S. Sastry, "An invitation to 3-D vision", 2004, section
   5.3.3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["essentials", "leaves_two_motions", "normals"]

Array = NDArray[np.float64]

#: Normals that are nearer than a tenth of a radian are one: both motions go along it.
_APART = 0.1

#: A translation below this, in distances of the plane, is rounding.
_STILL = 1e-9

#: No more than this share of the points is behind a possible plane, or so many: wrong matches that
#: fit it.
_BEHIND, _FEW = 0.02, 2


def normals(H: Array) -> Array:
    """Return the unit normals of both planes, shape (2, 3), up to their signs.

    Parameters
    ----------
    H : ndarray, shape (3, 3)
        Homography of rays, x2 ~ H x1, of any scale.

    Notes
    -----
    H stretches nothing in the plane through the camera that is parallel to that of the points. With
    the singular values s1 >= s2 = 1 >= s3 and right singular vectors v1, v2, v3 of H, there are two
    such planes, of v2 and ``sqrt(1 - s3^2) v1 +- sqrt(s1^2 - 1) v3``. Zero where the camera only
    turned. Proved in tests/derive/test_plane_motions.py.
    """
    _, s, Vt = np.linalg.svd(H)
    s = s / max(s[1], np.finfo(float).tiny)
    low, high = max(1.0 - s[2] ** 2, 0.0) ** 0.5, max(s[0] ** 2 - 1.0, 0.0) ** 0.5
    # v2 x (low v1 +- high v3), up to the sign
    both = np.array([low * Vt[2] - high * Vt[0], low * Vt[2] + high * Vt[0]])
    return np.asarray(both / max(np.hypot(low, high), np.finfo(float).tiny))


def essentials(H: Array) -> Array:
    """Return the essential matrices [t]_x R of both motions, shape (2, 3, 3); none without any.

    Parameters
    ----------
    H : ndarray, shape (3, 3)
        Homography of rays.

    Notes
    -----
    With H of determinant above 0 and s2 = 1, R turns the axes (v2, n x v2, n) of a plane with
    normal n as H does the first two, and t is along (H - R) n.
    """
    _, s, Vt = np.linalg.svd(H)
    H = H * np.sign(np.linalg.det(H)) / max(s[1], np.finfo(float).tiny)
    found = []
    for n in normals(H):
        axes = np.column_stack([Vt[1], np.cross(n, Vt[1]), n])
        first, second = (H @ axes[:, :2]).T
        R = np.column_stack([first, second, np.cross(first, second)]) @ axes.T
        found.append(np.cross((H - R) @ n, R, axisb=0, axisc=0))
    return np.array([E for E in found if np.linalg.norm(E) > _STILL]).reshape(-1, 3, 3)


def leaves_two_motions(H: Array, rays: Array) -> bool:
    """Tell whether both motions of a plane see its points in front of the cameras.

    Parameters
    ----------
    H : ndarray, shape (3, 3)
        Homography of rays.
    rays : ndarray, shape (m, 3)
        Points of the first image as directions.
    """
    n1, n2 = both = normals(H)
    if np.linalg.norm(np.cross(n1, n2)) <= _APART:
        return False
    ahead = np.count_nonzero(rays @ both.T > 0.0, axis=0)
    behind = np.minimum(ahead, len(rays) - ahead)
    return bool(np.all(behind <= max(_FEW, _BEHIND * len(rays))))
