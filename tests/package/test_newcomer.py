"""The short version of the walk of `newcomer.py`: every command in this process, bad input too."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import documents
import epigauge as eg
import html_pages
import pytest

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")
pytest.importorskip("cv2", reason="commands for photographs need OpenCV")
pytest.importorskip("matplotlib", reason="pictures need Matplotlib")

import commands


def newcomer() -> ModuleType:
    found = importlib.util.spec_from_file_location(
        "newcomer", Path(__file__).with_name("newcomer.py")
    )
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def test_a_newcomer_meets_nothing_that_is_wrong(tmp_path: Path) -> None:
    with commands.bare(tmp_path):
        parts = list(newcomer().walk(quick=True, programs=False))
    assert [problem for _, problems, _ in parts for problem in problems] == []
    walked = {name.partition(" ")[0].partition(":")[0] for name, _, _ in parts}
    assert walked >= set(commands.commands())


def test_what_is_wrong_is_seen() -> None:
    """The walk can fail: each check sees a fault of its kind."""
    fault = commands.Run(["x"], 2, b"", "Traceback (most recent call last)")
    assert "traceback" in fault.check(2)[0]
    assert "ends with 1" in commands.Run(["x"], 1, b"1", "").check(0)[0]
    assert "says nothing" in commands.Run(["x"], 0, b"", "").check(0)[0]
    assert "though the input is bad" in commands.Run(["x"], 2, b"1", "epigauge: no").check(2)[0]
    assert "what is bad" in commands.Run(["x"], 2, b"", "no").check(2)[0]
    assert "warning" in commands.Run(["x"], 0, b"", "DeprecationWarning: old").check(0)[0]


def test_pages_say_at_their_head_what_the_extra_all_does_not_bring() -> None:
    excused, pages = newcomer().excused, {}
    for page in documents.pages():
        code = "\n".join(block.code for block in documents.blocks(page))
        for name in re.findall(r"^import (torch|jax|cupy|sympy)\b", code, re.MULTILINE):
            pages[page.name] = excused(ModuleNotFoundError(name=name), page.read_text("utf-8"))
    assert pages == {"arrays.md": True, "camera.md": True, "derive.md": True}
    head = "It needs SymPy, which `all` does not bring.\n"
    missing = ModuleNotFoundError(name="sympy")
    assert excused(missing, head)
    assert not excused(missing, "It needs SymPy.\n")
    assert not excused(missing, f"Words.\n\n## Later\n{head}")
    assert not excused(ModuleNotFoundError(name="torch"), head)
    assert not excused(ValueError("sympy"), head)


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ('<a href="no.html">x</a>', "leads nowhere"),
        ('<a href="#no">x</a>', "names no part"),
        ('<img alt="x" src="data:image/png;base64,">', "is empty"),
        ('<img src="">', "without a source"),
        ("<div><b>x</div></b>", "closes nothing"),
    ],
)
def test_faults_of_a_page_are_seen(body: str, problem: str, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    head = '<!doctype html><title>x</title><meta name="viewport" content="width=device-width">'
    page.write_text(head + body)
    assert any(problem in found for found in html_pages.problems(page))
    page.write_text(head + '<p id="x"><a href="#x">x</a>')
    assert html_pages.problems(page) == []


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.png", b"\x89PNG\r\n\x1a\n" + b"\0" * 40),
        ("x.svg", b"<svg xmlns='http://www.w3.org/2000/svg'></svg>"),
        ("x.pdf", b"%PDF-1.4 and no end" + b" " * 40),
        ("x.npz", b"PK" + b" " * 40),
        ("x.csv", b"a,b\n1\n" * 10),
        ("x.json", b'{"a": NaN}' + b" " * 40),
        ("x.ply", b"ply\nelement vertex 0\n" * 4),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_files_that_are_nothing_are_seen(name: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / name
    assert commands.opened(path) == "was not written"
    path.write_bytes(content)
    assert commands.opened(path)


def helped(text: str) -> commands.Runner:
    """Return a run of every command that answers with this help."""
    return lambda *words, **_: commands.Run(list(words), 0, text.encode(), "")


def test_faults_of_a_help_are_seen() -> None:
    command = commands.commands()["samples"]
    whole = commands.in_process("samples", "--help").out.decode()
    assert commands.help_of(command, helped(whole)) == []
    (flag, *_) = (flag for option in command.options for flag in option.flags if flag[0] == "-")
    missing = commands.help_of(command, helped(whole.replace(flag, " " * len(flag))))
    assert any(f"misses {flag}" in found for found in missing)
    wide = commands.help_of(command, helped(whole + "x" * 81))
    assert any("overflows" in found for found in wide)
    assert any("says nothing" in found for found in commands.help_of(None, helped("")))


def test_a_traceback_and_a_file_that_is_not_written_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("planted")

    monkeypatch.chdir(tmp_path)
    eg.samples.copy(tmp_path)
    command = commands.commands()["refine"]
    done = commands.in_process(*command.words())
    silent = commands.Run(done.words, 0, done.out, done.err)
    unwritten = list(commands.written(command, lambda *words, **_: silent, "planted"))
    assert any("was not written" in found for found in unwritten)
    monkeypatch.setattr(sys.modules["epigauge.cli.refine"], "load_matches", broken)
    assert "traceback" in commands.in_process(*command.words()).check(0)[0]


def test_faults_of_the_documentation_are_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = newcomer()
    monkeypatch.setattr(walk, "CHECKOUT", tmp_path)
    (tmp_path / "docs").mkdir()
    (tmp_path / "CONTRIBUTING.md").write_text("")
    page = tmp_path / "README.md"
    page.write_text("`eg.load_matches`, [x](docs), `a[0](b)`\n\n    epigauge refine x --plot y\n")
    checks = walk.names_in_pages, walk.links_in_pages, walk.flags_in_pages
    assert [list(check()) for check in checks] == [[], [], []]
    page.write_text("eg.no_name, ![x](docs/no.png)\n\n    epigauge refine x --no-flag\n")
    found = [" ".join(check()) for check in checks]
    assert "no eg.no_name" in found[0]
    assert "docs/no.png leads nowhere" in found[1]
    assert "there is no --no-flag" in found[2]
