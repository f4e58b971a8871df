"""What ``epigauge bundle`` and ``epigauge compare`` do with scenes of calibrated cameras."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import epigauge as eg
from epigauge._options import Rigs as _Rigs
from epigauge.cli._common import (
    DONE,
    INTERRUPTED,
    NOT_CONVERGED,
    choice,
    console,
    facts,
    named,
    shown,
    told,
    write_json,
)
from epigauge.cli._lines import arrays_beside, check_kept, line_facts, save_residuals_beside
from epigauge.cli._live import watching
from epigauge.cli._tables import save_residuals
from epigauge.cli._targets import PICTURES, Targets, check_folder, save_drawing
from epigauge.errors import ArgumentError
from epigauge.io import SceneSource, load_line_tracks, load_scene, plain, save_ply, save_scene
from epigauge.io._npz_scene import write_npz_scene
from epigauge.io.output import arrays_of_result
from epigauge.io.scene_files import is_scene_file, scene_content
from epigauge.multi_view.display import Display, display

#: Views up to which standard deviations are told unasked, and rows of their table.
_TOLD, _ROWS = 200, 24

#: Points that are the datum of what is told of precision.
_DATUM = 200

_POINT, _CAMERA, _LINE = (90, 140, 190), (224, 122, 31), (42, 111, 151)

Refine = Annotated[
    str | None,
    typer.Option(
        help="Of a scene's cameras: all, pose, or names of parameters such as f,k1.",
        show_default=False,
    ),
]
FixView = Annotated[
    list[str] | None,
    typer.Option(help="Number (from 0) or name of a view of a scene that is not moved; several."),
]
Rigs = Annotated[
    _Rigs, choice(_Rigs, "Poses of a COLMAP folder's rigs; to keep them, they must fit.")
]


def refuse_options(options: Mapping[str, Any]) -> None:
    """Refuse what only projective cameras have, where it is given."""
    for name, value in options.items():
        if value is not None:
            option = f"--{name.replace('_', '-')}"
            raise ArgumentError(option, "is given with a scene", "tracks without cameras")


def of_tracks(init: str, prune: bool, repeated: str) -> dict[str, object]:
    """Return the options for tracks of cameras that are to be found, None where not given."""
    return {
        "init": None if init == "auto" else init,
        "prune": prune or None,
        "repeated": None if repeated == "first" else repeated,
    }


def save_cloud(
    path: Path,
    points: NDArray[np.float64],
    centres: NDArray[np.float64],
    note: str,
    colours: NDArray[np.uint8] | None = None,
    pieces: NDArray[np.float64] | None = None,
) -> None:
    """Write points, centres of cameras and pieces of lines (L, 2, 3) as a cloud to look at."""
    own = np.broadcast_to(np.array(_POINT, np.uint8), (len(points), 3))
    cameras = np.broadcast_to(np.array(_CAMERA, np.uint8), (len(centres), 3))
    rgb = np.vstack([own if colours is None else colours, cameras])
    places, edges = np.vstack([points, centres]), None
    if pieces is not None:
        ends = pieces.reshape(-1, 3)
        edges = len(places) + np.arange(len(ends)).reshape(-1, 2)
        rgb = np.vstack([rgb, np.broadcast_to(np.array(_LINE, np.uint8), ends.shape)])
        places = np.vstack([places, ends])
    save_ply(path, places, rgb, note, edges)


class SceneJob:
    """A scene, what is to be done with it, and the forms the answer is given in."""

    def __init__(
        self,
        path: Path,
        refine: str | None = None,
        fixed: Sequence[str] = (),
        rigs: str = "keep",
        y_up: bool | None = None,
        image_size: tuple[int, int] | None = None,
        lines: Path | None = None,
    ) -> None:
        self.path, self.rigs, self.image_size = path, rigs, image_size
        self.tracks, start = load_scene(path)
        if not isinstance(start, eg.MetricReconstruction):
            was = "is given with cameras that are not calibrated"
            raise ArgumentError("--refine", was, "a scene with calibrated ones, or none")
        self.start = start
        self.lines = None if lines is None else load_line_tracks(lines, self.tracks)
        check_kept(self.start, self.lines, "scene")
        model = self.start.cameras.model
        if image_size is not None and model != "bal":
            was = f"is given with cameras of the model {model}"
            raise ArgumentError("--image-size", was, "a BAL file; others tell the size themselves")
        self.refine: Any = refine or "all"
        if self.refine not in ("all", "pose"):
            self.refine = [name.strip() for name in self.refine.split(",")]
        self.fixed = [self._view(name) for name in fixed]
        self.y_up = self.start.cameras.model == "bal" if y_up is None else y_up

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out in reading."""
        source = self.tracks.source
        return source.notes if isinstance(source, SceneSource) else ()

    def _view(self, name: str) -> int:
        if name in (self.tracks.names or ()):
            return (self.tracks.names or ()).index(name)
        if name.isascii() and name.isdigit() and int(name) < self.tracks.n_views:
            return int(name)
        needed = f"a number from 0 to {self.tracks.n_views - 1}, or the name of a view"
        raise ArgumentError("--fix-view", f"is {name!r:.60}", needed)

    def run(
        self,
        options: Mapping[str, Any],
        plot: Sequence[Path] | None,
        output: Sequence[Path] | None,
        json: bool,
        precision: Sequence[Path] | None = None,
    ) -> int:
        """Adjust the scene and write what is asked for; return the exit code."""
        targets = Targets(plot, output, json=json, check=self._check_target, precision=precision)
        options = dict(options)
        adjust: Callable[..., eg.BundleResult] = options.pop("adjust")
        out = console()
        begin = time.perf_counter()
        with watching(out, len(self.tracks), "adjustment", not json) as watch:
            watch.begin()
            if self.lines is not None:
                options["lines"] = self.lines
            result = adjust(
                self.tracks,
                self.start,
                refine=self.refine,
                fixed_views=self.fixed,
                callback=watch,
                **options,
            )
        answer = _SceneAnswer(self, result, time.perf_counter() - begin, str(options["loss"]))
        targets.save(answer.save)
        targets.draw(answer.draw)
        targets.draw_precision(answer.draw_precision)
        if json:
            write_json(answer.document())
        else:
            for row in () if targets.on_stdout else answer.scene.vectors:
                typer.echo(" ".join(f"{value:.17g}" for value in row))
            answer.report(out, watch.interrupted)
        if watch.interrupted:
            out.print(f"[bold red]interrupted[/] after {result.nfev} evaluations: this is the best")
            return INTERRUPTED
        return DONE if result.success else NOT_CONVERGED

    def written(
        self, path: Path, scene: eg.MetricReconstruction
    ) -> tuple[eg.Tracks, eg.MetricReconstruction]:
        """Return a scene as it is written to a path: BAL's in a folder with COLMAP's cameras."""
        if self.image_size is None or is_scene_file(path):
            return self.tracks, scene
        return eg.interop.bal_to_colmap(self.tracks, scene, self.image_size)

    def _check_target(self, path: Path) -> None:
        """Check what a run that may be long will write, before it starts."""
        check_folder(path)
        if path.suffix.lower() in (".ply", ".csv"):
            return
        if path.suffix.lower() in PICTURES and not path.is_dir():
            was = f"is {str(path)!r}, which is the name of a picture, not of a folder"
            raise ArgumentError("-o", was, "a name without this ending, or --plot")
        if self.lines is not None and path.suffix.lower() != ".npz":
            was = f"is {str(path)!r}, a form that has no place for lines"
            raise ArgumentError("-o", was, "a name ending in .npz, .ply or .csv")
        if self.start.cameras.model == "bal" and not (self.image_size or is_scene_file(path)):
            was = "is not given, and a BAL file does not tell it"
            raise ArgumentError("--image-size", was, "the images' width and height, or -o FILE.npz")
        content = scene_content(path, *self.written(path, self.start), self.rigs)
        rigs = getattr(content, "rigs", None) or ()
        if any(len(rig.sensors) > 1 for rig in rigs):
            was = "is 'keep', but views are adjusted one by one, so that rigs lose their poses"
            raise ArgumentError("--rigs", was, "'drop', or an NPZ file to write to")


