"""Tracks of many views and reconstructions: NPZ, CSV and BAL."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._bal import nine_numbers, projective_cameras, read_bal, write_bal
from epigauge.io._common import MAX_MATCHES, PathLike, check_suffix, listed
from epigauge.io._npz import read_npz, write_npz
from epigauge.io._opensfm import HEAD as OPENSFM
from epigauge.io._opensfm import read_opensfm
from epigauge.io._text import Columns, read_text
from epigauge.io.output import writing
from epigauge.multi_view.labels import view_names
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_COLUMNS = Columns(
    "observations",
    ("view", "point", "x", "y"),
    indices=("view", "point"),
    flags=("clean",),
    labels=("view",),
)
_TRACKS = ("view", "point", "xy")
#: How measurements differ beside their weights.
MEASURED = ("unit", "whitening")
_SUFFIXES = (".npz", ".csv", ".txt", ".txt.bz2", ".txt.gz")


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
    found = _read(path, with_start, image_size)
    if "view" not in found:
        raise FileFormatError(path, "holds a reconstruction but no tracks: view, point and xy")
    view, point, xy = check_observations(path, found)
    keep = _kept(path, found, view, point, clean, views)
    start = _reconstruction(path, found)
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
        same = _rows(tracks, old_views, old_points, (view, point, xy))
        restore_measurement(path, found, tracks, same)
    tracks.names = _names(path, found, old_views, tracks.names)
    if "sizes" in found:
        tracks.sizes, tracks.colours = found["sizes"][old_views], found["colours"][old_points]
    if start is not None:
        if len(start.P) <= old_views[-1] or len(start.Q) <= old_points[-1]:
            reason = f"has {len(start.P)} cameras and {len(start.Q)} points but tracks of more"
            raise FileFormatError(path, reason)
        start = Reconstruction(start.P[old_views], start.Q[old_points])
    return TrackFile(tracks, start, old_views, old_points)


def _renumbered(
    path: Path, found: dict[str, Any], view: Indices, point: Indices, xy: Array, weights: Any
) -> tuple[Tracks, Indices, Indices]:
    """Return the tracks of a file, numbered from 0 without gaps, and the numbers in the file."""
    old_views, views = np.unique(view, return_inverse=True)
    old_points, points = np.unique(point, return_inverse=True)
    n_views, n_points = (_count(path, f"n_{name}s", found) for name in ("view", "point"))
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

    NPZ: arrays ``P`` (n, 3, 4) and ``Q`` (m, 4), or ``X`` of three or four columns. BAL:
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
    start = _reconstruction(path, _read(path, with_start=True))
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
        diag(-f, -f, 1) (R | t) up to scale and no point at infinity. CSV has no place for them.

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
    form = _form(path)
    if (start is None) != (form == ".csv") and form != ".npz":
        needed = "none for CSV" if form == ".csv" else "cameras and points, which BAL holds too"
        raise ArgumentError("start", "is given" if form == ".csv" else "is None", needed)
    if start is not None and (len(start.P), len(start.Q)) != (tracks.n_views, tracks.n_points):
        was = f"has {len(start.P)} cameras and {len(start.Q)} points"
        raise ArgumentError("start", was, f"{tracks.n_views} and {tracks.n_points}, as the tracks")
    with writing(path) as file:
        if form == ".npz":
            arrays = arrays_of(tracks) | ({} if start is None else {"P": start.P, "Q": start.Q})
            write_npz(file, arrays)
        elif form == ".csv":
            _write_csv(file, tracks)
        else:
            assert start is not None
            with compressing(file, form) as stream:
                write_bal(stream, tracks, *nine_numbers(start))


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
        write_npz(file, {"P": reconstruction.P, "Q": reconstruction.Q})


def arrays_of(tracks: Tracks) -> dict[str, Any]:
    """Return the arrays that stand for tracks in NPZ.

    Weights only where they are not all one, names of views where there are any; unit and whitening,
    (N, 2, 2), only where the measurements had a `sigma` or a `covariance`.
    """
    found: dict[str, Any] = {"view": tracks.view, "point": tracks.point, "xy": tracks.xy}
    if (tracks.weights != 1.0).any():
        found["weights"] = tracks.weights
    if tracks.names is not None:
        found["names"] = np.array(tracks.names)
    if tracks.unit != 1.0:
        found["unit"] = np.array(tracks.unit)
    if tracks.whitening is not None:
        found["whitening"] = tracks.whitening.transpose(2, 0, 1)
    return found


def restore_measurement(
    path: Path, found: dict[str, Any], tracks: Tracks, rows: Indices | None = None
) -> None:
    """Give tracks the unit and the whitening of a file, where it has them.

    Parameters
    ----------
    path : Path
        The file for messages.
    found : dict
        Its arrays.
    tracks : Tracks
        Read from it.
    rows : ndarray of int, shape (N,), optional
        The row in the file of each observation of the tracks; by default those of `order`.

    Raises
    ------
    FileFormatError
        If the arrays are none that `arrays_of` makes.
    """
    unit, whitening = found.get("unit"), found.get("whitening")
    if unit is not None:
        if unit.shape != () or unit.dtype.kind != "f" or not 0.0 < unit < np.inf:
            raise FileFormatError(path, "unit is no positive number")
        tracks.unit = float(unit)
    if whitening is None:
        return
    if whitening.shape != (len(found["view"]), 2, 2) or whitening.dtype.kind != "f":
        was = f"whitening has type {whitening.dtype}, shape {whitening.shape}"
        raise FileFormatError(path, f"{was}; needed: floats ({len(found['view'])}, 2, 2)")
    with np.errstate(all="ignore"):
        bad = np.flatnonzero(~(np.abs(np.linalg.det(whitening) - 1.0) < 1e-6))
    if len(bad):
        raise FileFormatError(path, f"whitening has no determinant of one in row {bad[0]}")
    rows = tracks.order if rows is None else rows
    tracks.whitening = np.ascontiguousarray(whitening[rows].transpose(1, 2, 0))


def _rows(
    tracks: Tracks, views: Indices, points: Indices, found: tuple[Indices, Indices, Array]
) -> Indices:
    """Return the row in the file of each observation, by view, point and place."""
    mine = np.column_stack([views[tracks.view], points[tracks.point], tracks.xy])
    both = np.vstack([np.column_stack(found), mine])
    first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)[1:]
    return np.asarray(first[inverse.ravel()[len(both) - len(mine) :]])


def _form(path: PathLike) -> str:
    """Return the suffix that chooses the form of a file."""
    name = Path(path).name.lower()
    for suffix in _SUFFIXES:
        if name.endswith(suffix) and name != suffix:
            return suffix
    raise ArgumentError("path", f"is {str(path)!r}", f"a name ending in {listed(_SUFFIXES)}")


def _read(path: Path, with_start: bool, image_size: ArrayLike | None = None) -> dict[str, Any]:
    """Read whatever a file holds."""
    try:
        form = _form(path)
    except ArgumentError as error:
        if path.exists():
            raise
        was = f"is {str(path)!r}, which does not exist"
        raise ArgumentError("path", was, f"{error.needed}; or a COLMAP folder") from None
    with path.open("rb") as file:
        head = file.read(len(OPENSFM))
        file.seek(0)
        if form == ".csv" and head == OPENSFM:
            return read_opensfm(path, file, image_size)
        if image_size is not None:
            raise ArgumentError("image_size", f"is given for {path.name!r:.60}", "OpenSfM's tracks")
        if form == ".npz":
            start = ("P", "Q", "X") if with_start else ()
            optional = (*MEASURED, "weights", "clean", "n_views", "n_points", *start)
            return dict(
                read_npz(path, file, [_TRACKS, ("P", "Q"), ("P", "X")], optional, ["names"])
            )
        if form == ".csv":
            columns = read_text(path, file, _COLUMNS, "clean")
            found = {"view": columns["view"], "point": columns["point"]}
            found["xy"] = np.column_stack([columns["x"], columns["y"]])
            found |= {"weights": columns["weight"]} if "weight" in columns else {}
            if "view_names" in columns:  # numbered by their order, whatever that of the rows
                names = columns["view_names"]
                found["names"] = sorted(names)
                rank = {name: k for k, name in enumerate(found["names"])}
                found["view"] = np.array([rank[name] for name in names])[found["view"]]
            return found | ({"clean_rows": columns["clean"]} if "clean" in columns else {})
        with decompressing(file, form) as stream:
            problem = read_bal(path, stream)
    return problem | {"P": projective_cameras(problem.pop("cameras"))}


def check_observations(path: Path, found: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Check what must hold before indices are used as sizes of arrays."""
    view, point, xy = (found[name] for name in _TRACKS)
    for name, index in (("view", view), ("point", point)):
        if index.ndim != 1 or index.dtype.kind not in "iu" or len(index) != len(view):
            reason = f"{name} has type {index.dtype}, shape {index.shape}; needed: integers (N,)"
            raise FileFormatError(path, reason)
        bad = np.flatnonzero((index < 0) | (index >= MAX_MATCHES))
        if len(bad):
            reason = f"{name} is {index[bad[0]]} in row {bad[0]}, needed: 0 to {MAX_MATCHES - 1}"
            raise FileFormatError(path, reason)
    if xy.shape != (len(view), 2) or xy.dtype.kind not in "iuf":
        reason = f"xy has type {xy.dtype}, shape {xy.shape}; needed: numbers ({len(view)}, 2)"
        raise FileFormatError(path, reason)
    return view, point, xy


