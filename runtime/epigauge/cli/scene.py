"""``epigauge scene``: photographs, or a COLMAP database, to a metric scene in a folder."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import epigauge as eg
from epigauge._arguments import as_choice
from epigauge._options import CameraGroups, Pairing, UpgradeModel
from epigauge.cameras import camera_model
from epigauge.cli._common import DONE, NOT_CONVERGED, choice, console, facts, shown
from epigauge.cli._scenes import save_cloud
from epigauge.cli._targets import check_folder
from epigauge.cli.metric import Camera, camera_rows
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.images.exif import exif_focal_px
from epigauge.images.loading import thumbnail
from epigauge.images.pairwise import names_of
from epigauge.images.tracks import NoTracks, TrackSource, build_tracks
from epigauge.io import plain, save_scene
from epigauge.io._npz_scene import write_npz_scene
from epigauge.io.output import json_text
from epigauge.multi_view.display import display
from epigauge.reports import save_viewer
from epigauge.verdicts import explained, usable

__all__ = ["scene"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Photographs in a folder are files with these endings.
_PHOTOS = (
    *(".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".ppm", ".pgm"),
    *(".heic", ".heif"),
)
#: Share of a nominal focal length that it is uncertain by, and that a zoom changes it by.
_NOMINAL, _ZOOMED = 0.1, 0.02

#: What photographs do that make no scene, by the flag that tells.
_WHY = {
    "still camera": "are all taken from one place, in one direction",
    "planar scene": "show something flat: all their points lie in one plane",
    "pure rotation": "show no parallax: the camera turned in one place, or all it saw is flat",
    "pure translation": "are by a camera that never turned: every focal length explains them",
    "critical motion": "go about the scene in a way that leaves the focal length open",
    "unlike cameras": "are not all of one camera, or were cut or stretched: cameras with square "
    "pixels do not explain them",
    "undetermined": "determine no scene: too few points in common, or matches that contradict "
    "one another",
}

_DATABASES = (".db", ".sqlite", ".sqlite3")


def scene(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Photographs, folders of them, or one COLMAP database (.db)."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for everything; new, or empty.")
    ],
    cameras: Annotated[
        CameraGroups,
        choice(
            CameraGroups,
            "one: the same camera took all; own: each photograph has its own; size: one "
            "for all photographs of a size; auto: one if all have one size, else own.",
        ),
    ] = "auto",
    camera: Camera = "SIMPLE_RADIAL",
    pairs: Annotated[
        Pairing,
        choice(
            Pairing,
            "Pairs to match; sequential: each with the next five; ranked: each with the twelve "
            "that look most like it.",
        ),
    ] = "all",
    max_features: Annotated[int, typer.Option(help="Features of each photograph.")] = 5000,
    exif_focal: Annotated[
        bool,
        typer.Option(
            "--exif-focal",
            help="Take focal lengths in EXIF data for known to ten percent; never needed.",
        ),
    ] = False,
    workers: Annotated[int, typer.Option(help="Threads that verify pairs and adjust.")] = 1,
    cache: Annotated[
        Path | None,
        typer.Option(
            help="NPZ file for features and matches; where it exists they are taken from it, as "
            "they are.",
            show_default=False,
        ),
    ] = None,
) -> int:
    """Reconstruct a scene from photographs, knowing nothing of the cameras.

    Writes into the folder a COLMAP model (sparse/0; sparse_text as text),
    points.ply in colours, scene.npz, report.json with all that is known, and
    index.html to turn the scene about.

    Photographs that do not belong to the others are left out, and it is said
    why. Exit code 1 with a sentence where there is no scene: photographs that
    do not match, of something flat, or by a camera that only turned. Then
    nothing is written.
    """
    as_choice("--cameras", cameras, get_args(CameraGroups))
    _check_output(output)
    if exif_focal and _is_database(sources):
        raise ArgumentError("--exif-focal", "is given with a database", "photographs")
    if cache is not None:
        check_folder(cache)
    begin, out = time.perf_counter(), console()
    photographs: dict[str, Path] = {}
    try:
        with _progress(out) as told:
            found = sources[0] if _is_database(sources) else _photographs(sources)
            options: dict[str, Any] = {}
            if isinstance(found, list):
                options = {"pairs": pairs, "max_features": max_features, "cache": cache}
                photographs = dict(zip(names_of(found), found, strict=True))
            tracks = build_tracks(found, progress=told, workers=workers, **options)
            told("cameras", 0, 1)
            how = tracks, cameras, camera, workers
            if exif_focal:
                result, exif = _with_exif(_exif_focal(tracks, photographs), *how)
            else:
                result, exif = _upgraded(None, *how), None
    except NoTracks as error:
        out.print(f"[bold red]no scene:[/] the photographs {escape(error.was)}", soft_wrap=True)
        out.print(f"needed: {escape(error.needed)}", soft_wrap=True)
        return NOT_CONVERGED
    answer = _Answer(tracks, result, photographs, time.perf_counter() - begin, exif)
    answer.report(out)
    if not result.success:
        return NOT_CONVERGED
    answer.write(output)
    out.print(f"written: {escape(shown(output))} (open {escape(shown(output / 'index.html'))})")
    return DONE


def _is_database(sources: list[Path]) -> bool:
    database = [path for path in sources if path.suffix.lower() in _DATABASES]
    if database and len(sources) > 1:
        raise ArgumentError("sources", "mix a database with other files", "one database alone")
    return bool(database)


def _photographs(sources: list[Path]) -> list[Path]:
    """Return the photographs named, and those in the folders named."""
    paths: list[Path] = []
    for source in sources:
        if source.is_dir():
            # Hidden files are notes that systems make beside photographs.
            inside = sorted(
                p
                for p in source.iterdir()
                if p.suffix.lower() in _PHOTOS and not p.name.startswith(".")
            )
            if not inside:
                raise FileFormatError(source, f"holds no photographs ({', '.join(_PHOTOS)})")
            paths += inside
        else:
            source.stat()  # an error where it is not there
            paths.append(source)
    once: dict[Path, Path] = {}
    for path in paths:
        once.setdefault(path.resolve(), path)
    return list(once.values())


def _check_output(output: Path) -> None:
    """Check, before a run that may be long, that a folder can be made or filled."""
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise ArgumentError("--output", f"exists: {shown(output)}", "a new or an empty folder")
    place = next(p for p in (output.absolute(), *output.absolute().parents) if p.exists())
    try:
        with tempfile.TemporaryDirectory(prefix=".scene.", dir=place):
            pass
    except OSError as error:
        raise OSError(error.errno, f"cannot be written ({error.strerror})", str(place)) from None


class _progress:
    """Bars for what is being done."""

    def __init__(self, out: Console) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
        self.bars = Progress(*columns, TimeElapsedColumn(), console=out, transient=True)
        self.tasks: dict[str, Any] = {}

    def __enter__(self) -> Callable[[str, int, int], object]:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def __call__(self, what: str, done: int, count: int) -> None:
        if what not in self.tasks:
            for task in self.tasks.values():
                self.bars.update(task, completed=self.bars.tasks[task].total)
            self.tasks[what] = self.bars.add_task(what, total=count)
        self.bars.update(self.tasks[what], completed=done)


def _exif_focal(tracks: eg.Tracks, photographs: dict[str, Path]) -> Array:
    """Return the focal length that each photograph tells, NaN where it does not."""
    sizes = np.asarray(tracks.sizes).tolist()
    told = [
        exif_focal_px(photographs[name], (w, h))
        for name, (w, h) in zip(tracks.names or (), sizes, strict=True)
    ]
    return np.array([np.nan if focal is None else focal for focal in told])


def _priors(focal: Array | None, groups: Indices, camera: str) -> list[eg.IntrinsicPrior]:
    """Return what the photographs tell of each camera's focal length: their median."""
    found, model = [], camera_model(camera)
    for c in range(int(groups.max()) + 1) if focal is not None else ():
        assert focal is not None
        own = focal[(groups == c) & np.isfinite(focal)]
        if len(own):
            value = float(np.median(own))
            names = [model.params[k] for k in model.focal]
            found += [eg.IntrinsicPrior(c, name, value, _NOMINAL * value) for name in names]
    return found


