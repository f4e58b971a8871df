"""What of a metric reconstruction is to be refined, as ties."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.freedom import Freedom
from epigauge.bundle.prior_kinds import (
    Distance,
    IntrinsicPrior,
    PointPrior,
    PositionPrior,
    Prior,
    RotationPrior,
)
from epigauge.bundle.ties import Ties
from epigauge.cameras import CameraModel, Cameras, MetricReconstruction, camera_model
from epigauge.errors import ArgumentError

__all__ = ["fixed_indices", "refinable", "refined_freedom", "whole_freedom"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Numbers of a camera's own tangent before its intrinsics: turn and move.
POSE = 6


def refinable(refine: Any, cameras: Cameras) -> dict[str, Array]:
    """Return the unknown intrinsics by name, as directions (c, k) of the cameras' parameters.

    Parameters
    ----------
    refine : "all", "pose" or sequence of str
        All parameters, none, or those named. "f" of a model with fx and fy changes both and keeps
        their ratio.
    cameras : Cameras
        The start.

    Raises
    ------
    ArgumentError
        On a name that the model does not have.
    """
    names = camera_model(cameras.model).adjusted
    unit = np.broadcast_to(np.eye(len(names)), (len(cameras), len(names), len(names)))
    known = {name: unit[:, k] for k, name in enumerate(names)}
    if "f" not in names and {"fx", "fy"} <= set(names):
        fx, fy = names.index("fx"), names.index("fy")
        both = np.zeros((len(cameras), len(names)))
        both[:, fx], both[:, fy] = 1.0, cameras.params[:, fy] / cameras.params[:, fx]
        known["f"] = both
    if isinstance(refine, str):
        chosen: Sequence[Any] = {"all": names, "pose": ()}.get(refine, (refine,))
    else:
        try:
            chosen = tuple(refine)
        except TypeError:
            raise ArgumentError("refine", f"is {refine!r:.60}", "'all', 'pose' or names") from None
    for name in chosen:
        if not isinstance(name, str) or name not in known:
            listed = ", ".join(known) or "no parameters"
            needed = f"'all', 'pose', or names of {cameras.model}: {listed}"
            raise ArgumentError("refine", f"names {name!r:.60}", needed)
    if len(set(chosen)) < len(chosen) or ("f" in chosen and {"fx", "fy"} & set(chosen) - {"f"}):
        raise ArgumentError("refine", f"names a parameter twice: {tuple(chosen)}", "each name once")
    return {name: known[name] for name in chosen}


def listed(name: str, value: Iterable[int]) -> tuple[int, ...]:
    """Return what may be an iterator as a tuple.

    Raises
    ------
    ArgumentError
        If it lists nothing, as a number does.
    """
    try:
        return tuple(value)
    except TypeError:
        raise ArgumentError(name, f"is {value!r:.60}", "a list of integers") from None


def fixed_indices(name: str, value: Iterable[int], count: int) -> Indices:
    """Return numbers of views or points to be fixed, each once."""
    if isinstance(value, tuple) and not value:
        return np.zeros(0, np.intp)
    array = np.asarray(value if isinstance(value, np.ndarray) else list(value))
    if array.size == 0:
        return np.zeros(0, np.intp)
    if array.dtype == np.bool_ and array.shape == (count,):
        return np.flatnonzero(array)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ArgumentError(name, f"is {array.dtype} {array.shape}", "integers (k,)")
    bad = np.flatnonzero((array < 0) | (array >= count))
    if len(bad):
        raise ArgumentError(name, f"names {array[bad[0]]}", f"0 to {count - 1}")
    return np.unique(array).astype(np.intp)


def whole_freedom(
    model: CameraModel, n: int, m: int, fixed_views: Indices, fixed_points: Indices
) -> Freedom:
    """Return what is free of cameras that are refined as a whole, or not at all.

    Parameters
    ----------
    model : CameraModel
        The camera.
    n, m : int
        Numbers of views and points.
    fixed_views, fixed_points : ndarray of int
        What stays.
    """
    if not len(fixed_views) + len(fixed_points):
        return Freedom()
    A = None
    if len(fixed_views):
        A = np.tile(np.eye(model.tangent_size), (n, 1, 1))
        A[fixed_views] = 0.0
    kept = np.zeros(m, np.bool_)
    kept[fixed_points] = True
    ties = Ties(A=A, C=_points(m, fixed_points, model.point_size))
    return Freedom(ties, kept if kept.any() else None)


def refined_freedom(
    start: MetricReconstruction,
    refine: Any,
    fixed_views: Indices,
    fixed_points: Indices,
    priors: Sequence[Prior],
) -> Freedom:
    """Return what is free, as ties.

    Intrinsics of a camera that took one view are unknowns of that view; those of several views are
    shared.

    Raises
    ------
    ArgumentError
        If nothing is left to refine, or a prior is on what is fixed.
    """
    cameras, n, m = start.cameras, start.n_views, start.n_points
    unknown = refinable(refine, cameras)
    _check_priors(priors, cameras, unknown, fixed_views, fixed_points)
    if not unknown and len(fixed_views) == n and len(fixed_points) == m:
        raise ArgumentError(
            "refine", "leaves nothing: all views and points are fixed", "an unknown"
        )
    k, q = len(camera_model(cameras.model).adjusted), len(unknown)
    directions = np.stack(list(unknown.values()), axis=2) if q else np.zeros((len(cameras), k, 0))
    of_view = directions[cameras.camera_of_view]
    views = np.bincount(cameras.camera_of_view, minlength=len(cameras))
    alone = views[cameras.camera_of_view] == 1
    local = q if alone.any() else 0
    A = np.zeros((n, POSE + k, POSE + local))
    A[:, :POSE, :POSE] = np.eye(POSE)
    A[fixed_views, :POSE] = 0.0
    if local:
        A[:, POSE:, POSE:] = np.where(alone[:, None, None], of_view, 0.0)
    whole = A.shape[1] == A.shape[2] and (A == np.eye(len(A[0]))).all()
    ties = Ties(A=None if whole else A, C=_points(m, fixed_points, 3))
    several = np.flatnonzero(views > 1)
    if q and len(several):
        number = np.zeros(len(cameras), np.intp)
        number[several] = np.arange(len(several))
        E = np.zeros((n, POSE + k, q))
        E[:, POSE:] = np.where(alone[:, None, None], 0.0, of_view)
        index = q * number[cameras.camera_of_view][:, None] + np.arange(q)
        ties = Ties(ties.A, E, index, q * len(several), ties.C)
    kept = np.zeros(m, np.bool_)
    kept[fixed_points] = True
    kept[[prior.point for prior in priors if isinstance(prior, PointPrior)]] = True
    for prior in priors:
        if isinstance(prior, Distance):
            kept[[prior.point1, prior.point2]] = True
    return Freedom(ties, kept if kept.any() else None)


def _points(m: int, fixed: Indices, size: int) -> Array | None:
    if not len(fixed):
        return None
    C = np.tile(np.eye(size), (m, 1, 1))
    C[fixed] = 0.0
    return C


def _check_priors(
    priors: Sequence[Prior],
    cameras: Cameras,
    unknown: dict[str, Array],
    fixed_views: Indices,
    fixed_points: Indices,
) -> None:
    names = camera_model(cameras.model).adjusted
    free = np.zeros(len(names), np.bool_)
    for direction in unknown.values():
        free |= direction.any(axis=0)
    for number, prior in enumerate(priors):
        what, remedy = f"priors[{number}]", "a prior on what is refined, or nothing fixed there"
        if isinstance(prior, PositionPrior | RotationPrior) and prior.view in fixed_views:
            raise ArgumentError(what, f"is on view {prior.view}, which is fixed", remedy)
        if isinstance(prior, PointPrior) and prior.point in fixed_points:
            raise ArgumentError(what, f"is on point {prior.point}, which is fixed", remedy)
        if isinstance(prior, Distance) and {prior.point1, prior.point2} <= set(fixed_points):
            raise ArgumentError(what, "is between points that are both fixed", remedy)
        if isinstance(prior, IntrinsicPrior) and not free[names.index(prior.name)]:
            raise ArgumentError(
                what, f"is on {prior.name}, which refine={tuple(unknown)} fixes", remedy
            )