def _kept(
    path: Path,
    found: dict[str, Any],
    view: Indices,
    point: Indices,
    clean: bool,
    views: Iterable[int] | None,
) -> NDArray[np.bool_] | None:
    """Return which observations are asked for; None for all of them."""
    if not clean and views is None:
        return None
    keep = np.ones(len(view), dtype=np.bool_)
    if views is not None:
        keep &= np.isin(view, list(views))
    if clean:
        keep &= _clean_rows(path, found, point)
    if not keep.any():
        raise FileFormatError(path, "holds no observation of those asked for")
    return keep


def _clean_rows(path: Path, found: dict[str, Any], point: Indices) -> NDArray[np.bool_]:
    """Return which observations are marked as clean."""
    if "clean_rows" in found:
        return np.asarray(found["clean_rows"])
    if "clean" not in found:
        raise FileFormatError(path, "marks nothing as clean: it has no clean column or array")
    marks = found["clean"]
    if marks.ndim != 1 or marks.dtype.kind not in "biu" or len(marks) <= point.max(initial=-1):
        reason = f"clean has type {marks.dtype}, shape {marks.shape}; needed: one mark a point"
        raise FileFormatError(path, reason)
    return np.asarray(marks[point] != 0)


def _reconstruction(path: Path, found: dict[str, Any]) -> Reconstruction | None:
    """Return cameras and points, where there are both."""
    Q = found.get("Q", found.get("X"))
    if "P" not in found or Q is None:
        return None
    if Q.ndim == 2 and Q.shape[1] == 3:
        Q = np.column_stack([Q, np.ones(len(Q))])
    try:
        return Reconstruction(found["P"].astype(np.float64), Q.astype(np.float64))
    except ArgumentError as error:
        raise FileFormatError(path, str(error)) from None


