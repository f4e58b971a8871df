"""The code in README and documentation: found in the pages and run as a reader would run it.

All ``python`` blocks of a page run in one namespace, in a folder of its own, in the order of the
page. A ``text`` block that follows one directly is what it prints: the words must be the same, the
numbers as far as they are printed, one behind ``~`` to 30 %, and ``...`` stands for anything. Of
``console`` blocks the lines ``$ epigauge ...`` are run, by the command line's own functions.

    python tests/documents.py docs/tutorials/sequence.md

runs pages and puts the pictures that they make into docs/pictures, where the pages show them.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import colmap_databases
import epigauge as eg
from epigauge.errors import MissingPackageError

CHECKOUT = Path(__file__).resolve().parents[1]
PICTURES = CHECKOUT / "docs" / "pictures"

#: Bytes of a picture, so that pages load on a phone.
LARGEST = 250_000

#: Commands that take minutes; their results are in the documentation.
LONG = ("reproduce",)
#: Shown between two matches of the text around it.
_ANYTHING = "..."
#: Before a number that depends on the version of some package.
_ROUGHLY = "~"
_FENCE = re.compile(r"^```([^`\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?(?![\w])", re.IGNORECASE)
_PARTS = re.compile(rf"({_ROUGHLY}?{_NUMBER.pattern}|{re.escape(_ANYTHING)}|\s+)", re.IGNORECASE)
_MISSING = re.compile(r"needs the package (\S+): pip install 'epigauge\[(\w+)\]'")
_PICTURE = re.compile(r"!\[[^\]]*\]\((?:\.\./)?pictures/([\w.-]+)\)")

_RUN: set[tuple[str, ...]] = set()


@dataclass(frozen=True)
class Block:
    """A block of code in a page, with what the page says that it prints."""

    language: str
    code: str
    line: int
    shown: str | None


def pages() -> list[Path]:
    """Return README, that of packages, and every page of the documentation with code that runs."""
    own = [CHECKOUT / "README.md", CHECKOUT / "packaging" / "README.md"]
    found = [*own, *sorted((CHECKOUT / "docs").rglob("*.md"))]
    return [page for page in found if "_build" not in page.parts and blocks(page)]


def blocks(page: Path) -> list[Block]:
    """Return the ``python`` and ``console`` blocks of a page."""
    text = page.read_text(encoding="utf-8")
    fences = list(_FENCE.finditer(text))
    found = []
    for fence, after in itertools.zip_longest(fences, fences[1:]):
        if fence[1] not in ("python", "console"):
            continue
        follows = after is not None and not text[fence.end() : after.start()].strip()
        shown = after[2] if follows and after[1] == "text" else None
        found.append(Block(fence[1], fence[2], text.count("\n", 0, fence.start()) + 1, shown))
    return found


def pictures(page: Path) -> list[str]:
    """Return the names of the pictures in docs/pictures that a page shows."""
    return _PICTURE.findall(page.read_text(encoding="utf-8"))


def run(
    page: Path, folder: Path, run_command: Callable[[list[str], str], None] | None = None
) -> None:
    """Run the blocks of a page in a folder that holds the files which pages take for granted.

    `run_command` takes the words of a command and where it stands; without it commands run in this
    process.
    """
    provide(folder)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.chdir(folder):
        for block in blocks(page):
            where = f"{page.name}, line {block.line}"
            if block.language == "python":
                printed = _run_python(block, page, namespace)
                if block.shown is not None:
                    compare(printed, block.shown, where)
            else:
                for arguments in commands(block):
                    (run_command or _run_command)(arguments, where)


def provide(folder: Path) -> None:
    """Write the samples, as `epigauge samples .` does, and database.db."""
    eg.samples.copy(folder)
    colmap_databases.Project().write(folder / "database.db")


def commands(block: Block) -> Iterator[list[str]]:
    """Yield the arguments of the commands of a console block that are run."""
    for line in block.code.splitlines():
        if line.startswith("$ epigauge "):
            arguments = shlex.split(line[len("$ epigauge ") :], comments=True)
            if arguments[0] not in LONG:
                yield arguments


def compare(printed: str, shown: str, where: str) -> None:
    """Compare what was printed with what a page shows."""
    pattern, numbers = "", []
    for part in _PARTS.split(shown.strip()):
        if part == _ANYTHING:
            pattern += r"[\s\S]*?"
        elif _NUMBER.fullmatch(part.removeprefix(_ROUGHLY)):
            pattern += rf"({_NUMBER.pattern})"
            numbers.append(part)
        else:
            pattern += r"\s+" if part.isspace() else re.escape(part)
    found = re.fullmatch(pattern, printed.strip(), re.IGNORECASE)
    assert found, f"{where} prints\n{printed}\nwhere the page shows\n{shown}"
    for number, said in zip(found.groups(), numbers, strict=True):
        assert _agree(number, said), f"{where} prints {number} where the page shows {said}"


def _agree(number: str, said: str) -> bool:
    if said.startswith(_ROUGHLY):
        return math.isclose(float(number), float(said.removeprefix(_ROUGHLY)), rel_tol=0.3)
    mantissa, _, exponent = said.lower().partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return math.isclose(
        float(number), float(said), rel_tol=1e-3, abs_tol=1.5 * unit if "." in mantissa else 0.0
    )


def _run_python(block: Block, page: Path, namespace: dict[str, Any]) -> str:
    # Empty lines before it make the line numbers of a traceback those of the page.
    code = compile("\n" * block.line + block.code, str(page), "exec")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(code, namespace)
    return printed.getvalue()


def _run_command(arguments: list[str], where: str) -> None:
    if tuple(arguments) in _RUN:
        return  # several pages show it, and it reads the same files
    from epigauge.cli import app
    from typer.testing import CliRunner

    done = CliRunner().invoke(app, arguments)
    missing = _MISSING.search(" ".join(done.output.split()))
    if missing:
        raise MissingPackageError(missing[1], missing[2])
    assert done.exit_code == 0, f"{where}: epigauge {' '.join(arguments)}\n{done.output}"
    _RUN.add(tuple(arguments))


def main(names: list[str]) -> None:
    """Run pages and keep the pictures that they show."""
    os.environ.setdefault("EPIGAUGE_DATA", str(CHECKOUT.parent / "shared" / "data"))
    for page in map(Path, names):
        with tempfile.TemporaryDirectory() as folder:
            run(page.resolve(), Path(folder))
            for name in pictures(page):
                if Path(folder, name).is_file():
                    shutil.copyfile(Path(folder, name), PICTURES / name)
                    shrink(PICTURES / name)
                    print(f"{page}: {name}")


def shrink(picture: Path) -> None:
    """Keep a picture above `LARGEST` in 256 colours: a third of the size, and hardly to be seen."""
    from PIL import Image

    if picture.stat().st_size > LARGEST:
        with Image.open(picture) as opened:
            few = opened.convert("RGB").quantize(method=Image.Quantize.MAXCOVERAGE)
        few.save(picture, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
