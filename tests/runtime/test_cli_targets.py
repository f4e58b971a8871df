"""One rule for what commands write: suffix, several, stdout by -, checked before the run."""

from __future__ import annotations

import inspect
import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

import commands

Run = Callable[..., tuple[int, str, str]]

#: Commands that write to files named by options.
WRITERS = {
    name: command
    for name, command in commands.commands().items()
    if any(option.name in ("plot", "output") and option.several for option in command.options)
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("matches.csv", "raw_matches.csv", "tracks.csv"):
        (tmp_path / name).write_bytes(eg.samples.path(name).read_bytes())
    return tmp_path


def test_all_commands_say_the_same_of_what_they_write() -> None:
    assert {"refine", "estimate", "pair", "bundle", "metric", "compare"} <= set(WRITERS)
    helps = {o.help for c in WRITERS.values() for o in c.options if o.name == "plot"}
    assert len(helps) == 1
    for command in WRITERS.values():
        (output,) = (o for o in command.options if o.name == "output")
        assert output.help.endswith("Or - for NPZ on stdout. Several.")
        assert output.flags == ("--output", "-o")


@pytest.mark.parametrize("words", [("refine", "matches.csv"), ("compare", "tracks.csv")])
def test_all_forms_at_once(words: tuple[str, ...], folder: Path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    paths = [folder / f"a{form}" for form in (".png", ".pdf", ".svg", ".html", ".npz", ".json")]
    targets = [
        word
        for path in paths
        for word in ("-o" if path.suffix in (".npz", ".json") else "--plot", path.name)
    ]
    methods = ["--methods", "covariant,free"] if words[0] == "compare" else []
    assert commands.in_process(*words, *methods, *targets).check(0) == []
    assert [commands.opened(path) for path in paths] == [None] * len(paths)


def test_a_result_goes_through_a_pipe() -> None:
    first = commands.in_process("estimate", "raw_matches.csv", "-o", "-")
    assert first.check(0) == []
    with np.load(io.BytesIO(first.out)) as file:
        F = file["F"]
    second = commands.in_process("refine", "-", "--inliers", stdin=first.out)
    assert second.check(0) == []
    found = np.loadtxt(second.out.decode().splitlines())
    np.testing.assert_allclose(np.abs(np.sum(found * F)), 1.0, atol=1e-6)
    (track,) = (c for c in [commands.in_process("bundle", "tracks.csv", "-o", "-")] if c.code == 0)
    with np.load(io.BytesIO(track.out)) as file:
        assert file["P"].shape == (5, 3, 4)


@pytest.mark.parametrize("name", ["scene.out", "bal.txt", "bal.txt.bz2", "bal.txt.gz", "scene.npz"])
def test_a_scene_of_any_form_is_read_from_stdin(name: str) -> None:
    scene = eg.line_scene(n_points=20, n_views=4, seed=1)
    bare = eg.MetricReconstruction(scene.true.R, scene.true.t, scene.true.X, scene.true.cameras)
    known = eg.interop.colmap_to_bal if name.startswith("bal") else lambda *both: both
    eg.save_scene(name, *known(scene.tracks, bare))
    options = "--refine", "pose", "--json"
    rms = []
    for word, stdin in ((name, b""), ("-", Path(name).read_bytes())):
        done = commands.in_process("bundle", word, *options, stdin=stdin)
        assert done.check(0) == []
        rms.append(json.loads(done.out)["rms_px"])
    assert rms[0] == rms[1]


@pytest.mark.parametrize("name", ["refine", "estimate", "bundle", "metric", "compare"])
def test_what_stdin_holds_is_called_stdin(name: str) -> None:
    """In errors, tables, JSON and pages: no name of the copy that is read."""
    commands.from_the_corner()
    words = [*commands.commands()[name].words(), *(["--methods", "free"] * (name == "compare"))]
    content = Path(words[1]).read_bytes()
    words[1] = "-"
    damaged = commands.in_process(*words, stdin=content + b"no,numbers,at,all\n")
    assert damaged.check(2) == []
    assert damaged.err.startswith("epigauge: stdin, line ")
    copies = str(Path(tempfile.gettempdir(), "epigauge-"))
    for more in ("--json",), ("--plot", "stdin.html"):
        done = commands.in_process(*words, *more, stdin=content)
        assert done.check(0, 1) == []
        page = Path("stdin.html").read_text(encoding="utf-8") if "--plot" in more else ""
        assert copies not in done.err + done.out.decode() + page
        assert "epigauge-" not in page.partition("</title>")[0]


def test_starts_and_lines_are_read_from_stdin_too() -> None:
    scene = eg.line_scene(n_points=20, n_views=4, seed=1)
    bare = eg.MetricReconstruction(scene.true.R, scene.true.t, scene.true.X, scene.true.cameras)
    eg.save_scene("scene.npz", scene.tracks, bare)
    eg.save_line_tracks("lines.csv", scene.line_tracks)
    words = "bundle", "scene.npz", "--refine", "pose", "--lines", "-"
    assert commands.in_process(*words, stdin=Path("lines.csv").read_bytes()).check(0) == []
    assert commands.in_process("bundle", "tracks.csv", "-o", "start.npz").check(0) == []
    start = Path("start.npz").read_bytes()
    methods = "--methods", "covariant"
    for call in (
        ("bundle", "tracks.csv", "--start", "-"),
        ("compare", "tracks.csv", *methods, "--start", "-"),
        ("bundle", "-", "--start", "-"),
        ("compare", "-", *methods, "--start", "-"),
    ):
        assert commands.in_process(*call, stdin=start).check(0) == []


def test_a_picture_goes_to_stdout() -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    done = commands.in_process("refine", "matches.csv", "--plot", "-")
    assert done.check(0) == []
    assert done.out.startswith(b"\x89PNG")
    assert b"IEND" in done.out[-16:]


@pytest.mark.parametrize(
    "targets", [("-o", "-", "--json"), ("-o", "-", "--plot", "-"), ("-o", "-", "-o", "-")]
)
def test_stdout_holds_one_thing(targets: tuple[str, ...]) -> None:
    done = commands.in_process("refine", "matches.csv", *targets)
    assert done.check(2) == []
    assert "one of them alone" in done.err


def test_the_size_of_the_images_frames_the_picture() -> None:
    pytest.importorskip("matplotlib", reason="pictures need Matplotlib")
    words = "refine", "matches.csv", "--image-size"
    assert commands.in_process(*words, "9", "0").check(2) == []
    done = commands.in_process(*words, "512", "512", "--plot", "a.svg", "-o", "a.npz")
    assert done.check(0) == []
    assert commands.opened(Path("a.svg")) is None


def test_no_help_is_wrapped_a_second_time() -> None:
    """Lines below the first of a help are kept: what exceeds 78 columns stands alone."""
    import typer
    from epigauge.cli import app

    group = typer.main.get_command(app)
    long = [
        (name, line)
        for name, command in group.commands.items()  # type: ignore[attr-defined]
        for line in inspect.cleandoc(command.help).splitlines()[1:]
        if len(line) > 78
    ]
    assert long == []
