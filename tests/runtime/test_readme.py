"""The commands and the program of the README work as printed."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import epigauge as eg
import pytest

README = (Path(__file__).parents[2] / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    scene = eg.two_view_scene()
    eg.save_matches(tmp_path / "matches.csv", eg.Matches(x1=scene.x1, x2=scene.x2))
    tracks = eg.multi_view_scene().tracks
    eg.save_tracks(tmp_path / "tracks.csv", tracks)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("program", blocks("python"))
def test_python_example_runs(program, workplace, capsys):
    exec(compile(program, "README.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "(9, 9)" in shown or "(5, 3, 4)" in shown


@pytest.mark.parametrize("session", blocks("console"))
def test_shell_example_runs(session, workplace):
    for package in ("typer", "rich", "matplotlib"):
        pytest.importorskip(package)
    commands = [line[2:] for line in session.splitlines() if line.startswith("$ ")]
    assert commands
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "epigauge"
        done = subprocess.run(
            [sys.executable, "-m", "epigauge", *arguments], capture_output=True, check=False
        )
        assert done.returncode == 0, done.stderr.decode()
    assert (workplace / "refined.png").stat().st_size > 10_000
    assert (workplace / "result.npz").is_file()
