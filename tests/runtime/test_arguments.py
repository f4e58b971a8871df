"""Checks of arguments: what is accepted arrives unchanged, what is refused is named."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from epigauge._arguments import (
    as_choice,
    as_count,
    as_fundamental,
    as_matches,
    as_positive,
    as_weights,
    check_general_position,
)
from epigauge.errors import (
    ArgumentError,
    BackendError,
    EpigaugeError,
    FileFormatError,
    MissingPackageError,
)
from hypothesis import given
from hypothesis import strategies as st


def some_points(m: int = 12, seed: int = 0) -> np.ndarray:
    """Points of an image of 640 x 480 pixels."""
    return np.random.default_rng(seed).uniform((0, 0), (640, 480), (m, 2))


POINTS = some_points()


@pytest.mark.parametrize(
    "form",
    [
        lambda x: x,
        lambda x: x[:, None, :],
        lambda x: x.tolist(),
        lambda x: np.asfortranarray(x),
        lambda x: np.repeat(x, 2, axis=0)[::2],
        lambda x: x.astype(">f8"),
        lambda x: x.astype(np.longdouble),
        lambda x: np.ma.masked_array(x),
    ],
)
def test_every_form_of_the_same_points_gives_the_same_array(form) -> None:
    given = form(POINTS)
    for out in as_matches(given, given):
        assert out.dtype == np.float64
        assert out.dtype.isnative
        assert out.flags.c_contiguous
        np.testing.assert_array_equal(out, POINTS)


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int64, np.float16, np.float32])
def test_integers_and_short_floats_keep_their_values(dtype) -> None:
    x = (POINTS / 8).astype(dtype)
    out, _ = as_matches(x, x, general_position=True)
    np.testing.assert_array_equal(out, x.astype(np.float64))


def test_inputs_stay_untouched() -> None:
    x1, x2 = POINTS.copy(), POINTS.astype(np.float32)
    before = x1.tobytes(), x2.tobytes()
    x1.flags.writeable = x2.flags.writeable = False
    as_matches(x1, x2, general_position=True)
    assert (x1.tobytes(), x2.tobytes()) == before


@pytest.mark.parametrize(
    ("x1", "x2", "argument", "words"),
    [
        (POINTS.T, POINTS, "x1", r"shape \(2, 12\).*transpose"),
        (POINTS, np.ones((12, 3)), "x2", r"shape \(12, 3\).*third coordinate"),
        (np.ones((12, 4)), POINTS, "x1", "columns 0, 1 as x1"),
        (POINTS.ravel(), POINTS, "x1", r"shape \(24,\)"),
        (3.0, POINTS, "x1", r"shape \(\)"),
        ([], [], "x1", r"shape \(0,\)"),
        (POINTS[:, None, None, :], POINTS, "x1", r"shape \(12, 1, 1, 2\)"),
        (POINTS[:9], POINTS, "x2", "12 points but x1 has 9"),
        (POINTS[:7], POINTS[:7], "x1, x2", "7 matches; needed: at least 8"),
        (POINTS[:0], POINTS[:0], "x1, x2", "0 matches"),
        (POINTS[:1], POINTS[:1], "x1, x2", "1 match;"),
        (POINTS + 1j, POINTS, "x1", "complex"),
        (POINTS, POINTS.astype(str), "x2", "type <U"),
        (POINTS > 3, POINTS, "x1", "type bool"),
        ([[1, None]] * 12, POINTS, "x1", "type object"),
        ([[1, 2], [3]], POINTS, "x1", "not a regular array"),
        (None, POINTS, "x1", "type object"),
        (np.ma.masked_greater(POINTS, 300), POINTS, "x1", "masked"),
    ],
)
def test_unusable_matches_are_refused_by_name(x1, x2, argument, words) -> None:
    with pytest.raises(ArgumentError, match=words) as caught:
        as_matches(x1, x2)
    assert caught.value.argument == argument


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_first_row_that_is_not_finite_is_named(bad) -> None:
    x = POINTS.copy()
    x[[5, 9], [1, 0]] = bad
    with pytest.raises(ArgumentError, match="row 5") as caught:
        as_matches(POINTS, x)
    assert caught.value.argument == "x2"


def test_number_too_large_for_float64_is_refused() -> None:
    x = POINTS.astype(np.longdouble)
    x[2, 0] = np.longdouble("1e400")
    if not np.isfinite(x).all():
        pytest.skip("long double is float64 on this platform")
    with pytest.raises(ArgumentError, match="row 2"):
        as_matches(x, POINTS)


LINE = np.linspace(0.0, 600.0, 12)[:, None] * [0.8, 0.3] + [20.0, 40.0]


@pytest.mark.parametrize("offset", [0.0, 1e6, -3e9])
@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e150, 1e-150])
def test_general_position_does_not_depend_on_offset_or_scale(offset, scale) -> None:
    check_general_position("x1", scale * (POINTS + offset))
    with pytest.raises(ArgumentError, match="on one line"):
        check_general_position("x1", scale * (LINE + offset))
    with pytest.raises(ArgumentError, match="equal"):
        check_general_position("x1", scale * (0 * POINTS + offset))


@pytest.mark.parametrize("angle", np.linspace(0, np.pi, 9))
def test_collinear_points_are_found_in_every_direction(angle) -> None:
    line = np.linspace(-300, 300, 50)[:, None] * [np.cos(angle), np.sin(angle)] + 500
    with pytest.raises(ArgumentError, match="image 2 on one line"):
        as_matches(some_points(50), line, general_position=True)
    # Six printed decimals leave 5e-7 px of rounding.
    with pytest.raises(ArgumentError, match="on one line"):
        check_general_position("x1", line.round(6))
    # A hundredth of a pixel of measurement noise is no longer a line.
    noise = np.random.default_rng(1).normal(scale=0.01, size=line.shape)
    check_general_position("x1", line + noise)


def test_rounding_of_the_input_type_is_no_extent() -> None:
    # float32 resolves 0.06 px at 1e6 px: the exact line is off by that much after rounding.
    rounded = (LINE + 1e6).astype(np.float32)
    with pytest.raises(ArgumentError, match="x1 has all its points of image 1 on one line"):
        as_matches(rounded, POINTS, general_position=True)
    as_matches((POINTS + 1e6).astype(np.float32), POINTS, general_position=True)


def test_one_point_off_the_line_is_enough() -> None:
    points = LINE.copy()
    points[3, 1] += 1.0
    check_general_position("x1", points)


def test_general_position_is_not_asked_for_by_default() -> None:
    as_matches(LINE, 0 * POINTS)


def test_choice_suggests_what_was_meant() -> None:
    assert as_choice("structure", "joint", ["joint", "eliminated"]) == "joint"
    with pytest.raises(ArgumentError, match=r"structure is 'Elimnated'.*mean 'eliminated'"):
        as_choice("structure", "Elimnated", ["joint", "eliminated"])
    with pytest.raises(ArgumentError, match=r"is 3; needed: one of 'joint', 'eliminated'$"):
        as_choice("structure", 3, ["joint", "eliminated"])


@pytest.mark.parametrize(
    ("F0", "words"),
    [
        (np.eye(4), r"shape \(4, 4\)"),
        (np.zeros((3, 3)), "zero matrix"),
        (np.diag([1, np.nan, 1]), r"nan at \[1, 1\]"),
        (np.eye(3) * 1j, "complex"),
        ("F", "type <U1"),
        (None, "type object"),
    ],
)
def test_unusable_fundamental_matrix_is_refused(F0, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        as_fundamental(F0)


def test_fundamental_matrix_keeps_its_values() -> None:
    F = [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    np.testing.assert_array_equal(as_fundamental(F), np.array(F, dtype=float))


@pytest.mark.parametrize("good", [1, 0.5, np.float32(2), np.int8(3), np.array(4.0)])
def test_positive_numbers_pass(good) -> None:
    assert as_positive("noise_px", good) == float(good)


@pytest.mark.parametrize("bad", [0, -1, np.nan, np.inf, "1", None, True, 1j, [1.0], 10**400])
def test_other_numbers_are_refused(bad) -> None:
    with pytest.raises(ArgumentError, match=r"noise_px is .*needed: a finite number > 0"):
        as_positive("noise_px", bad)


def test_zero_passes_where_it_is_allowed() -> None:
    assert as_positive("ftol", 0, zero=True) == 0.0
    with pytest.raises(ArgumentError, match=r"ftol is -0\.5; needed: a finite number >= 0"):
        as_positive("ftol", -0.5, zero=True)


def test_counts() -> None:
    assert as_count("max_iter", np.int64(3)) == 3
    assert as_count("max_iter", 0, at_least=0) == 0
    for bad in (0, 1.0, True, np.True_, "3", None):
        with pytest.raises(ArgumentError, match=r"max_iter is .*needed: an integer >= 1"):
            as_count("max_iter", bad)


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        (np.ones(3), r"shape \(3,\).*one weight a match"),
        (np.ones((4, 1)), r"shape \(4, 1\)"),
        ([1, -1, 1, 1], r"has -1\.0 in row 1"),
        ([1, 1, np.nan, 1], "has nan in row 2"),
        ([1, 1, 1, np.inf], "has inf in row 3"),
        (np.zeros(4), "zero for every match"),
        (["a"] * 4, "type <U1"),
    ],
)
def test_unusable_weights_are_refused(weights, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        as_weights(weights, 4)


def test_weights_keep_their_values() -> None:
    np.testing.assert_array_equal(as_weights([0, 1, 2], 3), [0.0, 1.0, 2.0])


def test_weights_are_contiguous() -> None:
    for values in (np.arange(6.0)[::2], np.arange(3.0)[::-1], np.ones((3, 2))[:, 1]):
        w = as_weights(values, 3)
        np.testing.assert_array_equal(w, values)
        assert w.flags.c_contiguous


@given(st.text(max_size=200) | st.binary(max_size=50) | st.lists(st.integers()) | st.none())
def test_any_value_is_refused_with_a_short_message(value) -> None:
    for check in (as_positive, as_count):
        with pytest.raises(ArgumentError) as caught:
            check("name", value)
        assert len(str(caught.value)) < 120


@pytest.mark.parametrize(
    "error",
    [
        ArgumentError("x1", "is odd", "even"),
        FileFormatError("a.csv", "bad number", 3),
        BackendError("c", "is not built", "install a compiler"),
        MissingPackageError("matplotlib", "plot"),
    ],
)
def test_errors_survive_pickling(error) -> None:
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - its own bytes
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)
    assert isinstance(error, EpigaugeError)
    assert isinstance(error, ValueError)
