"""Sections of a report and their forms: CSV, PNG, Markdown and self-contained HTML."""

from __future__ import annotations

import base64
import csv
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from epigauge.io.output import writing
from epigauge.plots import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Claim",
    "Picture",
    "Section",
    "Table",
    "fewest",
    "lower",
    "write_report",
    "write_section",
]

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table.

    Parameters
    ----------
    name : str
        Name of its CSV file, without suffix.
    caption : str
        What it shows.
    header : sequence of str
        Heading of each column.
    rows : sequence of sequences
        Cells; None is an empty one.
    formats : sequence of str
        Format of the numbers of each column in text; the last one holds for all that follow. CSV
        has ten significant digits.
    shown : bool
        Whether the report shows it; the CSV file is written in any case.
    """

    name: str
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    formats: Sequence[str] = ("",)
    shown: bool = True

    def text(self) -> list[list[str]]:
        """Return the cells as text."""
        formats = [*self.formats, *[self.formats[-1]] * len(self.header)]
        return [
            [_text(cell, form) for cell, form in zip(row, formats, strict=False)]
            for row in self.rows
        ]


@dataclass(frozen=True)
class Picture:
    """A figure, the name of its PNG file without suffix, and what it shows."""

    name: str
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Claim:
    """A statement, whether it was found to hold, and the numbers.

    Parameters
    ----------
    source : str
        Where it is made.
    statement : str
        The statement.
    confirmed : bool or None
        Whether our numbers agree; None where they are too near one another to tell.
    numbers : str
        Our numbers.
    """

    source: str
    statement: str
    confirmed: bool | None
    numbers: str

    @property
    def verdict(self) -> str:
        """Return the verdict in words."""
        if self.confirmed is None:
            return "tie"
        return "confirmed" if self.confirmed else "not confirmed"


def lower(ours: float, others: float, within: float) -> bool | None:
    """Tell whether a number is lower than another; None where they differ by less than a part."""
    if abs(ours - others) <= within * max(abs(ours), abs(others)):
        return None
    return bool(ours < others)


def fewest(ours: Sequence[float], others: Sequence[float], within: float = 0.02) -> bool | None:
    """Tell whether each of our numbers is lower than the other beside it.

    Returns
    -------
    bool or None
        False if any is higher, None if none is but some differ by less than a part.
    """
    verdicts = [lower(a, b, within) for a, b in zip(ours, others, strict=True)]
    return False if False in verdicts else None if None in verdicts else True


@dataclass(frozen=True)
class Section:
    """One experiment: paragraphs, tables and pictures in their order, and claims."""

    title: str
    content: Sequence[str | Table | Picture]
    claims: Sequence[Claim] = field(default_factory=tuple)


def write_section(directory: Path, section: Section) -> list[Path]:
    """Write tables as CSV and pictures as PNG, each complete or not at all.

    Parameters
    ----------
    directory : path
        Where; it exists.
    section : Section
        The experiment.

    Returns
    -------
    list of path
        The files.
    """
    paths = []
    for item in section.content:
        if isinstance(item, Table):
            text = io.StringIO()
            lines = csv.writer(text, lineterminator="\n")
            lines.writerow(item.header)
            lines.writerows([_raw(cell) for cell in row] for row in item.rows)
            paths.append(directory / f"{item.name}.csv")
            with writing(paths[-1]) as file:
                file.write(text.getvalue().encode())
        elif isinstance(item, Picture):
            paths.append(directory / f"{item.name}.png")
            save_figure(item.figure, paths[-1])
    return paths


def write_report(
    path: Path, title: str, introduction: Sequence[str], sections: Sequence[Section]
) -> list[Path]:
    """Write the report as Markdown and as HTML.

    Parameters
    ----------
    path : path
        The files without suffix; a directory of this name holds the pictures and CSV files.
    title : str
        Heading.
    introduction : sequence of str
        Paragraphs before the claims.
    sections : sequence of Section
        The experiments, already written by `write_section`.

    Returns
    -------
    list of path
        The two files.
    """
    claims = Table(
        "",
        "",
        ("claim", "where", "verdict", "our numbers"),
        [
            (claim.statement, claim.source, claim.verdict, claim.numbers)
            for section in sections
            for claim in section.claims
        ],
    )
    markdown = [f"# {title}", *introduction]
    document = [f"<h1>{html.escape(title)}</h1>", *map(_paragraph, introduction)]
    if claims.rows:
        markdown += ["## Claims", _markdown_table(claims)]
        document += ["<h2>Claims</h2>", _html_table(claims)]
    for section in sections:
        markdown.append(f"## {section.title}")
        document.append(f"<h2>{html.escape(section.title)}</h2>")
        for item in section.content:
            markdown += _markdown(item, path.name)
            document += _html(item, path)
    written = [path.with_suffix(".md"), path.with_suffix(".html")]
    page = _PAGE.format(title=html.escape(title), body="\n".join(document))
    for target, text in zip(written, ("\n\n".join(markdown) + "\n", page), strict=True):
        with writing(target) as file:
            file.write(text.encode())
    return written


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; }}
h2 {{ margin-top: 2.5rem; border-bottom: 1px solid #ccc; }}
table {{ border-collapse: collapse; font-size: 14px; margin: .5rem 0 1.5rem; }}
th, td {{ border-bottom: 1px solid #ddd; padding: .25rem .6rem; text-align: left;
  vertical-align: top; }}
td.number {{ text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }}
caption, figcaption {{ text-align: left; font-size: 14px; color: #555; padding: .3rem 0; }}
figure {{ margin: 1rem 0 1.5rem; }}
img {{ max-width: 100%; }}
.wide {{ overflow-x: auto; }}
.confirmed {{ color: #1b7837; font-weight: 600; white-space: nowrap; }}
.not {{ color: #c1121f; font-weight: 600; white-space: nowrap; }}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def _markdown(item: str | Table | Picture, folder: str) -> list[str]:
    if isinstance(item, Picture):
        return [f"![{item.caption}]({folder}/{item.name}.png)", f"*{item.caption}*"]
    if isinstance(item, Table):
        link = f"[{item.name}.csv]({folder}/{item.name}.csv)"
        caption = f"*{item.caption}* {link}"
        return [caption, _markdown_table(item)] if item.shown else [caption]
    return [item]


def _markdown_table(table: Table) -> str:
    lines = ["| " + " | ".join(table.header) + " |"]
    rules = ["---:" if numeric else "---" for numeric in _numeric(table)]
    lines.append("|" + "|".join(rules) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in table.text()]
    return "\n".join(lines)


def _html(item: str | Table | Picture, path: Path) -> list[str]:
    if isinstance(item, Picture):
        data = base64.b64encode((path / f"{item.name}.png").read_bytes()).decode()
        caption = html.escape(item.caption)
        image = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        return [f"<figure>{image}<figcaption>{caption}</figcaption></figure>"]
    if isinstance(item, Table):
        return [_html_table(item)] if item.shown else []
    return [_paragraph(item)]


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.header)
    numeric = _numeric(table)
    lines = []
    for row in table.text():
        cells = []
        for text, is_number in zip(row, numeric, strict=True):
            kind = "number" if is_number else text if text == "confirmed" else ""
            kind = "not" if text == "not confirmed" else kind
            style = f' class="{kind}"' if kind else ""
            cells.append(f"<td{style}>{html.escape(text)}</td>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    caption = f"<caption>{html.escape(table.caption)}</caption>" if table.caption else ""
    rows = f"{caption}<tr>{head}</tr>\n" + "\n".join(lines)
    return f'<div class="wide" data-scrolls><table>{rows}</table></div>'


def _numeric(table: Table) -> list[bool]:
    """Tell which columns hold numbers."""
    return [
        any(isinstance(cell, int | float) for cell in column)
        for column in zip(*table.rows, strict=True)
    ]


def _text(cell: Cell, form: str) -> str:
    if cell is None:
        return ""
    return cell if isinstance(cell, str) else format(cell, form)


def _raw(cell: Cell) -> Cell:
    return f"{cell:.10g}" if isinstance(cell, float) else cell
