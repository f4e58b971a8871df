"""The commands as the parser knows them, runs of them, and what must hold of each run.

A command or an option that is added is found here without a change, as long as its arguments have
names that `GIVEN` knows or take one of the samples.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import json
import os
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import html_pages
import numpy as np

#: What to give for arguments and required options, by their names; files are samples, or made of
#: them by `MADE`.
GIVEN: dict[Any, list[str]] = {
    "matches": ["raw_matches.csv"],
    "tracks": ["tracks.csv"],
    "image1": ["A.jpg"],
    "image2": ["B.jpg"],
    "sources": [f"room{k}.jpg" for k in range(8)],
    "database": ["database.db"],
    "paper": ["bs2004", "--only", "table2", "--trials", "1", "-o", "report"],
    "shell": ["bash"],
    "image_size": ["--image-size", "640", "480"],
    ("scene", "output"): ["-o", "made"],
    ("metric", "tracks"): ["corner.csv"],
}

#: Options whose value is a file to read or an address, and those that need another input.
INPUTS = {"start", "cache", "scheduler", "colmap", "seed", "lines"}
#: What an option is for, where the samples of the command's own argument do not have it.
NEEDS: dict[str, dict[str, list[str]]] = {
    "precision": {"tracks": ["made/scene.npz"]},
    "rigs": {"tracks": ["made/sparse/0"]},
    "clean": {"tracks": ["marked.npz"]},
    "inliers": {"matches": ["marked_matches.npz"]},
}
#: Forms of files, as helps name them.
FORMS = ("PNG", "PDF", "SVG", "HTML", "NPZ", "JSON", "CSV", "PLY")


@dataclass(frozen=True)
class Option:
    """An argument or option of a command."""

    name: str
    flags: tuple[str, ...]
    argument: bool
    required: bool
    flag: bool
    several: bool
    help: str
    choices: tuple[str, ...] = ()

    @property
    def forms(self) -> list[str]:
        """Suffixes of the files that it writes, as its help names them."""
        if self.name in INPUTS or self.argument or self.flag:
            return []
        return [f".{form.lower()}" for form in FORMS if re.search(rf"\b{form}\b", self.help)]


@dataclass(frozen=True)
class Command:
    """A command of the program."""

    name: str
    options: tuple[Option, ...]

    def words(self, needed: dict[str, list[str]] | None = None) -> list[str]:
        """Return the shortest call that works."""
        found = [self.name]
        for option in self.options:
            if option.required:
                given = (needed or {}).get(option.name) or GIVEN.get((self.name, option.name))
                found += given or GIVEN.get(option.name) or ["tracks.csv"]
        return found


@dataclass
class Run:
    """What came of a call."""

    words: list[str]
    code: int
    out: bytes
    err: str
    problems: list[str] = field(default_factory=list)

    def check(self, *codes: int) -> list[str]:
        """Return what is wrong with it, where these exit codes are right."""
        text = self.out.decode(errors="replace") + self.err
        found = []
        if "Traceback" in text:
            found.append("ends with a traceback")
        if re.search(r"\b\w*Warning:", text):
            found.append("prints a warning of Python")
        if self.code not in codes:
            found.append(f"ends with {self.code}, not {' or '.join(map(str, codes))}")
        if self.code == 2:
            if self.out:
                found.append("writes to stdout though the input is bad")
            if not re.search(r"^epigauge: \S|Error", self.err, re.MULTILINE):
                found.append("does not say what is bad")
        elif not text.strip():
            found.append("says nothing")
        call = f"epigauge {' '.join(self.words)}"
        return [f"{call}: {problem}\n{text[-1500:]}" for problem in found]


Runner = Callable[..., Run]


@functools.cache
def commands() -> dict[str, Command]:
    """Return the commands of the parser by name."""
    import typer
    from epigauge.cli import app

    group: Any = typer.main.get_command(app)
    return {name: Command(name, _options(made)) for name, made in group.commands.items()}


def _options(made: Any) -> tuple[Option, ...]:
    found = []
    for option in made.params:
        choices = re.search(r"(?:\S+ \| )+\S+$", option.help or "")
        found.append(
            Option(
                option.name,
                (*option.opts, *option.secondary_opts),
                option.param_type_name == "argument",
                bool(option.required),
                bool(getattr(option, "is_flag", False)),
                bool(option.multiple) or option.nargs == -1,
                option.help or "",
                tuple(choices[0].split(" | ")) if choices else (),
            )
        )
    return tuple(found)


def program(*words: str, stdin: bytes = b"", seconds: float = 300.0) -> Run:
    """Run a command as the shell does, in the folder of the moment."""
    environment = os.environ | {"COLUMNS": "80", "TERMINAL_WIDTH": "80"}
    done = subprocess.run(
        [sys.executable, "-m", "epigauge", *words],
        input=stdin,
        capture_output=True,
        check=False,
        timeout=seconds,
        env=environment,
    )
    return Run(list(words), done.returncode, done.stdout, done.stderr.decode(errors="replace"))


def in_process(*words: str, stdin: bytes = b"") -> Run:
    """Run a command in this process: quicker."""
    from epigauge.cli import app
    from typer.testing import CliRunner

    environment = {"COLUMNS": "80", "TERMINAL_WIDTH": "80"}
    done = CliRunner().invoke(app, list(words), input=stdin, env=environment)
    error = done.exception
    trace = ""
    if error is not None and not isinstance(error, SystemExit):
        trace = f"Traceback: {error!r}"
    return Run(list(words), done.exit_code, done.stdout_bytes, done.stderr + trace)


def prepare(run: Runner, scene: bool) -> list[str]:
    """Write the samples and what is made of them, and bad files, into the folder of the moment."""
    import colmap_databases
    import epigauge as eg

    problems = run("samples", ".").check(0)
    colmap_databases.Project().write(Path("database.db"))
    tracks = from_the_corner()
    clean = np.arange(len(tracks)) % 50 != 0
    parts = {"view": tracks.view, "point": tracks.point, "xy": tracks.xy}
    np.savez("marked.npz", **parts, clean=clean)
    matches = eg.load_matches("matches.csv")
    marks = np.arange(len(matches)) % 10 != 0
    np.savez("marked_matches.npz", x1=matches.x1, x2=matches.x2, inlier=marks)
    Path("empty.csv").write_bytes(b"")
    Path("words.csv").write_bytes(b"To be, or not to be\n" * 20)
    Path("words.txt").write_bytes(b"that is the question\n" * 20)
    Path("noise.npz").write_bytes(bytes(range(256)) * 9)
    Path("a_folder").mkdir()
    return problems + (alone(commands()["scene"], run) if scene else [])


def alone(command: Command, run: Runner) -> list[str]:
    """Return what is wrong with the shortest call that works."""
    return run(*command.words()).check(0, 1)


def from_the_corner() -> Any:
    """Write corner.csv, the tracks of the sample counted from a corner; return the sample."""
    import epigauge as eg

    tracks = eg.load_tracks("tracks.csv")
    moved = tracks.xy + np.array([320.0, 240.0])  # those of the sample are from the middle
    eg.save_tracks("corner.csv", eg.Tracks(tracks.view, tracks.point, moved))
    return tracks


def help_of(command: Command | None, run: Runner) -> list[str]:
    """Return what is wrong with a help: options that are missing, or that overflow."""
    done = run(*([command.name] if command else []), "--help")
    problems = done.check(0)
    text = done.out.decode()
    where = f"epigauge {command.name if command else ''} --help"
    problems += [f"{where} overflows: {line}" for line in text.splitlines() if len(line) > 80]
    for option in command.options if command else ():
        problems += [
            f"{where} misses {flag}"
            for flag in option.flags
            if not option.argument and not re.search(rf"(?<![\w-]){flag}(?![\w-])", text)
        ]
        if not (option.argument or option.help.strip()):
            problems.append(f"{where} says nothing of {option.name}")
        problems += [
            f"{where} misses or breaks the choice {choice} of {option.name}"
            for choice in option.choices
            if choice not in text
        ]
    for name in commands() if command is None else ():
        if not re.search(rf"^\W*{name}\b", text, re.MULTILINE):
            problems.append(f"epigauge --help misses {name}")
    return problems


def written(command: Command, run: Runner, folder: str = "out") -> Iterator[str]:
    """Yield what is wrong with files of every form that the help of an option names."""
    Path(folder).mkdir(exist_ok=True)
    for option in command.options:
        words = command.words(NEEDS.get(option.name))
        for form in option.forms:
            path = Path(folder, f"{command.name}_{option.name}{form}")
            done = run(*words, option.flags[0], str(path))
            yield from done.check(0, 1)
            why = opened(path)
            if why is not None:
                yield f"epigauge {' '.join(done.words)}: {path} {why}\n{done.err[-1500:]}"


def choices(command: Command, run: Runner) -> Iterator[str]:
    """Yield what is wrong with each choice of each option, and with each flag alone."""
    for option in command.options:
        if option.argument or option.name in INPUTS:
            continue
        words = command.words(NEEDS.get(option.name))
        for choice in option.choices:
            yield from run(*words, option.flags[0], choice).check(0, 1, 2)
        for flag in option.flags if option.flag else ():
            if flag.startswith("--"):
                yield from run(*words, flag).check(0, 1, 2)
    if any(option.name == "json" for option in command.options):
        done = run(*command.words(), "--json")
        try:
            named = json.loads(done.out)["command"]
        except (ValueError, KeyError) as error:
            yield f"epigauge {' '.join(done.words)}: no JSON with a command ({error!r})"
        else:
            if named != command.name:
                yield f"epigauge {command.name} --json says command {named}"


def bad_inputs(command: Command, run: Runner, quick: bool = False) -> Iterator[str]:
    """Yield what is wrong where a file is missing, empty, a directory, or of another kind."""
    files = ["missing.csv", "empty.csv", "a_folder"]
    if not quick:
        files += ["words.csv", "words.txt", "noise.npz", "A.jpg"]
    words = command.words()
    for option in command.options:
        given = GIVEN.get((command.name, option.name)) or GIVEN.get(option.name)
        if not (option.argument and option.required and given and Path(given[0]).exists()):
            continue
        for file in files:
            if file == given[0] or (file == "A.jpg" and Path(given[0]).suffix == ".jpg"):
                continue
            call = [file if word == given[0] else word for word in words]
            yield from _refused(run(*call))
    for option in command.options:
        for path in ("no_such_folder/x" + form for form in option.forms):
            yield from _refused(run(*command.words(NEEDS.get(option.name)), option.flags[0], path))
        if option.forms:
            call = [*command.words(NEEDS.get(option.name)), option.flags[0], "x.unknown"]
            yield from _refused(run(*call))
            if Path("x.unknown").exists():
                yield f"{' '.join(call)}: leaves x.unknown"
    yield from _refused(run(*words, "--no-such-option"))


def _refused(done: Run) -> list[str]:
    return done.check(2)


def opened(path: Path) -> str | None:
    """Return why a file is not what its name says, or None."""
    if not path.is_file():
        return "was not written"
    content = path.read_bytes()
    if len(content) < 32:
        return f"has {len(content)} bytes"
    try:
        return _OPENERS[path.suffix](content, path)
    except Exception as error:
        return f"cannot be read again: {error!r}"


def _png(content: bytes, path: Path) -> str | None:
    if content[:8] != b"\x89PNG\r\n\x1a\n":
        return "is no PNG"
    width, height = struct.unpack(">II", content[16:24])
    return None if min(width, height) > 50 else f"has {width} x {height} pixels"


def _svg(content: bytes, path: Path) -> str | None:
    root = ET.fromstring(content)
    return None if root.tag.endswith("svg") and len(list(root.iter())) > 20 else "is an empty SVG"


def _pdf(content: bytes, path: Path) -> str | None:
    whole = content.startswith(b"%PDF") and content.rstrip().endswith(b"%%EOF")
    return None if whole else "is no whole PDF"


def _npz(content: bytes, path: Path) -> str | None:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return None if arrays else "holds no arrays"


def _csv(content: bytes, path: Path) -> str | None:
    rows = list(csv.reader(content.decode().splitlines()))
    return None if len(rows) > 1 and len({len(row) for row in rows}) == 1 else "is no table"


def _ply(content: bytes, path: Path) -> str | None:
    found = re.search(rb"element vertex (\d+)", content[:2000])
    return None if found and int(found[1]) else "holds no points"


def _json(content: bytes, path: Path) -> str | None:
    def refuse(name: str) -> Any:
        raise ValueError(f"{name} is no JSON")

    return None if json.loads(content, parse_constant=refuse) else "is empty"


def _html(content: bytes, path: Path) -> str | None:
    problems = html_pages.problems(path)
    return "; ".join(problems) or None


_OPENERS: dict[str, Callable[[bytes, Path], str | None]] = {
    ".png": _png,
    ".svg": _svg,
    ".pdf": _pdf,
    ".npz": _npz,
    ".csv": _csv,
    ".ply": _ply,
    ".json": _json,
    ".html": _html,
}


@contextlib.contextmanager
def bare(folder: Path) -> Iterator[None]:
    """Work in a folder, without any measured data to be found."""
    kept = {name: os.environ.get(name) for name in ("EPIGAUGE_DATA", "EPIGAUGE_CACHE")}
    os.environ["EPIGAUGE_CACHE"] = str(folder / "cache")
    os.environ["EPIGAUGE_DATA"] = str(folder / "data")
    try:
        with contextlib.chdir(folder):
            yield
    finally:
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
