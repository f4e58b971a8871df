"""``epigauge bundle``: from a file of tracks to an adjusted reconstruction."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

import epigauge as eg
from epigauge import lm
from epigauge._arguments import as_choice
from epigauge.cli._common import DONE, NOT_CONVERGED, Json, console, facts, shown, write_json
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io import (
    TrackFile,
    load_reconstruction,
    load_track_file,
    plain,
    save_ply,
    save_result,
)
from epigauge.io._common import check_suffix
from epigauge.io.tracks import arrays_of
from epigauge.multi_view.display import display

_GAUGES = ("reference_camera", "two_cameras", "five_points", "normalized")
_POINT, _CAMERA = (90, 140, 190), (224, 122, 31)

Clean = Annotated[bool, typer.Option("--clean", help="Use only what the file marks as clean.")]
MaxIter = Annotated[int, typer.Option(help="Trial steps allowed.")]
Backend = Annotated[str | None, typer.Option(help="c, numpy or casadi; see `epigauge info`.")]
Start = Annotated[Path | None, typer.Option(help="NPZ or BAL with cameras and points to begin at.")]
TracksFile = Annotated[
    Path,
    typer.Argument(help="NPZ, CSV (view, point, x, y) or BAL (.txt, .bz2).", show_default=False),
]


def bundle(
    tracks: TracksFile,
    method: Annotated[str, typer.Option(help="Strategy; see `epigauge compare`.")] = "covariant",
    damping: Annotated[str | None, typer.Option(help="Another than the method's own.")] = None,
    gauge: Annotated[
        str | None, typer.Option(help=f"Gauge to iterate in: {', '.join(_GAUGES)}.")
    ] = None,
    gauge_mode: Annotated[str, typer.Option(help="explicit or implicit.")] = "explicit",
    loss: Annotated[
        str, typer.Option(help="linear, huber, soft_l1, cauchy or truncated.")
    ] = "linear",
    clean: Clean = False,
    max_iter: MaxIter = 100,
    start: Start = None,
    backend: Backend = None,
    plot: Annotated[Path | None, typer.Option(help="Draw a picture: PNG or SVG.")] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="NPZ: everything. PLY: a cloud to look at."),
    ] = None,
    json: Json = False,
) -> int:
    """Adjust the cameras and points of a file of tracks.

    Starts from two views, registers the others in turn, and minimises the
    reprojection error in a projective basis. Writes the cameras to stdout, one
    line of 12 numbers each, row by row; with --json everything known.

    PLY and pictures use a basis in which the scene looks plausible: that is no
    calibration, and nothing can be measured in it.
    """
    if plot is not None:
        check_suffix(plot, ".png", ".svg")
    if output is not None:
        check_suffix(output, ".npz", ".ply")
    out = console()
    file = load_track_file(tracks, clean)
    begin = time.perf_counter()
    with progress(out, file.tracks, not json) as callback:
        result = eg.bundle_adjust(
            file.tracks,
            first_reconstruction(file, tracks, start, backend),
            method=method,
            damping=damping,
            gauge=gauge_named(gauge),
            gauge_mode=gauge_mode,
            loss=loss,
            max_iter=max_iter,
            backend=backend,
            callback=callback,
        )
    seconds = time.perf_counter() - begin

    more = {
        "source": str(tracks),
        "n_views": file.tracks.n_views,
        "n_points": file.tracks.n_points,
        "view_numbers": file.views,
        "point_numbers": file.points,
        "seconds": seconds,
    }
    if output is not None:
        _save(output, result, file.tracks, more)
    if plot is not None:
        _draw(plot, result, file.tracks, tracks)
    if json:
        document = plain(result)
        document |= document.pop("reconstruction")
        write_json(document | more)
    else:
        _report(out, result, file.tracks, tracks, seconds)
        for P in result.reconstruction.P:
            typer.echo(" ".join(f"{value:.17g}" for value in P.ravel()))
    return DONE if result.success else NOT_CONVERGED


def first_reconstruction(
    file: TrackFile, tracks: Path, start: Path | None, backend: str | None
) -> eg.Reconstruction:
    """Return where to begin: what a file holds, or else two views and the others in turn."""
    if start is None:
        try:
            return eg.initialize(file.tracks, backend=backend)
        except ArgumentError as error:
            if error.argument == "tracks":
                raise FileFormatError(tracks, str(error)) from None
            raise
    if start == tracks and file.start is not None:
        return file.start
    return load_reconstruction(start)


def gauge_named(name: str | None) -> eg.gauge.Gauge | None:
    """Return a gauge by its name."""
    if name is None:
        return None
    gauge: eg.gauge.Gauge = getattr(eg.gauge, as_choice("gauge", name, _GAUGES))()
    return gauge


@contextmanager
def progress(
    out: Console, tracks: eg.Tracks, wanted: bool = True
) -> Iterator[Callable[[lm.Row], None] | None]:
    """Show on one line of a terminal what the adjustment is at.

    Parameters
    ----------
    out : Console
        For people; where it is no terminal nothing is shown.
    tracks : Tracks
        Observations, whose number makes an RMS of a cost (robust and weighted, if the cost is).
    wanted : bool
        Whether to show anything.

    Yields
    ------
    callable or None
        Callback of `bundle_adjust`.
    """
    if not (wanted and out.is_terminal):
        yield None
        return
    with out.status("first reconstruction") as status:

        def show(row: lm.Row) -> None:
            rms = float(np.sqrt(row.cost / len(tracks)))
            status.update(f"evaluation {row.iteration + 1}: RMS {rms:.6f} px")

        yield show


def _save(path: Path, result: eg.BundleResult, tracks: eg.Tracks, more: dict[str, Any]) -> None:
    """Write the result, with the tracks it belongs to, or a cloud of points and centres."""
    if path.suffix.lower() == ".npz":
        save_result(path, result, **arrays_of(tracks), **more)
        return
    frame = display(result.reconstruction, tracks)
    points = frame.points[frame.shown]
    colours = np.repeat(np.array([_POINT, _CAMERA], np.uint8), [len(points), tracks.n_views], 0)
    save_ply(
        path,
        np.vstack([points, frame.centres]),
        colours,
        "points blue, cameras orange; a basis to look at, not a calibration",
    )


def _draw(path: Path, result: eg.BundleResult, tracks: eg.Tracks, source: Path) -> None:
    from epigauge.plots import plot_bundle, save_figure

    save_figure(plot_bundle(result, tracks, source.name), path)


def _report(
    out: Console, result: eg.BundleResult, tracks: eg.Tracks, source: Path, seconds: float
) -> None:
    """Tell people on stderr what came out."""
    rows = {
        "tracks": f"{tracks.n_views} views, {tracks.n_points} points, {len(tracks)} observations",
        "method": result.method,
        "rms_px": f"{result.rms_px:.6g} per coordinate",
        "cost": f"{result.cost:.8g} px^2",
        "evaluations": f"{result.nfev}, with {result.njev} linearisations",
        "status": escape(result.message),
        "seconds": f"{seconds:.2f}",
    }
    if result.loss_scale_px:
        rows["loss_scale_px"] = f"{result.loss_scale_px:.4g}"
    out.print(facts(escape(shown(source)), rows))
    if not result.success:
        out.print(f"[bold red]did not converge:[/] {escape(result.message)}")
