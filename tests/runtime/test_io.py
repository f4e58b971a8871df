"""Files: what was saved comes back to the last bit, what cannot be used is refused by line."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from epigauge.errors import FileFormatError
from epigauge.io import MAX_MATCHES, Matches, load_matches, save_matches
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

RNG = np.random.default_rng(20)
X1 = RNG.uniform((0, 0), (640, 480), (9, 2))
X2 = X1 + RNG.normal(size=X1.shape)
INLIER = np.array([1, 1, 1, 0, 1, 0, 1, 1, 1], dtype=bool)


def write(path: Path, content: str | bytes) -> Path:
    """Write a file as it is, without translating line ends."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def npz(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def npy(array: np.ndarray, header: bytes | None = None) -> bytes:
    """One array as the bytes of an npy file, with another header if asked."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    if header is None:
        return stream.getvalue()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + array.tobytes()


def zipped(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


# What is written comes back


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".npz"])
@pytest.mark.parametrize("weights", [None, np.linspace(0, 1 / 3, 9)])
def test_matches_come_back_to_the_last_bit(tmp_path, suffix, weights) -> None:
    saved = Matches(X1 * [1e-300, 1e60], X2 / 3, weights, (640, 480), (800, 600))
    save_matches(tmp_path / f"a pair{suffix}", saved)
    loaded = load_matches(tmp_path / f"a pair{suffix}")
    assert len(loaded) == 9
    assert loaded.name == "a pair"
    np.testing.assert_array_equal(loaded.x1, saved.x1)
    np.testing.assert_array_equal(loaded.x2, saved.x2)
    if weights is None:
        assert loaded.weights is None
    else:
        np.testing.assert_array_equal(loaded.weights, weights)
    if suffix == ".npz":
        assert (loaded.image_size1, loaded.image_size2) == ((640, 480), (800, 600))


def test_measured_pairs_are_read(pair) -> None:
    z = np.load(pair, allow_pickle=False)
    everything, inliers = load_matches(pair), load_matches(str(pair), inliers=True)
    np.testing.assert_array_equal(everything.x1, z["x1"])
    np.testing.assert_array_equal(inliers.x1, z["x1"][z["inlier"]])
    np.testing.assert_array_equal(inliers.x2, z["x2"][z["inlier"]])
    for name in ("image_size1", "image_size2"):
        expected = tuple(z[name].tolist()) if name in z.files else None
        assert getattr(everything, name) == expected


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3,4\n5,6,7,8\n",
        "1, 2, 3, 4\n5, 6, 7, 8",
        "1;2;3;4\r\n5;6;7;8\r\n",
        "1\t2\t3\t4\n5\t6\t7\t8\n",
        "  1 2   3 4 \n\n5 6\t7 8\n\n",
        "\ufeff1 2 3 4\n5 6 7 8\n",
        "# a comment\n1 2 3 4  # the first\n#\n5 6 7 8",
        "x1,y1,x2,y2\n1,2,3,4\n5,6,7,8\n",
        "\ufeffX1;Y1;X2;Y2\n1;2;3;4\n5;6;7;8\n",
        "y2 x1 id y1 x2\n4 1 a 2 3\n8 5 b 6 7\n",
        "# y2 x2 y1 x1\n4 3 2 1\n8 7 6 5\n",
        "# made by hand, x1 y1 x2 y2\n1 2 3 4\n5 6 7 8\n",
        '"x1","y1","x2","y2"\n"1","2","3","4"\n"5.0","6e0","+7","8."\n',
    ],
)
def test_every_way_to_write_a_table_is_read_alike(tmp_path, text) -> None:
    found = load_matches(write(tmp_path / "m.csv", text))
    np.testing.assert_array_equal(found.x1, [[1, 2], [5, 6]])
    np.testing.assert_array_equal(found.x2, [[3, 4], [7, 8]])


def test_columns_of_weights_and_inliers(tmp_path) -> None:
    path = write(
        tmp_path / "m.csv",
        "inlier,weight,x1,y1,x2,y2\n1,.5,1,2,3,4\nFalse,1,0,0,0,0\n1,2,5,6,7,8\n",
    )
    assert len(load_matches(path)) == 3
    found = load_matches(path, inliers=True)
    np.testing.assert_array_equal(found.x2, [[3, 4], [7, 8]])
    np.testing.assert_array_equal(found.weights, [0.5, 2.0])


@pytest.mark.parametrize(
    "arrays",
    [
        {"x1": X1, "x2": X2},
        {"matches": np.hstack([X1, X2])},
        {"matches": np.asfortranarray(np.hstack([X1, X2]))},
        {"x1": X1[:, None], "x2": X2.astype(">f8"), "other": np.array([None])},
    ],
)
def test_every_form_of_npz_is_read_alike(tmp_path, arrays) -> None:
    path = npz(tmp_path / "m.npz", inlier=INLIER.astype(np.uint8), weights=np.arange(9.0), **arrays)
    found = load_matches(path, inliers=True)
    np.testing.assert_array_equal(found.x1, X1[INLIER])
    np.testing.assert_array_equal(found.x2, X2[INLIER])
    np.testing.assert_array_equal(found.weights, np.arange(9.0)[INLIER])
    assert found.x1.flags.writeable


def test_loaded_arrays_hold_no_larger_one_alive(tmp_path) -> None:
    found = load_matches(write(tmp_path / "m.txt", "1 2 3 4\n5 6 7 8\n"))
    assert found.x1.base is None
    assert found.x1.flags.c_contiguous


# What cannot be used is refused


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", None, "is empty"),
        ("# only this\n\n", None, "holds no matches"),
        ("x1,y1,x2,y2\n", None, "holds no matches"),
        ("1,2,3,4\n1,2,three,4\n", 2, "'three' is not a number"),
        ("1,2,3,4\n\n# c\n1,2,,4\n", 4, "'' is not a number"),
        ("1,2,3\n", 1, "3 columns, needed: 4 (x1 y1 x2 y2), or a first line with the names"),
        ("1,2,3,4\n1,2,3,4,5\n", 2, "5 columns, needed: 4"),
        ("1 2 3 4\n1\n", 2, "1 column, needed: 4"),
        ("id,x1,y1,x2,y2\n7,1,2,3,4\n1,2,3,4\n", 3, "4 columns, needed: 5 (id, x1, y1, x2, y2)"),
        ("1;2;3;4\n1,5;2;3;4\n", 2, "'1,5' is not a number (write a decimal point, not a comma)"),
        ("1 2 3 4\n1 nan 3 4\n", 2, "'nan' is not finite"),
        ("1 2 3 4\n1 2 3 -inf\n", 2, "'-inf' is not finite"),
        ("1 2 3 1e999\n", 1, "'1e999' is not finite"),
        ("1 2 3 1_000\n", 1, "'1_000' is not a number"),
        ("1 2 3 0x10\n", 1, "'0x10' is not a number"),
        ("a,b,c,d\n1,2,3,4\n", 1, "no column x1, y1, x2, y2 among a, b, c, d"),
        ("x1,y1,x2,x2,y2\n1,2,3,4,5\n", 1, "two columns are called x2"),
        ("x1,y1,x2,y2,weight\n1,2,3,4,-1\n1,2,3,4,1\n", None, "weights has -1.0 in row 0"),
        (b"1 2 3 4\n\xff\xfe\n", 2, "is not text"),
        ("1 2 3 4\n".encode("utf-16"), None, "is UTF-16 text: save it as UTF-8"),
        (b"PK\x03\x04....", None, "is a ZIP archive: name it .npz"),
        ("1 2 3 4 " + "#" * 5000, 1, "line longer than 4096 bytes"),
        pytest.param(b"\x00" * 100, 1, "no column x1", id="zeros"),
    ],
)
def test_bad_text_is_refused_with_line_and_reason(tmp_path, text, line, reason) -> None:
    path = write(tmp_path / "bad.csv", text)
    with pytest.raises(FileFormatError) as caught:
        load_matches(path)
    assert caught.value.line == line
    assert reason in caught.value.reason
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({}, "or matches; it holds nothing"),
        ({"x1": X1, "y1": X2}, "it holds x1, y1"),
        ({"matches": X1}, "matches has shape (9, 2), needed: (m, 4)"),
        ({"x1": X1, "x2": X2[:5]}, "x2 has 5 points but x1 has 9"),
        ({"x1": X1[:0], "x2": X2[:0]}, "0 matches"),
        ({"x1": X1[0, 0], "x2": X2}, "x1 has shape ()"),
        ({"x1": X1, "x2": np.array([[None, 1]] * 9)}, "array x2 holds values of type |O"),
        ({"x1": X1, "x2": X2.astype(str)}, "array x2 holds values of type <U"),
        ({"x1": X1, "x2": X2 * 1j}, "array x2 holds values of type <c16"),
        ({"x1": X1, "x2": np.where(X2 > 400, np.nan, X2)}, "nan"),
        ({"x1": X1 > 1, "x2": X2}, "x1 has type bool"),
        ({"x1": X1, "x2": X2, "weights": np.ones(3)}, "weights has shape (3,)"),
        ({"x1": X1, "x2": X2, "image_size1": np.ones(3)}, "image_size1 is [1.0, 1.0, 1.0]"),
        ({"x1": X1, "x2": X2, "image_size2": np.array([3, 0])}, "image_size2 is [3, 0]"),
    ],
)
def test_bad_arrays_are_refused_by_name(tmp_path, arrays, reason) -> None:
    path = npz(tmp_path / "bad.npz", **arrays)
    with pytest.raises(FileFormatError) as caught:
        load_matches(path)
    assert reason in caught.value.reason


@pytest.mark.parametrize(
    ("marks", "reason"),
    [
        ({}, "no inlier column or array"),
        ({"inlier": INLIER * 2}, "needed: 9 marks 0 or 1"),
        ({"inlier": INLIER * 1.0}, "type float64"),
        ({"inlier": INLIER & False}, "every match as an outlier"),
    ],
)
def test_inliers_must_be_marked(tmp_path, marks, reason) -> None:
    path = npz(tmp_path / "bad.npz", x1=X1, x2=X2, **marks)
    load_matches(path)
    with pytest.raises(FileFormatError) as caught:
        load_matches(path, inliers=True)
    assert reason in caught.value.reason


def test_inlier_marks_of_text(tmp_path) -> None:
    with pytest.raises(FileFormatError, match="no inlier column"):
        load_matches(write(tmp_path / "a.csv", "1 2 3 4\n"), inliers=True)
    path = write(tmp_path / "b.csv", "x1 y1 x2 y2 inlier\n1 2 3 4 1\n1 2 3 4 maybe\n")
    with pytest.raises(FileFormatError, match="line 3: inlier is 'maybe', needed: 0 or 1"):
        load_matches(path, inliers=True)


HEADER = "{{'descr': '<f8', 'fortran_order': False, 'shape': {}, }}\n"


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        (HEADER.format("(1000000000000, 2)"), "needed: at most"),
        (HEADER.format("(10000001, 2)"), "needed: at most"),
        (HEADER.format("(10000000, 5)"), "needed: at most"),
        (HEADER.format("(-9, 2)"), "is damaged"),
        (HEADER.format("(10000000, 2)"), "cut short"),
        (HEADER.format("(8, 2)"), "not the size that its header declares"),
        (HEADER.format("(9, 2"), "is damaged"),
        (HEADER.format("[9, 2]"), "is damaged"),
        (HEADER.format("(9, 2)").replace("<f8", "|O"), "holds values of type |O"),
        (HEADER.format("(9, 2)").replace("'<f8'", "[('a', '<f8')]"), "holds structured values"),
        (HEADER.format("(" * 300 + "9"), "is damaged"),
        (HEADER.format("(" + "9" * 80), "is damaged"),  # no regular expression explodes
        (HEADER.format("(" + "9" * 80 + ")"), "needed: at most"),
        (HEADER.format("(9, 2)").replace("f8", "f3"), "is damaged"),
        (HEADER.format("(9, 2)") + " " * 20_000, "is damaged"),
        ("", "is damaged"),
    ],
)
def test_declared_sizes_are_checked_before_allocating(tmp_path, header, reason) -> None:
    assert MAX_MATCHES == 10_000_000
    path = zipped(tmp_path / "bad.npz", x1=npy(X1, header.encode()), x2=npy(X2))
    with pytest.raises(FileFormatError, match="array x1") as caught:
        load_matches(path)
    assert reason in caught.value.reason


def test_nothing_is_unpickled(tmp_path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (os.mkdir, (str(tmp_path / "sprung"),))

    path = zipped(tmp_path / "bad.npz", x1=npy(np.array([Trap()] * 9)), x2=npy(X2))
    with pytest.raises(FileFormatError, match=r"holds values of type \|O"):
        load_matches(path)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("content", [b"", b"PK", b"1,2,3,4\n", b"\x93NUMPY\x01\x00v\x00"])
def test_npz_that_is_none_is_refused(tmp_path, content) -> None:
    with pytest.raises(FileFormatError, match=r"is empty|is not a readable NPZ"):
        load_matches(write(tmp_path / "bad.npz", content))


def test_truncated_npz_is_refused_at_every_length(tmp_path) -> None:
    content = npz(tmp_path / "good.npz", x1=X1, x2=X2).read_bytes()
    for length in range(0, len(content), 7):
        with pytest.raises(FileFormatError):
            load_matches(write(tmp_path / "bad.npz", content[:length]))


def test_flipped_bit_in_the_numbers_is_noticed(tmp_path) -> None:
    content = bytearray(npz(tmp_path / "good.npz", x1=X1, x2=X2).read_bytes())
    content[content.index(X2.tobytes()) + 40] ^= 4
    with pytest.raises(FileFormatError, match=r"array x2 is damaged.*CRC"):
        load_matches(write(tmp_path / "bad.npz", bytes(content)))


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_every_compression_is_read_and_its_damage_noticed(tmp_path, method) -> None:
    path = tmp_path / "m.npz"
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("x1.npy", npy(X1))
        archive.writestr("x2.npy", npy(X2))
    content = path.read_bytes()
    np.testing.assert_array_equal(load_matches(path).x2, X2)
    for at in range(60, 240, 6):
        write(path, content[:at] + b"\xaa\x55" + content[at + 2 :])
        with pytest.raises(FileFormatError, match=r"array x1 is damaged|not a readable NPZ"):
            load_matches(path)


@pytest.mark.parametrize(
    ("offset", "value", "reason"), [(8, 1, "encrypted"), (10, 99, "compression method")]
)
def test_archive_of_an_unknown_kind_is_refused(tmp_path, offset, value, reason) -> None:
    content = bytearray(npz(tmp_path / "m.npz", x1=X1, x2=X2).read_bytes())
    content[content.index(b"PK\x01\x02") + offset] = value  # in the directory's entry of x1
    with pytest.raises(FileFormatError, match="array x1 is damaged") as caught:
        load_matches(write(tmp_path / "bad.npz", bytes(content)))
    assert reason in str(caught.value)


def test_too_many_lines_are_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("epigauge.io._text.MAX_MATCHES", 3)
    path = write(tmp_path / "m.csv", "1 2 3 4\n" * 3)
    assert len(load_matches(path)) == 3
    write(path, "1 2 3 4\n" * 4)
    with pytest.raises(FileFormatError, match="line 4: holds more than 3 matches"):
        load_matches(path)


def test_absent_file_is_an_oserror(tmp_path) -> None:
    with pytest.raises(FileNotFoundError):
        load_matches(tmp_path / "none.csv")
    with pytest.raises(IsADirectoryError):
        load_matches(tmp_path)


# Whatever the bytes: matches or a FileFormatError

fuzzing = settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def read_hostile(path: Path, content: bytes) -> None:
    write(path, content)
    for inliers in (False, True):
        try:
            found = load_matches(path, inliers=inliers)
        except FileFormatError as error:
            message = str(error)
            assert len(message) < 600
            assert message.isprintable()
        else:
            assert found.x1.shape == found.x2.shape == (len(found), 2)
            assert np.isfinite(found.x1).all()
            assert np.isfinite(found.x2).all()


GOOD_TEXT = b"# pair\nx1,y1,x2,y2,weight,inlier\n" + b"".join(
    b"%r,%r,%r,%r,1.0,1\n" % (*a, *b) for a, b in zip(X1.tolist(), X2.tolist(), strict=True)
)


def good_npz() -> bytes:
    stream = io.BytesIO()
    size = np.array([640, 480])
    np.savez(stream, x1=X1, x2=X2, inlier=INLIER, weights=INLIER * 1.0, image_size1=size)
    return stream.getvalue()


GOOD_NPZ = good_npz()


@st.composite
def mutated(draw: st.DrawFn, good: bytes) -> bytes:
    """Overwrite, insert, delete or repeat a few stretches of a good file."""
    content = bytearray(good)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(content)))
        length = draw(st.integers(0, 12))
        new = draw(
            st.binary(max_size=8) | st.sampled_from([b"nan", b",", b"\n", b"1e", b"{", b"-"])
        )
        content[at : at + length] = new * draw(st.sampled_from([1, 1, 1, 300]))
    return bytes(content)


@fuzzing
@given(
    mutated(GOOD_TEXT)
    | mutated(GOOD_TEXT.replace(b",", b" "))
    | st.binary(max_size=300)
    | st.text(max_size=200).map(str.encode)
)
def test_any_text_gives_matches_or_a_file_format_error(tmp_path, content) -> None:
    read_hostile(tmp_path / "fuzz.csv", content)
    read_hostile(tmp_path / "fuzz.txt", content)


@fuzzing
@given(mutated(GOOD_NPZ) | st.binary(max_size=300))
def test_any_npz_gives_matches_or_a_file_format_error(tmp_path, content) -> None:
    read_hostile(tmp_path / "fuzz.npz", content)


@fuzzing
@given(mutated(npy(X1)))
def test_any_array_gives_matches_or_a_file_format_error(tmp_path, content) -> None:
    # Mutating inside the archive, with sums that fit, reaches the array reader itself.
    path = zipped(tmp_path / "fuzz.npz", x1=content, x2=npy(X2))
    read_hostile(path, path.read_bytes())
