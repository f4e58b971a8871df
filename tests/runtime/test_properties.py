"""Public functions and their arrays: types and memory layout do not count, only the numbers do.

A public function without a row in `ROWS`, or a reason in `NO_ARRAYS` why it has none, fails.
"""

from __future__ import annotations

import copy
import dataclasses
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import EpigaugeError
from epigauge.kernels import available

PAIR = eg.two_view_scene(distance=4.0, noise_px=0.0, n_points=30, seed=3)
MANY = eg.multi_view_scene(n_views=4, n_points=20, noise_px=0.0, distance=4.0, seed=4)


def pixels(x: np.ndarray) -> np.ndarray:
    """Return whole pixels, which every type from half precision on holds exactly."""
    return np.round(x) + 600.0


def short(x: np.ndarray) -> np.ndarray:
    """Return numbers that single precision holds exactly."""
    return np.asarray(x, np.float32).astype(np.float64)


def checked(shift: int) -> np.ndarray:
    """Return a grey image of squares of random grey, moved by `shift` pixels."""
    coarse = np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8)
    return np.roll(np.kron(coarse, np.ones((8, 8), np.uint8)), shift, axis=1)


X1, X2 = pixels(PAIR.x1), pixels(PAIR.x2)
F = short(eg.refine_fundamental(X1, X2).F)
VIEW, POINT, XY = MANY.tracks.view.copy(), MANY.tracks.point.copy(), pixels(MANY.tracks.xy)
START = eg.initialize(eg.Tracks(VIEW, POINT, XY))
P, Q = short(START.P), short(START.Q)
K = np.array([[1000.0, 0.0, 600.0], [0.0, 1000.0, 600.0], [0.0, 0.0, 1.0]])
#: X1 through a homography: matches in a plane.
H = np.array([[1.0, 0.125, 8.0], [-0.0625, 1.0, 4.0], [0.0, 0.0, 1.0]])
PLANE = {"x1": (X1, "px"), "x2": (np.round(X1 @ H[:2, :2].T + H[:2, 2]), "px")}
LINES = eg.line_scene(n_views=4, n_points=10, n_lines=6)


@dataclass(frozen=True)
class Row:
    """How a function is called, with which arrays.

    Parameters
    ----------
    call : callable
        Takes the arrays as keyword arguments.
    arrays : dict
        Each array with its kind: "px" holds whole pixels or other small integers >= 0 as float,
        "real" numbers of single precision, "index" integers, "image" grey values.
    needs : str
        A package that must be there.
    """

    call: Callable[..., Any]
    arrays: dict[str, tuple[np.ndarray, str]]
    needs: str = ""


