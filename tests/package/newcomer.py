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
import doctest
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterable, Iterator
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
TESTS = CHECKOUT / "tests"
sys.path.insert(0, str(TESTS))

#: Commands that take longer than the others, which choices and forms do not change much.
SLOW = ("reproduce", "demo", "scene")


def walk(quick: bool, programs: bool = True) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of each part of the walk and what is wrong there."""
    import commands as cli

    run = cli.program if programs else cli.in_process
    yield "samples", cli.prepare(run)
    found = cli.commands()
    yield "help", cli.help_of(None, run)
    # What the others read.
    if not quick:
        yield "scene", run(*found["scene"].words()).check(0)
    for name, command in found.items():
        yield f"{name} --help", cli.help_of(command, run)
        slow = name in SLOW
        if name != "scene" and not (quick and slow):
            yield name, run(*command.words()).check(0, 1)
        if not quick:
            yield f"{name}: files", list(cli.written(command, run)) if not slow else []
            yield f"{name}: choices", list(cli.choices(command, run)) if not slow else []
        yield f"{name}: bad input", list(cli.bad_inputs(command, run, quick))
    yield "flags in the documentation", list(flags_in_pages())
    yield "names in the documentation", list(names_in_pages())
    yield "links in the documentation", list(links_in_pages())
    if not quick:
        yield from examples(programs)
        yield "docstrings", list(docstrings())
        yield "pages in a browser", list(in_browser(Path()))


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


def examples(programs: bool) -> Iterator[tuple[str, list[str]]]:
    """Run what the pages show, each page in a folder of its own."""
    import commands as cli
    import documents

    run = cli.program if programs else cli.in_process

    def run_command(arguments: list[str], where: str) -> None:
        problems = run(*arguments).check(0)
        assert not problems, f"{where}: {problems[0]}"

    for page in documents.pages():
        name = page.relative_to(CHECKOUT).as_posix()
        with tempfile.TemporaryDirectory() as folder:
            try:
                documents.run(page, Path(folder), run_command)
            except Exception as error:  # whatever a reader would meet
                text = f"{type(error).__name__}: {error}"
                if excused(error, page.read_text(encoding="utf-8")):
                    yield f"{name}: skipped, as it says: {text}", []
                else:
                    yield name, [text[-1500:]]
            else:
                yield name, []


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


def report(parts: Iterable[tuple[str, list[str]]]) -> int:
    """Print each part as it ends; return how much is wrong."""
    count, begin = 0, time.perf_counter()
    for name, problems in parts:
        now = time.perf_counter()
        print(f"{'ok' if not problems else 'WRONG':6} {now - begin:6.1f} s  {name}", flush=True)
        begin = now
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
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="newcomer-") as folder:
        if not given.here:
            python = installed(given.wheel, Path(folder))
            call = [str(python), __file__, "--here", *(["--quick"] if given.quick else [])]
            kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "EPIGAUGE"))}
            return subprocess.run(call, check=False, cwd=folder, env=kept).returncode
        import commands as cli

        with cli.bare(Path(folder)):
            return 1 if report(walk(given.quick, not given.in_process)) else 0


if __name__ == "__main__":
    sys.exit(main())
