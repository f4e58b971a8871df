"""Damaged files through the command line, quickly; `python tests/fuzz.py` runs thousands."""

from __future__ import annotations

from pathlib import Path

import epigauge as eg
import numpy as np
import pytest

pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

import fuzz

KINDS = fuzz.kinds()


@pytest.mark.parametrize("name", KINDS)
def test_the_good_file_is_read_by_every_command(tmp_path, name) -> None:
    kind = KINDS[name]
    for command in kind.commands:
        outcome = fuzz.run(kind, kind.good, command, tmp_path)
        # Nothing in these files is marked as clean.
        assert (outcome.code, outcome.fault) == (2 if "--clean" in command else 0, "")


@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_read_or_refused(tmp_path, name) -> None:
    codes = set()

    def each(kind: fuzz.Kind, data: bytes, outcome: fuzz.Outcome) -> None:
        assert not outcome.fault, f"{outcome.command}: {outcome.fault}"
        codes.add(outcome.code)

    fuzz.fuzz(15, 7, [name], tmp_path, each)
    assert 2 in codes
    assert codes <= {0, 1, 2}


def test_a_fault_is_seen(tmp_path, monkeypatch) -> None:
    kind = KINDS["m.csv"]
    for error, told in ((KeyError("x"), "KeyError"), (RuntimeWarning("odd"), "RuntimeWarning")):

        def fail(*_: object, error: Exception = error, **__: object) -> None:
            raise error

        monkeypatch.setattr(eg, "refine_fundamental", fail)
        assert told in fuzz.run(kind, kind.good, "refine FILE", tmp_path).fault


#: Found by fuzzing: files that once made a command stumble.
_SCENE = eg.two_view_scene(n_points=20, seed=1)


@pytest.mark.parametrize(
    ("weights", "scale"), [(1e308, 1.0), (1.0, 1e300), (1.0, 1e-300)], ids=["weight", "far", "near"]
)
def test_numbers_beyond_measure_are_refused(tmp_path, weights, scale) -> None:
    w = np.ones(20)
    w[3] = weights
    rows = np.column_stack([_SCENE.x1 * scale, _SCENE.x2, w])
    text = "x1,y1,x2,y2,weight\n" + "\n".join(",".join(map(repr, r)) for r in rows.tolist())
    outcome = fuzz.run(KINDS["m.csv"], text.encode(), "refine FILE", Path(tmp_path))
    assert (outcome.code, outcome.fault) == (2, "")


def test_a_signalling_nan_is_refused(tmp_path) -> None:
    table = np.hstack([_SCENE.x1, _SCENE.x2]).astype(np.float32)
    table.view(np.uint32)[3, 2] = 0x7F800001
    np.save(tmp_path / "m.npy", table)
    data = (tmp_path / "m.npy").read_bytes()
    outcome = fuzz.run(KINDS["m.npy"], data, "refine FILE", Path(tmp_path))
    assert (outcome.code, outcome.fault) == (2, "")


def test_a_camera_of_another_size_ends(tmp_path) -> None:
    """Its normal equations overflow, so that no lambda made them solvable."""
    scene = eg.multi_view_scene(n_views=4, n_points=15, visible=0.8, noise_px=0.5, seed=2)
    P = scene.true.P.copy()
    P[1, 0, 2] = 3e85
    eg.save_reconstruction(tmp_path / "r.npz", eg.Reconstruction(P, scene.true.Q))
    kind = KINDS["r.npz"]
    data = (tmp_path / "r.npz").read_bytes()
    assert not fuzz.run(kind, data, kind.commands[0], tmp_path).fault