def _with_exif(
    focal: Array, tracks: eg.Tracks, cameras: CameraGroups, camera: UpgradeModel, workers: int
) -> tuple[eg.MetricUpgrade, str]:
    """Return the metric scene, and what to say of the focal lengths that photographs tell.

    They can be wrong: of photographs that were cut, or of a lens that was replaced.
    """
    result = _upgraded(focal, tracks, cameras, camera, workers)
    told = np.isfinite(focal)
    text = f"focal lengths of {np.count_nonzero(told) or 'none'} of {len(focal)} photographs"
    if not result.success and told.any():
        other = _upgraded(None, tracks, cameras, camera, workers)
        if other.success:
            return other, f"{text}, not used: with them there is no scene"
    if result.reconstruction is not None:
        views = result.reconstruction.cameras.camera_of_view[told]
        found, std = (np.atleast_1d(px)[views] for px in (result.focal_px, result.focal_std_px))
        sigma = np.hypot(std, _NOMINAL * focal[told])
        off = np.count_nonzero(np.abs(found - focal[told]) > 3.0 * sigma)
        text += f", {off} of them contradicted by what is seen" if off else ""
    return result, text


def _upgraded(
    focal: Array | None,
    tracks: eg.Tracks,
    cameras: CameraGroups,
    camera: UpgradeModel,
    workers: int,
) -> eg.MetricUpgrade:
    """Return the metric scene; with "auto", of own cameras where one does not fit."""
    sizes = np.asarray(tracks.sizes)
    n = len(sizes)
    kinds = np.unique(sizes, axis=0, return_inverse=True)[1].ravel()
    one = len(np.unique(kinds)) == 1
    if focal is not None and np.isfinite(focal).any():  # a zoom that was turned
        one &= bool(np.nanmax(focal) < (1.0 + _ZOOMED) * np.nanmin(focal))
    same, own = np.zeros(n, dtype=np.intp), np.arange(n)
    groups = {"one": same, "own": own, "size": kinds, "auto": same if one else own}[cameras]
    options: Any = {"image_size": sizes, "camera": camera, "workers": workers}
    known = _priors(focal, groups, camera)
    result = eg.metric_upgrade(tracks, shared=groups, priors=known, **options)
    if cameras == "auto" and one and "unlike cameras" in result.flags:
        known = _priors(focal, own, camera)
        other = eg.metric_upgrade(tracks, shared=own, priors=known, **options)
        result = other if other.success else result
    return result


