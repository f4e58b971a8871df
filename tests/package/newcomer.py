"""Walk everything that a newcomer meets, on a bare machine, and fail on whatever is wrong there.

    python tests/package/newcomer.py                  # builds a wheel, installs it with extra `all`
    python tests/package/newcomer.py --wheel X.whl    # takes this one
    python tests/package/newcomer.py --here           # with the interpreter that runs this

In a new environment, in an empty folder, without the checkout to import from: every command of the
parser with ``--help``, alone, with files of every form that its help names (opened again), with
each of its choices and flags, and with bad input; every example of README and documentation; the
examples in the docstrings; the pages, in a browser too where there is one. ``--quick`` leaves out
choices and everything that takes seconds. Wrong is: a traceback, an empty output, an option that
the help misses or a page uses without there being one, a broken link, a line or a page that is
wider than its screen.
"""

from __future__ import annotations

import argparse
import contextlib
import doctest
import multiprocessing
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import commands as cli

CHECKOUT = Path(__file__).resolve().parents[2]
TESTS = CHECKOUT / "tests"
sys.path.insert(0, str(TESTS))

#: Commands that take longer than the others, which choices and forms do not change much.
SLOW = ("reproduce", "demo", "scene")

#: Name of a part of the walk, what looks for faults, and its arguments.
Part = tuple[str, Callable[..., Iterable[str]], tuple[Any, ...]]


def parts(quick: bool, programs: bool = True) -> Iterator[Part]:
    """Yield the parts of the walk, each of which can run beside the others."""
    import commands as cli
    import documents

    run = cli.program if programs else cli.in_process
    yield "help", cli.help_of, (None, run)
    for name, command in cli.commands().items():
        yield f"{name} --help", cli.help_of, (command, run)
        if quick and name in SLOW:
            continue
        if name != "scene":  # others read what it makes: `commands.prepare`
            yield name, cli.alone, (command, run)
        if not quick and name not in SLOW:
            yield f"{name}: files", cli.written, (command, run)
            yield f"{name}: choices", cli.choices, (command, run)
    for name, command in cli.commands().items():
        yield f"{name}: bad input", cli.bad_inputs, (command, run, quick)
    yield "flags in the documentation", flags_in_pages, ()
    yield "names in the documentation", names_in_pages, ()
    yield "links in the documentation", links_in_pages, ()
    if not quick:
        for page in documents.pages():
            yield page.relative_to(CHECKOUT).as_posix(), example, (page, run)
        yield "docstrings", docstrings, ()


def walk(
    quick: bool, programs: bool = True, workers: int = 1
) -> Iterator[tuple[str, list[str], float]]:
    """Yield the name of each part of the walk, what is wrong there, and the seconds it took.

    Each part works in a copy of the folder that `commands.prepare` fills.
    """
    import commands as cli

    run = cli.program if programs else cli.in_process
    home = Path.cwd()
    Path("samples").mkdir()
    yield done_in(home / "samples", ("samples and scene", cli.prepare, (run, not quick)))
    with contextlib.ExitStack() as stack:
        found = list(parts(quick, programs))
        folders = [home / f"part{k}" for k in range(len(found))]
        if workers == 1:
            yield from map(done_in, folders, found)
        else:
            spawn = multiprocessing.get_context("spawn")
            pool = stack.enter_context(ProcessPoolExecutor(workers, spawn))
            yield from pool.map(done_in, folders, found)
    if not quick:
        yield done_in(home, ("pages in a browser", in_browser, (home,)))


def done_in(folder: Path, part: Part) -> tuple[str, list[str], float]:
    """Return the name of a part, what it finds in a copy of the samples, and its seconds."""
    name, look, arguments = part
    begin = time.perf_counter()
    if not folder.exists():
        shutil.copytree(folder.parent / "samples", folder)
    with contextlib.chdir(folder):
        try:
            problems = list(look(*arguments))
        except subprocess.TimeoutExpired as error:
            problems = [str(error)]
    return name, problems, time.perf_counter() - begin


