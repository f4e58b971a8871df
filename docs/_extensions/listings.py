"""Directives that list what the library says of itself: data sets, meanings, commands."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Sequence
from itertools import cycle
from typing import Any

import epigauge as eg
import typer
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

Row = Sequence[str]


def table(head: Row, rows: Iterable[Row]) -> nodes.table:
    """Return a table whose first column is code."""
    made = nodes.table()
    group = nodes.tgroup(cols=len(head))
    group += [nodes.colspec(colwidth=1) for _ in head]
    top, body = nodes.thead(), nodes.tbody()
    top += _row(head, nodes.Text)
    body += [_row(row, lambda name: nodes.literal(text=name)) for row in rows]
    group += [top, body]
    made += group
    return made


def _row(cells: Row, first: Callable[[str], nodes.Node]) -> nodes.row:
    row = nodes.row()
    for k, cell in enumerate(cells):
        row += nodes.entry("", nodes.paragraph("", "", first(cell)) if k == 0 else prose(cell))
    return row


def prose(text: str) -> nodes.paragraph:
    """Return a paragraph in which what stands in backticks is code."""
    kinds = cycle((nodes.Text, lambda code: nodes.literal(text=code)))
    pieces = " ".join(text.split()).split("`")
    return nodes.paragraph(
        "", "", *(kind(piece) for kind, piece in zip(kinds, pieces, strict=False))
    )


class Datasets(SphinxDirective):
    """The catalogue of data sets."""

    def run(self) -> list[nodes.Node]:
        """Return name, title, whether it can be fetched, and licence of each."""
        entries = map(eg.datasets.describe, eg.datasets.names())
        rows = ((e.name, e.title, "yes" if e.downloadable else "no", e.licence) for e in entries)
        return [table(("name", "what", "download", "licence"), rows)]


class Meanings(SphinxDirective):
    """A dictionary of what names or numbers mean: ``.. meanings:: epigauge.lm.STATUS``."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return keys and sentences."""
        module, _, name = self.arguments[0].rpartition(".")
        meanings = getattr(importlib.import_module(module), name)
        rows = ((str(key), meaning) for key, meaning in meanings.items())
        return [table(("", "meaning"), rows)]


class Flags(SphinxDirective):
    """The vocabulary of verdicts: ``.. flags::``."""

    def run(self) -> list[nodes.Node]:
        """Return name, meaning, remedy, and which kinds of result a flag spoils."""
        from epigauge.verdicts import FLAGS

        rows = (
            (name, flag.sentence, flag.remedy, ", ".join(flag.spoils) or "-")
            for name, flag in FLAGS.items()
        )
        return [table(("flag", "what was found", "remedy", "must not be used"), rows)]


class Commands(SphinxDirective):
    """The commands of the command line, each in a section of its own."""

    def run(self) -> list[nodes.Node]:
        """Return help and options of every command."""
        from epigauge.cli import app

        group = typer.main.get_command(app)
        assert hasattr(group, "commands")
        return [self._section(name, command) for name, command in group.commands.items()]

    def _section(self, name: str, command: Any) -> nodes.section:
        section = nodes.section(ids=[f"epigauge-{name}"])
        arguments = [p.name for p in command.params if p.param_type_name == "argument"]
        usage = " ".join(["epigauge", name, *(str(argument).upper() for argument in arguments)])
        section += nodes.title(text=f"epigauge {name}")
        section += nodes.literal_block(usage, usage, language="console")
        for paragraph in (command.help or "").split("\n\n"):
            section += prose(paragraph)
        rows = [
            (
                ", ".join(p.opts) if p.param_type_name == "option" else str(p.name).upper(),
                getattr(p, "help", "") or "",
                "" if p.default is None or p.required else str(p.default),
            )
            for p in command.params
        ]
        section += table(("", "what", "default"), rows)
        return section


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directives."""
    app.add_directive("datasets", Datasets)
    app.add_directive("meanings", Meanings)
    app.add_directive("flags", Flags)
    app.add_directive("commands", Commands)
    return {"version": "1", "parallel_read_safe": True}
