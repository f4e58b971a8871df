"""Matches of two views for tests of verdicts, and COLMAP databases that hold them."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
from colmap_databases import SCHEMA, pair_id
from two_views import Array

K = np.array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 480.0], [0.0, 0.0, 1.0]])
SIZE = [1280.0, 960.0]


def pixels(X: Array) -> Array:
    h = X @ K.T
    return np.asarray(h[:, :2] / h[:, 2:])


def plane(n: int, wrong: int, seed: int) -> tuple[Array, Array]:
    """Matches of a slanted plane, and wrong ones that a verifier let through."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform(-1.5, 1.5, n), rng.uniform(-1.0, 1.0, n), np.full(n, 4.0)])
    X[:, 2] += 0.4 * X[:, 0]
    x1, x2 = (pixels(Y) + rng.normal(0.0, 0.5, (n, 2)) for Y in (X, X + np.array([0.6, 0.1, 0.1])))
    others = rng.uniform([0.0, 0.0], SIZE, (2, wrong, 2))
    return np.vstack([x1, others[0]]), np.vstack([x2, others[1]])


def write(path: Path, x1: Array, x2: Array, *, config: int = 3, camera: tuple[int, Array]) -> Path:
    """Make a COLMAP database of one pair."""
    m = len(x1)
    with sqlite3.connect(path) as connection:
        connection.executescript(SCHEMA)
        row = (1, camera[0], 1280, 960, np.asarray(camera[1], "<f8").tobytes(), 0)
        connection.execute("INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)", row)
        for image, x in ((1, x1), (2, x2)):
            connection.execute("INSERT INTO images VALUES (?, ?, 1)", (image, f"{image}.jpg"))
            table = (image, m, 2, x.astype("<f4").tobytes())
            connection.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", table)
        inliers = np.column_stack([np.arange(m)] * 2).astype("<u4").tobytes()
        connection.execute(
            "INSERT INTO two_view_geometries VALUES (?, ?, 2, ?, ?, ?, NULL, NULL, NULL, NULL)",
            (pair_id(1, 2), m, inliers, config, np.eye(3).tobytes()),
        )
    connection.close()
    return path


PINHOLE = (0, np.array([1000.0, 640.0, 480.0]))
