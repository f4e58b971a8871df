"""Photographs: read as a viewer shows them, matched where their points are, refused clearly."""

from __future__ import annotations

import io
import struct
import sys
import zlib

import epigauge as eg
import numpy as np
import pytest
from epigauge.errors import ArgumentError, FileFormatError, MissingPackageError
from epigauge.images import DETECTORS, matching
from epigauge.images.loading import thumbnail
from photographs import rendered
from two_views import same_geometry

cv2 = pytest.importorskip("cv2", reason="photographs need OpenCV")

#: Rows and columns of the upright image from those of the file, by EXIF orientation.
UPRIGHT = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: np.swapaxes(a, 0, 1),
    6: lambda a: np.swapaxes(a[::-1], 0, 1),
    7: lambda a: np.swapaxes(a[::-1, ::-1], 0, 1),
    8: lambda a: np.swapaxes(a[:, ::-1], 0, 1),
}


@pytest.fixture(scope="module")
def views():
    """Two grey photographs of 640 x 480 pixels, and the true F."""
    return rendered((0.5, 0.05, 0.2))


@pytest.fixture(scope="module")
def small(views):
    """Parts of them, 280 x 240 pixels, with a colour cast."""
    crops = [view[100:340, 100:380] for view in views[:2]]
    return [np.dstack([crop, crop // 2, 255 - crop // 3]) for crop in crops]


def encoded(image: np.ndarray, suffix: str) -> bytes:
    """Return an RGB, RGBA or grey image as a file."""
    order = [2, 1, 0, 3]
    image = image if image.ndim == 2 else image[:, :, order[: image.shape[2]]]
    return cv2.imencode(suffix, image)[1].tobytes()


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """Put an EXIF block with an orientation into a JPEG file."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def png_head(width: int, height: int) -> bytes:
    """Return a PNG file that claims a size and has no pixels."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")


def jpeg_claiming(jpeg: bytes, width: int, height: int) -> bytes:
    """Return a JPEG file that claims another size."""
    at = jpeg.index(b"\xff\xc0")
    return jpeg[: at + 5] + struct.pack(">HH", height, width) + jpeg[at + 9 :]


# where points are


def test_matches_satisfy_the_true_geometry(views) -> None:
    image1, image2, F = views
    m = eg.match_images(image1, image2)
    d = eg.reprojection_distances(F, m.x1, m.x2)[0]
    assert len(m) > 500
    # Half a pixel of error in the frame of the pixels would be ten times this
    assert np.median(np.abs(d)) < 0.05
    assert (m.image_size1, m.image_size2) == ((640, 480), (640, 480))
    assert min(m.n_features1, m.n_features2) > len(m)
    result = eg.estimate_fundamental(m.x1, m.x2)
    assert same_geometry(result.F, F, m.x1, m.x2) < 0.01


@pytest.mark.parametrize("max_size", [2400, 140])
def test_turned_by_180_degrees_points_are_mirrored_at_the_middle(small, max_size) -> None:
    # With (0, 0) in the centre of a pixel, x -> w - 1 - x; a bias b shows as 2 b.
    image = small[0]
    m = eg.match_images(image, image[::-1, ::-1], max_size=max_size)
    assert len(m) > 50
    assert np.abs(np.median(m.x1 + m.x2, axis=0) - (279, 239)).max() < 0.02


def test_larger_images_are_matched_as_reduced_and_measured_in_full_pixels(small) -> None:
    large = [np.repeat(np.repeat(image, 3, axis=0), 3, axis=1) for image in small]
    few, many = eg.match_images(*large, max_size=280), eg.match_images(*small)
    for x_large, x_small in ((few.x1, many.x1), (few.x2, many.x2)):
        np.testing.assert_allclose(x_large, 3 * x_small + 1, atol=1e-9)
    assert few.image_size1 == (840, 720)


def test_exchanged_images_give_exchanged_matches(small) -> None:
    there, back = eg.match_images(*small), eg.match_images(*small[::-1])
    forward = {tuple(row) for row in np.column_stack([there.x1, there.x2])}
    assert forward == {tuple(row) for row in np.column_stack([back.x2, back.x1])}
    assert len(forward) == len(there) > 50  # none twice


def test_same_images_give_the_same_matches(small) -> None:
    first, second = eg.match_images(*small), eg.match_images(*small)
    assert first.x1.tobytes() == second.x1.tobytes()


def test_smaller_ratio_and_fewer_features_keep_part_of_the_matches(small) -> None:
    counts = [len(eg.match_images(*small, ratio=ratio)) for ratio in (1.0, 0.8, 0.5)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1] > 0


def test_strongest_features_are_kept_whether_or_not_the_detector_counts(small, monkeypatch) -> None:
    few = eg.match_images(*small, max_features=100)
    assert few.n_features1 == few.n_features2 == 100
    _, options = DETECTORS["sift"]
    unlimited = ("SIFT", lambda n: options(n) | {"nfeatures": 0})
    monkeypatch.setitem(DETECTORS, "sift", unlimited)
    counted = eg.match_images(*small, max_features=100)
    assert (counted.n_features1, counted.n_features2) == (100, 100)
    common = {tuple(x) for x in few.x1} & {tuple(x) for x in counted.x1}
    assert len(common) >= 0.9 * len(few)  # features of equal strength may change places


@pytest.mark.parametrize("detector", DETECTORS)
def test_every_detector_matches_or_is_said_to_be_missing(small, detector) -> None:
    name = DETECTORS[detector][0] + "_create"
    modules = (cv2, getattr(cv2, "xfeatures2d", None))
    if any(hasattr(module, name) for module in modules):
        m = eg.match_images(*small, detector=detector, ratio=0.95, max_features=500)
        assert len(m) > 20
        assert m.detector == detector
        assert m.n_features1 <= 500
    else:
        with pytest.raises(ArgumentError, match=f"detector is '{detector}', which OpenCV"):
            eg.match_images(*small, detector=detector)


# what files hold


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_exif_orientation_is_obeyed(tmp_path, small, orientation) -> None:
    jpeg = encoded(small[0], ".jpg")
    (tmp_path / "stored.jpg").write_bytes(jpeg)
    (tmp_path / "turned.jpg").write_bytes(with_orientation(jpeg, orientation))
    upright = UPRIGHT[orientation](eg.load_image(tmp_path / "stored.jpg"))
    np.testing.assert_array_equal(eg.load_image(tmp_path / "turned.jpg"), upright)


def test_matches_are_those_of_the_upright_images(tmp_path, small) -> None:
    jpegs = [encoded(image, ".jpg") for image in small]
    (tmp_path / "a.jpg").write_bytes(with_orientation(jpegs[0], 6))
    (tmp_path / "b.jpg").write_bytes(with_orientation(jpegs[1], 3))
    m = eg.match_images(tmp_path / "a.jpg", str(tmp_path / "b.jpg"))
    assert (m.image_size1, m.image_size2) == ((240, 280), (280, 240))
    assert m.name == "a - b"
    upright = eg.load_image(tmp_path / "a.jpg"), eg.load_image(tmp_path / "b.jpg")
    np.testing.assert_array_equal(m.x1, eg.match_images(*upright).x1)


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".webp", ".jpg", ".pgm"])
def test_formats_are_read_in_red_green_blue_or_grey(tmp_path, small, suffix) -> None:
    image = small[0] if suffix != ".pgm" else small[0][:, :, 0]
    (tmp_path / f"a{suffix}").write_bytes(encoded(image, suffix))
    found = eg.load_image(tmp_path / f"a{suffix}")
    assert found.shape == image.shape
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    lossy = suffix in (".jpg", ".webp")
    assert np.abs(found.astype(float) - image).mean() <= (8.0 if lossy else 0.0)


