"""What the commands share: where text and data go, and how a failure ends."""

from __future__ import annotations

import atexit
import functools
import logging
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, ParamSpec, get_args

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import epigauge as eg
from epigauge import _library, verdicts
from epigauge._results import SCHEMA
from epigauge.errors import EpigaugeError
from epigauge.io.output import json_text, plain

P = ParamSpec("P")

DONE, NOT_CONVERGED, BAD_INPUT = 0, 1, 2
#: What a shell reports of a program that Ctrl-C has ended.
INTERRUPTED = 130

#: How files begin that are no CSV.
_STARTS = {
    ".npz": b"PK",
    ".npy": b"\x93NUMPY",
    ".h5": b"\x89HDF",
    ".out": b"# Bundle file",
    ".txt.bz2": b"BZh",
    ".txt.gz": b"\x1f\x8b",
}
#: The first line of a BAL problem: numbers of cameras, points and observations.
_BAL = re.compile(rb"\s*\d+[ \t]+\d+[ \t]+\d+[ \t]*\r?\n")

#: Whether people are told nothing but errors.
_quiet: ContextVar[bool] = ContextVar("quiet", default=False)
#: Copies of what stdin held, which nobody should hear of.
_copies: list[Path] = []
#: Name of the command that runs.
_running: ContextVar[str] = ContextVar("command", default="")

Json = Annotated[bool, typer.Option("--json", help="Write one JSON document to stdout.")]


def choice(names: Any, text: str) -> Any:
    """Return an option of some names: help and completion show them, the library checks them."""
    allowed = [str(name) for name in get_args(names)]

    def similar(incomplete: str) -> list[str]:
        return [name for name in allowed if name.startswith(incomplete)]

    # In the text they are wrapped between the names, in a column of their own within them.
    said = f"{text} {' | '.join(allowed)}"
    return typer.Option(help=said, parser=str, metavar="NAME", autocompletion=similar)


def command(function: Callable[P, int]) -> Callable[P, None]:
    """Make a command of a function that returns its exit code.

    Errors of epigauge and of the operating system end it with `BAD_INPUT` and one line on stderr,
    Ctrl-C with `INTERRUPTED`; anything else is a bug and keeps its traceback.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        _running.set(function.__name__)
        try:
            code = function(*args, **kwargs)
            sys.stdout.flush()
        except BrokenPipeError:
            # The reader of stdout has seen enough; let the interpreter not complain at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(DONE) from None
        except (EpigaugeError, OSError) as error:
            typer.echo(f"epigauge: {_one_line(error)}", err=True)
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt:
            typer.echo("epigauge: interrupted; no file is left half-written", err=True)
            raise typer.Exit(INTERRUPTED) from None
        raise typer.Exit(code)

    return run


def console() -> Console:
    """Return the console for people: on stderr, as it is at this moment."""
    return Console(stderr=True, highlight=False, quiet=_quiet.get())


def set_loudness(quiet: bool, verbose: int) -> None:
    """Choose how much people are told: nothing, or also what the solvers log."""
    _quiet.set(quiet)
    warnings.filterwarnings("ignore", re.escape(_library.NOT_COMPILED))  # told here, on one line
    if _library.failed() and not quiet:
        typer.echo(f"epigauge: {_library.NOT_COMPILED}", err=True)
    if verbose:
        level = logging.INFO if verbose == 1 else logging.DEBUG
        logging.basicConfig(level=level, format="%(message)s", stream=sys.stderr, force=True)


def given(path: Path) -> Path:
    """Return a file to read: for ``-`` a copy of what stdin holds, kept until the program ends."""
    if str(path) != "-":
        return path
    content = sys.stdin.buffer.read()
    folder = tempfile.mkdtemp(prefix="epigauge-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    form = ".txt" if _BAL.match(content) else ".csv"
    form = next((form for form, start in _STARTS.items() if content.startswith(start)), form)
    copied = Path(folder, f"stdin{form}")
    copied.write_bytes(content)
    _copies.append(copied)
    return copied


def write_json(document: dict[str, Any]) -> None:
    """Write one JSON document to stdout, which says of which command and form it is."""
    head = {"command": _running.get(), "version": eg.__version__, "schema": SCHEMA}
    typer.echo(json_text(plain(head | document)))


def facts(title: str, rows: dict[str, str]) -> Table:
    """Return a table of names and what is known about them."""
    table = Table(title=title, title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def warn(out: Console, result: eg.FundamentalResult) -> None:
    """Tell people what the matches of a pair do not support, and what to do."""
    for flag, sentence in verdicts.explained(result.flags).items():
        out.print(f"[bold red]{escape(flag)}:[/] {escape(sentence)}", soft_wrap=True)
    if result.rank < 7 and result.E is None:
        text = f"the matches determine only {result.rank} of the 7 directions of F"
        out.print(f"[bold red]rank:[/] {text}", soft_wrap=True)
    if result.status <= 0:
        out.print(f"[bold red]not converged:[/] {escape(result.message)}", soft_wrap=True)


def told(path: Path) -> str:
    """Return what to call a file that was read: its path, or stdin for the copy of that."""
    return "stdin" if path in _copies else str(path)


def shown(path: Path) -> str:
    """Return a path as the caller wrote it, without what a terminal would interpret."""
    return "".join(c if c.isprintable() else "?" for c in told(path))


def named(path: Path) -> str:
    """Return what to call a file in a title: its name and that of its directory."""
    return shown(path if path in _copies else Path(*path.parts[-2:]))


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{os.fspath(error.filename)}: {error.strerror}"
    text = " ".join(str(error).split())
    for copied in _copies:
        text = text.replace(str(copied), "stdin")
    return text
