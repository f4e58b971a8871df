"""``epigauge colmap``: the fundamental matrices of a COLMAP database, refined."""

from __future__ import annotations

import csv
import io
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Table

from epigauge._options import Backend, Loss
from epigauge.cli._common import (
    BAD_INPUT,
    DONE,
    Json,
    check_target,
    choice,
    console,
    facts,
    shown,
    write_json,
)
from epigauge.colmap import DatabaseResult, refine_database
from epigauge.io import save_result, writing
from epigauge.io._common import cut

#: Rows of the table before it leaves out what is in order.
_ROWS = 40

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
    max_iter: Annotated[int, typer.Option(help="Trial steps allowed a pair.")] = 100,
    workers: Annotated[int, typer.Option(help="Threads.")] = 1,
    backend: Annotated[Backend | None, choice(Backend, "See `epigauge info`.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Save all pairs: CSV, or NPZ with more.")
    ] = None,
    json: Json = False,
) -> int:
    """Refine the fundamental matrix of every verified pair of a COLMAP database.

    Writes a line for each pair to stdout: its two image numbers and the nine
    entries of F, row by row, x2^T F x1 = 0 in COLMAP's pixels. With --write, F of
    the pairs called refined is stored in the database, in one transaction;
    without, the file is only read. Everything else in it stays as it is.
    """
    if output is not None:
        check_target(output, ".csv", ".npz")
    out = console()
    begin = time.perf_counter()
    with _progress(out, not json) as callback:
        result = refine_database(
            database,
            write=write,
            backup=backup,
            workers=workers,
            progress=callback,
            loss=loss,
            max_iter=max_iter,
            backend=backend,
        )
    seconds = time.perf_counter() - begin
    if output is not None:
        _save(output, result)
    if json:
        rows = [_row(result, k) for k in range(len(result))]
        counts = {"stored": int(result.stored.sum()), "backup": result.backup}
        write_json({"source": str(database), "seconds": seconds} | counts | {"pairs": rows})
    else:
        for k in np.flatnonzero(~np.isnan(result.rms_px)):
            numbers = " ".join(f"{value:.17g}" for value in result.F[k].ravel())
            typer.echo(f"{result.image_id[k, 0]} {result.image_id[k, 1]} {numbers}")
        _report(out, result, database, seconds)
    return BAD_INPUT if set(result.verdict) == {"skipped"} else DONE


@contextmanager
def _progress(out: Console, wanted: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar on a terminal; yield the callback that moves it."""
    if not (wanted and out.is_terminal):
        yield None
        return
    columns = (BarColumn(), MofNCompleteColumn(), "pairs", TimeRemainingColumn())
    with Progress(*columns, console=out, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


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


def _save(path: Path, result: DatabaseResult) -> None:
    """Write all pairs: arrays to NPZ, a line a pair to CSV."""
    if path.suffix.lower() == ".npz":
        names = list(result.names.items())
        more = {"names": [name for _, name in names], "name_id": [number for number, _ in names]}
        save_result(path, result, **more)
        return
    with writing(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        table = csv.writer(text, lineterminator="\n")
        for k in range(len(result)):
            row = _row(result, k)
            F = row.pop("F").ravel().tolist()
            if not k:
                table.writerow([*row, *(f"F{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))])
            table.writerow([*row.values(), *F])
        text.flush()
        text.detach()


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
    if len(result) > _ROWS:  # those to look at, as far as there is room
        order = [k for k in order if result.verdict[k] != "refined"][:_ROWS]
    for k in order:
        colour = _COLOURS.get(result.verdict[k], "red")
        note = f": {escape(result.note[k])}" if result.note[k] else ""
        table.add_row(
            *(_name(result, number) for number in result.image_id[k].tolist()),
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


def _name(result: DatabaseResult, number: int) -> str:
    return escape(cut(result.names.get(number, f"image {number}")))


def _pixels(rms: float) -> str:
    return "-" if np.isnan(rms) else f"{rms:.4f}"