def test_transparency_is_dropped(tmp_path, small) -> None:
    transparent = np.dstack([small[0], small[0][:, :, 0]])
    (tmp_path / "a.png").write_bytes(encoded(transparent, ".png"))
    np.testing.assert_array_equal(eg.load_image(tmp_path / "a.png"), small[0])
    m, expected = eg.match_images(transparent, small[1]), eg.match_images(*small)
    np.testing.assert_array_equal(m.x2, expected.x2)


@pytest.mark.parametrize("factor", [16, 257])
def test_16_bits_are_used_whatever_part_of_them_is_filled(tmp_path, small, factor) -> None:
    deep = [image[:, :, 0].astype(np.uint16) * factor + 30 for image in small]
    (tmp_path / "a.png").write_bytes(encoded(deep[0], ".png"))
    (tmp_path / "b.tiff").write_bytes(encoded(deep[1], ".tiff"))
    loaded = eg.load_image(tmp_path / "a.png")
    assert loaded.dtype == np.uint8
    assert (loaded.min(), loaded.max()) == (0, 255)
    m = eg.match_images(tmp_path / "a.png", tmp_path / "b.tiff")
    floating = eg.match_images(*(image[:, :, 0] / 255.0 for image in small))
    np.testing.assert_array_equal(m.x1, floating.x1)
    assert len(m) > 50


def test_a_single_bright_point_stays_visible(tmp_path) -> None:
    image = np.full((100, 100), 1000, dtype=np.uint16)
    image[30, 40] = 3000
    (tmp_path / "a.png").write_bytes(encoded(image, ".png"))
    found = eg.load_image(tmp_path / "a.png")
    assert np.argwhere(found == 255).tolist() == [[30, 40]]
    assert np.count_nonzero(found) == 1


