"""Focal lengths that are known beforehand: priors, and what photographs say of themselves."""

from __future__ import annotations

import struct
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from calibration import SIZE, tracks_of
from epigauge.images.exif import exif_focal_px


def _exif(entries: list[tuple[int, int, int | tuple[int, int]]], order: str) -> bytes:
    """Return an EXIF block: a first directory that points to a second one with the entries."""

    def packed(code: str, *values: int) -> bytes:
        return struct.pack(order + code, *values)

    inner = 8 + 2 + 12 + 4
    far = inner + 2 + 12 * len(entries) + 4
    head = (b"II" if order == "<" else b"MM") + packed("HI", 42, 8)
    first = packed("HHHII", 1, 0x8769, 4, 1, inner) + packed("I", 0)
    rows, tail = packed("H", len(entries)), b""
    for tag, kind, value in entries:
        if isinstance(value, tuple):
            rows += packed("HHII", tag, kind, 1, far + len(tail))
            tail += packed("II", *value)
        elif kind == 3:
            rows += packed("HHIHH", tag, kind, 1, value, 0)
        else:
            rows += packed("HHII", tag, kind, 1, value)
    return head + first + rows + packed("I", 0) + tail


def _jpeg(block: bytes) -> bytes:
    segment = b"Exif\0\0" + block
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + b"\xff\xd9"


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_35_mm_equivalent_is_of_the_diagonal(tmp_path: Path, order: str) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(_jpeg(_exif([(0x920A, 5, (43, 10)), (0xA405, 3, 50)], order)))
    # Portrait or landscape: the film is turned as the picture.
    for size in ((3000, 2000), (2000, 3000)):
        assert exif_focal_px(path, size) == pytest.approx(50.0 / 36.0 * 3000.0)


@pytest.mark.parametrize(("unit", "per_mm"), [(2, 1 / 25.4), (3, 1 / 10.0)])
def test_without_it_the_pitch_of_the_sensor_tells(tmp_path: Path, unit: int, per_mm: float) -> None:
    entries = [
        (0x920A, 5, (85, 10)),
        (0xA002, 4, 4000),
        (0xA003, 4, 3000),
        (0xA20E, 5, (12000, 1)),
        (0xA210, 3, unit),
    ]
    path = tmp_path / "a.tif"
    path.write_bytes(_exif(entries, "<"))
    assert exif_focal_px(path, (4000, 3000)) == pytest.approx(8.5 * 12000.0 * per_mm)
    # Made smaller since.
    assert exif_focal_px(path, (1000, 750)) == pytest.approx(8.5 * 12000.0 * per_mm / 4.0)


def test_other_forms_have_it_in_other_places(tmp_path: Path) -> None:
    block = _exif([(0xA405, 3, 50)], "<")
    chunk = struct.pack("<4sI", b"EXIF", len(block)) + block
    pixels = bytes(2**20)  # before what is looked for
    forms = {
        "a.webp": b"RIFF"
        + struct.pack("<I", 4 + len(pixels) + len(chunk))
        + b"WEBP"
        + pixels
        + chunk,
        "a.png": b"\x89PNG\r\n\x1a\n" + pixels + struct.pack(">I4s", len(block), b"eXIf") + block,
        "a.heic": b"\0\0\0\x18ftypheic" + pixels + b"\0\0\0\x06Exif\0\0" + block,
    }
    for name, data in forms.items():
        (tmp_path / name).write_bytes(data)
        assert exif_focal_px(tmp_path / name, (3000, 2000)) == pytest.approx(50.0 / 36.0 * 3000.0)


def test_files_that_tell_nothing_are_no_error(tmp_path: Path) -> None:
    whole = _jpeg(_exif([(0xA405, 3, 50)], "<"))
    damaged = [b"", b"II*\0", b"\xff\xd8\xff\xd9", _jpeg(_exif([(0xA405, 3, 0)], ">"))]
    damaged += [_jpeg(_exif([(0x920A, 5, (5, 0))], ">")), _jpeg(b"II*\0\xff\xff\xff\xff")]
    damaged += [whole[:end] for end in range(4, 44)]
    for k, data in enumerate(damaged):
        path = tmp_path / f"{k}.jpg"
        path.write_bytes(data)
        assert exif_focal_px(path, (100, 100)) is None


def test_a_weak_prior_hardly_moves_and_a_strong_one_holds() -> None:
    tracks, _ = tracks_of("general", 3, noise_px=0.4)
    free = eg.metric_upgrade(tracks, image_size=SIZE)
    weak = eg.metric_upgrade(
        tracks, image_size=SIZE, priors=[eg.IntrinsicPrior(0, "f", 800.0, 80.0)]
    )
    # What two independent measurements make together, by their weights.
    std = np.sqrt(free.covariance.intrinsics(0)[0, 0])
    expected = (free.focal_px / std**2 + 800.0 / 80.0**2) / (1.0 / std**2 + 1.0 / 80.0**2)
    assert weak.focal_px == pytest.approx(expected, abs=0.1 * std)
    strong = eg.metric_upgrade(
        tracks, image_size=SIZE, priors=[eg.IntrinsicPrior(0, "f", 890.0, 0.01)]
    )
    assert strong.focal_px == pytest.approx(890.0, abs=0.1)


def test_a_prior_determines_what_a_straight_walk_leaves_open() -> None:
    tracks, _ = tracks_of("translation", 3, noise_px=0.4)
    assert not eg.metric_upgrade(tracks, image_size=SIZE).success
    known = [eg.IntrinsicPrior(0, "f", 910.0, 20.0)]
    found = eg.metric_upgrade(tracks, image_size=SIZE, priors=known)
    assert found.success
    assert "pure translation" not in found.flags
    assert found.focal_px == pytest.approx(910.0, abs=10.0)
    assert found.focal_std_px == pytest.approx(20.0, rel=0.1)


@pytest.mark.parametrize(
    ("prior", "named"),
    [
        (eg.IntrinsicPrior(0, "fx", 900.0, 9.0), "fx"),
        (eg.IntrinsicPrior(1, "f", 900.0, 9.0), "camera 1"),
        (eg.IntrinsicPrior(0, "f", 900.0, 0.0), r"\+- 0"),
        (eg.IntrinsicPrior(0, "f", float("nan"), 1.0), "nan"),
        (900.0, "float"),
    ],
)
def test_priors_of_nothing_are_refused(prior: object, named: str) -> None:
    tracks, _ = tracks_of("general", 3, noise_px=0.4)
    with pytest.raises(eg.ArgumentError, match=named):
        eg.metric_upgrade(tracks, image_size=SIZE, priors=[prior])  # type: ignore[list-item]
