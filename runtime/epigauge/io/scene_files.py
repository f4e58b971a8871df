"""Scenes, that is tracks with cameras and points, in files: COLMAP folders, BAL problems, NPZ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_choice
from epigauge.cameras import AnyReconstruction, MetricReconstruction
from epigauge.cameras.bal import colmap_to_bal
from epigauge.errors import ArgumentError
from epigauge.io._bal import read_bal, write_bal
from epigauge.io._bundler import read_bundler, write_bundler
from epigauge.io._colmap_folder import read_folder, write_folder
from epigauge.io._colmap_parts import ColmapModel
from epigauge.io._colmap_scene import model_of, raw_scene
from epigauge.io._common import PathLike
from epigauge.io._exports import write_gltf, write_transforms
from epigauge.io._npz_scene import is_npz_scene, read_npz_scene, write_npz_scene
from epigauge.io._scene import RawScene, SceneSource, finished
from epigauge.io._track_reading import decompressing
from epigauge.io._track_writing import compressing
from epigauge.io.output import writing
from epigauge.multi_view.tracks import Tracks
from epigauge.rotations import from_rodrigues, rodrigues

__all__ = ["load_scene", "save_scene"]

Array = NDArray[np.float64]

#: Files of BAL problems; the form of others is told by their last suffix.
_BAL = (".txt", ".bal", ".bz2", ".gz")
_REPEATED = ("keep", "first", "refuse")
_WEAK = ("drop", "refuse")


def load_scene(
    path: PathLike, *, repeated: str = "keep", weak: str = "drop"
) -> tuple[Tracks, AnyReconstruction]:
    """Read a scene: observations, cameras, points.

    A directory is a COLMAP model, binary (``cameras.bin``, ``images.bin``, ``points3D.bin``) or
    text; with ``rigs`` and ``frames`` of COLMAP 3.12 and later, these have the poses. Pixels stay
    COLMAP's, with (0.5, 0.5) in the middle of the first one. A file ``.txt``, ``.txt.bz2`` or
    ``.txt.gz`` is a problem of "Bundle Adjustment in the Large", its cameras of the model ``bal``.
    ``.out`` is Bundler's, with the names of the images in ``list.txt`` beside it, its cameras of
    the model ``bal``. ``.npz`` is what `save_scene` writes: calibrated, affine or projective
    cameras.

    Parameters
    ----------
    path : str or path
        A directory or a file.
    repeated : {"keep", "first", "refuse"}
        What to do with further observations of a point in one view: keep them (`Tracks.n_repeated`
        counts them), leave all but the first of the file out, or refuse the file.
    weak : {"drop", "refuse"}
        What to do with points that fewer than two views see, and with views that see none of the
        others: leave them out and number the rest anew in the same order, or refuse the file.

    Returns
    -------
    tracks : Tracks
        Observations, with names and sizes of images and colours of points where the file has them.
        ``tracks.source.notes`` says what was left out or changed; its other content lets
        `save_scene` write what else the file held.
    reconstruction : MetricReconstruction, AffineReconstruction or Reconstruction
        Cameras and points of the tracks; of a folder and of BAL a `MetricReconstruction`.

    Raises
    ------
    FileFormatError
        If that is no scene, naming file, and line or record where there is one.
    OSError
        If it cannot be read.

    Notes
    -----
    Cameras of different models in one COLMAP folder become cameras of the poorest model that holds
    them all exactly (SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV); other
    mixtures are refused.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks, reconstruction = eg.load_scene("sparse/0")  # doctest: +SKIP
    >>> tracks.source.notes  # doctest: +SKIP
    ('second sightings of a point in a view: 9743, kept',)
    """
    path = Path(path)
    as_choice("repeated", repeated, _REPEATED)
    as_choice("weak", weak, _WEAK)
    if (path / "parts.json").exists():
        was = f"is {str(path)!r}, a folder of parts"
        raise ArgumentError("path", was, "eg.distributed.bundle_adjust, which reads them in parts")
    if path.is_dir():
        raw = raw_scene(path, read_folder(path))
    elif path.suffix.lower() == ".npz":
        raw = read_npz_scene(path)
    elif path.suffix.lower() in _BAL:
        raw = _read_bal(path)
    elif path.suffix.lower() == ".out":
        with path.open("rb") as file:
            raw = read_bundler(path, file)
    else:
        was = f"is {str(path)!r}" if path.exists() else f"is {str(path)!r}, which does not exist"
        raise ArgumentError(
            "path", was, f"a COLMAP folder, or a name ending in .npz, .out, {_listed()}"
        )
    return finished(path, raw, repeated, weak)


def save_scene(
    path: PathLike,
    tracks: Tracks,
    reconstruction: AnyReconstruction,
    *,
    text: bool = False,
    rigs: str = "keep",
) -> None:
    """Write a scene so that `load_scene` reads the same again, every number to its last digit.

    Parameters
    ----------
    path : str or path
        ``.npz`` holds everything; ``.txt``, ``.txt.bz2`` or ``.txt.gz`` is a BAL problem; ``.out``
        is Bundler's, with names in ``NAME.list.txt``; another name without these suffixes is a
        COLMAP folder, which is made if absent. For other programs and not to be read again:
        ``.glb`` (glTF: coloured points and cameras, for any viewer), ``.json``
        (``transforms.json`` of NeRF programs).
    tracks : Tracks
        Observations. Those of `load_scene` keep COLMAP's numbers of images, cameras and points, its
        features without points, rigs and frames.
    reconstruction : MetricReconstruction, AffineReconstruction or Reconstruction
        Of the same views and points; only NPZ holds the last two, and lines.
    text : bool
        Write a COLMAP folder as text, not binary.
    rigs : {"keep", "drop"}
        ``"keep"`` refuses images of a rig that no longer keep its poses; ``"drop"`` makes every
        image a frame of its own.

    Raises
    ------
    ArgumentError
        Naming what the form has no place for. COLMAP: weights, other models of cameras, images of
        several sizes by one camera. BAL: weights, cameras of several views, another model than
        ``bal``, names, sizes and colours.
    OSError
        If it cannot be written.

    Notes
    -----
    The rotation matrices are written as quaternions or Rodrigues vectors, which rounds them in the
    last digit; those that have not changed since `load_scene` are written as they were.

    Examples
    --------
    >>> eg.save_scene("refined", tracks, result.reconstruction)  # doctest: +SKIP
    >>> eg.save_scene("scene.glb", tracks, result.reconstruction)  # doctest: +SKIP
    """
    path = Path(path)
    content = scene_content(path, tracks, reconstruction, rigs)
    export = None if path.is_dir() else _EXPORTS.get(path.suffix.lower())
    if export is not None:
        assert isinstance(reconstruction, MetricReconstruction)
        export(path, tracks, reconstruction)
    elif content is None:
        write_npz_scene(path, tracks, reconstruction)
    elif isinstance(content, ColmapModel):
        write_folder(path, content, text)
    else:
        assert isinstance(reconstruction, MetricReconstruction)
        with writing(path) as file, compressing(file, path.suffix.lower()) as stream:
            write_bal(stream, tracks, content, reconstruction.X)


def scene_content(
    path: Path, tracks: Tracks, reconstruction: AnyReconstruction, rigs: str = "keep"
) -> ColmapModel | Array | None:
    """Return what is written to a path: a COLMAP model, BAL's cameras, or None for NPZ.

    Raises
    ------
    ArgumentError
        As `save_scene`.
    """
    as_choice("rigs", rigs, ("keep", "drop"))
    if (reconstruction.n_views, reconstruction.n_points) != (tracks.n_views, tracks.n_points):
        was = f"has {reconstruction.n_views} views and {reconstruction.n_points} points"
        needed = f"{tracks.n_views} and {tracks.n_points}, as the tracks"
        raise ArgumentError("reconstruction", was, needed)
    if is_scene_file(path) and path.suffix.lower() == ".npz":
        return None
    if not isinstance(reconstruction, MetricReconstruction):
        was = f"is a {type(reconstruction).__name__}, which has no calibrated cameras"
        raise ArgumentError("reconstruction", was, "a name ending in .npz")
    if reconstruction.lines is not None:
        was = f"are {len(reconstruction.lines)}, which only NPZ has a place for"
        needed = "a name ending in .npz, or dataclasses.replace(reconstruction, lines=None)"
        raise ArgumentError("reconstruction.lines", was, needed)
    if not is_scene_file(path):
        return model_of(tracks, reconstruction, rigs)
    if path.suffix.lower() in _EXPORTS:
        return None
    return _nine_numbers(tracks, reconstruction)


def is_scene_file(path: Path) -> bool:
    """Tell whether a scene is written to a path as one file, BAL or NPZ, not as COLMAP's folder."""
    return not path.is_dir() and path.suffix.lower() in (".npz", *_EXPORTS, *_BAL)


