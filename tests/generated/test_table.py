"""The table of kernels: which back ends there are, what it accepts, and what it refuses."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
from epigauge import _library, kernels
from epigauge._library import C_DIGEST
from epigauge.errors import ArgumentError, BackendError
from epigauge.kernels import SIGNATURES

Q, P = np.array([1.0, 2.0, 3.0, 0.5]), np.arange(12.0).reshape(3, 4) ** 1.5
F, X = np.arange(9.0).reshape(3, 3), np.array([[0.5], [-1.0]])


def test_every_kernel_is_in_every_table(table):
    for name in SIGNATURES:
        assert callable(getattr(table, name))


def test_unknown_kernel_is_an_error_that_lists_the_known(table):
    with pytest.raises(AttributeError, match=r"no kernel is named 'projekt'.*project"):
        _ = table.projekt


def test_unknown_backend_is_an_error_that_lists_the_known():
    with pytest.raises(ArgumentError, match="fortran") as error:
        kernels.table("fortran")
    assert all(name in str(error.value) for name in kernels.NAMES)


def test_arrays_of_other_types_and_layouts_are_accepted(table):
    expected = table.project(P, Q)
    assert not any(np.isnan(output).any() for output in expected)
    wide = np.zeros((6, 8))
    wide[::2, ::2] = P
    backwards = Q[::-1].copy()[::-1]
    for camera, point in (
        (P.tolist(), Q.tolist()),
        (np.asfortranarray(P), Q.astype(object)),
        (wide[::2, ::2], backwards),
    ):
        for a, e in zip(table.project(camera, point), expected, strict=True):
            np.testing.assert_array_equal(a, e)
    whole = table.project(np.round(P).astype(int), np.float32(Q))
    for a, e in zip(whole, table.project(np.round(P), Q), strict=True):
        np.testing.assert_array_equal(a, e)


def test_inputs_are_left_untouched(table):
    camera, points = P.copy(), np.tile(Q[:, None], 3)
    camera.flags.writeable = points.flags.writeable = False
    table.project(camera, points)
    np.testing.assert_array_equal(camera, P)


def test_results_are_new_arrays(table):
    first = table.project(P, Q)
    kept = [output.copy() for output in first]
    table.project(P, Q[::-1])
    for a, e in zip(first, kept, strict=True):
        np.testing.assert_array_equal(a, e)


def test_one_output_comes_alone_and_several_as_a_tuple(table):
    assert table.rotation(np.zeros(3)).shape == (3, 3)
    assert [output.shape for output in table.project(P, Q)] == [(2,), (2, 12), (2, 4), ()]


@pytest.mark.parametrize("arguments", [(), (P,), (P, Q, Q)])
def test_wrong_number_of_inputs_is_an_error_that_names_them(table, arguments):
    with pytest.raises(TypeError, match="needed: P, Q"):
        table.project(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((P[:2], Q), r"P has shape \(2, 4\), needed: \(3, 4\)"),
        ((P, Q[:3]), r"Q has shape \(3,\), needed: \(4,\)"),
        ((P, 1.0), r"Q has shape \(\), needed: \(4,\)"),
    ],
)
def test_wrong_shape_is_an_error_that_names_the_argument(table, arguments, message):
    with pytest.raises(TypeError, match=message):
        table.project(*arguments)


def test_batched_value_of_a_shared_argument_is_an_error(table):
    with pytest.raises(TypeError, match=r"F has shape \(3, 3, 1\)"):
        table.sampson(F[:, :, None], X, X)


def test_batch_axes_that_do_not_broadcast_are_an_error(table):
    with pytest.raises(ValueError, match="broadcast"):
        table.project(P, np.ones((4, 3))) and table.sampson(F, np.ones((2, 3)), np.ones((2, 4)))


@pytest.mark.parametrize("batch", [(), (2, 2)])
def test_sum_needs_one_batch_axis(table, batch):
    point = np.ones((2, *batch))
    frame = kernels.table("numpy").bilinear_frame(F)
    with pytest.raises(TypeError, match="exactly one batch axis"):
        table.reprojection_gauss_newton(*frame, point, point, np.ones(batch), np.ones(batch))


def test_numpy_is_always_there_and_a_missing_backend_has_a_reason():
    reasons = kernels.available()
    assert tuple(reasons) == kernels.NAMES
    assert reasons["numpy"] is None
    assert all(reason is None or len(reason) > 10 for reason in reasons.values())


@pytest.mark.parametrize("name", kernels.NAMES)
def test_missing_backend_is_an_error_with_a_remedy(name):
    if kernels.available()[name] is None:
        pytest.skip(f"back end {name} is there")
    with pytest.raises(BackendError) as error:
        kernels.table(name)
    assert error.value.reason
    assert "install" in error.value.remedy
    assert error.value.remedy in str(error.value)


def test_default_backend_is_c_where_the_library_is_there(monkeypatch):
    monkeypatch.setattr(kernels, "_active", None)
    expected = "c" if kernels.available()["c"] is None else "numpy"
    assert kernels.backend() == expected
    assert kernels.table().name == expected


def test_backend_can_be_chosen_and_a_refused_choice_changes_nothing(monkeypatch):
    monkeypatch.setattr(kernels, "_active", None)
    kernels.set_backend("numpy")
    assert kernels.table().name == kernels.backend() == "numpy"
    with pytest.raises(ArgumentError):
        kernels.set_backend("fortran")
    assert kernels.backend() == "numpy"


def loader():
    """Return the loader of the C library without its cache."""
    return _library._choose.__wrapped__


@pytest.fixture
def built():
    if kernels.available()["c"] is not None:
        pytest.skip(f"back end c {kernels.available()['c']}")


@pytest.mark.usefixtures("built")
def test_library_carries_the_digest_of_the_formulas():
    assert loader()()[1].eg_digest() == C_DIGEST.encode()


@pytest.mark.usefixtures("built")
def test_library_of_other_formulas_is_refused_with_a_remedy(monkeypatch):
    monkeypatch.setattr(_library, "C_DIGEST", "0123456789abcdef")
    with pytest.raises(BackendError, match="other formulas") as error:
        loader()()
    assert "install" in error.value.remedy


@pytest.mark.usefixtures("built")
def test_library_of_other_sources_is_refused_with_a_remedy(monkeypatch, tmp_path):
    """In a checkout a changed loop of runtime/c is noticed like a changed formula."""
    if _library._sources() is not None:
        assert loader()()[1].eg_sources() == _library._sources().encode()
    for folder in ("runtime/c", "generated/c", "runtime/epigauge"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "CMakeLists.txt").touch()
    (tmp_path / "runtime/c/loop.c").write_text("int changed;")
    monkeypatch.setattr(_library, "__file__", str(tmp_path / "runtime/epigauge/_library.py"))
    monkeypatch.setattr(_library, "_sources", _library._sources.__wrapped__)
    with pytest.raises(BackendError, match="other C sources") as error:
        loader()()
    assert "install" in error.value.remedy


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("name", _library.LEVELS.values())
def test_variant_can_be_chosen_and_one_that_cannot_run_is_refused(monkeypatch, name):
    monkeypatch.setenv("EPIGAUGE_PROCESSOR", name)
    if name in _library.usable():
        assert loader()()[0] == name
    else:
        with pytest.raises(ArgumentError, match="EPIGAUGE_PROCESSOR"):
            loader()()


@pytest.mark.usefixtures("built")
def test_unknown_variant_is_refused(monkeypatch):
    monkeypatch.setenv("EPIGAUGE_PROCESSOR", "x86-64-v9")
    with pytest.raises(ArgumentError, match="baseline"):
        loader()()


@pytest.mark.usefixtures("built")
def test_variants_round_arithmetic_alike():
    """Sums over observations aside, every variant gives the same bits."""
    rng = np.random.default_rng(5)
    n = 101
    P, Q = rng.standard_normal((3, 4, n)), rng.standard_normal((4, n))
    results = []
    _, levels = _library._usable(_library._files())
    for level in levels.values():
        library = _library._loaded(_library._files()[_library._suffix(level)])
        outputs = np.empty((2, n)), np.empty((2, 12, n)), np.empty((2, 4, n)), np.empty(n)
        library.eg_project(
            ctypes.c_ssize_t(n), *(ctypes.c_void_p(a.ctypes.data) for a in (P, Q, *outputs))
        )
        results.append(outputs)
    for outputs in results[1:]:
        for a, b in zip(outputs, results[0], strict=True):
            np.testing.assert_array_equal(a, b)


def test_install_without_library_is_refused_with_a_remedy(monkeypatch, tmp_path):
    (tmp_path / "__init__.py").write_text("")
    monkeypatch.setattr(_library.resources, "files", lambda package: tmp_path)
    with pytest.raises(BackendError, match="not built") as error:
        loader()()
    assert "compiler" in error.value.remedy