def _reason(result: eg.MetricUpgrade) -> str:
    """Return why there is no scene, by the first flag that tells."""
    reasons = [f"the photographs {_WHY[name]}" for name in result.flags if name in _WHY]
    return reasons[0] if reasons else result.message


class _Answer:
    """A scene from photographs and the forms it is given in."""

    def __init__(
        self,
        tracks: eg.Tracks,
        result: eg.MetricUpgrade,
        photographs: dict[str, Path],
        seconds: float,
        exif: str | None = None,
    ) -> None:
        #: What is to say of focal lengths that the photographs tell, where they were asked for.
        self.exif = exif
        self.tracks, self.result, self.seconds = tracks, result, seconds
        #: Files by the names of the views; none of a database.
        self.photographs = photographs
        source = tracks.source
        assert isinstance(source, TrackSource)
        self.source = source

    def notes(self) -> list[str]:
        """Return what people should know, a sentence each."""
        result = self.result
        focal, std = np.atleast_1d(result.focal_px), np.atleast_1d(result.focal_std_px)
        several = "" if len(focal) == 1 else f" (first of {len(focal)} cameras)"
        lines = [f"Focal length {focal[0]:.6g} +- {std[0]:.2g} px{several}; {self.seconds:.0f} s."]
        lines += [f"{flag}: {text}" for flag, text in explained(result.flags).items()]
        lines += [f"Left out: {name} {why}." for name, why in self.source.left_out.items()]
        return lines

    def _spaced(self) -> list[str]:
        """Return names with white space, which readers of COLMAP's text take for their end."""
        return [name for name in self.tracks.names or () if name.split() != [name]]

    def report(self, out: Console) -> None:
        """Tell people on stderr what came out."""
        result, tracks = self.result, self.tracks
        count = len(self.source.left_out)
        rows = {
            "photographs": f"{tracks.n_views} of {tracks.n_views + count}",
            "tracks": f"{tracks.n_points} points, {len(tracks)} observations",
        }
        if self.exif is not None:
            rows["EXIF data"] = self.exif
        if result.reconstruction is not None:
            rows |= camera_rows(result, result.reconstruction.cameras)
            rejected = int(np.count_nonzero(result.rejected))
            rows["rms_px"] = f"{result.rms_px:.6g} per coordinate"
            rows["set aside"] = f"{rejected} observations, as gross errors"
        rows["status"] = escape(result.message)
        rows["seconds"] = f"{self.seconds:.1f}"
        out.print(facts("scene", rows))
        for name, text in explained(result.flags).items():
            style = "bold yellow" if usable([name], "views") else "bold red"
            out.print(f"[{style}]{name}:[/] {escape(text)}", soft_wrap=True)
        left_out = dict(self.source.left_out)
        if result.success and self._spaced():
            left_out["sparse_text"] = f"cannot hold {self._spaced()[0]!r}, with white space"
        for name, why in left_out.items():
            out.print(f"[bold]left out:[/] {escape(name)} {escape(why)}", soft_wrap=True)
        if not result.success:
            out.print(f"[bold red]no scene:[/] {escape(_reason(result))}", soft_wrap=True)

    def write(self, output: Path) -> None:
        """Write everything into a folder that takes its name only when it is complete.

        One that is there already may be where a shell stands, or another disk: it is filled by
        moving complete files.
        """
        there = output.is_dir()
        output.absolute().parent.mkdir(parents=True, exist_ok=True)
        place = output if there else output.absolute().parent
        folder = Path(tempfile.mkdtemp(prefix=".scene.", dir=place))
        try:
            self._fill(folder)
            if there:
                for path in sorted(folder.iterdir()):
                    path.replace(output / path.name)
            else:
                folder.chmod(0o755)
                folder.replace(output)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _fill(self, folder: Path) -> None:
        tracks, found = self.result.kept(self.tracks)
        (folder / "sparse").mkdir()
        save_scene(folder / "sparse" / "0", tracks, found)
        if not self._spaced():
            save_scene(folder / "sparse_text", tracks, found, text=True)
        note = "points in the colours of the photographs, cameras orange"
        save_cloud(folder / "points.ply", found.X, found.centres, note, tracks.colours)
        write_npz_scene(folder / "scene.npz", tracks, found, {})
        (folder / "report.json").write_text(json_text(plain(self._document())) + "\n")
        bundle = self.result.bundle
        assert bundle is not None  # of a success
        shown_result = replace(bundle, reconstruction=found, fun=tracks.xy - found.project(tracks))
        frame = display(found, tracks, y_up=False)
        pictures = [thumbnail(self.photographs[n]) for n in tracks.names or () if self.photographs]
        extra: dict[str, Any] = {"frame": frame, "notes": self.notes(), "pictures": pictures}
        save_viewer(folder / "index.html", shown_result, tracks, "Scene", **extra)

    def _document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        result, cameras = self.result, self.result.reconstruction.cameras  # type: ignore[union-attr]
        known = result.covariance
        std = None
        if known is not None:
            std = [np.sqrt(np.diag(known.intrinsics(c))) for c in range(len(cameras))]
        return {
            "photographs": list(self.tracks.names or ()),
            "left_out": self.source.left_out,
            "camera_model": cameras.model,
            "camera_params": cameras.params,
            "camera_params_std": std,
            "camera_of_photograph": cameras.camera_of_view,
            "refined": result.refined,
            "focal_px": result.focal_px,
            "focal_std_px": result.focal_std_px,
            "flags": result.flags,
            "message": result.message,
            "rms_px": result.rms_px,
            "noise_px": result.noise_px,
            "n_points": self.tracks.n_points,
            "n_observations": len(self.tracks),
            "n_rejected": int(np.count_nonzero(result.rejected)),
            "pairs": self.source.pairs,
            "seconds": self.seconds,
        }
