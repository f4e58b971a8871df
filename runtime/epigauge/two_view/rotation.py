"""Whether a homography is that of a camera that only turned: K R K^-1, with a K that cameras have.

Its eigenvalues are those of a rotation, which is one condition and holds for many planes within the
noise. That pixels are square is another; and a focal length and a principal point that photographs
have exclude nearly all that is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from epigauge.two_view.chance import two_by_chance
from epigauge.two_view.consensus import RANGE

__all__ = ["is_of_a_turned_camera", "may_be_rotation"]

Array = NDArray[np.float64]

#: Focal length over the width of the images: its logarithm is normal around this with this
#: deviation, five times as short or long being three of them. The principal point is normal around
#: the middle of the matches, with this share of the width.
_FOCAL, _FOCAL_DEVIATION, _OFF = 0.9, 0.55, 0.2

#: The chance that a rotation is taken for none: three standard deviations of a normal number.
_DEVIATIONS, _MISSED = 3.0, 0.003

#: A deviation of H below this is rounding.
_ROUNDING = 1e-7

#: Where the search starts, over the width; steps, trials a step, and the step of a derivative.
_STARTS = (0.9, 0.3, 2.5)
_STEPS, _TRIALS, _DERIVATIVE = 25, 6, 1e-6

#: The logarithm of the focal length stays within, conditioned.
_LOG_FOCALS = (-1.0, 5.0)


def may_be_rotation(
    to_units1: Array, to_units2: Array, H: Array, N: Array, noise: float, redundancy: int
) -> bool:
    """Tell whether H may be that of a camera that only turned, within the noise.

    It then has the eigenvalues 1 and exp(+-i a), so that tr H = tr H^-1 at det H = 1, which is
    cheap to test; and it is that of an ordinary camera. Both images must have the same coordinates
    for that: H is mapped from the units of the second image to those of the first.

    Parameters
    ----------
    to_units1, to_units2 : ndarray, shape (3, 3)
        Maps of the images from pixels to the coordinates of H.
    H : ndarray, shape (3, 3)
        Homography of unit norm.
    N : ndarray, shape (9, 9)
        J^T J by vect(H).
    noise : float
        Standard deviation of a coordinate, in the same coordinates.
    redundancy : int
        Degrees of freedom that the noise is known by.

    Returns
    -------
    bool
        Whether a rotation cannot be excluded.
    """
    same = to_units1 @ np.linalg.inv(to_units2)
    G = same @ H
    determinant = float(np.linalg.det(G))
    if determinant == 0.0:
        return False
    values, vectors = np.linalg.eigh(N)
    values = np.maximum(values, np.finfo(float).eps * values[-1])
    spread = noise * np.kron(same, np.eye(3)) @ (vectors[:, 1:] / np.sqrt(values[1:]))
    root = np.cbrt(determinant)
    inverse = np.linalg.inv(G)
    trace, trace_inverse = np.trace(G) / root, np.trace(inverse) * root
    by_log_determinant = -(trace + trace_inverse) / 3.0 * inverse.T
    by_G = np.eye(3) / root + root * (inverse @ inverse).T + by_log_determinant
    deviation = float(np.linalg.norm(by_G.ravel() @ spread))
    if abs(trace - trace_inverse) > _student(redundancy) * deviation:
        return False
    return is_of_a_turned_camera(G, spread @ spread.T, redundancy)


def _student(redundancy: int) -> float:
    """Return the bound of a number whose deviation is known by so many degrees of freedom.

    The quantile of Student's t, as D. Gaver and K. Kafadar (1984) approximate it.
    """
    n = max(redundancy, 1)
    g = (n - 1.5) / (n - 1.0) ** 2 if n > 2 else 1.0
    return math.sqrt(n * math.expm1(g * _DEVIATIONS**2))


def is_of_a_turned_camera(H: Array, covariance: Array, redundancy: int) -> bool:
    """Tell whether a camera with square pixels may have turned.

    Parameters
    ----------
    H : ndarray, shape (3, 3)
        Homography of any scale, both images in the same coordinates, conditioned.
    covariance : ndarray, shape (9, 9)
        Of vect(H).
    redundancy : int
        Degrees of freedom that the noise in it is known by.

    Returns
    -------
    bool
        Whether some K R K^-1 with K = [f, 0, u; 0, f, v; 0, 0, 1] is within the noise.
    """
    bound = two_by_chance(max(redundancy, 1), _MISSED)  # two conditions that H has to meet
    size = float(np.linalg.norm(H))
    H = H / size
    across = (np.eye(9) - np.outer(H, H)) / size
    values, vectors = np.linalg.eigh(across @ covariance @ across.T)
    whiten = (vectors[:, 1:] / np.sqrt(np.maximum(values[1:], _ROUNDING**2))).T
    target = H.ravel() * np.sign(np.linalg.det(H))

    def residuals(p: Array) -> Array:
        K = _camera(p)
        turned = (K @ _rotation(p[3:]) @ np.linalg.inv(K)).ravel()
        off = whiten @ (turned / np.linalg.norm(turned) - target)
        likely = (p[0] - np.log(_FOCAL * RANGE)) / _FOCAL_DEVIATION
        return np.asarray([*off, likely, *(p[1:3] / (_OFF * RANGE))])

    starts = (_start(H, focal * RANGE) for focal in _STARTS)
    return any(_least(residuals, start, bound) <= bound for start in starts)


def _camera(p: Array) -> Array:
    f = np.exp(p[0])
    return np.array([[f, 0.0, p[1]], [0.0, f, p[2]], [0.0, 0.0, 1.0]])


def _rotation(w: Array) -> Array:
    """Return exp([w]x)."""
    angle = float(np.linalg.norm(w))
    if angle < 1e-12:
        return np.eye(3)
    C = np.cross(np.eye(3), w / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * C + (1.0 - np.cos(angle)) * C @ C)


def _start(H: Array, focal: float) -> Array:
    """Return the parameters of the rotation nearest to K^-1 H K, for a focal length."""
    k = np.array([focal, focal, 1.0])
    U, _, Vt = np.linalg.svd(H * np.sign(np.linalg.det(H)) * k / k[:, None])
    R = U @ Vt * np.linalg.det(U @ Vt)
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(axis)) / 2.0
    angle = np.arctan2(sine, (np.trace(R) - 1.0) / 2.0)
    return np.array([np.log(focal), 0.0, 0.0, *(axis * (angle / max(2.0 * sine, 1e-12)))])


def _least(residuals: Callable[[Array], Array], p: Array, bound: float) -> float:
    """Return the sum of squares that damped Gauss-Newton steps lead to, or one within a bound."""
    r, damping = residuals(p), 1e-3
    for _ in range(_STEPS):
        if r @ r <= bound:
            break
        J = np.array([(residuals(p + e) - r) / _DERIVATIVE for e in _DERIVATIVE * np.eye(len(p))])
        N, gradient = J @ J.T, J @ r
        for _ in range(_TRIALS):
            step = np.linalg.solve(N + damping * np.diag(np.diag(N) + 1e-9), -gradient)
            trial = p + step
            trial[0] = np.clip(trial[0], *_LOG_FOCALS)
            after = residuals(trial)
            if after @ after < r @ r:
                break
            damping *= 10.0
        else:
            break
        small = r @ r - after @ after <= 1e-4 * (after @ after)
        p, r, damping = trial, after, 0.1 * damping
        if small:
            break
    return float(r @ r)