class _SceneAnswer:
    """An adjusted scene and the forms it is given in."""

    def __init__(self, job: SceneJob, result: eg.BundleResult, seconds: float, loss: str) -> None:
        self.job, self.result, self.seconds, self.loss = job, result, seconds, loss
        assert isinstance(result.reconstruction, eg.MetricReconstruction)
        self.scene = result.reconstruction

    @cached_property
    def covariance(self) -> eg.MetricCovariance | ArgumentError:
        """How sure it is, or why nobody can say.

        By inner constraints over the points that are seen most: over all, the farthest ones, whose
        places the noise makes, would be the datum.
        """
        tracks, result = self.job.tracks, self.result
        weights = np.where(result.rejected, 0.0, tracks.weights)
        counts = np.bincount(tracks.point, weights > 0.0, minlength=tracks.n_points)
        most = np.argsort(-np.where(self.frame.shown, counts, 0.0), kind="stable")[:_DATUM]
        try:
            return eg.covariance(
                tracks.weighted(weights),
                self.scene,
                eg.gauge.inner(points=most[self.frame.shown[most]].tolist()),
                refine=self.job.refine,
                fixed_views=self.job.fixed,
                lines=self.job.lines,
                loss=self.loss,
                loss_scale_px=result.loss_scale_px or "auto",
            )
        except ArgumentError as error:
            return error

    @property
    def sure(self) -> eg.MetricCovariance | None:
        """The covariance where there is one."""
        return None if isinstance(self.covariance, ArgumentError) else self.covariance

    @property
    def intrinsics(self) -> list[tuple[int, str, float, float, str]]:
        """Camera, name, value, sigma and unit of each refined parameter; few views only."""
        if self.job.tracks.n_views > _TOLD or self.job.refine == "pose" or self.sure is None:
            return []
        return self.sure.intrinsic_rows()

    @cached_property
    def pieces(self) -> NDArray[np.float64] | None:
        """What is seen of each line, (L, 2, 3)."""
        lines = self.job.lines
        return None if lines is None else lines.pieces(self.scene)

    @cached_property
    def frame(self) -> Display:
        """Where to look at it."""
        return display(self.scene, self.job.tracks, y_up=self.job.y_up)

    def more(self) -> dict[str, Any]:
        """Return what neither result nor scene holds."""
        tracks, lines = self.job.tracks, self.job.lines
        known = {
            "source": told(self.job.path),
            "n_views": tracks.n_views,
            "n_points": tracks.n_points,
            "seconds": self.seconds,
        }
        return known if lines is None else known | {"n_lines": lines.n_lines}

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        document: dict[str, Any] = plain(self.result)
        scene = document.pop("reconstruction")
        names = self.job.tracks.names
        document |= scene.pop("cameras") | scene
        keys = "camera", "name", "value", "sigma", "unit"
        rows = [dict(zip(keys, row, strict=True)) for row in self.intrinsics]
        more = {"names": plain(names), "notes": plain(self.job.notes), "intrinsics": rows}
        return document | self.more() | more

    def save(self, path: Path) -> None:
        """Write the scene with the result, a cloud of points and centres, or residuals."""
        tracks, scene = self.job.tracks, self.scene
        match path.suffix.lower():
            case ".ply":
                note = "points, cameras orange"
                save_cloud(path, scene.X, scene.centres, note, tracks.colours, self.pieces)
            case ".npz":
                more = arrays_of_result(self.result) | self.more()
                write_npz_scene(path, tracks, scene, more | arrays_beside(self.job.lines))
            case ".csv":
                save_residuals(path, self.result, tracks)
                save_residuals_beside(path, self.result, self.job.lines, tracks)
            case _:
                save_scene(path, *self.job.written(path, scene), rigs=self.job.rigs)

    def draw(self, path: Path) -> None:
        """Draw a picture, or write a page."""
        tracks, title = self.job.tracks, named(self.job.path)
        if path.suffix.lower() == ".html":
            from epigauge.reports import save_viewer

            options: Any = {"frame": self.frame, "covariance": self.sure, "pieces": self.pieces}
            save_viewer(path, self.result, tracks, title, **options)
            return
        from epigauge.plots import plot_bundle, save_figure

        save_figure(
            plot_bundle(self.result, tracks, title, frame=self.frame, pieces=self.pieces), path
        )

    def draw_precision(self, path: Path) -> None:
        """Draw how sure it is."""
        from epigauge.plots import plot_precision

        if isinstance(self.covariance, ArgumentError):
            raise self.covariance
        tracks, title = self.job.tracks, named(self.job.path)
        figure = plot_precision(self.covariance, tracks, title, frame=self.frame)
        save_drawing(path, figure, title, self.covariance)

    def report(self, out: Console, interrupted: bool) -> None:
        """Tell people on stderr what came out."""
        result, tracks, cameras = self.result, self.job.tracks, self.scene.cameras
        refine = self.job.refine
        rows = {
            "scene": f"{tracks.n_views} views, {tracks.n_points} points, "
            f"{len(tracks)} observations",
            "cameras": f"{len(cameras)} of the model {cameras.model}, refined: "
            f"{refine if isinstance(refine, str) else 'pose, ' + ', '.join(refine)}",
            "method": result.method,
            "rms_px": f"{result.rms_px:.6g} per coordinate",
            "cost": f"{result.cost:.8g} px^2",
            "evaluations": f"{result.nfev}, with {result.njev} linearisations",
            "status": "interrupted" if interrupted else escape(result.message),
            "flags": escape(", ".join(result.flags)) or "none",
            "seconds": f"{self.seconds:.2f}",
        }
        rows |= line_facts(self.job.lines, result)
        if result.n_behind:
            rows["behind"] = f"{result.n_behind} observations of points behind their camera"
        if result.weakest:
            rows["weakest"] = escape(result.weakest)
        if result.rejected.any():
            count = int(np.count_nonzero(result.rejected))
            rows["set aside"] = f"{count} of {len(tracks)} observations, as gross errors"
        if result.loss_scale_px:
            rows["loss_scale_px"] = f"{result.loss_scale_px:.4g}"
        if self.job.notes:
            rows["file"] = escape("; ".join(self.job.notes))
        out.print(facts(escape(shown(self.job.path)), rows))
        if known := self.intrinsics:
            out.print(_table(known))
        if not (result.success or interrupted):
            why = result.message if result.status <= 0 or not result.flags else result.flags[0]
            out.print(f"[bold red]not to be trusted:[/] {escape(why)}")


def _table(rows: Sequence[tuple[int, str, float, float, str]]) -> Table:
    """Return a table of parameters with their standard deviations, the first ones of many."""
    table = Table(box=None, pad_edge=False)
    for name in ("camera", "parameter", "value", "sigma", "unit"):
        table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
    for camera, name, value, sigma, unit in rows[:_ROWS]:
        table.add_row(
            str(camera), name, f"{value:.8g}", f"{sigma:.3g}", "" if unit == "1" else unit
        )
    if len(rows) > _ROWS:
        table.caption = f"{len(rows) - _ROWS} more: --json has them"
    return table
