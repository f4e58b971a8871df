"""Angles between the walls of a building, with free and with published intrinsics.

    python benchmarks/walls.py FOLDER

The folder is a data set with tracks.npz and K of a building, whose walls are at right angles or
parallel, nearly. What a wrong focal length does to them needs no calibration to be seen. Walls are
found by random triples of points in the scene with free intrinsics, and are the same points
throughout.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Distance of a point from its wall, of the depth of the scene; triples; walls; points of one.
_NEAR, _TRIPLES, _WALLS, _LEAST = 0.004, 600, 4, 200


def normal_of(X: Array) -> tuple[Array, Array]:
    """Return a point and the normal of a plane, robustly."""
    weights = np.ones(len(X))
    for _ in range(10):
        middle = weights @ X / weights.sum()
        Y = X - middle
        normal = np.linalg.eigh((Y * weights[:, None]).T @ Y)[1][:, 0]
        distances = np.abs(Y @ normal)
        weights = 1.0 / np.maximum(distances, np.median(distances))
    return middle, normal


def walls(X: Array) -> list[NDArray[np.intp]]:
    """Return the points of the largest planes."""
    rng, left, found = np.random.default_rng(0), np.arange(len(X)), []
    while len(found) < _WALLS and len(left) >= _LEAST:
        Y, best = X[left], np.zeros(len(left), dtype=bool)
        for _ in range(_TRIPLES):
            a, b, c = Y[rng.choice(len(Y), 3, replace=False)]
            normal = np.cross(b - a, c - a)
            near = np.abs((Y - a) @ normal) < _NEAR * np.linalg.norm(normal)
            best = near if near.sum() > best.sum() else best
        middle, normal = normal_of(Y[best])
        if np.count_nonzero(np.abs((Y - middle) @ normal) < _NEAR) >= _LEAST:
            found.append(np.flatnonzero(np.abs((X - middle) @ normal) < _NEAR))
        left = left[np.abs((Y - middle) @ normal) > 2.0 * _NEAR]
    return found


def main(folder: Path) -> None:
    """Print angles between walls, for three adjustments."""
    with np.load(folder / "tracks.npz") as z:
        K, size = np.array(z["K"]).reshape(-1, 3, 3)[0], z["image_size"]
        tracks = eg.Tracks(z["view"], z["point"], z["xy"])
    found = eg.metric_upgrade(tracks, image_size=size)
    scene, kept = found.reconstruction, tracks.weighted(np.where(found.rejected, 0.0, 1.0))
    lengths = np.bincount(tracks.point[~found.rejected], minlength=tracks.n_points)
    f, cx, cy, k = scene.cameras.params[0]
    bend, fixed = ("k1", "k2", "p1", "p2"), [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    of_walls: list[NDArray[np.intp]] = []
    for label, params, refine in (
        ("all free", [f, f, cx, cy, k, 0, 0, 0], "all"),
        ("f published", [*fixed[:2], cx, cy, k, 0, 0, 0], ("cx", "cy", *bend)),
        ("K published", [*fixed, k, 0, 0, 0], bend),
    ):
        cameras = eg.Cameras("OPENCV", [params], np.zeros(tracks.n_views, dtype=int))
        start = eg.MetricReconstruction(scene.R, scene.t, scene.X, cameras)
        end = eg.bundle_adjust(kept, start, refine=refine, ftol=1e-8, max_iter=100)
        X = end.reconstruction.X
        if not of_walls:
            good = np.flatnonzero(lengths >= 3)
            good = good[np.linalg.norm(X[good] - np.median(X[good], axis=0), axis=1) < 3.0]
            of_walls = [good[rows] for rows in walls(X[good])]
        N = np.array([normal_of(X[rows])[1] for rows in of_walls])
        angles = np.degrees(np.arccos(np.clip(np.abs(N @ N.T), 0.0, 1.0)))
        pairs = zip(*np.triu_indices(len(N), 1), strict=True)
        told = ", ".join(f"{i}-{j} {angles[i, j]:.2f}" for i, j in pairs)
        rms = np.sqrt(np.mean(end.fun[kept.weights > 0.0] ** 2))
        print(f"{label:12} rms {rms:.4f} px; walls of {[len(w) for w in of_walls]} points: {told}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    main(parser.parse_args().folder)
