"""Matches as other programs write them, and arrays as other libraries hold them."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError, FileFormatError

VIEW = eg.two_view_scene(noise_px=0.5, seed=3)
X1, X2 = (x.astype(np.float32) for x in (VIEW.x1, VIEW.x2))
M = len(X1)
RNG = np.random.default_rng(5)

#: Keypoints among which the matches are, in another order, and who matches whom.
FIRST, SECOND = RNG.permutation(M + 20), RNG.permutation(M + 30)
LONELY = RNG.uniform(-100.0, 100.0, (50, 2)).astype(np.float32)
KEYPOINTS0 = np.vstack([X1, LONELY[:20]])[FIRST]
KEYPOINTS1 = np.vstack([X2, LONELY[20:]])[SECOND]
ROW0, ROW1 = np.argsort(FIRST)[:M], np.argsort(SECOND)[:M]
MATCHES0, MATCHES1 = np.full(M + 20, -1), np.full(M + 30, -1)
MATCHES0[ROW0], MATCHES1[ROW1] = ROW1, ROW0
CONFIDENCE = RNG.uniform(size=M)

#: As the programs write them, of `np.savez`.
FORMS: dict[str, dict[str, Any]] = {
    "epigauge": {"x1": X1, "x2": X2},
    "epigauge, one table": {"matches": np.hstack([X1, X2])},
    "LoFTR": {"mkpts0": X1, "mkpts1": X2, "mconf": CONFIDENCE},
    "LoFTR, fine": {"mkpts0_f": X1, "mkpts1_f": X2},
    "LightGlue": {
        "keypoints0": KEYPOINTS0,
        "keypoints1": KEYPOINTS1,
        "matches": np.column_stack([ROW0, ROW1]),
        "scores": CONFIDENCE,
    },
    "LightGlue, batched": {
        "keypoints0": KEYPOINTS0[None],
        "keypoints1": KEYPOINTS1[None],
        "matches": np.column_stack([ROW0, ROW1])[None],
    },
    "SuperGlue": {"keypoints0": KEYPOINTS0, "keypoints1": KEYPOINTS1, "matches": MATCHES0},
    "matches0": {
        "keypoints0": KEYPOINTS0,
        "keypoints1": KEYPOINTS1,
        "matches0": MATCHES0[None].astype(np.int64),
    },
    "matches1": {"keypoints0": KEYPOINTS0, "keypoints1": KEYPOINTS1, "matches1": MATCHES1},
    "kornia": {"keypoints0": X1, "keypoints1": X2, "confidence": CONFIDENCE},
    "OpenCV": {"pts1": X1[:, None], "pts2": X2[:, None]},
    "OpenCV, homography": {"src_pts": X1, "dst_pts": X2},
    "points": {"points1": X1, "points2": X2},
}


def same(found: eg.Matches) -> None:
    """Compare as sets: other programs list matches in the order of the keypoints."""
    table = np.hstack([found.x1, found.x2])
    expected = np.hstack([X1, X2]).astype(np.float64)
    np.testing.assert_array_equal(table[np.lexsort(table.T)], expected[np.lexsort(expected.T)])
    assert found.weights is None  # a confidence is none


@pytest.mark.parametrize("form", FORMS)
def test_arrays_of_other_programs_are_read(form: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "m.npz", **FORMS[form])
    same(eg.load_matches(tmp_path / "m.npz"))


@pytest.mark.parametrize("table", [np.hstack([X1, X2]), np.stack([X1, X2])])
def test_npy_is_read(table: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", table)
    same(eg.load_matches(tmp_path / "m.npy"))


@pytest.mark.parametrize("name", ["mask", "inliers", "inlier"])
@pytest.mark.parametrize("high", [1, 255])
def test_masks_of_opencv_mark_inliers(name: str, high: int, tmp_path: Path) -> None:
    mask = (np.arange(M) % 3 > 0).astype(np.uint8)[:, None] * np.uint8(high)
    np.savez(tmp_path / "m.npz", pts1=X1, pts2=X2, **{name: mask})
    found = eg.load_matches(tmp_path / "m.npz", inliers=True)
    np.testing.assert_array_equal(found.x1, X1[mask.ravel() > 0])
    assert eg.load_matches(tmp_path / "m.npz").marked == np.count_nonzero(mask)


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no name": ({"a": X1, "b": X2}, "needs arrays x1 and x2, or mkpts0 and mkpts1"),
    "one side": ({"mkpts0": X1}, "needs arrays"),
    "lengths": ({"mkpts0": X1, "mkpts1": X2[:-1]}, "x2 has 49 points but x1 has 50"),
    "shape": ({"pts1": X1.T, "pts2": X2.T}, r"pts1 has shape \(2, 50\), needed: \(m, 2\)"),
    "row": (
        {**FORMS["LightGlue"], "matches": np.array([[0, 1], [2, 80]])},
        "matches says 80 in row 1, but image 1 has 80 keypoints",
    ),
    "negative row": (
        {**FORMS["LightGlue"], "matches": np.array([[-1, 1]])},
        "matches says -1 in row 0, but image 0 has 70",
    ),
    "real rows": (
        {**FORMS["LightGlue"], "matches": np.zeros((3, 2))},
        "matches is float64",
    ),
    "too few rows": (
        {**FORMS["SuperGlue"], "matches": MATCHES0[:-3]},
        "matches has 67 rows, needed: 70, one a keypoint",
    ),
    "too few rows of the other image": (
        {**FORMS["matches1"], "matches1": MATCHES1[:-3]},
        "matches1 has 77 rows, needed: 80, one a keypoint",
    ),
    "too few marks": (
        {"mkpts0": X1, "mkpts1": X2, "mask": np.ones(M - 1, np.uint8)},
        "inlier has 49 marks, needed: 50, one a match",
    ),
    "nan": (
        {"mkpts0": np.where(X1 == X1[7], np.nan, X1), "mkpts1": X2},
        r"x1 has a point \(nan, nan\) in row 7",
    ),
    "words": ({"mkpts0": X1.astype(str), "mkpts1": X2}, "needed: plain numbers"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_arrays_are_refused_by_name(kind: str, tmp_path: Path) -> None:
    arrays, reason = BAD[kind]
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(FileFormatError, match=reason):
        eg.load_matches(tmp_path / "m.npz")


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not in npy format"),
        (b"\x93NUMPY\x01\x00", "damaged"),
        (npy(X1), r"matches has shape \(50, 2\), needed: \(m, 4\)"),
        (npy(np.array([{}], dtype=object)), "needed: plain numbers"),
        (npy(np.hstack([X1, X2]))[:-4], "has not the size"),
        (npy(np.hstack([X1, X2])) + b"more", "has not the size"),
    ],
)
def test_bad_npy_is_refused(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "m.npy").write_bytes(content)
    with pytest.raises(FileFormatError, match=reason):
        eg.load_matches(tmp_path / "m.npy")


# hloc

NAMES = ("db/left.jpg", "right.jpg")


@pytest.fixture
def hloc(tmp_path: Path) -> tuple[Path, Path]:
    """Files of features and matches as hloc lays them out, written by h5py alone."""
    h5py = pytest.importorskip("h5py", reason="HDF5 needs h5py")
    features, matches = tmp_path / "features.h5", tmp_path / "matches.h5"
    with h5py.File(features, "w") as file:
        for name, keypoints in zip(NAMES, (KEYPOINTS0, KEYPOINTS1), strict=True):
            group = file.create_group(name)  # db/left.jpg: a group in a group
            group.create_dataset("keypoints", data=keypoints)
            group.create_dataset("descriptors", data=np.zeros((4, len(keypoints)), np.float16))
    with h5py.File(matches, "w") as file:
        group = file.create_group("/".join(name.replace("/", "-") for name in NAMES))
        group.create_dataset("matches0", data=MATCHES0)
        group.create_dataset("matching_scores0", data=np.zeros(len(MATCHES0), np.float16))
    return features, matches


def test_matches_of_hloc_are_read(hloc: tuple[Path, Path]) -> None:
    features, matches = hloc
    same(eg.load_matches(matches, features=features, pair=NAMES))
    found = eg.load_matches(matches, features=features, pair=NAMES[::-1])
    same(eg.Matches(found.x2, found.x1))


def test_dense_matches_of_hloc_hold_their_keypoints(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="HDF5 needs h5py")
    with h5py.File(tmp_path / "dense.h5", "w") as file:
        group = file.create_group("a.jpg/b.jpg")
        for name, x in (("keypoints0", X1), ("keypoints1", X2)):
            group.create_dataset(name, data=x)
        group.create_dataset("scores", data=CONFIDENCE)
    same(eg.load_matches(tmp_path / "dense.h5"))  # the only pair needs no name


def test_what_hloc_does_not_hold_is_told(hloc: tuple[Path, Path], tmp_path: Path) -> None:
    features, matches = hloc
    with pytest.raises(ArgumentError, match="features is None, and the file holds matches alone"):
        eg.load_matches(matches, pair=NAMES)
    with pytest.raises(FileFormatError, match=r"holds no pair of right\.jpg and other\.jpg"):
        eg.load_matches(matches, features=features, pair=("right.jpg", "other.jpg"))
    with pytest.raises(FileFormatError, match="is not a readable HDF5 file"):
        eg.load_matches(matches, features=Path(__file__), pair=NAMES)
    with pytest.raises(FileFormatError, match=r"holds no keypoints of db/left\.jpg"):
        eg.load_matches(matches, features=matches, pair=NAMES)
    # The only pair needs no name, but keypoints in folders do: db-left.jpg could be db/left.jpg.
    with pytest.raises(FileFormatError, match=r"no keypoints of db-left\.jpg \(.*: say pair="):
        eg.load_matches(matches, features=features)
    with pytest.raises(FileNotFoundError):
        eg.load_matches(matches, features=tmp_path / "missing.h5", pair=NAMES)
    (tmp_path / "empty.h5").write_bytes(b"")
    with pytest.raises(FileFormatError, match="is not a readable HDF5 file"):
        eg.load_matches(tmp_path / "empty.h5")
    with pytest.raises(ArgumentError, match=r"pair is given for 'm\.npz'"):
        eg.load_matches(tmp_path / "m.npz", pair=NAMES)


# Arrays of other libraries


class Tensor:
    """What a tensor of PyTorch allows: NumPy cannot convert one that needs a gradient."""

    def __init__(self, array: np.ndarray, state: str = "cuda, grad") -> None:
        self.array, self.state = array, state

    def detach(self) -> Tensor:
        return Tensor(self.array, self.state.replace("grad", ""))

    def cpu(self) -> Tensor:
        return Tensor(self.array, self.state.replace("cuda", ""))

    def numpy(self) -> np.ndarray:
        if "grad" in self.state or "cuda" in self.state:
            raise RuntimeError("Can't call numpy()")
        if "bfloat16" in self.state:
            raise TypeError("Got unsupported ScalarType BFloat16")
        return self.array

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        return self.numpy()


class OnCard:
    """What CuPy and numba have: memory that NumPy cannot reach."""

    __cuda_array_interface__: dict[str, Any] = {"version": 3}  # noqa: RUF012

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise TypeError("Implicit conversion to a NumPy array is not allowed")

    def get(self) -> np.ndarray:
        return self.array


def frame(array: np.ndarray) -> Any:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    return pandas.DataFrame(array, columns=["x", "y"])


def labelled(array: np.ndarray) -> Any:
    xarray = pytest.importorskip("xarray", reason="needs xarray")
    return xarray.DataArray(array, dims=("match", "coordinate"))


OTHERS: dict[str, Callable[[np.ndarray], Any]] = {
    "torch": Tensor,
    "cupy": OnCard,
    "pandas": frame,
    "pandas, nullable": lambda array: frame(array).convert_dtypes(),
    "xarray": labelled,
    "memoryview": lambda array: memoryview(np.ascontiguousarray(array)),
}


@pytest.mark.parametrize("library", OTHERS)
def test_arrays_of_other_libraries_are_taken_for_what_they_are(library: str) -> None:
    as_theirs = OTHERS[library]
    expected = eg.refine_fundamental(X1, X2)
    found = eg.refine_fundamental(as_theirs(X1), as_theirs(X2))
    np.testing.assert_array_equal(found.F, expected.F)
    d, *_ = eg.reprojection_distances(found.F, X1, X2)
    np.testing.assert_array_equal(
        eg.reprojection_distances(found.F, as_theirs(X1), as_theirs(X2))[0], d
    )


def test_tracks_take_columns_of_a_table() -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    tracks = eg.multi_view_scene(n_points=12, seed=1).tracks
    table = pandas.DataFrame({"view": tracks.view, "point": tracks.point})
    table[["x", "y"]] = tracks.xy
    shuffled = table.sample(frac=1.0, random_state=3)
    found = eg.Tracks(shuffled["view"], shuffled["point"], shuffled[["x", "y"]])
    np.testing.assert_array_equal(found.xy, tracks.xy)


def test_a_tensor_that_is_no_array_says_why() -> None:
    with pytest.raises(ArgumentError, match=r"x1 is a Tensor that is no array.*BFloat16"):
        eg.refine_fundamental(Tensor(X1, "bfloat16"), X2)
