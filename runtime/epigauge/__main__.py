"""The command line: ``epigauge`` or ``python -m epigauge``."""

from __future__ import annotations

import sys

_NEEDED = ("typer", "rich")


def main() -> None:
    """Run the command line; exit with 2 and the remedy where its packages are not installed."""
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
    app(prog_name="epigauge")


if __name__ == "__main__":
    main()
