"""Point matches of an image pair: read and written as CSV, TXT or NPZ."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_matches, as_weights
from epigauge._results import Result
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._common import PathLike, check_suffix, cut
from epigauge.io._match_arrays import GROUPS, LINKS, MARKS, points_of, read_hdf5
from epigauge.io._npz import read_npy, read_npz, write_npz
from epigauge.io._text import Columns, read_text
from epigauge.io.output import writing

Array = NDArray[np.float64]

_COLUMNS = Columns("matches", ("x1", "y1", "x2", "y2"), flags=("inlier",))


@dataclass(frozen=True, slots=True, eq=False)
class Matches(Result):
    """Point matches of an image pair, as read from a file.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Matching points in image 1 and 2, in pixels.
    weights : ndarray, shape (m,), optional
        One weight >= 0 a match.
    image_size1, image_size2 : (int, int), optional
        (width, height) of the images, in pixels.
    name : str
        What to call the pair: the file's name without its suffix.
    marked : int, optional
        How many of the matches the file marks as inliers; None where it marks none.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> len(eg.Matches(scene.x1, scene.x2))
    50
    """

    x1: Array
    x2: Array
    weights: Array | None = None
    image_size1: tuple[int, int] | None = None
    image_size2: tuple[int, int] | None = None
    name: str = ""
    marked: int | None = None

    def __len__(self) -> int:
        return len(self.x1)

    def save(self, path: PathLike, **more: Any) -> None:
        """Write them in a form that `load_matches` reads.

        Parameters
        ----------
        path : str or path
            As for `save_matches`: ``.csv``, ``.txt`` or ``.npz``.
        **more
            Nothing yet.

        Examples
        --------
        >>> eg.Matches(x1, x2).save("pair.csv")  # doctest: +SKIP
        """
        save_matches(path, self, **more)

    def _heading(self) -> str:
        return f"{type(self).__name__}: {len(self)}" + (f" of {self.name}" if self.name else "")

    def _summary_rows(self) -> dict[str, str]:
        marked = None if self.marked is None else f"{self.marked} as inliers"
        sizes = {"image 1": self.image_size1, "image 2": self.image_size2}
        rows = {name: f"{size[0]} x {size[1]} px" for name, size in sizes.items() if size}
        return rows | ({} if marked is None else {"marked": marked})


def load_matches(
    path: PathLike,
    inliers: bool = False,
    *,
    features: PathLike | None = None,
    pair: tuple[str, str] | None = None,
) -> Matches:
    """Read point matches from a CSV, TXT, NPZ, NPY or HDF5 file.

    Text (every other suffix): one match a line, columns separated by commas, semicolons or
    white space, ``#`` starts a comment. Either four columns x1, y1, x2, y2, or a first line with
    the names of the columns: these four in any order, optionally ``weight`` and ``inlier`` (0 or
    1); other columns are ignored. A comment that holds nothing but these names is obeyed too.

    NPZ: arrays ``x1`` and ``x2`` (m, 2), or ``matches`` (m, 4) with columns x1, y1, x2, y2;
    optionally ``weights`` (m,), ``inlier`` (m,), ``image_size1`` and ``image_size2`` (width,
    height). Or the arrays of other programs: ``mkpts0`` and ``mkpts1`` (LoFTR), ``keypoints0`` and
    ``keypoints1`` with ``matches`` (k, 2) (LightGlue), ``matches0``, ``matches1`` or ``matches``
    (n,) (SuperGlue) or as they are (kornia), ``pts1`` and ``pts2`` (OpenCV). Other arrays are not
    looked at, confidences neither: they are no inverse variances.

    NPY: one array (m, 4), or (2, m, 2). HDF5 (``.h5``, ``.hdf5``): the matches of hloc.

    Parameters
    ----------
    path : str or path
        The file.
    inliers : bool
        Keep only the matches that the file marks as inliers.
    features : str or path, optional
        With HDF5, the file of the keypoints that the matches refer to.
    pair : tuple of str, optional
        With HDF5, names of both images; not needed where the file holds one pair.

    Returns
    -------
    Matches
        At least one match, all coordinates finite.

    Raises
    ------
    FileFormatError
        If the file does not hold matches in this form, or more than `MAX_MATCHES` of them, or no
        inlier marks although `inliers` asks for them.
    ArgumentError
        If `features` or `pair` are given without HDF5, or missing with it.
    MissingPackageError
        If HDF5 is to be read without h5py.
    OSError
        If the file cannot be read.

    Notes
    -----
    Pixels are taken as they are. Most of these programs have (0, 0) in the middle of the first
    pixel, as OpenCV; COLMAP has (0.5, 0.5) there (`epigauge.interop.move_points`).

    Examples
    --------
    >>> eg.load_matches("lightglue.npz")  # doctest: +SKIP
    >>> pair = ("a.jpg", "b.jpg")
    >>> eg.load_matches("m.h5", features="f.h5", pair=pair)  # doctest: +SKIP
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".h5", ".hdf5") and (features is not None or pair is not None):
        name = "pair" if features is None else "features"
        raise ArgumentError(name, f"is given for {path.name!r:.60}", "None, or a file of HDF5")
    with path.open("rb") as file:
        if suffix == ".npz":
            fields = _from_npz(path, file, inliers)
        elif suffix == ".npy":
            fields = _from_npy(path, file)
        elif suffix in (".h5", ".hdf5"):
            fields = read_hdf5(path, file, None if features is None else Path(features), pair)
        else:
            fields = _from_text(path, file, inliers)
    return _matches(path, fields, inliers)


