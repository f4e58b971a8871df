"""``epigauge colmap``: the pairs of a COLMAP database, refined, or verified from raw matches."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from epigauge._options import Backend, Loss
from epigauge.cli._cluster import pool
from epigauge.cli._common import (
    BAD_INPUT,
    DONE,
    Json,
    choice,
    console,
    facts,
    shown,
    write_json,
)
from epigauge.cli._database import ROWS, name_of, progress, save_pairs
from epigauge.cli._targets import Targets, outputs
from epigauge.cli._verification import verify
from epigauge.colmap import DatabaseResult, refine_database
from epigauge.errors import ArgumentError

_MAX_ITER = 100

_COLOURS = {"refined": "green", "skipped": "dim"}


def colmap(
    database: Annotated[Path, typer.Argument(help="SQLite file of COLMAP.", show_default=False)],
    write: Annotated[
        bool, typer.Option("--write", help="Store the refined F in the database.")
    ] = False,
    backup: Annotated[
        bool, typer.Option(help="With --write: copy the database to DATABASE.bak first.")
    ] = True,
    loss: Annotated[Loss, choice(Loss, "Of each squared residual.")] = "linear",
    max_iter: Annotated[int, typer.Option(help="Trial steps allowed a pair.")] = _MAX_ITER,
    workers: Annotated[int, typer.Option(help="Threads; processes for many raw pairs.")] = 1,
    backend: Annotated[Backend | None, choice(Backend, "See `epigauge info`.")] = None,
    from_matches: Annotated[
        bool,
        typer.Option(
            "--from-matches",
            help="Verify the raw matches; with --write, store what each pair is.",
        ),
    ] = False,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Compute by the workers of a Dask cluster, such as tcp://host:8786.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[list[Path] | None, outputs("Save all pairs: CSV, or NPZ with more.")] = None,
    json: Json = False,
) -> int:
    """Refine the fundamental matrix of every verified pair of a COLMAP database.

    Writes a line for each pair to stdout: its two image numbers and the nine
    entries of F, row by row, x2^T F x1 = 0 in COLMAP's pixels. With --write, F of
    the pairs called refined is stored in the database, in one transaction;
    without, the file is only read. Everything else in it stays as it is.

    With --from-matches, the raw matches of all pairs that are not verified yet
    are, as by COLMAP's geometric verification: the lines are F of the pairs with
    general motion. With --write, what each pair is, its inliers and its F, E
    and H are stored; a second run goes on where the first one was stopped.

    Pairs that cannot be read or used are named with the reason and skipped; the
    others are done, with exit code 0. It is 2 where all are skipped.
    """
    targets = Targets(None, output, (".csv", ".npz"), json=json)
    if from_matches:
        if loss != "linear" or max_iter != _MAX_ITER:
            raise ArgumentError("--from-matches", "takes no --loss or --max-iter", "it alone")
        with pool(workers, scheduler) as where:
            return verify(database, write, backup, where, backend, targets, json)
    out = console()
    begin = time.perf_counter()
    with pool(workers, scheduler) as where, progress(out, not json) as callback:
        result = refine_database(
            database,
            write=write,
            backup=backup,
            progress=callback,
            loss=loss,
            max_iter=max_iter,
            backend=backend,
            **where,
        )
    seconds = time.perf_counter() - begin
    rows = [_row(result, k) for k in range(len(result))]
    targets.save(lambda path: save_pairs(path, result, rows))
    if json:
        counts = {"stored": int(result.stored.sum()), "backup": result.backup}
        write_json({"source": str(database), "seconds": seconds} | counts | {"pairs": rows})
    else:
        for k in [] if targets.on_stdout else np.flatnonzero(~np.isnan(result.rms_px)):
            numbers = " ".join(f"{value:.17g}" for value in result.F[k].ravel())
            typer.echo(f"{result.image_id[k, 0]} {result.image_id[k, 1]} {numbers}")
        _report(out, result, database, seconds)
    return BAD_INPUT if set(result.verdict) == {"skipped"} else DONE


def _row(result: DatabaseResult, k: int) -> dict[str, Any]:
    """Return what is told about a pair."""
    image1, image2 = result.image_id[k].tolist()
    return {
        "image1": image1,
        "image2": image2,
        "name1": result.names.get(image1, ""),
        "name2": result.names.get(image2, ""),
        "config": int(result.config[k]),
        "inliers": int(result.inliers[k]),
        "rms_before_px": float(result.rms_before_px[k]),
        "rms_px": float(result.rms_px[k]),
        "sigma": float(result.sigma[k]),
        "condition": float(result.condition[k]),
        "evaluations": int(result.nfev[k]),
        "verdict": result.verdict[k],
        "note": result.note[k],
        "stored": bool(result.stored[k]),
        "F": result.F[k],
    }


def _report(out: Console, result: DatabaseResult, source: Path, seconds: float) -> None:
    """Tell people on stderr what came out."""
    title = f"{escape(shown(source))}: RMS in pixels"
    table = Table(
        title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
    )
    for heading in ("image 1", "image 2"):
        table.add_column(heading, overflow="fold")
    for heading in ("inliers", "before", "after"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    order = list(range(len(result)))
    if len(result) > ROWS:  # those to look at, as far as there is room
        order = [k for k in order if result.verdict[k] != "refined"][:ROWS]
    for k in order:
        colour = _COLOURS.get(result.verdict[k], "red")
        note = f": {escape(result.note[k])}" if result.note[k] else ""
        table.add_row(
            *(name_of(result.names, number) for number in result.image_id[k].tolist()),
            str(result.inliers[k]),
            *(_pixels(rms[k]) for rms in (result.rms_before_px, result.rms_px)),
            f"[{colour}]{result.verdict[k]}[/]{note}",
        )
    out.print(table)
    if len(order) < len(result):
        out.print(f"{len(order)} of {len(result)} pairs shown; -o FILE holds all")
    counts = Counter(result.verdict)
    both = np.isfinite(result.rms_before_px) & np.isfinite(result.rms_px)
    rows = {"pairs": ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())}
    if both.any():
        medians = (np.median(rms[both]) for rms in (result.rms_before_px, result.rms_px))
        rows["median RMS"] = " -> ".join(f"{value:.4f} px" for value in medians)
    rows["stored"] = f"F of {result.stored.sum()} pairs" if result.stored.any() else "nothing"
    if result.backup is not None:
        rows["backup"] = escape(shown(Path(result.backup)))
    rows["seconds"] = f"{seconds:.2f}"
    out.print(facts("", rows))


def _pixels(rms: float) -> str:
    return "-" if np.isnan(rms) else f"{rms:.4f}"
