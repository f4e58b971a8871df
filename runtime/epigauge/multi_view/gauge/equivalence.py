"""Whether two reconstructions are one geometry (B03 eq. 6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.multi_view.gauge.gauges import normalized
from epigauge.multi_view.gauge.transformations import Transformation
from epigauge.multi_view.reconstruction import Reconstruction

__all__ = ["equivalent"]

Array = NDArray[np.float64]


def equivalent(a: Reconstruction, b: Reconstruction, tol: float = 1e-8) -> bool:
    """Tell whether two reconstructions are the same geometry (B03 eq. 6).

    Parameters
    ----------
    a, b : Reconstruction
        Of the same views and points.
    tol : float
        Largest sine of the angle between a camera (or point) of b and its image from a, as vectors
        of R^12 (R^4), in the basis where the points of b are spread evenly.

    Returns
    -------
    bool
        True where some T, gamma, alpha take a to b.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.multi_view_scene(seed=1).tracks
    >>> a = eg.initialize(tracks)
    >>> b = eg.gauge.transform(a, 2.0 * np.eye(4) + np.eye(4, k=1))
    >>> eg.gauge.equivalent(a, b)
    True
    """
    if a.P.shape != b.P.shape or a.Q.shape != b.Q.shape:
        return False
    P_a, Q_a = normalized().transformation(a.P, a.Q).apply(a.P, a.Q)
    P_b, Q_b = normalized().transformation(b.P, b.Q).apply(b.P, b.Q)
    # P_a T ~ P_b: the part of P_a T across P_b vanishes; the unknown is vect(T).
    normal = np.zeros((16, 16))
    for camera_a, camera_b in zip(P_a, P_b, strict=True):
        linear = np.kron(camera_a, np.eye(4))
        across = linear - np.outer(camera_b.ravel(), camera_b.ravel() @ linear)
        normal += across.T @ across
    T = np.linalg.eigh(normal)[1][:, 0].reshape(4, 4)
    if np.linalg.cond(T) > 1e12:
        return False
    ones = (np.ones(len(P_a)), np.ones(len(Q_a)))
    moved_P, moved_Q = Transformation(T, *ones).apply(P_a, Q_a)
    return _sine(moved_P.reshape(-1, 12), P_b.reshape(-1, 12)) <= tol and _sine(moved_Q, Q_b) <= tol


def _sine(a: Array, b: Array) -> float:
    """Return the largest sine of the angle between corresponding rows."""
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    along = np.sum(a * b, axis=1, keepdims=True)
    return float(np.linalg.norm(a - along * b, axis=1).max(initial=0.0))