def save_matches(path: PathLike, matches: Matches) -> None:
    """Write point matches so that `load_matches` reads the same numbers again, to the last bit.

    Parameters
    ----------
    path : str or path
        The file; ``.csv``, ``.txt`` or ``.npz`` chooses the form. Image sizes are kept by NPZ only.
    matches : Matches
        What to write.

    Raises
    ------
    ArgumentError
        If the suffix is none of these, or the matches are not usable as such.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import epigauge as eg
    >>> scene = eg.two_view_scene(5.0, seed=1)
    >>> eg.save_matches("pair.csv", eg.Matches(scene.x1, scene.x2))  # doctest: +SKIP
    """
    suffix = check_suffix(path, ".csv", ".txt", ".npz")
    x1, x2 = as_matches(matches.x1, matches.x2, at_least=1)
    columns = [*x1.T, *x2.T]
    names = list(_COLUMNS.names)
    if matches.weights is not None:
        columns.append(as_weights(matches.weights, len(x1)))
        names.append("weight")
    with writing(path) as file:
        if suffix == ".npz":
            optional = {
                "weights": matches.weights,
                "image_size1": matches.image_size1,
                "image_size2": matches.image_size2,
            }
            given: dict[str, Any] = {k: v for k, v in optional.items() if v is not None}
            write_npz(file, {"x1": x1, "x2": x2} | given)
            return
        comma = "," if suffix == ".csv" else " "
        head = comma.join(names) if suffix == ".csv" else "# " + comma.join(names)
        file.write(f"{head}\n".encode())
        for row in np.column_stack(columns).tolist():
            file.write((comma.join(map(repr, row)) + "\n").encode())


def _from_npz(path: Path, file: IO[bytes], inliers: bool) -> dict[str, Any]:
    """Read the arrays of an NPZ file."""
    own = ("weights", "image_size1", "image_size2")
    found = read_npz(path, file, GROUPS, (*own, *MARKS, *LINKS))
    kept = {name: found[name] for name in own if name in found}
    return kept | points_of(path, found)


def _from_npy(path: Path, file: IO[bytes]) -> dict[str, Any]:
    """Read the points of both images as one array."""
    array = read_npy(path, file)
    if array.ndim == 3 and array.shape[0] == 2 and array.shape[2] == 2:
        array = np.concatenate([array[0], array[1]], axis=1)
    return points_of(path, {"matches": array})


def _from_text(path: Path, file: IO[bytes], inliers: bool) -> dict[str, Any]:
    """Read the columns of a text file and put the coordinates together."""
    columns = read_text(path, file, _COLUMNS, "inlier" if inliers else None)
    found: dict[str, Any] = {
        f"x{view}": np.column_stack([columns[f"x{view}"], columns[f"y{view}"]]) for view in (1, 2)
    }
    if "weight" in columns:
        found["weights"] = columns["weight"]
    if "inlier" in columns:
        found["inlier"] = columns["inlier"]
    return found


def _matches(path: Path, fields: dict[str, Any], inliers: bool) -> Matches:
    """Check what a file holds and put it together."""
    try:
        x1, x2 = as_matches(fields["x1"], fields["x2"], at_least=1)
        weights = as_weights(fields["weights"], len(x1)) if "weights" in fields else None
    except ArgumentError as error:
        raise FileFormatError(path, str(error)) from None
    if "inlier" in fields and len(fields["inlier"]) != len(x1):
        reason = f"inlier has {len(fields['inlier'])} marks, needed: {len(x1)}, one a match"
        raise FileFormatError(path, reason)
    keep = _inlier_mask(path, fields, len(x1)) if inliers else slice(None)
    return Matches(
        np.array(x1[keep]),
        np.array(x2[keep]),
        None if weights is None else np.array(weights[keep]),
        _image_size(path, "image_size1", fields),
        _image_size(path, "image_size2", fields),
        path.stem,
        int(np.count_nonzero(fields["inlier"][keep])) if "inlier" in fields else None,
    )


def _inlier_mask(path: Path, fields: dict[str, Any], m: int) -> NDArray[np.bool_]:
    """Check the inlier marks."""
    if "inlier" not in fields:
        raise FileFormatError(path, "marks no inliers: it has no inlier column or array")
    marks = fields["inlier"]
    if marks.shape != (m,) or marks.dtype.kind not in "biu" or not np.isin(marks, (0, 1)).all():
        raise FileFormatError(
            path, f"inlier has type {marks.dtype}, shape {marks.shape}; needed: {m} marks 0 or 1"
        )
    if not marks.any():
        raise FileFormatError(path, "marks every match as an outlier")
    return np.asarray(marks, dtype=np.bool_)


def _image_size(path: Path, name: str, fields: dict[str, Any]) -> tuple[int, int] | None:
    """Check the size of an image."""
    if name not in fields:
        return None
    size = fields[name]
    if size.shape != (2,) or size.dtype.kind not in "iu" or not (size > 0).all():
        raise FileFormatError(path, f"{name} is {cut(size.tolist())}, needed: (width, height)")
    return int(size[0]), int(size[1])
