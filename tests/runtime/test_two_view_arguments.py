"""Bad input is refused by an error that names the argument, what it was and what is needed."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.errors import ArgumentError, BackendError, EpigaugeError
from epigauge.scenes import two_view_scene

VIEW = two_view_scene(5.0, seed=1)
X1, X2, F = VIEW.x1, VIEW.x2, VIEW.F_true


def changed(x: np.ndarray, row: int, value: float) -> np.ndarray:
    x = x.copy()
    x[row, 1] = value
    return x


LINE = np.column_stack([np.arange(50.0), 3 * np.arange(50.0) - 7])
SAME = np.full((50, 2), 17.25)
RANK_ONE = np.outer([1.0, 2.0, 3.0], [0.5, -1.0, 4.0])

#: Arguments that differ from good ones, the name of the argument at fault, a part of the message.
BAD_MATCHES = {
    "seven": ({"x1": X1[:7], "x2": X2[:7]}, "x1, x2", "7 matches"),
    "one": ({"x1": X1[:1], "x2": X2[:1]}, "x1, x2", "1 match;"),
    "none": ({"x1": X1[:0], "x2": X2[:0]}, "x1, x2", "0 matches"),
    "empty list": ({"x1": [], "x2": []}, "x1", "shape (0,)"),
    "unequal lengths": ({"x2": X2[:40]}, "x2", "40 points but x1 has 50"),
    "NaN": ({"x1": changed(X1, 11, np.nan)}, "x1", "row 11"),
    "infinity": ({"x2": changed(X2, 49, -np.inf)}, "x2", "row 49"),
    "homogeneous": ({"x1": np.column_stack([X1, np.ones(50)])}, "x1", "shape (50, 3)"),
    "transposed": ({"x1": X1.T}, "x1", "transpose"),
    "flat": ({"x2": X2.ravel()}, "x2", "shape (100,)"),
    "ragged": ({"x1": [[1, 2], [3]]}, "x1", "regular"),
    "strings": ({"x1": X1.astype(str)}, "x1", "type"),
    "complex": ({"x2": X2 + 0j}, "x2", "complex128"),
    "booleans": ({"x1": X1 > 0}, "x1", "bool"),
    "None": ({"x1": None}, "x1", "object"),
    "all equal": ({"x1": SAME}, "x1", "equal"),
    "all equal in image 2": ({"x2": SAME}, "x2", "image 2 equal"),
    "on one line": ({"x1": LINE}, "x1", "one line"),
    "on one line in image 2": ({"x2": LINE[:, ::-1]}, "x2", "image 2 on one line"),
    "on one line far away": ({"x1": LINE + 1e6}, "x1", "one line"),
}

BAD_OPTIONS = {
    "F0 flat": ({"F0": F.ravel()}, "F0", "shape (9,)"),
    "F0 of another shape": ({"F0": np.eye(4)}, "F0", "shape (4, 4)"),
    "F0 zero": ({"F0": np.zeros((3, 3))}, "F0", "zero"),
    "F0 of rank one": ({"F0": RANK_ONE}, "F0", "rank 1"),
    "F0 of rank one, scaled": ({"F0": -1e6 * RANK_ONE}, "F0", "rank 1"),
    "F0 with NaN": ({"F0": np.where(np.eye(3), np.nan, F)}, "F0", "[0, 0]"),
    "F0 with infinity": ({"F0": np.where(np.eye(3), F, np.inf)}, "F0", "[0, 1]"),
    "F0 string": ({"F0": "8point"}, "F0", "type"),
    "weights negative": ({"weights": changed(np.ones((50, 2)), 3, -1.0)[:, 1]}, "weights", "row 3"),
    "weights NaN": ({"weights": changed(np.ones((50, 2)), 4, np.nan)[:, 1]}, "weights", "row 4"),
    "weights infinite": (
        {"weights": changed(np.ones((50, 2)), 5, np.inf)[:, 1]},
        "weights",
        "row 5",
    ),
    "weights too few": ({"weights": np.ones(49)}, "weights", "(49,)"),
    "weights as a column": ({"weights": np.ones((50, 1))}, "weights", "(50, 1)"),
    "weights zero": ({"weights": np.zeros(50)}, "weights", "zero"),
    "weights leave seven": ({"weights": np.arange(50) < 7}, "weights", "bool"),
    "weights leave seven matches": (
        {"weights": (np.arange(50) < 7) * 1.0},
        "weights",
        "fewer than 8",
    ),
    "noise zero": ({"noise_px": 0}, "noise_px", "is 0.0"),
    "noise negative": ({"noise_px": -1.0}, "noise_px", "-1.0"),
    "noise NaN": ({"noise_px": np.nan}, "noise_px", "nan"),
    "noise infinite": ({"noise_px": np.inf}, "noise_px", "inf"),
    "noise string": ({"noise_px": "auto"}, "noise_px", "'auto'"),
    "ftol one": ({"ftol": 1.0}, "ftol", "1.0"),
    "ftol negative": ({"ftol": -1e-10}, "ftol", "-1e-10"),
    "xtol NaN": ({"xtol": np.nan}, "xtol", "nan"),
    "gtol string": ({"gtol": "small"}, "gtol", "'small'"),
    "max_iter zero": ({"max_iter": 0}, "max_iter", "is 0"),
    "max_iter a half": ({"max_iter": 0.5}, "max_iter", "0.5"),
}

#: Names of options: a typical slip, and what the message proposes.
SLIPS = {
    "parameterization": ("orto", "'ortho'"),
    "criterion": ("reprojecton", "'reprojection'"),
    "structure": ("Eliminated", "'eliminated'"),
    "damping": ("levenburg", "'levenberg'"),
    "hessian": ("gauss_newton", "'gauss-newton'"),
    "backend": ("nump", "'numpy'"),
}


def refuse(call, argument: str, part: str) -> ArgumentError:
    with pytest.raises(ArgumentError) as caught:
        call()
    error = caught.value
    assert isinstance(error, ValueError)
    assert error.argument == argument
    assert str(error).startswith(argument)
    assert part in str(error)
    assert error.needed
    assert len(str(error)) < 300
    return error


@pytest.mark.parametrize("case", BAD_MATCHES)
@pytest.mark.parametrize("function", [eg.refine_fundamental, eg.fundamental_8point])
def test_matches_that_cannot_be_used(function, case) -> None:
    bad, argument, part = BAD_MATCHES[case]
    refuse(lambda: function(**{"x1": X1, "x2": X2} | bad), argument, part)


@pytest.mark.parametrize("case", BAD_OPTIONS)
@pytest.mark.parametrize("structure", ["eliminated", "joint"])
def test_options_that_cannot_be_used(structure, case) -> None:
    bad, argument, part = BAD_OPTIONS[case]
    refuse(lambda: eg.refine_fundamental(X1, X2, structure=structure, **bad), argument, part)


@pytest.mark.parametrize("option", SLIPS)
def test_unknown_names_are_refused_with_what_may_have_been_meant(option) -> None:
    slip, meant = SLIPS[option]
    error = refuse(lambda: eg.refine_fundamental(X1, X2, **{option: slip}), option, repr(slip))
    assert f"did you mean {meant}" in str(error)


@pytest.mark.parametrize("option", SLIPS)
@pytest.mark.parametrize("value", ["", "nothing like it", 3, None, ["ortho"], b"ortho", True])
def test_values_that_are_no_name_are_refused(option, value) -> None:
    if option == "backend" and value is None:  # the active one
        eg.refine_fundamental(X1, X2, backend=None)
        return
    refuse(lambda: eg.refine_fundamental(X1, X2, **{option: value}), option, repr(value)[:10])


def test_every_allowed_name_is_listed() -> None:
    error = refuse(lambda: eg.refine_fundamental(X1, X2, structure="x"), "structure", "'x'")
    assert "'eliminated'" in error.needed
    assert "'joint'" in error.needed


def test_unknown_option_is_no_option() -> None:
    with pytest.raises(TypeError, match="dampingg"):
        eg.refine_fundamental(X1, X2, dampingg="levenberg")


def test_options_are_given_by_name() -> None:
    with pytest.raises(TypeError):
        eg.refine_fundamental(X1, X2, F, "ortho")


@pytest.mark.parametrize("weights", [(np.arange(50) == 0) * 1.0, (np.arange(50) < 2) * 2.0])
def test_matches_that_count_must_not_be_on_one_line(weights) -> None:
    # With a start value fewer than eight matches may count, but not on one line.
    with pytest.raises(ArgumentError) as caught:
        eg.refine_fundamental(X1, X2, F, weights=weights)
    assert caught.value.argument in ("x1", "weights")


def test_start_value_allows_fewer_than_eight_matches_of_weight() -> None:
    w = (np.arange(50) < 7) * 1.0
    result = eg.refine_fundamental(X1, X2, F, weights=w)
    assert result.status > 0
    d, _, _ = eg.reprojection_distances(F, X1, X2)
    assert result.cost < 0.1 * 0.5 * np.sum(w * d**2)


@pytest.mark.parametrize(
    "options",
    [{}, {"loss": "huber"}, {"parameterization": "block"}, {"structure": "joint"}, {"starts": 2}],
    ids=str,
)
def test_weights_may_lie_anywhere_in_memory(options) -> None:
    w = np.random.default_rng(0).uniform(0.1, 5.0, (50, 3))
    for weights in (w[:, 1], w[::-1, 2]):
        strided = eg.refine_fundamental(X1, X2, weights=weights, **options)
        packed = eg.refine_fundamental(X1, X2, weights=weights.copy(), **options)
        assert strided.cost == packed.cost
        np.testing.assert_array_equal(strided.F, packed.F)


class TestGeometry:
    @pytest.mark.parametrize("function", [eg.reprojection_distances, eg.sampson_distances])
    @pytest.mark.parametrize(
        "case",
        [k for k in BAD_MATCHES if BAD_MATCHES[k][2][:3] in ("40 ", "row", "sha", "tra", "typ")],
    )
    def test_distances_check_their_matches(self, function, case) -> None:
        bad, argument, part = BAD_MATCHES[case]
        refuse(lambda: function(F, **{"x1": X1, "x2": X2} | bad), argument, part)

    @pytest.mark.parametrize(
        "function",
        [
            eg.canonical_cameras,
            lambda bad: eg.reprojection_distances(bad, X1, X2),
            lambda bad: eg.sampson_distances(bad, X1, X2),
        ],
    )
    @pytest.mark.parametrize(
        ("bad", "part"),
        [
            (np.zeros((3, 3)), "zero"),
            (RANK_ONE, "rank 1"),
            (1e-9 * RANK_ONE, "rank 1"),
            (np.eye(2), "shape (2, 2)"),
            (np.full((3, 3), np.nan), "nan"),
            ("F", "type"),
            (np.stack([F, F]), "shape (2, 3, 3)"),
        ],
    )
    def test_fundamental_matrix_must_be_one(self, function, bad, part) -> None:
        refuse(lambda: function(bad), "F", part)

    @pytest.mark.parametrize(
        ("P", "part"),
        [
            (VIEW.P1, "shape (3, 4)"),
            ([VIEW.P1], "shape (1, 3, 4)"),
            (np.zeros((2, 4, 3)), "shape (2, 4, 3)"),
        ],
    )
    def test_triangulation_needs_two_cameras(self, P, part) -> None:
        refuse(lambda: eg.triangulate(P, [X1, X2]), "P", part)

    @pytest.mark.parametrize("x", [X1, [X1], [X1, X2, X1], np.zeros(2)])
    def test_triangulation_needs_two_images(self, x) -> None:
        refuse(lambda: eg.triangulate([VIEW.P1, VIEW.P2], x), "x", "shape")

    def test_triangulation_refuses_what_is_not_finite(self) -> None:
        P2 = VIEW.P2.copy()
        P2[0, 0] = np.nan
        refuse(lambda: eg.triangulate([VIEW.P1, P2], [X1, X2]), "P", "finite")
        with pytest.raises(ArgumentError, match="row 2"):
            eg.triangulate([VIEW.P1, VIEW.P2], [changed(X1, 2, np.inf), X2])


class TestBackends:
    @pytest.fixture
    def nothing_built(self, monkeypatch) -> None:
        """An installation without the C library and without CasADi."""

        def missing() -> None:
            raise BackendError("c", "was not built", "install a C compiler")

        monkeypatch.setattr(kernels, "library", missing)
        without = SimpleNamespace(
            import_module=importlib.import_module,
            util=SimpleNamespace(find_spec=lambda name: None),
        )
        monkeypatch.setattr(kernels, "importlib", without)

    @pytest.mark.parametrize("name", ["c", "casadi"])
    def test_absent_backend_is_refused_with_a_remedy(self, nothing_built, name) -> None:
        with pytest.raises(BackendError) as caught:
            eg.refine_fundamental(X1, X2, backend=name)
        assert isinstance(caught.value, EpigaugeError)
        assert isinstance(caught.value, ValueError)
        assert caught.value.name == name
        assert "install" in str(caught.value)
        assert repr(name) in str(caught.value)

    def test_numpy_remains(self, nothing_built, monkeypatch) -> None:
        monkeypatch.setattr(kernels, "_active", None)
        assert eg.backend() == "numpy"
        assert eg.refine_fundamental(X1, X2).success

    def test_choice_holds_for_later_calls_and_argument_goes_before_it(self, monkeypatch) -> None:
        monkeypatch.setattr(kernels, "_active", None)
        eg.set_backend("numpy")
        assert eg.backend() == "numpy"
        with pytest.raises(ArgumentError):
            eg.set_backend("fortran")
        assert eg.backend() == "numpy"  # a refused choice changes nothing
