"""Files of results, and writing: all numbers are there, and no half file is left."""

from __future__ import annotations

import io
import json
import os
import stat
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from epigauge.errors import ArgumentError
from epigauge.io import Matches, plain, save_matches, save_result
from epigauge.io._common import listed
from epigauge.io._npz import write_npz
from epigauge.io.output import writing

RNG = np.random.default_rng(20)
X1 = RNG.uniform((0, 0), (640, 480), (9, 2))
X2 = X1 + RNG.normal(size=X1.shape)


# Results


@dataclass(frozen=True)
class Row:
    cost: float
    accepted: bool


@dataclass(frozen=True)
class Result:
    F: np.ndarray
    sigma: float
    message: str
    success: bool
    history: tuple[Row, ...]
    noise_px: float | None = None


RESULT = Result(X1 / 3, np.float64(0.1), "done", np.True_, (Row(2.0, True), Row(np.inf, False)))


def test_json_holds_the_same_numbers(tmp_path) -> None:
    save_result(tmp_path / "r.json", RESULT, matches=9)
    found = json.loads((tmp_path / "r.json").read_text(), parse_constant=pytest.fail)
    np.testing.assert_array_equal(found.pop("F"), RESULT.F)
    assert found == {
        "sigma": 0.1,
        "message": "done",
        "success": True,
        "history": [{"cost": 2.0, "accepted": True}, {"cost": None, "accepted": False}],
        "noise_px": None,
        "matches": 9,
    }


def test_json_has_a_line_a_row_of_a_matrix(tmp_path) -> None:
    save_result(tmp_path / "r.json", RESULT, many=[0] * 40, words=["a, [b", "c"], names=["a", "b"])
    lines = (tmp_path / "r.json").read_text().splitlines()
    assert sum(line.startswith("  [") for line in lines) == len(RESULT.F)
    assert ' "names": ["a", "b"]' in lines
    assert lines.count("  0,") == 39  # a long list is no row
    assert json.loads("".join(lines))["words"] == ["a, [b", "c"]


def test_npz_holds_the_same_numbers(tmp_path) -> None:
    save_result(tmp_path / "r.npz", RESULT, matches=9)
    with np.load(tmp_path / "r.npz", allow_pickle=False) as found:
        np.testing.assert_array_equal(found["F"], RESULT.F)
        np.testing.assert_array_equal(found["history_cost"], [2.0, np.inf])
        np.testing.assert_array_equal(found["history_accepted"], [True, False])
        assert found["message"] == "done"
        assert found["matches"] == 9
        assert "noise_px" not in found.files


def test_what_has_no_plain_form_is_refused(tmp_path) -> None:
    with pytest.raises(TypeError, match="no plain form of complex"):
        plain({"z": [1j]})
    with pytest.raises(TypeError, match="no array form of F"):
        save_result(tmp_path / "r.npz", Result({}, 0.0, "", True, ()))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["r.pkl", "r", "r.npy", ".json"])
def test_unknown_suffix_is_refused_before_writing(tmp_path, name) -> None:
    with pytest.raises(ArgumentError, match=r"a name ending in \.npz, \.json"):
        save_result(tmp_path / name, RESULT)
    with pytest.raises(ArgumentError, match=r"a name ending in \.csv, \.txt, \.npz"):
        save_matches(tmp_path / name, Matches(X1, X2))
    assert list(tmp_path.iterdir()) == []


# Writing


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path) -> None:
    path = tmp_path / "r.json"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), writing(path) as file:
        file.write(b"half" * (1 // 0))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# Where the archive itself is being made or dropped, it complains when it is collected.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interruption_at_any_line_of_writing_an_archive_comes_through() -> None:
    def interrupted(after: int) -> bool:
        """Write arrays; end that after so many lines of `zipfile`, as Ctrl-C would."""
        left = after

        def trace(frame, event, _):
            nonlocal left
            if event == "line" and "zipfile" in frame.f_code.co_filename:
                left -= 1
                if left == 0:
                    raise KeyboardInterrupt
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            write_npz(io.BytesIO(), {"F": X1, "message": "done"})
        except KeyboardInterrupt:
            return True
        finally:
            sys.settrace(before)
        return left <= 0  # in what collects the archive

    assert not interrupted(100_000)
    after = 1
    while interrupted(after):
        after += 2
    assert after > 100


def test_written_file_replaces_the_old_one_in_one_step(tmp_path) -> None:
    path = tmp_path / "r.json"
    path.write_text("old")
    with writing(path) as file:
        file.write(b"new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name != "posix", reason="permission bits and links are those of POSIX")
def test_written_file_has_usual_permissions_and_keeps_a_link(tmp_path) -> None:
    target, usual = tmp_path / "target.json", tmp_path / "usual"
    for path in (target, usual):
        path.write_text("old")
    (tmp_path / "link.json").symlink_to(target)
    target.chmod(0o600)
    plain_mode = stat.S_IMODE(usual.stat().st_mode)
    save_result(tmp_path / "link.json", RESULT)
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads(target.read_text())["message"] == "done"
    assert stat.S_IMODE(target.stat().st_mode) == plain_mode


def test_a_file_that_cannot_be_opened_is_told_by_the_name_that_was_given(tmp_path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        save_result(tmp_path / "absent" / "r.json", RESULT)
    assert caught.value.filename == str(tmp_path / "absent" / "r.json")


def test_directory_is_not_replaced(tmp_path) -> None:
    (tmp_path / "r.json").mkdir()
    with pytest.raises(OSError, match="not a regular file"):
        save_result(tmp_path / "r.json", RESULT)


@pytest.mark.parametrize("count", [0, 1, 8, 9])
def test_a_list_of_names_says_that_there_are_more_where_there_are(count) -> None:
    names = [f"name{k}" for k in range(count)]
    text = listed(names)
    assert text.count("name") == min(count, 8)
    assert text.endswith("...") == (count > 8)
    assert (text == "nothing") == (count == 0)
