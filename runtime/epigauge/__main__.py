"""The command line: ``epigauge`` or ``python -m epigauge``."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typer import Typer

_NEEDED = ("typer", "rich")


def main() -> None:
    """Run the command line; exit with 2 and the remedy where its packages are not installed."""
    try:
        _app()(prog_name="epigauge")
    except KeyboardInterrupt:  # while modules are imported; later, commands see to it
        print("epigauge: interrupted", file=sys.stderr)
        sys.exit(130)


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