def sources() -> list[Path]:
    """Return the pages as they are written."""
    found = [CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").rglob("*.md"))]
    return [page for page in found if "_build" not in page.parts]


def links_in_pages() -> Iterator[str]:
    """Yield links and pictures of a page that lead to no file."""
    for page in sources():
        text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", re.sub(r"`[^`]*`", "", text)):
            if "://" not in target and not (page.parent / target).exists():
                yield f"{page.relative_to(CHECKOUT)}: {target} leads nowhere"


def names_in_pages() -> Iterator[str]:
    """Yield names of the package that a page uses and that nobody reaches after importing it."""
    import epigauge as eg

    for page in sources():
        for name in set(re.findall(r"\beg\.([a-zA-Z]\w*)", page.read_text(encoding="utf-8"))):
            try:
                eg.__getattr__(name)  # not what other imports have left there
            except AttributeError:
                yield f"{page.relative_to(CHECKOUT)}: there is no eg.{name}"


def flags_in_pages() -> Iterator[str]:
    """Yield options that a page uses of a command, or commands, which do not exist."""
    import commands as cli

    pages = [CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md"]
    pages += sorted((CHECKOUT / "docs").rglob("*.md")) + sorted((CHECKOUT / "docs").rglob("*.rst"))
    call = re.compile(r"(?:^[ ]{3,}|^\$ |`)epigauge ([a-z]\w*)([^`\n]*)", re.MULTILINE)
    for page in pages:
        if "_build" in page.parts:
            continue
        for name, rest in call.findall(page.read_text(encoding="utf-8")):
            where = f"{page.relative_to(CHECKOUT)}: epigauge {name}{rest}"
            command = cli.commands().get(name)
            if command is None:
                yield f"{where}: there is no such command"
                continue
            known = {flag for option in command.options for flag in option.flags}
            known |= {"-q", "-v", "-vv", "--quiet", "--verbose", "--help", "-h"}
            for word in re.findall(r"(?<!\S)--?[a-z][\w-]*", rest.partition("#")[0]):
                if word not in known:
                    yield f"{where}: there is no {word}"


def example(page: Path, run: cli.Runner) -> Iterator[str]:
    """Run what a page shows."""
    import documents

    def run_command(arguments: list[str], where: str) -> None:
        problems = run(*arguments).check(0)
        assert not problems, f"{where}: {problems[0]}"

    folder = Path("as a reader").resolve()
    folder.mkdir()
    try:
        documents.run(page, folder, run_command)
    except Exception as error:  # whatever a reader would meet
        text = f"{type(error).__name__}: {error}"
        if excused(error, page.read_text(encoding="utf-8")):
            print(f"   {page.name} skips the rest, as it says: {text}", flush=True)
        else:
            yield text[-1500:]


def excused(error: Exception, page: str) -> bool:
    """Tell whether a page says itself that it needs what is missing here.

    Data sets: by their functions. Packages beyond the extra `all`: before the first section.
    """
    if type(error).__name__ in ("DatasetError", "MissingPackageError"):
        return "epigauge.datasets" in page or "eg.datasets" in page
    head = page.partition("\n## ")[0].lower()
    named = isinstance(error, ModuleNotFoundError) and (error.name or "?").lower() in head
    return named and re.search(r"`all`\s+does\s+not", head) is not None


def docstrings() -> Iterator[str]:
    """Yield examples of public names that print something else than they show."""
    import importlib
    import inspect

    import epigauge as eg
    import numpy as np

    for name in eg.__all__:
        value = getattr(eg, name)
        if not (inspect.isfunction(value) or inspect.isclass(value)) or not value.__doc__:
            continue
        names = vars(importlib.import_module(value.__module__)) | {"eg": eg, "np": np}
        test = doctest.DocTestParser().get_doctest(value.__doc__, names, name, None, 0)
        said: list[str] = []
        doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
        if said:
            yield "".join(said)


def in_browser(folder: Path) -> Iterator[str]:
    """Yield what is wrong with the pages of a folder at the widths of a phone, tablet and desk."""
    import browser

    why = browser.missing()
    if why:
        print(f"   no browser: {why}")
        return
    with browser.Browser() as window:
        for page in sorted(folder.rglob("*.html")):
            for width in browser.WIDTHS:
                yield from (
                    f"{page} at {width} px: {problem}" for problem in window.problems(page, width)
                )


def report(parts: Iterable[tuple[str, list[str], float]]) -> int:
    """Print each part as it ends; return how much is wrong."""
    count = 0
    for name, problems, seconds in parts:
        print(f"{'ok' if not problems else 'WRONG':6} {seconds:6.1f} s  {name}", flush=True)
        for problem in problems:
            print("       " + problem.replace("\n", "\n       "), flush=True)
        count += len(problems)
    print(f"{count} things are wrong" if count else "nothing is wrong")
    return count


def installed(wheel: Path | None, folder: Path) -> Path:
    """Return the interpreter of a new environment with the package and extra `all`."""
    if wheel is None:
        build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder)]
        subprocess.run([*build, str(CHECKOUT)], check=True)
        (wheel,) = folder.glob("epigauge-*.whl")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    install = [str(python), "-m", "pip", "install", "-q", f"{wheel.resolve()}[all]"]
    print(f"$ {shlex.join(install)}", flush=True)
    subprocess.run(install, check=True)
    return python


def main() -> int:
    """Walk, in a new environment or here; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--wheel", type=Path, help="wheel to install; one is built without it")
    parser.add_argument("--here", action="store_true", help="walk with this interpreter")
    parser.add_argument("--quick", action="store_true", help="only what takes no seconds")
    parser.add_argument(
        "--in-process", action="store_true", help="with --here: no process for each command"
    )
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="parts that run side by side"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="newcomer-") as folder:
        if not given.here:
            python = installed(given.wheel, Path(folder))
            call = [str(python), __file__, "--here", "--workers", str(given.workers)]
            call += ["--quick"] if given.quick else []
            kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "EPIGAUGE"))}
            return subprocess.run(call, check=False, cwd=folder, env=kept).returncode
        import commands as cli

        with cli.bare(Path(folder)):
            done = walk(given.quick, not given.in_process, given.workers)
            return 1 if report(done) else 0


if __name__ == "__main__":
    sys.exit(main())
