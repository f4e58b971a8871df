"""Focal lengths from one fundamental matrix."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge import kernels
from epigauge._arguments import as_fundamental, as_positive, as_real
from epigauge._results import Result
from epigauge.errors import ArgumentError

__all__ = ["FocalLengths", "focal_lengths"]

Array = NDArray[np.float64]

#: Relative standard deviations beyond which a focal length is weak, or open.
WEAK, OPEN = 0.05, 0.3


#: Largest coordinate of a principal point that is accepted, pixels.
_FARTHEST = 1e9

#: Range of shared focal lengths, in units of about three centres' distance from the corner; how
#: many are tried in it, and steps from the best of them, of Newton or by halves.
_RANGE, _TRIED, _STEPS = (0.02, 50.0), 240, 12

#: Curvature of the difference by log f that rounding alone makes, with a margin: there every focal
#: length does.
_ROUNDING = 1e-11

_Variances = Callable[[Array, Array], Array]


class _Focal(NamedTuple):
    focal_px: tuple[float, float]
    std_px: tuple[float, float]
    flag: str


class FocalLengths(_Focal, Result):
    """Focal lengths of two views.

    Attributes
    ----------
    focal_px : tuple of float
        Of the first and the second view; NaN where F has none.
    std_px : tuple of float
        Their standard deviations, to first order.
    flag : str
        Empty; "weak focal length" beyond 5 %; "ambiguous" where a shared one has a second value as
        good; or "undetermined" beyond 30 %, or where F has no real focal lengths: the optical axes
        meet or are parallel, or nearly so.

    Examples
    --------
    >>> import epigauge as eg
    >>> found = eg.FocalLengths((812.0, 809.5), (9.1, 9.3), "")
    >>> found.focal_px[0], found.flag
    (812.0, '')
    """

    __slots__ = ()

    def _contents(self) -> dict[str, Any]:
        return self._asdict()


def focal_lengths(
    F: ArrayLike,
    centre1: ArrayLike,
    centre2: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    centre_std_px: float = 10.0,
    shared: bool = False,
    backend: str | None = None,
) -> FocalLengths:
    """Return the focal lengths of two views with square pixels from their fundamental matrix.

    f1^2 = -(p2^T [e2]x D F p1) (p1^T F^T p2) / (p2^T [e2]x D F D F^T p2) with D = diag(1, 1, 0),
    principal points p1, p2 and the epipole e2 [1]_, and likewise for the second view. Where both
    have one focal length, it is the one with which K2^T F K1 is nearest to an essential matrix, of
    two equal singular values [2]_.

    Parameters
    ----------
    F : array_like, shape (3, 3)
        Fundamental matrix, ``x2^T F x1 = 0`` in pixels.
    centre1, centre2 : array_like, shape (2,)
        Principal points in pixels, as a rule the centres of the images.
    covariance : array_like, shape (9, 9), optional
        Covariance of F row by row, such as `FundamentalResult.covariance`, for the same scale of F.
        By default F counts as exact.
    centre_std_px : float
        Standard deviation of each coordinate of the principal points. The centre of an image is
        rarely the principal point to better than about ten pixels.
    shared : bool
        Whether both views have one focal length, as of one camera. Then it is known in more
        arrangements: not where the optical axes are parallel, or meet in a point at one distance
        from both centres.
    backend : {"c", "numpy", "casadi"}, optional
        Where the formula is computed.

    Returns
    -------
    FocalLengths
        ``focal_px``, ``std_px``, ``flag``.

    Raises
    ------
    ArgumentError
        On other shapes, and numbers that are not finite.

    Notes
    -----
    Nothing is determined where both optical axes lie in one plane, as of two cameras side by side
    or turned towards one point: the most frequent arrangements of two views. More views do better:
    see `metric_upgrade`. With a shared focal length the flag is "ambiguous" where another one is
    nearly as good as noise goes.

    References
    ----------
    .. [1] S. Bougnoux, "From projective to Euclidean space under any practical situation, a
       criticism of self-calibration", ICCV 1998.
    .. [2] P. Sturm, "On focal length calibration from two views", CVPR 2001.

    Examples
    --------
    >>> import epigauge as eg, numpy as np
    >>> K1, K2 = np.diag([800.0, 800.0, 1.0]), np.diag([900.0, 900.0, 1.0])
    >>> R = np.array([[0.8, 0.0, -0.6], [0.36, 0.8, 0.48], [0.48, -0.6, 0.64]])
    >>> E = np.cross(np.eye(3), [1.0, 0.5, 0.2]).T @ R
    >>> F = np.linalg.inv(K2) @ E @ np.linalg.inv(K1)
    >>> found = eg.focal_lengths(F, (0, 0), (0, 0), centre_std_px=1.0)
    >>> np.round(found.focal_px, 6).tolist(), found.flag
    ([800.0, 900.0], '')
    >>> F = np.linalg.inv(K1) @ E @ np.linalg.inv(K1)
    >>> round(eg.focal_lengths(F, (0, 0), (0, 0), shared=True).focal_px[0], 6)
    800.0
    """
    matrix = as_fundamental(F, "F")
    values = np.linalg.svd(matrix, compute_uv=False)
    if values[1] <= 1e-14 * values[0]:
        raise ArgumentError("F", "has rank 1", "a matrix of rank 2")
    c = np.concatenate([_checked("centre1", centre1, (2,)), _checked("centre2", centre2, (2,))])
    if np.abs(c).max() > _FARTHEST:
        raise ArgumentError("centre1, centre2", f"reach {np.abs(c).max():.3g} px", "image points")
    C = np.zeros((9, 9))
    if covariance is not None:
        rescaling = float(np.abs(matrix).max() / np.abs(np.asarray(F, dtype=np.float64)).max())
        C = _checked("covariance", covariance, (9, 9)) * rescaling**2
    centre_std = as_positive("centre_std_px", centre_std_px, zero=True)
    # In units of which focal lengths are about one, and F of norm one.
    unit = max(float(np.abs(c).mean()), 100.0) * 3.0
    D = np.diag([unit, unit, 1.0])
    scaled = D @ matrix @ D
    size = float(np.linalg.norm(scaled))
    scaled, c = scaled / size, c / unit
    by_F, by_centre = np.outer(np.diag(D), np.diag(D)).ravel() / size, (centre_std / unit) ** 2

    def variances(J_F: Array, J_c: Array) -> Array:
        rows = J_F * by_F
        own = np.einsum("ki,ij,kj->k", rows, C, rows) + by_centre * np.sum(J_c**2, axis=1)
        return np.asarray(np.maximum(own, 0.0))

    solve = _shared if shared else _each
    with np.errstate(all="ignore"):
        focal, share, ambiguous = solve(kernels.table(backend), scaled, c, variances)
    share = np.nan_to_num(share, nan=np.inf, posinf=np.inf)
    worst = float(share.max())
    weak = "weak focal length" if worst > WEAK else ""
    flag = "undetermined" if worst > OPEN else "ambiguous" if ambiguous else weak
    first, second = (unit * focal).tolist()
    with np.errstate(all="ignore"):
        of_first, of_second = np.nan_to_num(
            unit * focal * share, nan=np.inf, posinf=np.inf
        ).tolist()
    return FocalLengths((first, second), (of_first, of_second), flag)


def _each(table: Any, F: Array, c: Array, variances: _Variances) -> tuple[Array, Array, bool]:
    """Return the focal length of each view, their relative deviations, and that there is one."""
    shifts = np.array([[[1, 0, x], [0, 1, y], [0, 0, 1]] for x, y in c.reshape(2, 2)])
    U, _, Vt = np.linalg.svd(shifts[1].T @ F @ shifts[0])
    squares, J_F, J_c = table.two_view_focals(F, c[:2], c[2:], Vt[2], U[:, 2])
    focal = np.sqrt(np.where(squares > 0.0, squares, np.nan))
    return focal, np.sqrt(variances(J_F, J_c)) / (2.0 * focal**2), False


def _shared(table: Any, F: Array, c: Array, variances: _Variances) -> tuple[Array, Array, bool]:
    """Return the focal length of both views, its deviation, and whether another is as good."""

    def at(log_f: Array) -> tuple[Array, ...]:
        n = len(log_f)
        many = [np.ascontiguousarray(np.broadcast_to(x[..., None], (*x.shape, n))) for x in (F, c)]
        found = table.shared_focal(many[0], many[1][:2].copy(), many[1][2:].copy(), np.exp(log_f))
        return tuple(np.asarray(array) for array in found)

    grid = np.log(np.geomspace(_RANGE[0], _RANGE[1], _TRIED))
    difference = at(grid)[0].ravel()
    inner = np.flatnonzero(
        (difference[1:-1] < difference[:-2]) & (difference[1:-1] <= difference[2:])
    )
    if not len(inner):
        return np.full(2, np.nan), np.full(2, np.inf), False
    log_f, low, high = grid[inner + 1], grid[inner], grid[inner + 2]
    for _ in range(_STEPS):
        _, slope, curvature, _, _ = at(log_f)
        slope, curvature = slope.ravel(), curvature.ravel()
        low, high = np.where(slope < 0.0, log_f, low), np.where(slope > 0.0, log_f, high)
        newton = log_f - slope / curvature
        within = (curvature > 0.0) & (newton > low) & (newton < high)
        log_f = np.where(within, newton, np.where(slope == 0.0, log_f, 0.5 * (low + high)))
    difference, _, curvature, J_F, J_c = at(log_f)
    order = np.argsort(difference.ravel(), kind="stable")
    best = order[0]
    k = float(curvature.ravel()[best])
    variance = float(variances(J_F[..., best].reshape(1, 9), J_c[..., best].reshape(1, 4))[0])
    share = np.sqrt(variance) / k if k > _ROUNDING else np.inf
    # What noise makes of a difference that is zero without: half the curvature, times variance.
    noise = variance / (2.0 * k) if k > _ROUNDING else np.inf
    others = difference.ravel()[order[1:]] - difference.ravel()[best]
    return np.full(2, np.exp(log_f[best])), np.full(2, share), bool((others < 9.0 * noise).any())


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = as_real(name, value, f"an array of shape {shape}")
    if array.shape != shape:
        raise ArgumentError(name, f"has shape {array.shape}", f"{shape}")
    if not np.isfinite(array).all():
        raise ArgumentError(name, "is not finite", "finite numbers")
    return np.asarray(array, dtype=np.float64)
