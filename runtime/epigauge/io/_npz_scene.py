"""Scenes as NPZ: everything that a scene holds, as arrays of numbers; texts are UTF-8 bytes."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from epigauge.cameras import AffineReconstruction, AnyReconstruction, MetricReconstruction
from epigauge.errors import FileFormatError
from epigauge.io._colmap_parts import Place
from epigauge.io._colmap_text import camera_line, camera_of, frame_line, frame_of, rig_line, rig_of
from epigauge.io._common import MAX_MATCHES, cut
from epigauge.io._npz import read_npz, write_npz
from epigauge.io._scene import ColmapSource, RawScene, SceneSource
from epigauge.io._track_reading import MEASURED, check_observations
from epigauge.io._track_writing import arrays_of, projective_arrays
from epigauge.io.output import writing
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

Row = TypeVar("Row")

_TRACKS = ("view", "point", "xy")
_NEEDED = (*_TRACKS, "R", "t", "X", "model", "params", "camera_of_view")
#: The same of cameras without rotations: affine and projective ones.
_AFFINE, _PROJECTIVE = (*_TRACKS, "P", "X"), (*_TRACKS, "P", "Q")
_LABELS = (*MEASURED, "weights", "names", "sizes", "colours", "notes", "rotations", "lines")
_IDS = ("image_ids", "camera_ids", "point_ids", "feature_of")
_COLMAP = (*(f"colmap_{name}" for name in _IDS), "colmap_features", "colmap_feature_counts")
_TEXTS = ("colmap_cameras", "colmap_rigs", "colmap_frames")


def is_npz_scene(path: Path) -> bool:
    """Tell whether a file names the arrays of a scene, rather than of tracks alone."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in _NEEDED} <= set(archive.namelist())
    except zipfile.BadZipFile:
        return False


