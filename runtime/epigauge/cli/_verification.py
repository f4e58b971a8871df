"""``epigauge colmap --from-matches``: what the pairs of a COLMAP database have in common."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from epigauge._options import Backend
from epigauge.cli._common import BAD_INPUT, DONE, console, facts, shown, write_json
from epigauge.cli._database import ROWS, name_of, progress, save_pairs
from epigauge.cli._targets import Targets
from epigauge.colmap import CONFIGS, DatabaseVerification, verify_database

_GENERAL = (2, 3)


def verify(
    database: Path,
    write: bool,
    backup: bool,
    where: dict[str, Any],
    backend: Backend | None,
    targets: Targets,
    json: bool,
) -> int:
    """Verify the raw matches of a database; return the exit code."""
    out = console()
    begin = time.perf_counter()
    with progress(out, not json) as callback:
        result = verify_database(
            database,
            write=write,
            backup=backup,
            backend=backend,
            progress=callback,
            **where,
        )
    seconds = time.perf_counter() - begin
    rows = [_row(result, k) for k in range(len(result))]
    targets.save(lambda path: save_pairs(path, result, rows))
    if json:
        facts_ = {"stored": int(result.stored.sum()), "backup": result.backup}
        more = {"already": result.already, "pairs": rows}
        write_json({"source": str(database), "seconds": seconds} | facts_ | more)
    else:
        for k in [] if targets.on_stdout else np.flatnonzero(np.isin(result.config, _GENERAL)):
            numbers = " ".join(f"{value:.17g}" for value in result.F[k].ravel())
            typer.echo(f"{result.image_id[k, 0]} {result.image_id[k, 1]} {numbers}")
        _report(out, result, database, seconds)
    return BAD_INPUT if len(result) and (result.config == -1).all() else DONE


def _verdict(config: int) -> str:
    return "skipped" if config == -1 else CONFIGS[config].split(":")[0]


def _row(result: DatabaseVerification, k: int) -> dict[str, Any]:
    """Return what is told about a pair."""
    image1, image2 = result.image_id[k].tolist()
    config = int(result.config[k])
    return {
        "image1": image1,
        "image2": image2,
        "name1": result.names.get(image1, ""),
        "name2": result.names.get(image2, ""),
        "config": config,
        "matches": int(result.matches[k]),
        "inliers": int(result.inliers[k]),
        "noise_px": float(result.noise_px[k]),
        "verdict": _verdict(config),
        "note": result.note[k],
        "stored": bool(result.stored[k]),
        **{name: getattr(result, name)[k] for name in ("F", "E", "H")},
    }


def _report(out: Console, result: DatabaseVerification, source: Path, seconds: float) -> None:
    """Tell people on stderr what came out."""
    table = Table(
        title=escape(shown(source)),
        title_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    for heading in ("image 1", "image 2"):
        table.add_column(heading, overflow="fold")
    for heading in ("matches", "inliers", "noise, px"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    order = list(range(len(result)))
    if len(order) > ROWS:  # those to look at, as far as there is room
        order = [k for k in order if result.config[k] not in _GENERAL or result.note[k]][:ROWS]
    for k in order:
        config, noise = int(result.config[k]), result.noise_px[k]
        note = f": {escape(result.note[k])}" if result.note[k] else ""
        colour = "green" if config in _GENERAL else "dim" if config == 1 else "red"
        table.add_row(
            *(name_of(result.names, number) for number in result.image_id[k].tolist()),
            str(result.matches[k]),
            str(result.inliers[k]),
            "-" if np.isnan(noise) else f"{noise:.4f}",
            f"[{colour}]{_verdict(config)}[/]{note}",
        )
    if order:
        out.print(table)
    if len(order) < len(result):
        out.print(f"{len(order)} of {len(result)} pairs shown; -o FILE holds all")
    counts = Counter(_verdict(config) for config in result.config.tolist())
    listed = ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common())
    rows = {"pairs": listed or "none left"}
    if result.already:
        rows["before"] = f"{result.already} pairs were verified already"
    rows["stored"] = f"{result.stored.sum()} pairs" if result.stored.any() else "nothing"
    if result.backup is not None:
        rows["backup"] = escape(shown(Path(result.backup)))
    rows["seconds"] = f"{seconds:.2f}"
    out.print(facts("", rows))
