"""Samples in the package, and what the command line does around all its commands."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError

#: All samples together stay small.
LARGEST = 1_000_000


def test_samples_are_all_there_and_small() -> None:
    folder = eg.samples.path("matches.csv").parent
    files = {path.name for path in folder.iterdir() if path.suffix in (".csv", ".jpg")}
    assert files == set(eg.samples.names()) == set(eg.samples.SAMPLES)
    assert sum((folder / name).stat().st_size for name in files) < LARGEST
    with pytest.raises(ArgumentError, match=r"name is 'match\.csv'.*did you mean 'matches\.csv'"):
        eg.samples.path("match.csv")


def test_samples_hold_what_they_say() -> None:
    scene, many = eg.two_view_scene(), eg.multi_view_scene()
    matches = eg.load_matches(eg.samples.path("matches.csv"))
    np.testing.assert_array_equal(matches.x1, scene.x1)
    np.testing.assert_array_equal(eg.load_tracks(eg.samples.path("tracks.csv")).xy, many.tracks.xy)
    raw = eg.load_tracks(eg.samples.path("raw_tracks.csv"))
    off = np.linalg.norm(raw.xy - many.tracks.xy, axis=1)
    assert np.count_nonzero(off) == len(off) // 20
    assert off[off > 0.0].min() > 10.0


def test_the_photographs_show_the_cameras_that_they_name() -> None:
    """F of the raw matches is that of the rendered cameras."""
    pytest.importorskip("cv2", reason="a front end")
    raw = eg.load_matches(eg.samples.path("raw_matches.csv"))
    found = eg.estimate_fundamental(raw.x1, raw.x2)
    assert found.success
    assert np.count_nonzero(found.inlier) > 0.8 * len(raw)
    K = np.array([[560.0, 0.0, 319.5], [0.0, 560.0, 239.5], [0.0, 0.0, 1.0]])
    motion = eg.refine_fundamental(raw.x1[found.inlier], raw.x2[found.inlier], essential=True, K1=K)

    def looking(centre: np.ndarray) -> np.ndarray:
        z = np.array([-0.1, 0.2, 2.0]) - centre
        x = np.cross([0.0, 1.0, 0.0], z)
        x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
        return np.array([x, np.cross(z, x), z])

    A, B = np.array([-0.9, 0.0, -2.0]), np.array([0.5, -0.15, -1.7])
    t = looking(B) @ (A - B)
    assert np.degrees(np.arccos(motion.t @ t / np.linalg.norm(t))) < 0.5
    np.testing.assert_allclose(motion.R, looking(B) @ looking(A).T, atol=5e-3)


def test_copies_replace_nothing(tmp_path: Path) -> None:
    copies = eg.samples.copy(tmp_path / "new")
    assert [path.name for path in copies] == list(eg.samples.names())
    assert eg.samples.copy(tmp_path / "new") == copies  # the same already
    copies[2].write_text("mine")
    copies[0].unlink()
    with pytest.raises(ArgumentError, match=f"holds another {copies[2].name}"):
        eg.samples.copy(tmp_path / "new")
    assert not copies[0].exists()
    assert copies[2].read_text() == "mine"


class TestCommandLine:
    def test_samples_are_listed_and_copied(self, run, tmp_path: Path) -> None:
        code, out, err = run("samples")
        assert code == 0
        assert all(Path(line).is_file() for line in out.splitlines())
        assert "raw_tracks.csv" in err
        code, out, _ = run("samples", tmp_path / "here")
        assert code == 0
        assert [Path(line).parent for line in out.splitlines()] == [tmp_path / "here"] * 14
        (tmp_path / "here" / "A.jpg").write_text("mine")
        code, out, err = run("samples", tmp_path / "here")
        assert (code, out) == (2, "")
        assert "holds another A.jpg" in err

    @pytest.mark.parametrize(
        ("command", "name"), [("refine", "matches.csv"), ("bundle", "tracks.csv")]
    )
    def test_stdin_is_a_file_too(self, run, monkeypatch, command: str, name: str) -> None:
        expected = run(command, eg.samples.path(name))
        content = io.BytesIO(eg.samples.path(name).read_bytes())
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(content))
        code, out, err = run(command, "-")
        assert (code, out) == expected[:2]
        assert err.split()[0] == "stdin"

    def test_stdin_may_hold_arrays(self, run, monkeypatch) -> None:
        scene, file = eg.two_view_scene(), io.BytesIO()
        np.savez(file, mkpts0=scene.x1, mkpts1=scene.x2)
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(file.getvalue())))
        assert run("refine", "-")[:2] == run("refine", eg.samples.path("matches.csv"))[:2]

    @pytest.mark.parametrize("before", [True, False])
    def test_quiet_leaves_the_product_and_errors(self, run, before: bool) -> None:
        words = ["refine", eg.samples.path("matches.csv")]
        expected = run(*words)
        code, out, err = run("-q", *words) if before else run(*words, "-q")
        assert (code, out, err) == (*expected[:2], "")
        code, out, err = run("-q", "refine", "absent.csv")
        assert (code, out) == (2, "")
        assert "absent.csv" in err

    def test_verbose_logs_results_and_evaluations(self, run, monkeypatch) -> None:
        root = logging.getLogger()
        monkeypatch.setattr(root, "handlers", list(root.handlers))
        level = root.level
        try:
            err = run("refine", eg.samples.path("matches.csv"), "-v")[2]
            assert "refine_fundamental: FundamentalResult: may be used" in err
            assert "step 1 accepted" not in err
            err = run("refine", eg.samples.path("matches.csv"), "-vv")[2]
            assert "step 1 accepted" in err
        finally:
            root.setLevel(level)

    @pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
    def test_shells_get_a_script(self, run, shell: str) -> None:
        code, out, err = run("completion", shell)
        assert (code, err) == (0, "")
        assert f"_EPIGAUGE_COMPLETE=complete_{shell}" in out

    def test_another_shell_is_refused(self, run) -> None:
        code, out, err = run("completion", "tcsh")
        assert (code, out) == (2, "")
        assert "shell is 'tcsh'" in err

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            ("epigauge ref", {"refine"}),
            ("epigauge refine --criterion s", {"sampson"}),
            ("epigauge bundle --loss c", {"cauchy"}),
        ],
    )
    def test_completion_knows_commands_and_choices(self, words: str, expected: set[str]) -> None:
        pytest.importorskip("typer", reason="the command line needs typer")
        asked = {
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split()) - 1),
            "_EPIGAUGE_COMPLETE": "complete_bash",
        }
        done = subprocess.run(
            [sys.executable, "-m", "epigauge"],
            env=os.environ | asked,
            capture_output=True,
            text=True,
            check=False,
        )
        assert set(done.stdout.split()) == expected, done.stderr