def write_npz_scene(
    path: Path,
    tracks: Tracks,
    reconstruction: AnyReconstruction,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write a scene.

    Parameters
    ----------
    path : Path
        The file.
    tracks : Tracks
        Observations.
    reconstruction : MetricReconstruction, AffineReconstruction or Reconstruction
        Of the same views and points.
    more : mapping of str to array_like, optional
        Further arrays, under other names.
    """
    arrays = arrays_of(tracks)
    match reconstruction:
        case MetricReconstruction(R=R, t=t, X=X, cameras=cameras, lines=lines):
            arrays |= {"R": R, "t": t, "X": X, "model": _bytes([cameras.model])}
            arrays |= {"params": cameras.params, "camera_of_view": cameras.camera_of_view}
            arrays |= {} if lines is None else {"lines": lines}
        case AffineReconstruction(P=P, X=X):
            arrays |= {"P": P, "X": X}
        case Reconstruction():
            arrays |= projective_arrays(reconstruction)
    if tracks.names is not None:
        arrays["names"] = _bytes(tracks.names)
    for name in ("sizes", "colours"):
        if getattr(tracks, name) is not None:
            arrays[name] = getattr(tracks, name)
    source = tracks.source
    if isinstance(source, SceneSource):
        arrays |= {"notes": _bytes(source.notes)} if source.notes else {}
        arrays |= {} if source.rotations is None else {"rotations": source.rotations}
        arrays |= {} if source.colmap is None else _colmap_arrays(source.colmap)
    with writing(path) as file:
        write_npz(file, {**(more or {}), **arrays})


def _colmap_arrays(colmap: ColmapSource) -> dict[str, Any]:
    arrays: dict[str, Any] = {f"colmap_{name}": getattr(colmap, name) for name in _IDS}
    arrays["colmap_features"] = np.concatenate(colmap.features)
    arrays["colmap_feature_counts"] = np.array([len(xy) for xy in colmap.features])
    arrays["colmap_cameras"] = _bytes([camera_line(row) for row in colmap.cameras])
    if colmap.rigs is not None and colmap.frames is not None:
        arrays["colmap_rigs"] = _bytes([rig_line(row) for row in colmap.rigs])
        arrays["colmap_frames"] = _bytes([frame_line(row) for row in colmap.frames])
    return arrays


def _bytes(lines: Sequence[str]) -> NDArray[np.uint8]:
    """Return lines of text as bytes, a zero after each."""
    return np.frombuffer("".join(f"{line}\0" for line in lines).encode(), np.uint8)


def read_npz_scene(path: Path) -> RawScene:
    """Read a scene.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    RawScene
        Its content.

    Raises
    ------
    FileFormatError
        Naming the array at fault.
    OSError
        If the file cannot be read.
    """
    with path.open("rb") as file:
        forms = [_NEEDED, _AFFINE, _PROJECTIVE]
        found = read_npz(path, file, forms, (*_LABELS, *_COLMAP, *_TEXTS))
    calibrated = "R" in found
    if not calibrated:
        found |= _without_rotations(path, found)
    view, point, xy = check_observations(path, found)
    n, m = (len(np.atleast_1d(found[name])) for name in ("R", "X"))
    N, c = len(view), len(np.atleast_1d(found["params"]))
    for name, kinds, shape in (
        ("R", "f", (n, 3, 3 if calibrated else 4)),
        ("t", "f", (n, 3)),
        ("X", "f", (m, 3) if calibrated else (m, None)),
        ("params", "f", (c, None)),
        ("camera_of_view", "iu", (n,)),
        ("weights", "f", (N,)),
        ("sizes", "iu", (n, 2)),
        ("colours", "iu", (m, 3)),
        ("rotations", "f", (n, None)),
        ("lines", "f", (None, 6)),
        ("colmap_image_ids", "iu", (n,)),
        ("colmap_camera_ids", "iu", (c,)),
        ("colmap_point_ids", "iu", (m,)),
        ("colmap_feature_of", "iu", (N,)),
        ("colmap_features", "f", (None, 2)),
        ("colmap_feature_counts", "iu", (n,)),
    ):
        _check(path, found, name, kinds, shape)
    for name, index, limit in (
        ("view", view, n),
        ("point", point, m),
        ("camera_of_view", found["camera_of_view"], c),
    ):
        bad = np.flatnonzero((index < 0) | (index >= limit))
        if len(bad):
            reason = f"{name} is {index[bad[0]]} in row {bad[0]}, needed: 0 to {limit - 1}"
            raise FileFormatError(path, reason)
    model, *more = _lines(path, found, "model") or [""]
    if more:
        raise FileFormatError(path, "array model holds more than one name")
    names = _lines(path, found, "names") if "names" in found else None
    if names is not None and len(names) != n:
        raise FileFormatError(path, f"array names holds {len(names)} names, needed: {n}")
    source = SceneSource(
        tuple(_lines(path, found, "notes")) if "notes" in found else (),
        found.get("rotations"),
        _colmap(path, found) if _COLMAP[0] in found else None,
    )
    return RawScene(
        view.astype(np.int64),
        point.astype(np.int64),
        xy,
        found["R"],
        found["t"],
        found["X"],
        model,
        found["params"],
        found["camera_of_view"].astype(np.int64),
        found.get("weights"),
        names,
        found.get("sizes"),
        found.get("colours"),
        source,
        {name: found[name] for name in ("view", *MEASURED) if name in found},
        found.get("lines"),
    )


def _without_rotations(path: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Return what stands for the arrays of a scene of affine or projective cameras."""
    P, points = found["P"], found["X" if "X" in found else "Q"]
    for name, array, sides in (("P", P, (3, 4)), ("points", points, (3 if "X" in found else 4,))):
        if array.dtype.kind != "f" or array.shape[1:] != sides or not len(array):
            raise FileFormatError(path, f"array {name} has type {array.dtype}, shape {array.shape}")
    n = len(P)
    return {
        "R": P,
        "t": np.zeros((n, 3)),
        "X": points,
        "model": _bytes(["affine" if "X" in found else "projective"]),
        "params": np.zeros((1, 0)),
        "camera_of_view": np.zeros(n, np.int64),
    }


def _check(
    path: Path, found: dict[str, Any], name: str, kinds: str, shape: tuple[int | None, ...]
) -> None:
    """Check type and shape of an array, where the file has it."""
    if name not in found:
        return
    array = found[name]
    fits = array.ndim == len(shape) and all(
        side is None or side == given for side, given in zip(shape, array.shape, strict=True)
    )
    if array.dtype.kind not in kinds or not fits:
        sides = ", ".join("any" if side is None else str(side) for side in shape)
        was = f"array {name} has type {array.dtype}, shape {array.shape}"
        kind = "integers" if "i" in kinds else "floats"
        raise FileFormatError(path, f"{was}; needed: {kind} ({sides})")


def _lines(path: Path, found: dict[str, Any], name: str) -> list[str]:
    array = found[name]
    if array.dtype != np.uint8 or array.ndim != 1:
        raise FileFormatError(path, f"array {name} is no text: bytes of UTF-8")
    try:
        text = array.tobytes().decode()
    except UnicodeDecodeError:
        raise FileFormatError(path, f"array {name} is no text (UTF-8)") from None
    if text and not text.endswith("\0"):
        raise FileFormatError(path, f"array {name} does not end in a zero byte")
    lines: list[str] = text.split("\0")[:-1]
    return lines


def _colmap(path: Path, found: dict[str, Any]) -> ColmapSource:
    missing = [name for name in (*_COLMAP, _TEXTS[0]) if name not in found]
    if missing or ("colmap_rigs" in found) != ("colmap_frames" in found):
        raise FileFormatError(path, f"has no array {cut((missing or _TEXTS[1:])[0])}")
    counts = found["colmap_feature_counts"].astype(np.int64)
    features, feature_of = found["colmap_features"], found["colmap_feature_of"].astype(np.int64)
    if (counts < 0).any() or (counts > MAX_MATCHES).any() or counts.sum() != len(features):
        raise FileFormatError(path, "array colmap_feature_counts does not fit colmap_features")
    bad = (feature_of < 0) | (feature_of >= counts[found["view"]])
    if bad.any():
        k = int(np.argmax(bad))
        raise FileFormatError(path, f"colmap_feature_of is {feature_of[k]} in row {k}: no feature")
    for name in ("image_ids", "camera_ids", "point_ids"):
        ids = found[f"colmap_{name}"]
        if len(np.unique(ids)) < len(ids) or (ids < 0).any():
            raise FileFormatError(path, f"colmap_{name} are not different numbers from 0")
    image_ids, camera_ids, point_ids = (found[name].astype(np.int64) for name in _COLMAP[:3])
    with_rigs = "colmap_rigs" in found
    return ColmapSource(
        image_ids,
        camera_ids,
        point_ids,
        tuple(np.split(features, np.cumsum(counts)[:-1])),
        feature_of,
        found["camera_of_view"].astype(np.int64),
        _rows(path, found, "colmap_cameras", camera_of),
        _rows(path, found, "colmap_rigs", rig_of) if with_rigs else None,
        _rows(path, found, "colmap_frames", frame_of) if with_rigs else None,
    )


def _rows(
    path: Path, found: dict[str, Any], name: str, parse: Callable[[Place, list[str]], Row]
) -> tuple[Row, ...]:
    """Read lines in COLMAP's form."""
    lines = _lines(path, found, name)
    return tuple(parse(Place(path, name, k + 1), line.split()) for k, line in enumerate(lines))
