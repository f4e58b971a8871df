"""Tracks of many views and reconstructions: NPZ, CSV and BAL."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._bal import nine_numbers, write_bal
from epigauge.io._common import PathLike, check_suffix
from epigauge.io._npz import write_npz
from epigauge.io._track_reading import (
    check_observations,
    count_of,
    form_of,
    kept_rows,
    read_tracks,
    restore_measurement,
    rows_of,
    start_of,
)
from epigauge.io._track_writing import arrays_of, compressing, projective_arrays, write_csv
from epigauge.io.output import writing
from epigauge.multi_view.labels import view_names
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class TrackFile:
    """What a file of tracks holds.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    start : Reconstruction or None
        Cameras and points, where the file has both.
    views, points : ndarray of int
        The numbers in the file of the views and points of the tracks.

    Examples
    --------
    >>> import epigauge as eg
    >>> file = eg.io.load_track_file(eg.samples.path("tracks.csv"))
    >>> file.tracks.n_views, file.start is None, file.views.tolist()
    (5, True, [0, 1, 2, 3, 4])
    """

    tracks: Tracks
    start: Reconstruction | None
    views: Indices
    points: Indices


def load_tracks(
    path: PathLike,
    clean: bool = False,
    views: Iterable[int] | None = None,
    *,
    prune: str | None = None,
    image_size: ArrayLike | None = None,
) -> Tracks:
    """Read tracks from an NPZ, CSV or BAL file.

    NPZ: arrays ``view``, ``point`` (N,) and ``xy`` (N, 2); optionally ``weights`` (N,), ``clean``
    (one mark a point), ``n_views`` and ``n_points``, and ``unit`` and ``whitening`` as of `Tracks`.
    CSV: columns view, point, x, y, or a first
    line with the names of the columns: these in any order, optionally ``weight`` and ``clean``
    (one mark an observation). Views may have names, such as those of files, in place of numbers,
    and are then sorted by them; numbers may begin anywhere and have gaps: both are kept in
    ``tracks.names``.
    BAL (``.txt``, ``.txt.bz2``, ``.txt.gz``): the observations.
    OpenSfM's ``tracks.csv``: pixels as OpenCV counts them, from the sizes of the images in
    ``exif/NAME.exif`` beside it or from `image_size`.

    Parameters
    ----------
    path : str or path
        The file.
    clean : bool
        Keep only what the file marks as clean.
    views : iterable of int, optional
        Keep only these views.
    prune : {"first", "best", "drop"}, optional
        Drop views and points with too few observations, and of a point measured several times in
        one view keep the first, the best or none, as `Tracks.pruned` does.

    image_size : array_like of int, shape (2,), optional
        Width and height of all images of OpenSfM's tracks, where their project does not tell.

    Returns
    -------
    Tracks
        With `clean` or `views`, views and points left with too few observations are dropped, and
        the rest numbered anew, in the same order; without, such a file is refused.

    Raises
    ------
    FileFormatError
        If the file does not hold tracks in this form, naming the line where there is one.
    OSError
        If the file cannot be read.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.load_tracks(eg.samples.path("tracks.csv"))
    Tracks(5 views, 100 points, 500 observations)
    """
    return load_track_file(
        path, clean, views, prune=prune, with_start=False, image_size=image_size
    ).tracks


def load_track_file(
    path: PathLike,
    clean: bool = False,
    views: Iterable[int] | None = None,
    *,
    prune: str | None = None,
    with_start: bool = True,
    image_size: ArrayLike | None = None,
) -> TrackFile:
    """Read tracks, the reconstruction that comes with them, and the numbers they had in the file.

    Parameters
    ----------
    path : str or path
        The file, as for `load_tracks`.
    clean : bool
        Keep only what the file marks as clean.
    views : iterable of int, optional
        Keep only these views.
    prune : {"first", "best", "drop"}, optional
        Drop views and points with too few observations, and of a point measured several times in
        one view keep the first, the best or none, as `Tracks.pruned` does.
    with_start : bool
        Read the reconstruction too, where there is one.
    image_size : array_like of int, shape (2,), optional
        As for `load_tracks`.

    Returns
    -------
    TrackFile
        The reconstruction is that of the views and points of the tracks.

    Raises
    ------
    FileFormatError, OSError
        As for `load_tracks`.

    Examples
    --------
    >>> import epigauge as eg
    >>> file = eg.io.load_track_file(eg.samples.path("tracks.csv"))
    >>> file.tracks.n_points, file.points.shape
    (100, (100,))
    """
    path = Path(path)
    found = read_tracks(path, with_start, image_size)
    if "view" not in found:
        raise FileFormatError(path, "holds a reconstruction but no tracks: view, point and xy")
    view, point, xy = check_observations(path, found)
    keep = kept_rows(path, found, view, point, clean, views)
    start = start_of(path, found)
    weights = found.get("weights")
    try:
        if keep is None and prune is None:
            tracks, old_views, old_points = _renumbered(path, found, view, point, xy, weights)
        else:
            rows = slice(None) if keep is None else keep
            if weights is not None and weights.shape == view.shape:
                weights = weights[rows]
            tracks, old_views, old_points = Tracks.pruned(
                view[rows], point[rows], xy[rows], weights, repeated=prune
            )
    except ArgumentError as error:
        raise FileFormatError(path, str(error)) from None
    if "unit" in found or "whitening" in found:
        same = rows_of(tracks, old_views, old_points, (view, point, xy))
        restore_measurement(path, found, tracks, same)
    tracks.names = _names(path, found, old_views, tracks.names)
    if "sizes" in found:
        tracks.sizes, tracks.colours = found["sizes"][old_views], found["colours"][old_points]
    if start is not None:
        if len(start.P) <= old_views[-1] or len(start.Q) <= old_points[-1]:
            reason = f"has {len(start.P)} cameras and {len(start.Q)} points but tracks of more"
            raise FileFormatError(path, reason)
        start = Reconstruction(start.P[old_views], start.Q[old_points], start.lines)
    return TrackFile(tracks, start, old_views, old_points)


def _renumbered(
    path: Path, found: dict[str, Any], view: Indices, point: Indices, xy: Array, weights: Any
) -> tuple[Tracks, Indices, Indices]:
    """Return the tracks of a file, numbered from 0 without gaps, and the numbers in the file."""
    old_views, views = np.unique(view, return_inverse=True)
    old_points, points = np.unique(point, return_inverse=True)
    n_views, n_points = (count_of(path, f"n_{name}s", found) for name in ("view", "point"))
    # A number that says how many there are is checked, unless there are gaps.
    n_views = n_views if old_views[-1] == len(old_views) - 1 else None
    n_points = n_points if old_points[-1] == len(old_points) - 1 else None
    return Tracks(views, points, xy, n_views, n_points, weights), old_views, old_points


def _names(
    path: Path, found: dict[str, Any], old_views: Indices, names: tuple[str, ...] | None
) -> tuple[str, ...] | None:
    """Return what the file calls the views: by name, or by numbers other than ours."""
    if "names" in found:
        given = found["names"]
        if isinstance(given, np.ndarray):
            if given.ndim != 1:
                raise FileFormatError(path, f"names has shape {given.shape}; needed: one a view")
            given = given.tolist()
        if len(given) <= old_views[-1]:
            raise FileFormatError(path, f"holds {len(given)} names, needed: one a view")
        return view_names([given[k] for k in old_views.tolist()], len(old_views))
    if (old_views != np.arange(len(old_views))).any():
        return tuple(map(str, old_views.tolist()))
    return names


def load_reconstruction(path: PathLike) -> Reconstruction:
    """Read cameras and points from an NPZ or BAL file.

    NPZ: arrays ``P`` (n, 3, 4) and ``Q`` (m, 4), or ``X`` of three or four columns, and ``lines``
    (L, 6) where there are any. BAL:
    P = diag(-f, -f, 1) (R | t), without the distortion.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    Reconstruction
        Of all views and points in the file.

    Raises
    ------
    FileFormatError
        If the file does not hold them.
    OSError
        If the file cannot be read.

    Examples
    --------
    >>> eg.load_reconstruction("result.npz").P.shape  # doctest: +SKIP
    (11, 3, 4)
    """
    path = Path(path)
    start = start_of(path, read_tracks(path, with_start=True))
    if start is None:
        raise FileFormatError(path, "holds no reconstruction: P (n, 3, 4) and Q or X (m, 4)")
    return start


def save_tracks(path: PathLike, tracks: Tracks, start: Reconstruction | None = None) -> None:
    """Write tracks so that `load_tracks` reads the same numbers again, to the last bit.

    Parameters
    ----------
    path : str or path
        The file; ``.npz``, ``.csv``, ``.txt``, ``.txt.bz2`` or ``.txt.gz`` (the last three: BAL)
        chooses the form.
    tracks : Tracks
        What to write.
    start : Reconstruction, optional
        Cameras and points to write too. BAL needs them, and in its own form: cameras
        diag(-f, -f, 1) (R | t) up to scale, all before or all behind their points, and no point at
        infinity; a scene behind its cameras is written as the one before them that has the same
        images, -X seen from -t. CSV has no place for them.

    Raises
    ------
    ArgumentError
        If the suffix is none of these, or the form cannot hold what is given.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> eg.save_tracks("tracks.csv", tracks)  # doctest: +SKIP
    """
    form = form_of(path)
    if (start is None) != (form == ".csv") and form != ".npz":
        needed = "none for CSV" if form == ".csv" else "cameras and points, which BAL holds too"
        raise ArgumentError("start", "is given" if form == ".csv" else "is None", needed)
    if start is not None and (len(start.P), len(start.Q)) != (tracks.n_views, tracks.n_points):
        was = f"has {len(start.P)} cameras and {len(start.Q)} points"
        raise ArgumentError("start", was, f"{tracks.n_views} and {tracks.n_points}, as the tracks")
    if start is not None and start.lines is not None and form != ".npz":
        needed = "a name ending in .npz, or dataclasses.replace(start, lines=None)"
        raise ArgumentError("start", f"has {len(start.lines)} lines, which {form} loses", needed)
    with writing(path) as file:
        if form == ".npz":
            arrays = arrays_of(tracks) | ({} if start is None else projective_arrays(start))
            write_npz(file, arrays)
        elif form == ".csv":
            write_csv(file, tracks)
        else:
            assert start is not None
            with compressing(file, form) as stream:
                write_bal(stream, tracks, *nine_numbers(start, tracks))


def save_reconstruction(path: PathLike, reconstruction: Reconstruction) -> None:
    """Write cameras and points so that `load_reconstruction` reads the same numbers again.

    Parameters
    ----------
    path : str or path
        The file, ``.npz``.
    reconstruction : Reconstruction
        What to write.

    Raises
    ------
    ArgumentError
        If the suffix is another one.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> eg.save_reconstruction("scene.npz", result.reconstruction)  # doctest: +SKIP
    """
    check_suffix(path, ".npz")
    with writing(path) as file:
        write_npz(file, projective_arrays(reconstruction))
