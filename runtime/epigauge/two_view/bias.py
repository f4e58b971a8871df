"""Kanatani's bias correction of the maximum-likelihood F."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.covariance import tangent_basis
from epigauge.two_view.criteria import FootPoints, Reprojection
from epigauge.two_view.parameterizations import factorize

__all__ = ["bias_corrected"]

Array = NDArray[np.float64]


def bias_corrected(
    reprojection: Reprojection, F: Array, feet: FootPoints, weights: Array, variance: float
) -> Array:
    """Return F less its second-order bias in Kanatani's formula, of rank 2.

    With theta = vect(F), xi = vect(q2 q1^T) at the corrected matches, n the gradient of xi^T theta
    by the match, W = 1 / |n|^2, M = (1/N) sum W xi xi^T, M^- its inverse in F's tangent space,

        theta <- theta - (variance / N^2) M^- sum W^2 (xi^T M^- V theta) xi,

    where V theta = (d xi / d q) n. The epipolar constraint is bilinear, so that the other term of
    the formula vanishes. The curvature of the constraint det F = 0 is not part of it.

    Parameters
    ----------
    reprojection : Reprojection
        Conditioned matches.
    F : ndarray, shape (3, 3)
        The estimate in the same coordinates.
    feet : FootPoints
        Its foot points.
    weights : ndarray, shape (m,)
        Weights of the matches; those of zero weight are left out.
    variance : float
        Of the noise of a conditioned coordinate.

    Returns
    -------
    ndarray, shape (3, 3)
        The corrected matrix.

    References
    ----------
    .. [1] K. Kanatani, Y. Sugaya, "Hyperaccurate correction of maximum likelihood for geometric
       estimation", IPSJ Trans. on Computer Vision and Applications 5, 2013.
    """
    F = F / np.linalg.norm(F)
    q1_hat, q2_hat, _ = reprojection.corrected(feet)
    counts = weights > 0.0
    w = weights[counts]
    ones = np.ones((1, len(w)))
    q1, q2 = np.vstack([q1_hat[:, counts], ones]), np.vstack([q2_hat[:, counts], ones])
    n1, n2 = F.T @ q2, F @ q1
    n1[2] = n2[2] = 0.0
    # A match of weight w has noise of variance / w.
    W = w / (np.sum(n1**2, axis=0) + np.sum(n2**2, axis=0))
    xi = _products(q2, q1)
    V_theta = (_products(q2, n1) + _products(n2, q1)) / w
    basis = tangent_basis(F)
    inverse = basis @ np.linalg.pinv(basis.T @ ((xi * W) @ xi.T) @ basis) @ basis.T
    along = np.sum(xi * (inverse @ V_theta), axis=0)
    corrected = F.ravel() - variance * inverse @ (xi @ (W**2 * along))
    U, V, sigma = factorize(corrected.reshape(3, 3))
    return np.asarray((U[:, :2] * [1.0, sigma]) @ V[:, :2].T)


def _products(a: Array, b: Array) -> Array:
    """Return vect(a b^T) of corresponding columns, (9, m)."""
    return (a[:, None, :] * b[None, :, :]).reshape(9, -1)
