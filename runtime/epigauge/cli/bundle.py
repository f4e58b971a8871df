"""``epigauge bundle``: from a file of tracks to an adjusted reconstruction."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer

import epigauge as eg
from epigauge._arguments import as_choice
from epigauge._options import Backend as _Backend
from epigauge._options import (
    BundleDamping,
    GaugeMode,
    GaugeName,
    Initialization,
    Loss,
    Method,
)
from epigauge._options import Repeated as _Repeated
from epigauge.cli._cluster import adjuster
from epigauge.cli._common import (
    DONE,
    INTERRUPTED,
    NOT_CONVERGED,
    Json,
    choice,
    console,
    given,
    write_json,
)
from epigauge.cli._lines import check_kept, segments_of_file
from epigauge.cli._live import watching
from epigauge.cli._parts import adjust_folder, refuse
from epigauge.cli._scenes import (
    FixView,
    Refine,
    Rigs,
    SceneJob,
    of_tracks,
    refuse_options,
)
from epigauge.cli._targets import ImageSize, Plot, Targets, outputs
from epigauge.cli._tracks import TracksAnswer
from epigauge.distributed.parts import is_parts
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io import (
    TrackFile,
    load_reconstruction,
    load_track_file,
)
from epigauge.io.scene_files import is_scene

#: Tracks in these files have y down, those of BAL problems y up.
_Y_DOWN = (".npz", ".csv")

Clean = Annotated[bool, typer.Option("--clean", help="Use only what the file marks as clean.")]
MaxIter = Annotated[int, typer.Option(help="Trial steps allowed.")]
Backend = Annotated[_Backend | None, choice(_Backend, "See `epigauge info`.")]
Init = Annotated[Initialization, choice(Initialization, "Start without --start.")]
Prune = Annotated[
    bool,
    typer.Option(
        "--prune", help="Drop views and points with too few observations, and repeated ones."
    ),
]
Repeated = Annotated[
    _Repeated,
    choice(_Repeated, "What --prune keeps of a point twice in a view; drop: none of them."),
]
Start = Annotated[Path | None, typer.Option(help="NPZ or BAL with cameras and points to begin at.")]
TracksFile = Annotated[
    Path,
    typer.Argument(
        help="NPZ, CSV (view, point, x, y), BAL (.txt, .bz2), a COLMAP folder, or one of parts.",
        show_default=False,
    ),
]


Precision = Annotated[
    list[Path] | None,
    typer.Option(
        help="Of a scene: draw sigma of intrinsics and maps of precision: PNG, PDF, SVG or HTML. "
        "Or - for PNG on stdout. Several.",
        show_default=False,
    ),
]


def bundle(
    tracks: TracksFile,
    method: Annotated[Method, choice(Method, "Strategy.")] = "covariant",
    damping: Annotated[
        BundleDamping | None, choice(BundleDamping, "Another than the method's own.")
    ] = None,
    gauge: Annotated[GaugeName | None, choice(GaugeName, "Gauge to iterate in.")] = None,
    gauge_mode: Annotated[GaugeMode, choice(GaugeMode, "How the gauge acts.")] = "explicit",
    loss: Annotated[Loss, choice(Loss, "Of each squared residual.")] = "linear",
    robust: Annotated[
        bool,
        typer.Option(
            "--robust", help="Find gross errors, set them aside and list them (-o FILE.csv)."
        ),
    ] = False,
    clean: Clean = False,
    prune: Prune = False,
    repeated: Repeated = "first",
    max_iter: MaxIter = 100,
    init: Init = "auto",
    start: Start = None,
    backend: Backend = None,
    plot: Plot = None,
    output: Annotated[
        list[Path] | None,
        outputs(
            "Save NPZ: everything; PLY: a cloud to look at; CSV: residual of each observation, and "
            "whether it was set aside; of scenes: any form, as below."
        ),
    ] = None,
    colmap: Annotated[
        Path | None, typer.Option(help="Folder for a COLMAP text model with pinhole cameras.")
    ] = None,
    y_up: Annotated[
        bool | None,
        typer.Option(
            "--y-up/--y-down",
            help="Where y points in the images: up in BAL files, else down. Else what is drawn is "
            "mirrored.",
            show_default=False,
        ),
    ] = None,
    precision: Precision = None,
    refine: Refine = None,
    fix_view: FixView = None,
    rigs: Rigs = "keep",
    image_size: ImageSize = None,
    lines: Annotated[
        Path | None,
        typer.Option(
            help="Segments of lines to adjust with the points: CSV with view, line, x1, y1, x2, y2 "
            "and, if you like, sigma; or NPZ.",
            show_default=False,
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Adjust by the workers of a Dask cluster, such as tcp://host:8786.",
            show_default=False,
        ),
    ] = None,
    memory_limit: Annotated[
        int | None,
        typer.Option(
            metavar="MB",
            min=0,
            help="Of a folder of parts: what each worker keeps of observations.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> int:
    """Adjust the cameras and points of a file of tracks, or of a scene.

    Starts from two views and registers the others in turn, or from random
    cameras where that fails, and minimises the reprojection error in a
    projective basis. Writes the cameras to stdout, one line of 12 numbers
    each, row by row; with --json everything known.

    A scene is a COLMAP folder, an NPZ file of `eg.save_scene` or, with
    --refine or --image-size, a BAL file: it has calibrated cameras and points
    to begin with, which stay of their model. -o then takes a folder (COLMAP; of
    a BAL file with --image-size), .txt or .txt.bz2 (BAL) too; stdout has R | t
    row by row and the parameters of each view. With --lines, lines are adjusted
    together with the points; NPZ, PLY (as edges), CSV (residuals of segments in
    NAME.lines.csv) and pages have them, other forms no place for them.

    A folder of parts, as eg.distributed.write_parts writes it, is adjusted by
    the workers of --scheduler or, without, by processes of this machine, none
    of which holds all observations. -o takes a new folder, for parts with the
    result.

    Else pictures, PLY and COLMAP models use a basis in which the scene looks
    plausible: that is no calibration, and nothing can be measured in it.

    Ctrl-C stops after the evaluation being done: the best estimate so far is
    reported and saved as asked, with exit code 130.
    """
    source, tracks = tracks, given(tracks)
    start = tracks if start == source else start and given(start)
    lines = lines and given(lines)
    if is_parts(tracks):
        refuse({"gauge": gauge, "start": start, "colmap": colmap, "clean": clean, "prune": prune})
        refuse({"damping": damping, "robust": robust, "plot": plot, "precision": precision})
        refuse({"method": method != "covariant", "image_size": image_size, "lines": lines})
        refuse({"init": init != "auto", "gauge_mode": gauge_mode != "explicit"})
        refuse({"repeated": repeated != "first", "rigs": rigs != "keep"})
        if y_up is not None:
            refuse({"y_up" if y_up else "y_down": True})
        known: dict[str, Any] = {"loss": loss, "max_iter": max_iter, "backend": backend}
        where = scheduler, memory_limit
        return adjust_folder(tracks, *where, refine, fix_view or [], output or [], json, **known)
    if memory_limit is not None:
        raise ArgumentError("--memory-limit", "is given without parts", "a folder of parts")
    if refine is not None or image_size is not None or is_scene(tracks):
        others: dict[str, Any] = {
            "gauge": gauge,
            "start": start,
            "colmap": colmap,
            "clean": clean or None,
        }
        others |= of_tracks(init, prune, repeated)
        asked: dict[str, Any] = {
            "method": method,
            "damping": damping,
            "loss": loss,
            "max_iter": max_iter,
        }
        asked |= {"backend": backend, "gauge_mode": gauge_mode, "robust": robust}
        refuse_options(others)
        asked["adjust"] = adjuster(scheduler)
        scene = SceneJob(tracks, refine, fix_view or [], rigs, y_up, image_size, lines)
        return scene.run(asked, plot, output, json, precision)
    if precision is not None:
        was = "is given with tracks, whose cameras are not calibrated"
        raise ArgumentError("--precision", was, "a scene")
    if lines is not None and colmap is not None:
        was = "is given with lines, for which it has no place"
        raise ArgumentError("--colmap", was, "-o NAME.npz")
    try:
        targets = Targets(plot, output, (".npz", ".ply", ".csv"), json=json)
    except ArgumentError as error:
        if tracks.suffix.lower() in _Y_DOWN:
            raise
        needed = f"{error.needed}; or --refine, which adjusts the cameras of a BAL file as a scene"
        raise ArgumentError(error.argument, error.was, needed) from None
    out = console()
    file = load_track_file(tracks, clean, prune=repeated if prune else None)
    segments = None if lines is None else segments_of_file(lines, file)
    begin = time.perf_counter()
    with watching(out, len(file.tracks), "first reconstruction", not json) as watch:
        first = first_reconstruction(file, tracks, start, backend, init, robust)
        check_kept(first, segments, "start")
        watch.begin()
        result = adjuster(scheduler)(
            file.tracks,
            first,
            method=method,
            damping=damping,
            gauge=gauge_named(gauge),
            gauge_mode=gauge_mode,
            robust=robust,
            loss=loss,
            max_iter=max_iter,
            backend=backend,
            callback=watch,
            **({} if segments is None else {"lines": segments}),
        )
    seconds = time.perf_counter() - begin

    if y_up is None:
        y_up = tracks.suffix.lower() not in _Y_DOWN
    answer = TracksAnswer(result, file, tracks, y_up, seconds, segments)
    targets.save(answer.save)
    targets.draw(answer.draw)
    refused = None if colmap is None else answer.save_colmap(colmap)
    if json:
        write_json(answer.document())
    else:
        for P in () if targets.on_stdout else result.reconstruction.P:
            typer.echo(" ".join(f"{value:.17g}" for value in P.ravel()))
        answer.report(out, watch.interrupted)  # last: many cameras would scroll it away
    if watch.interrupted:
        out.print(f"[bold red]interrupted[/] after {result.nfev} evaluations: this is the best")
        return INTERRUPTED
    if refused is not None:
        raise refused
    return DONE if result.success else NOT_CONVERGED


def first_reconstruction(
    file: TrackFile,
    tracks: Path,
    start: Path | None,
    backend: _Backend | None,
    init: Initialization = "auto",
    robust: bool = False,
) -> eg.Reconstruction:
    """Return where to begin: what a file holds, or else two views and the others in turn."""
    if start is None:
        try:
            return eg.initialize(file.tracks, method=init, robust=robust, backend=backend)
        except ArgumentError as error:
            if error.argument == "tracks":
                raise FileFormatError(tracks, str(error)) from None
            raise
    if start == tracks and file.start is not None:
        found = file.start
    else:
        found = load_reconstruction(start)
    size = (file.tracks.n_views, file.tracks.n_points)
    # A reconstruction of another size is refused by who takes both.
    fits = (len(found.P), len(found.Q)) == size
    if fits and not np.isfinite(found.rms_px(file.tracks)):
        raise FileFormatError(
            start,
            "has no finite cost: some point is in or near the focal plane of a camera that sees it",
        )
    return found


def gauge_named(name: str | None) -> eg.gauge.Gauge | None:
    """Return a gauge by its name."""
    if name is None:
        return None
    gauge: eg.gauge.Gauge = getattr(eg.gauge, as_choice("gauge", name, get_args(GaugeName)))()
    return gauge