def _count(path: Path, name: str, found: dict[str, Any]) -> int | None:
    """Check a number of views or points."""
    if name not in found:
        return None
    count = found[name]
    if count.shape != () or count.dtype.kind not in "iu" or not 0 < count <= MAX_MATCHES:
        raise FileFormatError(path, f"{name} is no number from 1 to {MAX_MATCHES}")
    return int(count)


def _write_csv(file: IO[bytes], tracks: Tracks) -> None:
    if tracks.whitening is not None:
        was = "have coordinates measured unlike, or together, for which CSV has no place"
        raise ArgumentError("tracks", was, "a name ending in .npz")
    arrays = arrays_of(tracks)
    names = None if tracks.names is None else np.array(list(map(_label, tracks.names)))
    views = tracks.view if names is None else names[tracks.view]
    head = ["view", "point", "x", "y", *(["weight"] if "weights" in arrays else [])]
    columns = [views, tracks.point, *tracks.xy.T]
    columns += [arrays["weights"]] if "weights" in arrays else []
    file.write((",".join(head) + "\n").encode())
    for row in zip(*(column.tolist() for column in columns), strict=True):
        file.write((",".join(map(_written, row)) + "\n").encode())


def _label(name: str) -> str:
    """Return the name of a view as a field, quoted where it has to be."""
    if not name.isprintable():
        raise ArgumentError("names", f"hold {name!r:.60}", "names of one line for CSV, or NPZ")
    special = name != name.strip() or any(mark in name for mark in ",;#\"'")
    return '"' + name.replace('"', '""') + '"' if special else name


def _written(value: object) -> str:
    """Return a field of a table."""
    return value if isinstance(value, str) else repr(value)


def decompressing(file: IO[bytes], form: str) -> AbstractContextManager[Any]:
    """Return a stream of the content of a file whose suffix is given."""
    if not form.endswith(("gz", "bz2")):
        return nullcontext(file)
    return gzip.GzipFile("", "rb", fileobj=file) if form.endswith("gz") else bz2.BZ2File(file)


def compressing(file: IO[bytes], form: str) -> AbstractContextManager[Any]:
    """Return a stream into a file whose suffix is given."""
    if not form.endswith(("gz", "bz2")):
        return nullcontext(file)
    # No date in the file: the same content gives the same bytes.
    if form.endswith("gz"):
        return gzip.GzipFile("", "wb", 9, file, 0.0)
    return bz2.BZ2File(file, "wb")
