"""Commands for files of matches and tracks: human text on stderr, data on stdout.

Exit codes: 0 done, 1 not to be used, 2 bad input. One module a command; a command is a function
that returns its exit code, registered here.
"""

from __future__ import annotations

from typing import Annotated

import typer

import epigauge as eg
from epigauge.cli._common import command, set_loudness
from epigauge.cli.bundle import bundle
from epigauge.cli.colmap import colmap
from epigauge.cli.compare import compare
from epigauge.cli.completion import completion
from epigauge.cli.data import data
from epigauge.cli.demo import demo
from epigauge.cli.estimate import estimate
from epigauge.cli.info import info
from epigauge.cli.metric import metric
from epigauge.cli.pair import pair
from epigauge.cli.refine import refine
from epigauge.cli.reproduce import reproduce
from epigauge.cli.samples import samples
from epigauge.cli.scene import scene

__all__ = ["app"]

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"epigauge {eg.__version__}")
        raise typer.Exit


@app.callback()
def _main(
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No text for people but errors.")
    ] = False,
    verbose: Annotated[
        int,
        typer.Option("--verbose", "-v", count=True, help="Log results; twice: every evaluation."),
    ] = 0,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Geometry of uncalibrated images: the maximum-likelihood fundamental matrix.

    Text for people goes to stderr, data to stdout.
    Exit codes: 0 done, 1 the result must not be used (it did not converge, or its
    flags say so), 2 bad input. Files of matches and tracks may be - for stdin.
    -q and -v may stand anywhere.
    """
    set_loudness(quiet, verbose)


for _function in (
    demo,
    refine,
    estimate,
    pair,
    bundle,
    metric,
    scene,
    compare,
    colmap,
    data,
    info,
    reproduce,
    samples,
    completion,
):
    app.command()(command(_function))
