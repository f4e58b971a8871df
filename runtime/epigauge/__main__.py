"""The command line: ``epigauge`` or ``python -m epigauge``."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typer import Typer

_NEEDED = ("typer", "rich")
_LOUDNESS = ("-q", "--quiet", "-v", "-vv", "--verbose")
#: Set by the scripts of ``epigauge completion``.
_COMPLETE = "_EPIGAUGE_COMPLETE"


def main() -> None:
    """Run the command line; exit with 2 and the remedy where its packages are not installed."""
    try:
        app = _app()
        if _COMPLETE in os.environ:
            from typer.completion import completion_init  # type: ignore[attr-defined]

            completion_init()
        app(args=_loudness_first(sys.argv[1:]), prog_name="epigauge")
    except KeyboardInterrupt:  # while modules are imported; later, commands see to it
        print("epigauge: interrupted", file=sys.stderr)
        sys.exit(130)


def _loudness_first(arguments: list[str]) -> list[str]:
    """Return the arguments with -q and -v, which belong to no command, before the command."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    first = [word for word in arguments[:end] if word in _LOUDNESS]
    rest = [word for word in arguments[:end] if word not in _LOUDNESS]
    return first + rest + arguments[end:]


def _app() -> Typer:
    """Import the commands."""
    try:
        from epigauge.cli import app
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _NEEDED:
            raise
        print(
            f"epigauge: the command line needs the package {package}: pip install 'epigauge[cli]'",
            file=sys.stderr,
        )
        sys.exit(2)
    return app


if __name__ == "__main__":
    main()
