"""Makes the samples of the package, `runtime/epigauge/samples`; everything is computed here.

    python tests/make_samples.py

The photographs show a room with textured walls and two boxes in it, seen by a camera without
distortion: rays are cast, nine a pixel. JPEG is by OpenCV, whose versions differ in a few bytes.
"""

from __future__ import annotations

from pathlib import Path

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TARGET = Path(__file__).resolve().parents[1] / "runtime" / "epigauge" / "samples"

#: Corners of the room in metres (y down), and of the boxes that stand in it.
ROOM = np.array([[-3.0, -1.6, -3.0], [3.0, 1.2, 3.5]])
BOXES = (
    np.array([[-1.6, 0.1, 1.2], [-0.5, 1.2, 2.2]]),
    np.array([[0.7, 0.5, 0.6], [1.5, 1.2, 1.3]]),
)
#: Rays a pixel in each direction.
FINE = 3
QUALITY = 72


def texture(rng: np.random.Generator, tint: Array, size: int = 512) -> Array:
    """Return noise of several scales in one colour, (size, size, 3) in [0, 1]."""
    frequency = np.fft.fftfreq(size)
    radius = np.hypot(frequency[:, None], frequency[None, :])
    spectrum = np.fft.fft2(rng.normal(size=(size, size)))
    shape = np.where(radius > 0.0, np.maximum(radius, 1e-3) ** -0.9, 0.0)
    noise = np.real(np.fft.ifft2(spectrum * shape * np.exp(-((radius / 0.22) ** 2))))
    noise = np.clip(0.5 + 0.22 * noise / noise.std(), 0.03, 0.97)
    return noise[:, :, None] ** (1.0 / tint)


class Room:
    """Walls and boxes with their textures."""

    def __init__(self, seed: int = 4) -> None:
        rng = np.random.default_rng(seed)
        self.faces = [
            (box, axis, side, texture(rng, rng.uniform(0.6, 1.7, 3)))
            for box in (ROOM, *BOXES)
            for axis in range(3)
            for side in range(2)
        ]

    def colours(self, centre: Array, rays: Array) -> Array:
        """Return what rays (k, 3) from a point meet first, (k, 3)."""
        nearest = np.full(len(rays), np.inf)
        colour = np.zeros((len(rays), 3))
        for box, axis, side, image in self.faces:
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (box[side, axis] - centre[axis]) / rays[:, axis]
                hit = centre + t[:, None] * rays
            others = [k for k in range(3) if k != axis]
            inside = ((hit[:, others] >= box[0, others]) & (hit[:, others] <= box[1, others])).all(
                1
            )
            new = np.flatnonzero(inside & (t > 1e-6) & (t < nearest))
            nearest[new] = t[new]
            # Both faces of a pair have 90 pixels a metre of their own texture.
            u, v = (90.0 * hit[new][:, others]).T
            colour[new] = sampled(image, u, v) * (0.75 + 0.25 * (axis != 1))
        return colour

    def photograph(
        self, R: Array, centre: Array, size: tuple[int, int], f: float
    ) -> NDArray[np.uint8]:
        """Return an image, (h, w, 3) in the order blue, green, red."""
        w, h = size
        step = (np.arange(FINE) + 0.5) / FINE - 0.5
        total = np.zeros((h * w, 3))
        x, y = np.meshgrid(np.arange(w) - (w - 1) / 2, np.arange(h) - (h - 1) / 2)
        for dx in step:
            for dy in step:
                rays = np.stack([(x + dx) / f, (y + dy) / f, np.ones_like(x)], axis=-1)
                total += self.colours(centre, rays.reshape(-1, 3) @ R)
        return np.rint(255.0 * total / FINE**2).astype(np.uint8).reshape(h, w, 3)


def sampled(image: Array, u: Array, v: Array) -> Array:
    """Return bilinear values of a texture that repeats."""
    size = len(image)
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = (u - i)[:, None], (v - j)[:, None]
    i0, j0, i1, j1 = i % size, j % size, (i + 1) % size, (j + 1) % size
    near = (1 - a) * image[j0, i0] + a * image[j0, i1]
    return (1 - b) * near + b * ((1 - a) * image[j1, i0] + a * image[j1, i1])


def looking(centre: Array, at: Array) -> Array:
    """Return the rotation of a camera that looks at a point, upright."""
    z = (at - centre) / np.linalg.norm(at - centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def write_photographs() -> None:
    import cv2

    room = Room()
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    places = {"A": (-0.9, 0.0, -2.0), "B": (0.5, -0.15, -1.7)}
    for name, place in places.items():
        centre = np.array(place)
        R = looking(centre, np.array([-0.1, 0.2, 2.0]))
        assert cv2.imwrite(
            str(TARGET / f"{name}.jpg"), room.photograph(R, centre, (640, 480), 560.0), options
        )
    for k, angle in enumerate(np.linspace(-0.7, 0.7, 8)):
        centre = np.array([2.4 * np.sin(angle), -0.2 + 0.1 * (-1) ** k, 1.0 - 3.4 * np.cos(angle)])
        R = looking(centre, np.array([0.0, 0.2, 1.6]))
        image = room.photograph(R, centre, (400, 300), 360.0)
        assert cv2.imwrite(str(TARGET / f"room{k}.jpg"), image, options)


def write_tables() -> None:
    scene = eg.two_view_scene()
    eg.save_matches(TARGET / "matches.csv", eg.Matches(scene.x1, scene.x2))
    found = eg.match_images(TARGET / "A.jpg", TARGET / "B.jpg")
    eg.save_matches(TARGET / "raw_matches.csv", eg.Matches(found.x1, found.x2))
    tracks = eg.multi_view_scene().tracks
    eg.save_tracks(TARGET / "tracks.csv", tracks)
    rng = np.random.default_rng(8)
    wrong = rng.choice(len(tracks), len(tracks) // 20, replace=False)
    xy = tracks.xy.copy()
    xy[wrong] += rng.uniform(10.0, 60.0, (len(wrong), 2)) * rng.choice([-1.0, 1.0], (len(wrong), 2))
    eg.save_tracks(TARGET / "raw_tracks.csv", eg.Tracks(tracks.view, tracks.point, xy))


if __name__ == "__main__":
    write_photographs()
    write_tables()
    for path in sorted(TARGET.iterdir()):
        print(path.name, path.stat().st_size)