def test_odd_values_of_pixels_do_no_harm() -> None:
    image = np.zeros((20, 20), dtype=np.float32)
    image[3, 4], image[5, 6], image[7, 8] = np.nan, np.inf, 1.0
    m = eg.match_images(image, np.full((30, 30), np.nan))
    assert (m.n_features2, len(m)) == (0, 0)
    assert len(eg.match_images(np.zeros((20, 20), dtype=bool), image)) == 0


def test_grey_colour_and_layout_of_arrays_make_no_difference(small) -> None:
    grey = [np.ascontiguousarray(image[:, :, 0]) for image in small]
    expected = eg.match_images(*grey)
    frozen = np.asfortranarray(grey[0])
    frozen.flags.writeable = False
    padded = np.zeros((480, 560), dtype=np.uint8)
    padded[::2, ::2] = grey[1]
    for image1, image2 in (
        (np.dstack([grey[0]] * 3), grey[1][:, :, None]),
        (frozen, padded[::2, ::2]),
        (grey[0].astype(np.uint8), np.dstack([grey[1]] * 4)),
    ):
        before = np.array(image1), np.array(image2)
        m = eg.match_images(image1, image2)
        np.testing.assert_array_equal(m.x1, expected.x1)
        np.testing.assert_array_equal(m.x2, expected.x2)
        np.testing.assert_array_equal(image1, before[0])
        np.testing.assert_array_equal(image2, before[1])


def test_matches_of_images_are_saved_and_read_like_others(tmp_path, small) -> None:
    m = eg.match_images(*small)
    eg.save_matches(tmp_path / "m.npz", m)
    again = eg.load_matches(tmp_path / "m.npz")
    np.testing.assert_array_equal(again.x2, m.x2)
    assert again.image_size2 == m.image_size2


# what is refused