def from_start(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Return a function of the arrays of tracks and of a reconstruction."""

    def call(view: Any, point: Any, xy: Any, P: Any, Q: Any) -> Any:
        return function(eg.Tracks(view, point, xy), start=eg.Reconstruction(P, Q), **options)

    return call


def covariance(tracks: eg.Tracks, start: eg.Reconstruction) -> Any:
    found = eg.covariance(tracks, start, noise_px=1.0)
    return found.cameras, found.points, found.projections


def triangulate_lines(view: Any, line: Any, segments: Any) -> Any:
    return eg.triangulate_lines(eg.LineTracks(view, line, segments), LINES.true)


def transform(P: Any, Q: Any, T: Any, camera_scales: Any, point_scales: Any) -> Any:
    return eg.gauge.transform(eg.Reconstruction(P, Q), T, camera_scales, point_scales)


_MATCHES = {"x1": (X1, "px"), "x2": (X2, "px")}
_F = {"F": (F, "real")}
_TRACKS = {"view": (VIEW, "index"), "point": (POINT, "index"), "xy": (XY, "px")}
_START = {"P": (P, "real"), "Q": (Q, "real")}
_WEIGHTS = {"weights": (np.arange(1.0, 31.0), "px")}
_COVARIANCE = np.tile([[2.0, 0.5], [0.5, 1.0]], (30, 1, 1))

ROWS = {
    "Reconstruction": Row(eg.Reconstruction, _START),
    "Tracks": Row(eg.Tracks, _TRACKS | {"weights": (np.arange(1.0, 81.0), "px")}),
    "Tracks.pruned": Row(eg.Tracks.pruned, _TRACKS),
    "bundle_adjust": Row(from_start(eg.bundle_adjust), _TRACKS | _START),
    "canonical_cameras": Row(eg.canonical_cameras, _F),
    "compare": Row(from_start(eg.compare, methods=["covariant", "free"]), _TRACKS | _START),
    "covariance": Row(from_start(covariance), _TRACKS | _START),
    "estimate_essential": Row(eg.estimate_essential, _MATCHES | {"K1": (K, "px"), "K2": (K, "px")}),
    "estimate_fundamental": Row(eg.estimate_fundamental, _MATCHES),
    "estimate_fundamental_batch": Row(
        eg.estimate_fundamental_batch,
        _MATCHES | _WEIGHTS | {"offsets": (np.array([0, 30]), "index")},
    ),
    "estimate_homography": Row(eg.estimate_homography, PLANE),
    "estimate_two_view": Row(eg.estimate_two_view, PLANE | {"K1": (K, "px"), "K2": (K, "px")}),
    "fundamental_7point": Row(eg.fundamental_7point, {"x1": (X1[:7], "px"), "x2": (X2[:7], "px")}),
    "fundamental_8point": Row(eg.fundamental_8point, _MATCHES),
    "gauge.equivalent": Row(lambda **k: eg.gauge.equivalent(eg.Reconstruction(**k), START), _START),
    "gauge.transform": Row(
        transform,
        _START
        | {
            "T": (np.eye(4) + np.diag([1.0, 0.0, 2.0], 1), "px"),
            "camera_scales": (np.arange(1.0, 5.0), "px"),
            "point_scales": (np.arange(1.0, 21.0), "px"),
        },
    ),
    "focal_lengths": Row(
        eg.focal_lengths,
        _F | {"centre1": (np.array([4.0, 3.0]), "px"), "centre2": (np.array([5.0, 2.0]), "px")},
    ),
    "initialize_affine": Row(lambda **k: eg.initialize_affine(eg.Tracks(**k)), _TRACKS),
    "initialize": Row(lambda **k: eg.initialize(eg.Tracks(**k)), _TRACKS),
    "interop.from_colmap": Row(
        eg.interop.from_colmap,
        {
            "keypoints1": (X1, "px"),
            "keypoints2": (X2, "px"),
            "matches": (np.arange(60).reshape(30, 2) % 29 + 1, "index"),
        },
    ),
    "interop.move_fundamental": Row(
        lambda F: eg.interop.move_fundamental(F, "opencv", "colmap"), _F
    ),
    "interop.move_points": Row(
        lambda x: eg.interop.move_points(x, "opencv", "colmap"), {"x": (X1, "px")}
    ),
    "interop.to_colmap": Row(eg.interop.to_colmap, _MATCHES),
    "match_images": Row(
        lambda **k: eg.match_images(*k.values(), detector="orb"),
        {"image1": (checked(0), "image"), "image2": (checked(5), "image")},
        "cv2",
    ),
    "refine_fundamental": Row(eg.refine_fundamental, _MATCHES | _WEIGHTS | {"F0": (F, "real")}),
    "refine_fundamental, covariances": Row(
        eg.refine_fundamental, _MATCHES | {f"covariance{i}": (_COVARIANCE, "real") for i in (1, 2)}
    ),
    "refine_fundamental, essential": Row(
        lambda **k: eg.refine_fundamental(essential=True, **k),
        _MATCHES | {"K1": (K, "px"), "K2": (K, "px")},
    ),
    "refine_homography": Row(eg.refine_homography, PLANE | _WEIGHTS | {"H0": (H, "real")}),
    "refine_fundamental_batch": Row(
        eg.refine_fundamental_batch,
        {
            "x1": (np.vstack([X1, X1]), "px"),
            "x2": (np.vstack([X2, X2]), "px"),
            "offsets": (np.array([0, 30, 60]), "index"),
            "F0": (np.stack([F, F]), "real"),
            "weights": (np.arange(1.0, 61.0), "px"),
        },
    ),
    "reprojection_distances": Row(eg.reprojection_distances, _F | _MATCHES),
    "sampson_distances": Row(eg.sampson_distances, _F | _MATCHES),
    "triangulate_lines": Row(
        triangulate_lines,
        {
            "view": (LINES.line_tracks.view.copy(), "index"),
            "line": (LINES.line_tracks.line.copy(), "index"),
            "segments": (short(LINES.line_tracks.segments), "real"),
        },
    ),
    "triangulate": Row(eg.triangulate, {"P": (P[:2], "real"), "x": (np.stack([X1, X2]), "px")}),
}

NO_ARRAYS = {
    "Matches": "holds what it is given",
    **dict.fromkeys(("backend", "set_backend"), "takes a name"),
    **dict.fromkeys(("load_image", "load_matches"), "reads a file"),
    **dict.fromkeys(("load_line_tracks", "load_reconstruction", "load_tracks"), "reads a file"),
    **dict.fromkeys(("load_result", "load_scene"), "reads a file"),
    **dict.fromkeys(("save_matches", "save_reconstruction"), "writes what has been checked"),
    **dict.fromkeys(
        ("save_line_tracks", "save_result", "save_tracks"), "writes what has been checked"
    ),
    **dict.fromkeys(("build_tracks", "match_photographs"), "takes files or what they hold"),
    "metric_upgrade": "takes tracks, which have a row; its sizes are tested with it",
    "save_scene": "writes what has been checked",
    "gauge.group": "takes a name",
    "gauge.similarity": "refused forms are tested with the scenes that it moves",
    **dict.fromkeys(("line_scene", "multi_view_scene", "two_view_scene"), "takes numbers"),
    **dict.fromkeys(("interop.bal_to_colmap", "interop.colmap_to_bal"), "takes a reconstruction"),
    "interop.from_opencv": "takes objects of OpenCV",
    "interop.from_poselib": "takes objects of PoseLib",
    "interop.from_two_view_geometry": "takes objects of pycolmap",
    "interop.to_opencv": "makes objects of OpenCV",
    "interop.to_poselib": "makes objects of PoseLib",
    "interop.to_two_view_geometry": "makes objects of pycolmap",
}
_CHECKED_CLASSES = ("Matches", "Reconstruction", "Tracks")


def test_every_public_function_has_a_row_or_a_reason() -> None:
    public = {
        *(name for name in eg.__all__ if isinstance(getattr(eg, name), types.FunctionType)),
        *(
            f"{name}.{function}"
            for name in ("gauge", "interop")
            for function in getattr(eg, name).__all__
            if isinstance(getattr(getattr(eg, name), function), types.FunctionType)
        ),
        *_CHECKED_CLASSES,
    }
    covered = {name.partition(",")[0] for name in ROWS} | set(NO_ARRAYS)
    assert public == covered - {"Tracks.pruned"}
    assert not set(ROWS) & set(NO_ARRAYS)


# Forms of the same numbers


def strided(a: np.ndarray) -> np.ndarray:
    """Return every other element, along each axis, of a larger array."""
    wide = np.zeros([2 * side for side in a.shape], a.dtype)
    view = wide[tuple(slice(None, None, 2) for _ in a.shape)]
    view[...] = a
    return view


def backward(a: np.ndarray) -> np.ndarray:
    """Return an array that is stored from its end to its beginning."""
    flip = tuple(slice(None, None, -1) for _ in a.shape)
    return a[flip].copy()[flip]


def unaligned(a: np.ndarray) -> np.ndarray:
    """Return an array whose numbers begin at odd addresses."""
    raw = np.zeros(a.nbytes + 1, np.uint8)[1:].view(np.uint8)
    view = np.frombuffer(raw.data, a.dtype).reshape(a.shape)
    view.setflags(write=True)
    view[...] = a
    return view


def frozen(a: np.ndarray) -> np.ndarray:
    a = a.copy()
    a.setflags(write=False)
    return a


LAYOUTS: dict[str, Callable[[np.ndarray], Any]] = {
    "Fortran order": np.asfortranarray,
    "every other element": strided,
    "negative strides": backward,
    "odd addresses": unaligned,
    "read-only": frozen,
    "broadcast": lambda a: np.broadcast_to(a, (3, *a.shape))[1],
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "subclass": lambda a: a.view(np.ma.MaskedArray),
    "lists": np.ndarray.tolist,
}
#: Types by the kinds of arrays that they hold exactly.
TYPES = {
    "index": (np.uint8, np.int16, np.uint32, np.int64, np.uint64),
    "px": (np.float16, np.float32, np.longdouble, np.int16, np.uint16, np.int32, np.uint64),
    "real": (np.float32, np.longdouble),
    "image": (),
}


def in_type(a: np.ndarray, kind: str, number: int) -> np.ndarray:
    """Return the array in one of the types of its kind, or as it is."""
    return a.astype(TYPES[kind][number % len(TYPES[kind])]) if TYPES[kind] else a


FORMS: dict[str, Callable[[np.ndarray, str], Any]] = {
    **{name: lambda a, _, layout=layout: layout(a) for name, layout in LAYOUTS.items()},
    **{f"types {n}": lambda a, kind, n=n: in_type(a, kind, n) for n in range(len(TYPES["px"]))},
}


def numbers(value: Any) -> Iterator[Any]:
    """Yield what a result holds, all the way down, except for seconds."""
    if isinstance(value, eg.Tracks):
        value = [value.view, value.point, value.xy, value.weights, value.order]
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name != "seconds" and not field.name.startswith("_"):
                yield from numbers(getattr(value, field.name))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, dict):
        yield from numbers(list(value.values()))
    elif value is not None:
        yield value


def equal(a: Any, b: Any) -> bool:
    """Tell whether two arrays hold the same; NaN is the same as NaN."""
    return bool(np.all((np.asarray(a) == np.asarray(b)) | (np.asarray(a) != np.asarray(a))))


def called(name: str, form: Callable[[np.ndarray, str], Any], only: str | None = None) -> list[Any]:
    """Return what a function gives for its arrays, or `only` one, in some form.

    And check that it leaves them alone.
    """
    row = ROWS[name]
    if row.needs:
        pytest.importorskip(row.needs)
    given = {
        argument: form(array, kind) if only in (None, argument) else array.copy()
        for argument, (array, kind) in row.arrays.items()
    }
    before = copy.deepcopy(given)
    try:
        return list(numbers(row.call(**given)))
    finally:
        for argument, value in before.items():
            same = (
                value == given[argument]
                if isinstance(value, list)
                else equal(value, given[argument])
            )
            assert same, f"{argument} was changed"


def searches(name: str) -> bool:
    """Tell whether a call takes seconds: a search in NumPy, whose border is the same as with C."""
    return name.startswith("estimate_") and available()["c"] is not None


@pytest.mark.parametrize("name", ROWS)
def test_same_numbers_in_any_form_give_the_same_answer(name) -> None:
    expected = called(name, lambda a, _: a.copy())
    for form, change in list(FORMS.items())[:: 4 if searches(name) else 1]:
        found = called(name, change)
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other, err_msg=form)


# Arrays that cannot be used, or hardly


def with_entry(value: object) -> Callable[[np.ndarray], np.ndarray]:
    """Return a change of one entry of an array."""

    def change(a: np.ndarray) -> np.ndarray:
        a = a.astype(np.result_type(a, type(value)) if isinstance(value, float) else a.dtype)
        a[tuple(side // 2 for side in a.shape)] = value
        return a

    return change


#: Changes of an array; with None for the kinds they are for, for all.
CHANGES: dict[str, tuple[str | None, Callable[[np.ndarray], Any]]] = {
    "empty": (None, lambda a: a[:0]),
    "one row": (None, lambda a: a[:1]),
    "a row too few": (None, lambda a: a[:-1]),
    "a column too few": (None, lambda a: a[..., :-1]),
    "transposed": (None, np.transpose),
    "flat": (None, np.ravel),
    "another axis": (None, lambda a: a[None]),
    "a number": (None, lambda a: a.flat[0]),
    "None": (None, lambda a: None),
    "text": (None, lambda a: a.astype(str)),
    "objects": (None, lambda a: a.astype(object)),
    "ragged lists": (None, lambda a: [*a.tolist(), [[]]]),
    "complex": (None, lambda a: a + 0j),
    "booleans": (None, lambda a: a > 0),
    "dates": (None, lambda a: a.astype("M8[s]")),
    "structured": (None, lambda a: np.zeros(a.shape, "f8,f8")),
    "masked": (None, lambda a: np.ma.masked_equal(a, a.max())),
    "zeros": (None, np.zeros_like),
    "all the same": (None, lambda a: np.full_like(a, 7)),
    "negative": (None, lambda a: -a),
    "an entry far off": ("index", with_entry(2**62)),
    "fractions": ("index", lambda a: a + 0.5),
    "NaN": ("real", with_entry(np.nan)),
    "infinity": ("real", with_entry(-np.inf)),
    "a huge entry": ("real", with_entry(1e300)),
    "huge": ("real", lambda a: a * 1e300),
    "tiny": ("real", lambda a: a * 1e-300),
    "longer than double": ("real", lambda a: a.astype(np.longdouble) * np.longdouble("1e400")),
}


@pytest.mark.parametrize("name", ROWS)
def test_arrays_that_cannot_be_used_are_refused(name) -> None:
    """Or give numbers: never another error, a warning, or NaN."""
    problems, step = [], 3 if searches(name) else 1
    for k, (argument, (_, kind)) in enumerate(ROWS[name].arrays.items()):
        for what, (only, change) in list(CHANGES.items())[k % step :: step]:
            if only not in (None, "real" if kind == "px" else kind):
                continue
            try:
                found = called(name, lambda a, _, change=change: change(a), argument)
            except EpigaugeError as error:
                if not 10 < len(str(error)) < 400:
                    problems.append(f"{argument}, {what}: message {error}")
            except (Exception, AssertionError) as error:
                problems.append(f"{argument}, {what}: {error!r}")
            else:
                if any(not isinstance(v, str) and np.isnan(v).any() for v in found):
                    problems.append(f"{argument}, {what}: there is NaN in the result")
    assert not problems, "\n".join(problems)


# Tables of other libraries


def of_pandas(a: np.ndarray, nullable: bool = False) -> Any:
    """Return a table or column of pandas; more than two dimensions it does not have."""
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    if a.ndim > 2:
        return a
    made = pandas.DataFrame(a) if a.ndim == 2 else pandas.Series(a)
    return made.convert_dtypes() if nullable else made


def of_xarray(a: np.ndarray) -> Any:
    return pytest.importorskip("xarray", reason="needs xarray").DataArray(a)


def of_polars(a: np.ndarray) -> Any:
    polars = pytest.importorskip("polars", reason="needs polars")
    if a.ndim > 2:
        return a
    return polars.DataFrame(a) if a.ndim == 2 else polars.Series(a)


LIBRARIES: dict[str, Callable[[np.ndarray], Any]] = {
    "pandas": of_pandas,
    "pandas, nullable": lambda a: of_pandas(a, nullable=True),
    "xarray": of_xarray,
    "polars": of_polars,
}


@pytest.mark.parametrize("library", LIBRARIES)
def test_tables_of_other_libraries_are_arrays(library) -> None:
    for name in ROWS:
        expected = called(name, lambda a, _: a.copy())
        found = called(name, lambda a, _: LIBRARIES[library](a))
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.parametrize("library", ["pandas, nullable", "xarray"])
@pytest.mark.parametrize("what", ["words", "an entry that is missing"])
def test_tables_that_hold_no_numbers_are_refused_by_name(library, what) -> None:
    problems = []
    for name, row in ROWS.items():
        for argument, (array, kind) in row.arrays.items():
            if kind == "image" or array.ndim > 2:
                continue
            bad = array.astype(str) if what == "words" else array.astype(np.float64)
            if what != "words":
                bad.flat[-1] = np.nan
            table = LIBRARIES[library](bad)
            given = {other: value for other, (value, _) in row.arrays.items()} | {argument: table}
            try:
                row.call(**given)
            except EpigaugeError as error:
                if argument not in str(error):
                    problems.append(f"{name}: {argument} is not named in: {error}")
            except Exception as error:
                problems.append(f"{name}, {argument}: {error!r}")
            else:
                problems.append(f"{name}, {argument}: taken")
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("name", ["reprojection_distances", "sampson_distances", "triangulate"])
def test_a_hundred_thousand_rows_give_what_thirty_do(name) -> None:
    few = called(name, lambda a, _: a)
    times = 3400

    def repeated(a: np.ndarray, kind: str) -> np.ndarray:
        return a if kind == "real" else np.concatenate([a] * times, axis=a.ndim - 2)

    for one, many in zip(few, called(name, repeated), strict=True):
        # The mean of all points, where computing begins, is rounded otherwise.
        expected = np.concatenate([one] * times)
        np.testing.assert_allclose(many, expected, rtol=1e-9, atol=1e-9 * np.abs(one).max())
