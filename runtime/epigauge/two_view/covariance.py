"""Uncertainty of a fundamental matrix: the (9, 9) covariance of its entries, of rank 7."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Uncertainty", "fundamental_covariance", "tangent_basis"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Uncertainty:
    """What the matches say about F to second order.

    Attributes
    ----------
    covariance : ndarray, shape (9, 9)
        Covariance of vect(F); infinite on its diagonal where the matches leave F undetermined.
    rank : int
        Number of directions, of 7, that the matches determine.
    condition : float
        Ratio of the largest to the smallest standard deviation over these directions, in
        conditioned coordinates; infinity where `rank` is below 7.
    """

    covariance: Array
    rank: int
    condition: float


def tangent_basis(F: Array) -> Array:
    """Return an orthonormal basis of the directions in which F stays of rank 2 and unit norm.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Of rank 2 and unit Frobenius norm.

    Returns
    -------
    ndarray, shape (9, 7)
        Columns are directions of vect(F). Unlike the derivative of the orthonormal representation,
        it has rank 7 at sigma = 1 too.
    """
    U, _, Vt = np.linalg.svd(F)
    # To first order the rank stays 2 when u3^T dF v3 = 0, and the norm when <F, dF> = 0.
    normals = np.column_stack([np.outer(U[:, 2], Vt[2]).ravel(), F.ravel()])
    return np.asarray(np.linalg.qr(normals, mode="complete")[0][:, 2:])


def fundamental_covariance(F: Array, N: Array, variance: float, entry_map: Array) -> Uncertainty:
    """Propagate the noise of the matches to the entries of F in pixels.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Conditioned estimate with unit Frobenius norm.
    N : ndarray, shape (9, 9)
        Gauss-Newton matrix by vect(F), conditioned.
    variance : float
        Variance of a conditioned coordinate.
    entry_map : ndarray, shape (9, 9)
        Matrix from vect(F) conditioned to vect(F) in pixels, up to scale.

    Returns
    -------
    Uncertainty
        Covariance of vect(F) in pixels, F with unit Frobenius norm.
    """
    basis = tangent_basis(F)
    values, vectors = np.linalg.eigh(basis.T @ N @ basis)
    determined = values > 1e-14 * max(values[-1], np.finfo(float).tiny)
    rank = int(np.count_nonzero(determined))
    mapped = entry_map @ F.ravel()
    size = float(np.linalg.norm(mapped))
    unit = mapped / size
    # Derivative of entry_map F / |entry_map F|
    derivative = (np.eye(9) - np.outer(unit, unit)) @ entry_map / size
    directions = derivative @ basis @ vectors
    if rank < 7:
        touched = np.any(np.abs(directions[:, ~determined]) > 1e-12, axis=1)
        covariance = np.diag(np.where(touched, np.inf, 0.0))
        return Uncertainty(covariance, rank, float("inf"))
    covariance = (directions / values) @ directions.T * variance
    condition = float(np.sqrt(values[-1] / values[0]))
    return Uncertainty((covariance + covariance.T) / 2.0, rank, condition)
