"""``epigauge data``: measured data sets by name."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

import epigauge as eg
from epigauge.cli._common import DONE, Json, console, facts, write_json


def data(
    name: Annotated[
        str | None, typer.Argument(help="A data set; without it all are listed.")
    ] = None,
    json: Json = False,
) -> int:
    """List the data sets that are known by name, or fetch one.

    Writes the path of its file to stdout, for the other commands to read.
    A set is looked for where EPIGAUGE_DATA points and in the cache, and
    downloaded only if it is in neither.
    """
    if name is None:
        entries = [eg.datasets.describe(known) for known in eg.datasets.names()]
        if json:
            write_json({"datasets": [_known(entry) for entry in entries]})
        else:
            console().print(_table(entries))
        return DONE
    entry = eg.datasets.describe(name)
    file = eg.datasets.path(name)
    if json:
        write_json(_known(entry) | {"path": str(file)})
        return DONE
    rows = {key: str(value) for key, value in _known(entry).items() if key != "downloadable"}
    console().print(facts("", {key: escape(value) for key, value in rows.items()}))
    typer.echo(file)
    return DONE


def _known(entry: eg.datasets.Dataset) -> dict[str, Any]:
    fields = ("name", "kind", "title", "origin", "licence", "downloadable")
    return {field: getattr(entry, field) for field in fields}


def _table(entries: list[eg.datasets.Dataset]) -> Table:
    table = Table("name", "what", "download", "licence")
    for entry in entries:
        downloadable = "yes" if entry.downloadable else "no"
        table.add_row(entry.name, escape(entry.title), downloadable, escape(entry.licence))
    return table
