"""``epigauge samples``: small files to try the other commands with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

import epigauge as eg
from epigauge.cli._common import DONE, Json, console, write_json


def samples(
    folder: Annotated[
        Path | None,
        typer.Argument(help="Where to copy all of them; without it they are listed."),
    ] = None,
    json: Json = False,
) -> int:
    """List the samples that come with the package, or copy them to a folder.

    Matches, tracks and photographs, half a megabyte, to try the other commands
    with. Writes the paths of the files to stdout, one a line.
    """
    if folder is None:
        paths = [eg.samples.path(name) for name in eg.samples.names()]
    else:
        paths = eg.samples.copy(folder)
    if json:
        rows = [
            {"name": path.name, "what": eg.samples.SAMPLES[path.name], "path": str(path)}
            for path in paths
        ]
        write_json({"samples": rows})
        return DONE
    table = Table("name", "what")
    for path in paths:
        table.add_row(path.name, eg.samples.SAMPLES[path.name])
    console().print(table)
    for path in paths:
        typer.echo(path)
    return DONE