def test_nothing_to_find_gives_no_matches(small) -> None:
    flat = np.full((100, 100), 7, dtype=np.uint8)
    m = eg.match_images(flat, small[1])
    assert (len(m), m.n_features1) == (0, 0)
    assert m.x1.shape == m.x2.shape == (0, 2)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("nothing", "is empty"),
        ("text", "is damaged, or no image"),
        ("cut png", "is damaged, or no image"),
        ("cut jpeg", "is a JPEG file that was cut off"),
        ("large png", "has 100000 x 100000 pixels, more than"),
        ("empty png", "is damaged, or no image"),
        ("large jpeg", "has 60000 x 50000 pixels, more than"),
    ],
)
def test_files_that_are_no_image_are_refused(tmp_path, small, content, reason) -> None:
    jpeg, png = encoded(small[0], ".jpg"), encoded(small[0], ".png")
    made = {
        "nothing": b"",
        "text": b"x1,y1,x2,y2\n1,2,3,4\n",
        "large png": png_head(100_000, 100_000),
        "empty png": png_head(20_000, 2),
        "cut png": png[: len(png) // 2],
        "cut jpeg": with_orientation(jpeg, 6)[: len(jpeg) // 2],
        "large jpeg": with_orientation(jpeg_claiming(jpeg, 60_000, 50_000), 1),
    }
    (tmp_path / "a.png").write_bytes(made[content])
    with pytest.raises(FileFormatError, match=reason) as caught:
        eg.match_images(small[1], tmp_path / "a.png")
    assert caught.value.file == str(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".webp"])
def test_damaged_files_are_read_or_refused(tmp_path, small, suffix) -> None:
    data = np.frombuffer(encoded(small[0][:64, :64], suffix), dtype=np.uint8)
    rng = np.random.default_rng(0)
    for _ in range(60):
        damaged = data.copy()
        head = len(data) if rng.random() < 0.5 else 200
        at = rng.integers(0, min(head, len(data)), rng.integers(1, 6))
        damaged[at] = rng.integers(0, 256, len(at))
        (tmp_path / "a").write_bytes(
            damaged[: rng.integers(len(data) // 2, 2 * len(data))].tobytes()
        )
        try:
            image = eg.load_image(tmp_path / "a")
        except FileFormatError:
            continue
        assert image.dtype == np.uint8


def test_what_cannot_be_opened_is_an_os_error(tmp_path, small) -> None:
    with pytest.raises(FileNotFoundError):
        eg.match_images(tmp_path / "absent.png", small[0])
    with pytest.raises(IsADirectoryError):
        eg.load_image(tmp_path)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((3, 4), np.uint8), "image2 is 4 x 3 pixels; needed: at least 16"),
        (np.zeros((16, 3000), np.uint8), "is 3000 x 16 pixels, 2000 x 11 within max_size"),
        (np.zeros(5), r"image2 has shape \(5,\)"),
        (np.zeros((20, 20, 2)), r"image2 has shape \(20, 20, 2\)"),
        (np.zeros((0, 20)), r"image2 has shape \(0, 20\)"),
        (np.zeros((20, 20), complex), "image2 has type complex128"),
        ([[1, 2], [3]], "image2 is not a regular array"),
        (None, "image2 has type object"),
    ],
)
def test_arrays_that_are_no_image_are_refused(small, image, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        eg.match_images(small[0], image)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"detector": "surf"}, "detector is 'surf'"),
        ({"ratio": 0.0}, "ratio is 0.0"),
        ({"ratio": 1.5}, "ratio is 1.5"),
        ({"max_size": 4}, "max_size is 4"),
        ({"max_features": 2.5}, "max_features is 2.5"),
    ],
)
def test_unusable_options_are_refused(small, options, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        eg.match_images(*small, **options)


def test_without_opencv_the_remedy_is_named(monkeypatch, small) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'epigauge\[cv\]'"):
        eg.match_images(*small)


@pytest.mark.parametrize("shape", [(300, 500, 3), (500, 300), (40, 50, 3)])
def test_thumbnails_show_the_same_smaller(tmp_path, shape) -> None:
    image = np.full(shape, 40, dtype=np.uint8)
    image[: shape[0] // 2, ..., : (1 if len(shape) == 3 else None)] = 200  # red, or light, above
    cv2.imwrite(str(tmp_path / "a.png"), image[..., ::-1] if len(shape) == 3 else image)
    (tmp_path / "small.jpg").write_bytes(thumbnail(tmp_path / "a.png", 100))
    small = eg.load_image(tmp_path / "small.jpg")
    assert max(small.shape[:2]) == min(100, max(shape[:2]))
    assert small.shape[0] / small.shape[1] == pytest.approx(shape[0] / shape[1], abs=0.02)
    assert abs(int(np.atleast_1d(small[5, 5])[0]) - int(np.atleast_1d(image[0, 0])[0])) < 60


def heic(image: np.ndarray) -> bytes:
    """Return an RGB or grey image as a HEIC file."""
    heif = pytest.importorskip("pillow_heif", reason="HEIC needs pillow-heif")
    height, width = image.shape[:2]
    mode = "RGB" if image.ndim == 3 else "L"
    file = heif.from_bytes(mode, (width, height), np.ascontiguousarray(image).tobytes())
    target = io.BytesIO()
    file.save(target, quality=-1)
    return target.getvalue()


def test_photographs_of_telephones_are_read(small, tmp_path) -> None:
    path = tmp_path / "IMG_0001.HEIC"
    for image in (small[0], small[0][:, :, 0]):
        path.write_bytes(heic(image))
        found = eg.load_image(path)
        assert found.dtype == np.uint8
        assert found.shape[:2] == image.shape[:2]
        shown = image if found.ndim == image.ndim else image[:, :, None]
        # Colours are stored at half the resolution: means of 4 x 4 pixels are compared.
        off = (found.astype(float) - shown)[:240, :280].reshape(60, 4, 70, 4, -1).mean(axis=(1, 3))
        assert np.abs(off).max() < 12.0
        assert np.abs(off).mean() < 2.0
    data = heic(small[0])
    for damaged in (data[:200], data[: len(data) // 2], data[:40] + bytes(len(data) - 40)):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match="HEIC"):
            eg.load_image(path)


def test_what_reads_photographs_of_telephones_is_named(tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.heic"
    path.write_bytes((24).to_bytes(4) + b"ftypheic" + bytes(4) + b"mif1heic" + bytes(100))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(MissingPackageError, match=r"epigauge\[heic\]"):
        eg.load_image(path)


@pytest.mark.parametrize("shape", [(700, 900), (3, 2), (513, 40)])
def test_nearest_descriptors_are_those_of_opencv(shape) -> None:
    """Of SIFT, whose descriptors are whole numbers, exactly."""
    rng = np.random.default_rng(0)
    drawn = [rng.gamma(0.5, 1.0, (n, 128)) for n in shape]
    first, second = ((d * 512 / np.linalg.norm(d, axis=1)[:, None]).round() for d in drawn)
    first[: min(shape) // 2] = second[: min(shape) // 2]
    first, second = first.astype(np.float32), second.astype(np.float32)
    index, clear = matching._nearest(cv2, first, second, 0.8)
    distance, expected = cv2.batchDistance(first, second, cv2.CV_32F, normType=cv2.NORM_L2, K=2)
    np.testing.assert_array_equal(index, expected[:, 0])
    np.testing.assert_array_equal(clear, distance[:, 0] < 0.8 * distance[:, 1])
