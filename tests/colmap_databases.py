"""COLMAP databases of simulated points: what tests of readers and writers share."""

from __future__ import annotations

import sqlite3
from itertools import combinations
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: The tables of COLMAP 3.9 that matter, as it creates them.
SCHEMA = """
CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB,
    prior_focal_length INTEGER NOT NULL);
CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL,
    CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < 2147483647),
    FOREIGN KEY(camera_id) REFERENCES cameras(camera_id));
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB,
    FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE);
CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB);
CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL,
    cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL, F BLOB, E BLOB, H BLOB, qvec BLOB,
    tvec BLOB);
"""

_MAX_IMAGES = 2147483647


def pair_id(image1: int, image2: int) -> int:
    """Return COLMAP's number of a pair."""
    return _MAX_IMAGES * image1 + image2


class Project:
    """Six views of a scene: keypoints, inliers and fundamental matrices of its 15 pairs.

    Parameters
    ----------
    n_views, n_points : int
        Size of the scene, of which every view sees all.
    seed : int
        Of scene, noise and the order of the keypoints.
    """

    def __init__(self, n_views: int = 6, n_points: int = 40, seed: int = 5) -> None:
        scene = eg.multi_view_scene(
            n_views=n_views, n_points=n_points, distance=4.0, noise_px=0.5, seed=seed
        )
        random = np.random.default_rng(seed)
        self.keypoints: dict[int, NDArray[np.float32]] = {}
        place: dict[int, NDArray[np.intp]] = {}
        for view in range(n_views):
            points = scene.tracks.xy[scene.tracks.view == view] + [600.0, 500.0]
            # Every image has its own order, and keypoints that match nothing.
            others = random.uniform(0.0, 1000.0, (7, 2))
            order = random.permutation(n_points + len(others))
            self.keypoints[view + 1] = np.vstack([points, others])[order].astype(np.float32)
            place[view + 1] = np.argsort(order)[:n_points]
        self.inliers = {
            pair: np.column_stack([place[pair[0]], place[pair[1]]]).astype(np.uint32)
            for pair in combinations(self.keypoints, 2)
        }
        self.F = {pair: eg.fundamental_8point(*self.points(pair)) for pair in self.inliers}

    def points(self, pair: tuple[int, int]) -> tuple[Array, Array]:
        """Return the inliers of a pair as points."""
        numbers = self.inliers[pair].T
        x1, x2 = (self.keypoints[i][k] for i, k in zip(pair, numbers, strict=True))
        return x1.astype(np.float64), x2.astype(np.float64)

    def write(self, path: Path, *, version: int = 3900, cols: int = 6, config: int = 3) -> Path:
        """Make a database as COLMAP makes it; of the pair (1, 2) it has no F."""
        with sqlite3.connect(path) as connection:
            connection.executescript(SCHEMA)
            params = np.array([1000.0, 600.0, 500.0]).tobytes()
            connection.execute("INSERT INTO cameras VALUES (1, 0, 1200, 1000, ?, 0)", (params,))
            for image, points in self.keypoints.items():
                table = np.ones((len(points), cols), np.float32)
                table[:, :2] = points
                connection.execute("INSERT INTO images VALUES (?, ?, 1)", (image, f"{image}.jpg"))
                row = (image, *table.shape, table.tobytes())
                connection.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", row)
            for pair, inliers in self.inliers.items():
                F = None if pair == (1, 2) else self.F[pair].tobytes()
                row = (pair_id(*pair), *inliers.shape, inliers.tobytes())
                connection.execute("INSERT INTO matches VALUES (?, ?, ?, ?)", row)
                connection.execute(
                    "INSERT INTO two_view_geometries VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    (*row, config, F, F, F, None, None),
                )
            connection.execute(f"PRAGMA user_version = {version}")
        connection.close()
        return path

    def write_by_pycolmap(self, path: Path) -> Path:
        """Make the same database by COLMAP itself, with every other pair given in reverse."""
        import pycolmap

        database = pycolmap.Database.open(path)
        params = [1000.0, 600.0, 500.0]
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=1200, height=1000, params=params, camera_id=1
        )
        database.write_camera(camera, use_camera_id=True)
        for image, points in self.keypoints.items():
            database.write_image(
                pycolmap.Image(name=f"{image}.jpg", camera_id=1, image_id=image), use_image_id=True
            )
            database.write_keypoints(image, points)
        for number, ((image1, image2), inliers) in enumerate(self.inliers.items()):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            reverse = -1 if number % 2 else 1
            images = (image1, image2)[::reverse]
            geometry.inlier_matches = np.ascontiguousarray(inliers[:, ::reverse])
            if number:
                F = self.F[image1, image2]
                geometry.F = F.T if number % 2 else F
            database.write_matches(*images, geometry.inlier_matches)
            database.write_two_view_geometry(*images, geometry)
        database.close()
        return path


def content(path: Path) -> dict[str, list[Any]]:
    """Return all rows of all tables; the file must be in order."""
    connection = sqlite3.connect(path)
    try:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        return {
            name: connection.execute(f"SELECT * FROM {name}").fetchall()
            for (name,) in tables.fetchall()
        }
    finally:
        connection.close()


def change(path: Path, *statements: str, parameters: tuple[Any, ...] = ()) -> Path:
    """Change a database."""
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement, parameters)
    connection.commit()
    connection.close()
    return path
