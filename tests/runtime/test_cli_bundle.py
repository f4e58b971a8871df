"""``epigauge bundle`` and ``epigauge compare``: data on stdout, text on stderr, exit codes."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

from epigauge.multi_view.display import Display, display
from rich.console import Console
from rich.progress import Progress

SCENE = eg.multi_view_scene(n_points=30, distance=4.0, seed=4)

#: The command line watches every step, and then the loop in Python runs: the same to the last bit.
RESULT = eg.bundle_adjust(SCENE.tracks, callback=lambda row: None)


@pytest.fixture
def file(tmp_path) -> Path:
    eg.save_tracks(tmp_path / "tracks.npz", SCENE.tracks)
    return tmp_path / "tracks.npz"


def document(text: str) -> dict:
    """Parse one strict JSON document with nothing around it."""
    return json.loads(text, parse_constant=pytest.fail)


# bundle


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_stdout_is_the_cameras_of_the_library_to_the_last_bit(run, tmp_path, suffix) -> None:
    eg.save_tracks(tmp_path / f"t{suffix}", SCENE.tracks)
    code, out, err = run("bundle", tmp_path / f"t{suffix}")
    assert code == 0
    np.testing.assert_array_equal(
        np.loadtxt(out.splitlines()).reshape(-1, 3, 4), RESULT.reconstruction.P
    )
    for word in ("5 views, 30 points", "covariant", f"{RESULT.rms_px:.6g}", "status", "seconds"):
        assert word in err


def test_json_is_one_document_and_nothing_else(run, file) -> None:
    code, out, err = run("bundle", file, "--json")
    found = document(out)
    assert (code, err) == (0, "")
    np.testing.assert_array_equal(found["P"], RESULT.reconstruction.P)
    np.testing.assert_array_equal(found["Q"], RESULT.reconstruction.Q)
    np.testing.assert_array_equal(found["fun"], RESULT.fun)
    assert len(found["history"]) == found["nfev"] == RESULT.nfev
    assert found["view_numbers"] == [0, 1, 2, 3, 4]


def test_options_reach_the_solver(run, file) -> None:
    options = {"method": "marquardt", "gauge": "normalized", "gauge_mode": "implicit"}
    options |= {"loss": "cauchy", "max_iter": 60, "backend": "numpy"}
    words = [w for k, v in options.items() for w in ("--" + k.replace("_", "-"), v)]
    found = document(run("bundle", file, "--json", *words)[1])
    expected = eg.bundle_adjust(SCENE.tracks, **options | {"gauge": eg.gauge.normalized()})
    assert found["nfev"] == expected.nfev
    assert found["cost"] == expected.cost
    assert found["loss_scale_px"] == expected.loss_scale_px > 0.0
    damped = document(run("bundle", file, "--json", "--damping", "levenberg")[1])
    assert damped["nfev"] == eg.bundle_adjust(SCENE.tracks, damping="levenberg").nfev


def test_saved_result_is_a_start_and_a_file_of_tracks(run, file, tmp_path) -> None:
    assert run("bundle", file, "-o", tmp_path / "r.npz")[0] == 0
    saved = eg.load_reconstruction(tmp_path / "r.npz")
    np.testing.assert_array_equal(saved.P, RESULT.reconstruction.P)
    np.testing.assert_array_equal(eg.load_tracks(tmp_path / "r.npz").xy, SCENE.tracks.xy)
    with np.load(tmp_path / "r.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["history_cost"], [r.cost for r in RESULT.history])
    for tracks in (file, tmp_path / "r.npz"):
        again = document(run("bundle", tracks, "--start", tmp_path / "r.npz", "--json")[1])
        assert again["history"][0]["cost"] == pytest.approx(RESULT.cost, rel=1e-12)


def test_cloud_holds_points_and_cameras(run, file, tmp_path) -> None:
    assert run("bundle", file, "-o", tmp_path / "c.ply")[0] == 0
    head, _, body = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    assert b"not a calibration" in head
    assert b"element vertex 35\n" in head
    table = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert np.isfinite(table["xyz"]).all()
    assert len(np.unique(table["rgb"][:30], axis=0)) == 1
    assert (table["rgb"][30:] != table["rgb"][0]).any(axis=1).all()


def test_pictures_are_drawn(run, file, tmp_path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    run("bundle", file, "--plot", tmp_path / "b.png", "--plot", tmp_path / "b.html")
    run("compare", file, "--methods", "free,covariant", "--plot", tmp_path / "c.svg")
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")
    assert "5 views, 30 points" in (tmp_path / "b.html").read_text()
    assert "<svg" in (tmp_path / "c.svg").read_text()


def test_several_files_are_written_in_one_run(run, file, tmp_path) -> None:
    code, _, err = run(
        *("bundle", file, "-o", tmp_path / "r.npz", "-o", tmp_path / "c.ply"),
        *("--colmap", tmp_path / "model", "--plot", tmp_path / "v.html"),
    )
    assert code == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        *("tracks.npz", "r.npz", "c.ply", "v.html", "model")
    }
    assert "by pinhole cameras" in err
    assert "no calibration" in " ".join(err.split())
    images = (tmp_path / "model" / "images.txt").read_text().splitlines()
    assert images[4].endswith(" 1 view0000")


def test_reconstruction_like_no_pinhole_cameras_is_refused_after_all_else(
    run, file, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("epigauge.multi_view.pinhole._UNUSUAL", 0.0)
    code, out, err = run("bundle", file, "-o", tmp_path / "r.npz", "--colmap", tmp_path / "model")
    assert code == 2
    assert len(out.splitlines()) == 5
    assert (tmp_path / "r.npz").exists()
    assert not (tmp_path / "model").exists()
    assert "no basis in which its cameras look like pinhole cameras" in " ".join(err.split())


@pytest.mark.parametrize(
    ("suffix", "options", "y_up"),
    [
        (".npz", [], False),
        (".npz", ["--y-up"], True),
        (".txt", [], True),
        (".txt", ["--y-down"], False),
    ],
)
def test_images_of_bal_files_have_y_up(run, tmp_path, monkeypatch, suffix, options, y_up) -> None:
    told = []

    def spy(*arguments: object, y_up: bool) -> Display:
        told.append(y_up)
        return display(*arguments, y_up=y_up)

    monkeypatch.setattr("epigauge.cli._tracks.display", spy)
    tracks = eg.Tracks(SCENE.tracks.view, SCENE.tracks.point, -SCENE.tracks.xy)
    start = eg.Reconstruction(np.diag([-1.0, -1.0, 1.0]) @ SCENE.true.P, SCENE.true.Q)
    path = tmp_path / f"t{suffix}"
    eg.save_tracks(path, tracks, *([start] if suffix == ".txt" else []))
    assert run("bundle", path, "-o", tmp_path / "c.ply", *options)[0] == 0
    assert told == [y_up]


def test_only_clean_points_are_used_and_keep_their_numbers(run, tmp_path) -> None:
    t, clean = SCENE.tracks, np.arange(30) != 11
    np.savez(tmp_path / "t.npz", view=t.view, point=t.point, xy=t.xy, clean=clean)
    found = document(run("bundle", tmp_path / "t.npz", "--clean", "--json")[1])
    assert found["point_numbers"] == np.flatnonzero(clean).tolist()
    assert len(found["Q"]) == 29


def test_a_run_that_does_not_converge_exits_1_and_still_answers(run, file) -> None:
    code, out, err = run("bundle", file, "--max-iter", 1)
    assert code == 1
    assert len(out.splitlines()) == 5
    assert "did not converge" in err
    assert run("compare", file, "--methods", "free,bartoli", "--max-iter", 1)[0] == 1


@pytest.mark.parametrize("command", ["bundle", "compare"])
def test_a_start_without_a_finite_cost_is_bad_input(run, file, tmp_path, command) -> None:
    P, Q = SCENE.true.P.copy(), SCENE.true.Q.copy()
    P[1, 2], Q[0] = (1.0, 0.0, 0.0, -1.0), (1.0, 0.0, 0.0, 1.0)  # in the focal plane, exactly
    eg.save_reconstruction(tmp_path / "s.npz", eg.Reconstruction(P, Q))
    code, out, err = run(command, file, "--start", tmp_path / "s.npz")
    assert (code, out) == (2, "")
    assert "s.npz: has no finite cost" in err


def test_progress_is_shown_on_a_terminal_only(run, file, monkeypatch) -> None:
    shown = []
    real = Progress.update

    def update(self, task, **options):
        shown.append(options["description"])
        return real(self, task, **options)

    monkeypatch.setattr(Progress, "update", update)
    run("bundle", file)
    assert shown == []
    monkeypatch.setattr(Console, "is_terminal", property(lambda self: True))
    assert document(run("bundle", file, "--json")[1])["nfev"] == RESULT.nfev
    assert shown == []
    code, out, _ = run("bundle", file)
    assert code == 0
    assert len(out.splitlines()) == 5
    assert len(shown) == 1 + RESULT.nfev
    best = np.inf
    for number, (text, row) in enumerate(zip(shown[1:], RESULT.history, strict=True), 1):
        best = min(best, row.cost)
        rms = np.sqrt(best / len(SCENE.tracks))
        words = f"evaluation {number}  RMS {rms:.6f} px  cost {best:.8g} px\N{SUPERSCRIPT TWO}"
        assert text.startswith(words)
    shown.clear()
    run("compare", file, "--methods", "free,covariant")
    assert shown[0].startswith("free: evaluation 1")
    assert shown[-1].startswith(f"covariant: evaluation {RESULT.nfev}  RMS {RESULT.rms_px:.6f} px")


# Ctrl-C


@pytest.fixture
def pressed(monkeypatch):
    """Press Ctrl-C during some evaluations of every adjustment."""

    def press(*evaluations: int) -> None:
        real = eg.bundle_adjust

        def adjust(*arguments, callback, **options):
            def watched(row):
                stop = callback(row)
                for _ in range(evaluations.count(row.iteration)):
                    signal.raise_signal(signal.SIGINT)
                return stop

            return real(*arguments, callback=watched, **options)

        monkeypatch.setattr(eg, "bundle_adjust", adjust)
        monkeypatch.setattr("epigauge.multi_view.compare.bundle_adjust", adjust)

    before = signal.getsignal(signal.SIGINT)
    yield press
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupted_run_reports_and_saves_the_best_so_far(run, file, tmp_path, pressed) -> None:
    pressed(1)
    code, out, err = run("bundle", file, "-o", tmp_path / "r.npz")
    assert code == 130
    assert "interrupted after 3 evaluations" in err
    P = np.loadtxt(out.splitlines()).reshape(-1, 3, 4)
    with np.load(tmp_path / "r.npz", allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["P"], P)
        assert saved["cost"] == min(row.cost for row in RESULT.history[:3])
        assert len(saved["history_cost"]) == 3
    code, out, err = run("bundle", file, "--json")
    assert (code, document(out)["nfev"]) == (130, 3)


def test_interrupted_comparison_reports_what_was_done(run, file, pressed) -> None:
    pressed(2)
    code, out, err = run("compare", file, "--methods", "free,covariant,bartoli", "--json")
    assert code == 130
    assert [row["method"] for row in document(out)["rows"]] == ["free"]
    assert "interrupted at free" in err


def test_second_interrupt_ends_at_once_and_writes_nothing(run, file, tmp_path, pressed) -> None:
    pressed(1, 1)
    code, out, err = run("bundle", file, "-o", tmp_path / "r.npz")
    assert (code, out) == (130, "")
    assert err == "epigauge: interrupted; no file is left half-written\n"
    assert [path.name for path in tmp_path.iterdir()] == ["tracks.npz"]


def test_interrupt_before_there_is_an_estimate_ends_at_once(
    run, file, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(eg, "initialize", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    code, out, err = run("bundle", file, "-o", tmp_path / "r.npz")
    assert (code, out) == (130, "")
    assert "interrupted" in err
    assert [path.name for path in tmp_path.iterdir()] == ["tracks.npz"]


@pytest.mark.parametrize("name", ["r.npz", "c.ply", "b.svg", "v.html"])
def test_interrupt_while_writing_leaves_the_old_file(
    run, file, tmp_path, monkeypatch, name
) -> None:
    if name == "b.svg":
        pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    (tmp_path / name).write_text("old")
    monkeypatch.setattr(Path, "replace", lambda *_: signal.raise_signal(signal.SIGINT))
    option = "--plot" if name in ("b.svg", "v.html") else "-o"
    assert run("bundle", file, option, tmp_path / name)[0] == 130
    assert {path.name for path in tmp_path.iterdir()} == {"tracks.npz", name}
    assert (tmp_path / name).read_text() == "old"


# compare


def test_compare_shows_every_method(run, file) -> None:
    code, out, err = run("compare", file, "--methods", "free,covariant")
    assert (code, out) == (0, "")
    assert "free" in err
    assert f"{RESULT.rms_px:.6f}" in err
    code, out, err = run("compare", file, "--methods", "free, covariant", "--markdown")
    assert (code, err) == (0, "")
    assert out.count("\n") == 4
    found = document(run("compare", file, "--json", "--max-iter", 50)[1])
    assert "covariant" in [row["method"] for row in found["rows"]]
    covariant = found["rows"][-1]
    assert (covariant["nfev"], covariant["cost"]) == (RESULT.nfev, RESULT.cost)


# Bad input


@pytest.mark.parametrize("command", ["bundle", "compare"])
@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("bad.csv", "0,0,1,2\n0,1,x,2\n", "bad.csv, line 2: 'x' is not a number"),
        ("bad.csv", "0,0,1,2\n1,0,1,2\n", "bad.csv: view 0, 1 has fewer than 6"),
        ("bad.txt", "1 2\n", "bad.txt, line 1: is no BAL problem"),
        ("bad.npz", "", "bad.npz: is empty"),
        ("bad.xyz", "", "bad.xyz"),
        ("bad.csv", None, "No such file"),
    ],
)
def test_a_bad_file_is_one_clear_line_and_exit_2(
    run, tmp_path, command, name, content, words
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    code, out, err = run(command, tmp_path / name)
    assert (code, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--method", "covarian"], "did you mean 'covariant'?"),
        (["--gauge", "normalised"], "did you mean 'normalized'?"),
        (["--gauge", "normalized", "--method", "bartoli"], "gauge is given with method"),
        (["--damping", "none!"], "damping is 'none!'"),
        (["--loss", "l3"], "loss is 'l3'"),
        (["--max-iter", "0"], "max_iter"),
        (["--clean"], "marks nothing as clean"),
        (["--plot", "b.gif"], "b.gif"),
        (["-o", "r.json"], "r.json"),
        (["-o", "absent/r.npz"], "absent: No such file or directory"),
        (["--plot", "absent/r.html"], "absent: No such file or directory"),
        (["--start", "absent.npz"], "absent.npz: No such file"),
    ],
)
def test_bad_options_are_one_clear_line_and_exit_2(run, file, options, words) -> None:
    code, out, err = run("bundle", file, *options)
    assert (code, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1


def test_missing_matplotlib_is_noticed_before_the_work(run, file, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setattr(eg, "bundle_adjust", pytest.fail)
    for command in ("bundle", "compare"):
        code, _, err = run(command, file, "--plot", tmp_path / "b.png")
        assert code == 2
        assert "pip install 'epigauge[plot]'" in err


def test_start_of_another_size_is_refused(run, file, tmp_path) -> None:
    smaller = eg.Reconstruction(RESULT.reconstruction.P[:4], RESULT.reconstruction.Q)
    eg.save_reconstruction(tmp_path / "s.npz", smaller)
    code, _, err = run("bundle", file, "--start", tmp_path / "s.npz")
    assert code == 2
    assert "start has 4 cameras and 30 points" in err


def test_demo_has_both_jobs(run, tmp_path) -> None:
    code, out, _ = run("demo", "--trials", 1, "--json", "-o", tmp_path)
    found = document(out)["many_views"]
    assert code == 0
    costs = {row["method"]: row["cost"] for row in found["rows"]}
    np.testing.assert_allclose(list(costs.values()), costs["covariant"], rtol=1e-6)
    if found["picture"] is not None:
        assert Path(found["picture"]).read_bytes().startswith(b"\x89PNG")