def is_scene(path: Path) -> bool:
    """Tell whether a path is a scene with cameras of a known model and nothing else."""
    suffix = path.suffix.lower()
    return path.is_dir() or suffix == ".out" or (suffix == ".npz" and is_npz_scene(path))


def _save_bundler(path: Path, tracks: Tracks, reconstruction: MetricReconstruction) -> None:
    """Write a scene of BAL's or COLMAP's radial cameras as Bundler's."""
    if (tracks.weights != 1.0).any():
        raise ArgumentError("tracks.weights", "are not all one", "ones; NPZ keeps them")
    own = reconstruction.cameras.model == "bal"
    moved, scene = (tracks, reconstruction) if own else colmap_to_bal(tracks, reconstruction)
    write_bundler(path, tracks, moved.xy, scene)


#: Forms that are written for other programs; of them only Bundler's is read, too.
_EXPORTS = {".glb": write_gltf, ".json": write_transforms, ".out": _save_bundler}


def _listed() -> str:
    return " or ".join(_BAL)


def _read_bal(path: Path) -> RawScene:
    with path.open("rb") as file, decompressing(file, path.suffix.lower()) as stream:
        found = read_bal(path, stream)
    nine = found["cameras"]
    return RawScene(
        found["view"],
        found["point"],
        found["xy"],
        from_rodrigues(nine[:, :3]),
        nine[:, 3:6],
        found["X"],
        "bal",
        nine[:, 6:],
        np.arange(len(nine)),
        source=SceneSource(rotations=nine[:, :3]),
    )


