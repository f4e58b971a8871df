"""``epigauge compare``: the methods side by side on one file of tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import epigauge as eg
from epigauge.bundle.strategies import STRATEGIES
from epigauge.cli._common import (
    DONE,
    INTERRUPTED,
    NOT_CONVERGED,
    Json,
    console,
    given,
    named,
    shown,
    told,
    write_json,
)
from epigauge.cli._live import watching
from epigauge.cli._scenes import FixView, Refine, SceneJob, of_tracks, refuse_options
from epigauge.cli._targets import Plot, Targets, outputs, save_drawing
from epigauge.cli.bundle import (
    Backend,
    Clean,
    Init,
    MaxIter,
    Prune,
    Repeated,
    Start,
    first_reconstruction,
)
from epigauge.io import TrackFile, load_track_file
from epigauge.io.scene_files import is_scene
from epigauge.multi_view.compare import Comparison


def compare(
    tracks: Annotated[
        Path,
        typer.Argument(
            help="NPZ, CSV (view, point, x, y), BAL (.txt, .bz2) or a COLMAP folder.",
            show_default=False,
        ),
    ],
    methods: Annotated[
        str, typer.Option(help="all, or several of: " + ", ".join(STRATEGIES) + ".")
    ] = "all",
    clean: Clean = False,
    prune: Prune = False,
    repeated: Repeated = "first",
    max_iter: MaxIter = 100,
    init: Init = "auto",
    start: Start = None,
    backend: Backend = None,
    plot: Plot = None,
    output: Annotated[
        list[Path] | None, outputs("Save all that was measured: NPZ or JSON.")
    ] = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Write the table to stdout as Markdown.")
    ] = False,
    refine: Refine = None,
    fix_view: FixView = None,
    json: Json = False,
) -> int:
    """Adjust the same tracks, or the same scene, from the same start by several methods.

    Exit code 1 if the default method or, without it, none converged.

    Ctrl-C stops after the evaluation being done: what has been measured so far
    is reported, with exit code 130.
    """
    source, tracks = tracks, given(tracks)
    start = tracks if start == source else start and given(start)
    targets = Targets(plot, output, json=json)
    out = console()
    observed: TrackFile | SceneJob
    if refine is not None or is_scene(tracks):
        refuse_options({"clean": clean or None, "start": start} | of_tracks(init, prune, repeated))
        observed = SceneJob(tracks, refine, fix_view or [])
    else:
        observed = load_track_file(tracks, clean, prune=repeated if prune else None)
    chosen: Any = methods if methods == "all" else [name.strip() for name in methods.split(",")]
    with watching(out, len(observed.tracks), "first reconstruction", not json) as watch:
        options: dict[str, Any] = {"max_iter": max_iter, "backend": backend}
        if isinstance(observed, SceneJob):
            options |= {"refine": observed.refine, "fixed_views": observed.fixed}
            first: Any = observed.start
        else:
            first = first_reconstruction(observed, tracks, start, backend, init)
        comparison = eg.compare(
            observed.tracks, chosen, first, on_method=watch.begin, callback=watch, **options
        )
    title = named(tracks)
    targets.save(lambda path: comparison.save(path, source=told(tracks)))
    targets.draw(lambda path: save_drawing(path, comparison.plot(title), title, comparison))
    if json:
        write_json(
            {
                "source": told(tracks),
                "start_rms_px": comparison.start_rms_px,
                "rows": comparison.rows,
            }
        )
    elif markdown:
        typer.echo(comparison.to_markdown(), nl=False)
    else:
        size = f"{observed.tracks.n_views} views, {observed.tracks.n_points} points"
        print_table(out, comparison, f"{shown(tracks)}: {size}")
    if watch.interrupted:
        done = f"[bold red]interrupted[/] at {comparison.rows[-1].method}: this is what was done"
        out.print(done)
        return INTERRUPTED
    return exit_code(comparison)


def print_table(out: Console, comparison: Comparison, title: str) -> None:
    """Show the rows to people, the default method in bold and what did not converge in red."""
    table = Table(
        title=escape(title),
        title_justify="left",
        caption=f"start: RMS {comparison.start_rms_px:.4f} px; evals: evaluations of the cost",
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("method", no_wrap=True)
    for heading in ("evals", "RMS px", "cost px^2", "seconds"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("converged")
    for row in comparison.rows:
        style = "bold" if row.method == "covariant" else None
        table.add_row(
            row.method,
            str(row.nfev),
            f"{row.rms_px:.6f}",
            f"{row.cost:.8g}",
            f"{row.seconds:.3f}",
            "yes" if row.success else ", ".join(row.flags) or "no",
            style=style if row.success else "red",
        )
    out.print(table)
    for row in comparison.rows:
        if not row.success:
            out.print(f"[red]{row.method}:[/] {escape(row.message)}")


def exit_code(comparison: Comparison) -> int:
    """Return whether the default method, or else any, converged."""
    counted = [row for row in comparison.rows if row.method == "covariant"] or comparison.rows
    return DONE if any(row.success for row in counted) else NOT_CONVERGED
