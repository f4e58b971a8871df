"""Command line: data on stdout, text on stderr, exit codes 0 done, 1 not converged, 2 bad input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from epigauge.io import Matches, save_matches
from epigauge.scenes import two_view_scene

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

from epigauge.__main__ import main
from epigauge.cli.refine import epipoles, standard_deviations

SCENE = two_view_scene(noise_px=0.5, seed=7)
RESULT = eg.refine_fundamental(SCENE.x1, SCENE.x2, noise_px=None)


@pytest.fixture
def pair_file(tmp_path) -> Path:
    path = tmp_path / "pair.csv"
    save_matches(path, Matches(SCENE.x1, SCENE.x2))
    return path


def numbers(text: str) -> np.ndarray:
    return np.loadtxt(text.splitlines())


def document(text: str) -> dict:
    """Parse one strict JSON document with nothing around it."""
    return json.loads(text, parse_constant=pytest.fail)


# refine


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".npz"])
def test_stdout_is_the_matrix_of_the_library_to_the_last_bit(run, tmp_path, suffix) -> None:
    save_matches(tmp_path / f"pair{suffix}", Matches(SCENE.x1, SCENE.x2))
    code, out, err = run("refine", tmp_path / f"pair{suffix}")
    assert code == 0
    assert len(out.splitlines()) == 3
    np.testing.assert_array_equal(numbers(out), RESULT.F)
    for name in ("matches", "rms_px", "noise_px", "sigma", "epipoles", "evaluations", "status"):
        assert name in err
    assert f"{RESULT.rms_px:.6g}" in err


def test_json_is_one_document_and_nothing_else(run, pair_file) -> None:
    code, out, err = run("refine", pair_file, "--json")
    found = document(out)
    assert (code, err) == (0, "")
    np.testing.assert_array_equal(found["F"], RESULT.F)
    np.testing.assert_array_equal(found["covariance"], RESULT.covariance)
    np.testing.assert_array_equal(found["fun"], RESULT.fun)
    np.testing.assert_array_equal(found["epipoles"], epipoles(RESULT.F))
    assert found["matches"] == 50
    assert found["success"] is True
    assert len(found["history"]) == found["nfev"] == RESULT.nfev
    assert found["noise_px"] == RESULT.noise_px
    assert found["noise_estimated"] is True


def test_options_reach_the_solver(run, pair_file) -> None:
    options = {"structure": "joint", "hessian": "gauss-newton", "max_iter": 90, "noise_px": 2.0}
    expected = eg.refine_fundamental(SCENE.x1, SCENE.x2, backend="numpy", **options)
    words = [w for k, v in options.items() for w in ("--" + k.replace("_", "-"), v)]
    found = document(run("refine", pair_file, "--json", *words, "--backend", "numpy")[1])
    assert found["nfev"] == expected.nfev != RESULT.nfev
    assert found["noise_px"] == 2.0
    np.testing.assert_array_equal(found["covariance"], expected.covariance)


def test_inliers_and_weights_of_the_file_are_used(run, tmp_path) -> None:
    x1, inlier = SCENE.x1.copy(), np.ones(50, dtype=bool)
    x1[3] += 40.0
    inlier[3] = False
    weights = np.linspace(0.5, 2.0, 50)
    np.savez(tmp_path / "m.npz", x1=x1, x2=SCENE.x2, inlier=inlier, weights=weights)
    expected = eg.refine_fundamental(x1[inlier], SCENE.x2[inlier], weights=weights[inlier])
    _, out, _ = run("refine", tmp_path / "m.npz", "--inliers")
    np.testing.assert_array_equal(numbers(out), expected.F)
    assert np.abs(numbers(run("refine", tmp_path / "m.npz")[1]) - expected.F).max() > 1e-4


def test_result_and_pictures_are_saved(run, pair_file, tmp_path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    code, _, _ = run("refine", pair_file, "-o", tmp_path / "r.npz", "--plot", tmp_path / "r.png")
    assert code == 0
    with np.load(tmp_path / "r.npz", allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["F"], RESULT.F)
        np.testing.assert_array_equal(saved["points"], RESULT.points)
        np.testing.assert_array_equal(saved["history_cost"], [row.cost for row in RESULT.history])
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")
    run("refine", pair_file, "--output", tmp_path / "r.json", "--plot", tmp_path / "r.svg")
    np.testing.assert_array_equal(document((tmp_path / "r.json").read_text())["F"], RESULT.F)
    assert "<svg" in (tmp_path / "r.svg").read_text()


def test_a_run_that_does_not_converge_exits_1_and_still_answers(run, pair_file) -> None:
    code, out, err = run("refine", pair_file, "--max-iter", 1)
    assert code == 1
    assert numbers(out).shape == (3, 3)
    assert "not converged" in err
    code, out, _ = run("refine", pair_file, "--max-iter", 1, "--json")
    assert code == 1
    assert document(out)["success"] is False


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "bad.csv: is empty"),
        ("1,2,3,4\n1,2,x,4\n", "bad.csv, line 2: 'x' is not a number"),
        ("1,2,3,4\n1,2,nan,4\n", "bad.csv, line 2: 'nan' is not finite"),
        ("1,2,3\n", "bad.csv, line 1: 3 columns"),
        ("1,2,3,4\n4,3,2,1\n", "bad.csv: x1, x2 hold 2 matches; needed: at least 8"),
        ("1,2,3,4\n" * 9, "bad.csv: x1 has all its points of image 1 equal"),
        (
            "".join(f"{i},{i * i},{i},{2 * i}\n" for i in range(9)),
            "bad.csv: x2 has all its points of image 2 on one line",
        ),
        (b"\x00\xff\xfe", "bad.csv, line 1: is not text"),
        (None, "bad.csv: No such file or directory"),
    ],
)
def test_a_bad_file_is_one_clear_line_and_exit_2(run, tmp_path, content, words) -> None:
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for options in ([], ["--json"]):
        code, out, err = run("refine", path, *options)
        assert (code, out) == (2, "")
        assert err.startswith(f"epigauge: {path}")
        assert words in err
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--structure", "jiont"], "did you mean 'joint'?"),
        (["--hessian", "none"], "hessian is 'none'"),
        (["--parameterization", "orto"], "parameterization is 'orto'"),
        (["--criterion", "sampson!"], "criterion is 'sampson!'"),
        (["--backend", "fortran"], "backend is 'fortran'"),
        (["--noise-px", "0"], "noise_px is 0.0; needed: a finite number > 0"),
        (["--max-iter", "0"], "max_iter"),
        (["--plot", "picture.gif"], "picture.gif"),
        (["-o", "result.pkl"], "result.pkl"),
        (["-o", "absent/result.npz"], "epigauge: absent: No such file or directory"),
        (["--inliers"], "marks no inliers"),
    ],
)
def test_bad_options_are_one_clear_line_and_exit_2(run, pair_file, options, words) -> None:
    code, out, err = run("refine", pair_file, *options)
    assert (code, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "options",
    [["-o", "r.pkl"], ["--plot", "r.gif"], ["-o", "absent/r.npz"], ["--plot", "absent/r.svg"]],
)
def test_names_of_outputs_are_checked_before_the_work(run, pair_file, monkeypatch, options) -> None:
    monkeypatch.setattr(eg, "refine_fundamental", pytest.fail)
    assert run("refine", pair_file, *options)[0] == 2


@pytest.mark.parametrize(
    "arguments", [[], ["refine"], ["refine", "a", "b"], ["refin"], ["info", "-x"]]
)
def test_wrong_usage_exits_2(run, arguments) -> None:
    code, _, _ = run(*arguments)
    assert code == 2


def test_bugs_keep_their_traceback(run, pair_file, monkeypatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(eg, "refine_fundamental", broken)
    monkeypatch.setattr(sys, "argv", ["epigauge", "refine", str(pair_file)])
    with pytest.raises(ZeroDivisionError):
        main()


def test_markup_in_a_file_name_is_only_a_name(run, pair_file) -> None:
    path = pair_file.rename(pair_file.with_name("[bold red]x[.csv"))
    code, _, err = run("refine", path)
    assert code == 0
    assert "[boldred]x[.csv" in "".join(err.split())  # long paths are wrapped


def test_standard_deviation_of_sigma_follows_its_derivative() -> None:
    rng = np.random.default_rng(4)
    U, _, Vt = np.linalg.svd(rng.normal(size=(3, 3)))
    F = U @ np.diag([1.0, 0.7, 0.0]) @ Vt
    for _ in range(5):
        direction = rng.normal(size=9)
        ratio = [
            (lambda s: s[1] / s[0])(
                np.linalg.svd(F + h * direction.reshape(3, 3), compute_uv=False)
            )
            for h in (-1e-6, 1e-6)
        ]
        std_F, std_sigma = standard_deviations(F, np.outer(direction, direction))
        np.testing.assert_allclose(std_F.ravel(), np.abs(direction))
        # Central differences with a step of 1e-6 are right to about 1e-10.
        assert std_sigma == pytest.approx(abs(ratio[1] - ratio[0]) / 2e-6, abs=1e-8)
    assert standard_deviations(F, np.diag([np.inf] * 9))[1] == np.inf


# info and demo


def test_info_names_versions_and_backends(run) -> None:
    code, out, _ = run("info", "--json")
    found = document(out)
    assert code == 0
    assert found["epigauge"] == eg.__version__
    assert found["backend"] == eg.backend()
    assert found["backends"] == eg.kernels.available()
    assert found["packages"]["numpy"] == np.__version__
    code, out, err = run("info")
    assert (code, out) == (0, "")
    assert np.__version__ in err
    assert "available, active" in err
    assert run("--version")[1] == f"epigauge {eg.__version__}\n"


def test_demo_compares_the_methods_from_one_start(run, tmp_path) -> None:
    code, out, err = run("demo", "--no-plot", "--json", "--trials", 3)
    methods = document(out)["methods"]
    assert (code, err) == (0, "")
    start, *refined = methods.values()
    assert len(refined) == 3
    for measured in refined:
        assert len(measured["cost"]) == 3
        assert np.all(np.less(measured["cost"], start["cost"]))
        assert all(measured["converged"])
    # All end in the same minimum; each stops at a relative decrease of 1e-10.
    np.testing.assert_allclose(refined[0]["cost"], refined[2]["cost"], rtol=1e-8)
    np.testing.assert_allclose(refined[1]["cost"], refined[2]["cost"], rtol=1e-8)


def test_demo_draws_where_it_is_told(run, tmp_path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need matplotlib")
    code, out, err = run("demo", "--trials", 1, "-o", tmp_path / "new" / "folder")
    assert (code, out) == (0, "")
    assert (tmp_path / "new/folder/epigauge-demo.png").read_bytes().startswith(b"\x89PNG")
    assert "epigauge-demo.png" in err
    assert "Gauss-Newton" in err


def test_demo_without_matplotlib_says_how_to_get_it(run, monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, _, err = run("demo", "--trials", 1, "-o", tmp_path)
    assert code == 0
    assert "pip install 'epigauge[plot]'" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [["--trials", 0], ["--distance", 0.2], ["--distance", "nan"]])
def test_impossible_demo_is_refused(run, options) -> None:
    code, out, err = run("demo", "--no-plot", *options)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1


# Another process


def spawn(*arguments: object, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "epigauge", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_module_runs_as_a_command(pair_file) -> None:
    done = spawn("refine", pair_file.name, cwd=pair_file.parent)
    assert done.returncode == 0
    np.testing.assert_array_equal(numbers(done.stdout), RESULT.F)
    failed = spawn("refine", "absent.csv", cwd=pair_file.parent)
    assert failed.returncode == 2
    assert failed.stderr == "epigauge: absent.csv: No such file or directory\n"


def test_terminal_without_unicode_is_no_obstacle(pair_file) -> None:
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "TERM": "dumb"}
    path = pair_file.rename(pair_file.with_name("p\u00e4r.csv"))
    for arguments in (["refine", path], ["info"], ["demo", "--no-plot", "--trials", 1]):
        done = spawn(*arguments, env=environment | {"PYTHONUTF8": "0"})
        assert done.returncode == 0, done.stderr


@pytest.mark.skipif(os.name != "posix", reason="closes a pipe as a POSIX shell does")
def test_reader_that_stops_early_is_no_error(pair_file) -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "epigauge", "refine", "--json", str(pair_file)]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("package", ["typer", "rich"])
def test_missing_package_is_named_with_its_remedy(package) -> None:
    code = (
        f"import sys; sys.modules[{package!r}] = None\nfrom epigauge.__main__ import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert package in done.stderr
    assert "pip install 'epigauge[cli]'" in done.stderr
    assert done.stderr.count("\n") == 1
