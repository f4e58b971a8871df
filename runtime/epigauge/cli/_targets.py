"""The one rule for what commands write: the suffix chooses the form, ``-`` is stdout.

Every target is checked before a run that may be long. With ``-`` a file goes to stdout in place of
the lines that are written there else: NPZ of results, PNG of pictures.
"""

from __future__ import annotations

import errno
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from epigauge.errors import ArgumentError
from epigauge.io._common import check_suffix

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PICTURES", "ImageSize", "Plot", "Targets", "check_target", "outputs", "save_drawing"]

#: The forms of pictures.
PICTURES = (".png", ".pdf", ".svg", ".html")

_STDOUT = Path("-")


def outputs(text: str) -> Any:
    """Return the option ``-o`` of a command, whose forms the text names."""
    said = f"{text} Or - for NPZ on stdout. Several."
    return typer.Option("--output", "-o", help=said, show_default=False)


Plot = Annotated[
    list[Path] | None,
    typer.Option(
        help="Draw a picture: PNG, PDF or SVG; or write a page: HTML. Or - for PNG on stdout. "
        "Several.",
        show_default=False,
    ),
]
ImageSize = Annotated[
    tuple[int, int] | None,
    typer.Option(
        metavar="W H",
        help="Width and height of the images in pixels, where the file does not tell them.",
        show_default=False,
    ),
]


def check_target(path: Path, *suffixes: str) -> None:
    """Check what a run that may be long will write, before it starts."""
    if path == _STDOUT:
        return
    suffix = check_suffix(path, *suffixes)
    check_folder(path)
    if suffix in PICTURES:
        from epigauge.plots._style import need_matplotlib

        need_matplotlib()


def check_folder(path: Path) -> None:
    """Check that the folder is there in which a file or folder is to be made."""
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))


class Targets:
    """What a command shall write, by its options.

    Parameters
    ----------
    plot, output : sequence of Path or None
        What the options were given.
    forms : tuple of str
        Suffixes that ``-o`` takes.
    json : bool
        Whether JSON goes to stdout.
    check : callable, optional
        Checks a target of ``-o`` where other things than suffixes are to be seen to.
    precision : sequence of Path, optional
        What ``--precision`` was given: pictures as those of ``--plot``.
    """

    def __init__(
        self,
        plot: Sequence[Path] | None,
        output: Sequence[Path] | None,
        forms: tuple[str, ...] = (".npz", ".json"),
        *,
        json: bool = False,
        check: Callable[[Path], object] | None = None,
        precision: Sequence[Path] | None = None,
    ) -> None:
        self.plots, self.outputs = list(plot or ()), list(output or ())
        self.maps = list(precision or ())
        pictures = [*self.plots, *self.maps]
        dashes = [path for path in (*pictures, *self.outputs) if path == _STDOUT]
        if len(dashes) + json > 1:
            was = "is wanted for more than one of -o -, --plot -, --precision - and --json"
            raise ArgumentError("stdout", was, "one of them alone")
        #: Whether a file goes to stdout, in place of lines.
        self.on_stdout = bool(dashes)
        for path in pictures:
            check_target(path, *PICTURES)
        for path in self.outputs:
            if check is None or path == _STDOUT:
                check_target(path, *forms)
            else:
                check(path)

    def save(self, write: Callable[[Path], object]) -> None:
        """Write the results, each by a function of its path."""
        _write(self.outputs, ".npz", write)

    def draw(self, write: Callable[[Path], object]) -> None:
        """Write the pictures, each by a function of its path."""
        _write(self.plots, ".png", write)

    def draw_precision(self, write: Callable[[Path], object]) -> None:
        """Write the pictures of precision, each by a function of its path."""
        _write(self.maps, ".png", write)


def _write(paths: Iterable[Path], form: str, write: Callable[[Path], object]) -> None:
    for path in paths:
        with _landing(path, form) as place:
            write(place)


@contextmanager
def _landing(path: Path, form: str) -> Iterator[Path]:
    """Yield where to write: for stdout a file that is copied there afterwards."""
    if path != _STDOUT:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="epigauge-") as folder:
        place = Path(folder, f"stdout{form}")
        yield place
        sys.stdout.flush()
        sys.stdout.buffer.write(place.read_bytes())
        sys.stdout.buffer.flush()


def save_drawing(path: Path, figure: Figure, title: str, result: Any = None) -> None:
    """Write a picture in the form that the suffix says; a page tells the result, too."""
    if path.suffix.lower() == ".html":
        from epigauge.reports import save_picture_page

        save_picture_page(path, figure, title, result)
    else:
        from epigauge.plots import save_figure

        save_figure(figure, path)