def _nine_numbers(tracks: Tracks, reconstruction: MetricReconstruction) -> Array:
    """Return what BAL holds of a scene's cameras, (n, 9)."""
    cameras = reconstruction.cameras
    if cameras.model != "bal":
        was = f"has cameras of the model {cameras.model!r}"
        needed = "'bal': a BAL problem has no other; NPZ has all"
        if cameras.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
            needed = "eg.interop.colmap_to_bal(tracks, reconstruction), or NPZ"
        raise ArgumentError("reconstruction", was, needed)
    if len(cameras) < tracks.n_views:
        was = f"has {len(cameras)} cameras for {tracks.n_views} views"
        needed = "a camera a view: Cameras('bal', cameras.of_views, range(n)); NPZ keeps them"
        raise ArgumentError("reconstruction", was, needed)
    if (tracks.weights != 1.0).any():
        raise ArgumentError("tracks.weights", "are not all one", "ones; NPZ keeps them")
    for name in ("names", "sizes", "colours"):
        if getattr(tracks, name) is not None:
            raise ArgumentError(f"tracks.{name}", "are given", "None: BAL has no place for them")
    w = rodrigues(reconstruction.R)
    source = tracks.source
    if isinstance(source, SceneSource) and source.rotations is not None:
        old = source.rotations
        if old.shape == w.shape:
            same = (from_rodrigues(old) == reconstruction.R).all(axis=(1, 2))
            w[same] = old[same]
    return np.asarray(np.column_stack([w, reconstruction.t, cameras.of_views]))
