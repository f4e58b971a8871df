"""What the tests of two views share: how to compare F, measured pairs and their optima."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FOCAL = 1000.0
_CENTRE = np.array([512.0, 384.0])


def homogeneous(x: Array) -> Array:
    """Append a column of ones."""
    return np.column_stack([x, np.ones(len(x))])


def project(P: Array, Q: Array) -> Array:
    """Return the pixels that homogeneous points (m, 4) project to."""
    h = Q @ P.T
    return h[:, :2] / h[:, 2:]


def cross(v: Array) -> Array:
    """Return the matrix of the cross product with v."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def up_to_sign(A: Array, B: Array) -> float:
    """Return the largest difference of two arrays of unit norm that are known up to sign."""
    A, B = A / np.linalg.norm(A), B / np.linalg.norm(B)
    return float(min(np.abs(A - B).max(), np.abs(A + B).max()))


def normalizing(x: Array) -> Array:
    """Return the (3, 3) map from pixels to coordinates with mean zero and RMS one."""
    origin = x.mean(axis=0)
    scale = np.sqrt(np.mean((x - origin) ** 2))
    return np.array([[1, 0, -origin[0]], [0, 1, -origin[1]], [0, 0, scale]]) / scale


def same_geometry(F: Array, G: Array, x1: Array, x2: Array) -> float:
    """Return the difference of two fundamental matrices in coordinates where entries compare.

    In pixels the last entry of F dwarfs all others; in normalised coordinates all matter alike.
    """
    to_pixels1, to_pixels2 = np.linalg.inv(normalizing(x1)), np.linalg.inv(normalizing(x2))
    return up_to_sign(to_pixels2.T @ F @ to_pixels1, to_pixels2.T @ G @ to_pixels1)


def algebraic(F: Array, x1: Array, x2: Array) -> Array:
    """Return x2^T F x1 over the length of its gradient: pixels, zero on the epipolar geometry."""
    right, left = homogeneous(x1) @ F.T, homogeneous(x2) @ F
    gradient = np.linalg.norm(np.column_stack([right[:, :2], left[:, :2]]), axis=1)
    return np.asarray(np.sum(homogeneous(x2) * right, axis=1) / gradient)


def inliers(pair: Path) -> tuple[Array, Array]:
    """Return the matches of a measured pair that its makers call right."""
    with np.load(pair) as data:
        return data["x1"][data["inlier"]], data["x2"][data["inlier"]]


def published_rms(readme: Path) -> dict[str, float]:
    """Return the column "RMS per coordinate" of the table in the pairs' README."""
    rows = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in readme.read_text(encoding="utf-8").splitlines()
        if line.startswith("|")
    ]
    (column,) = (k for k, title in enumerate(rows[0]) if "RMS per coordinate" in title)
    return {row[0]: float(row[column]) for row in rows[2:]}


def turned(rng: np.random.Generator) -> Array:
    """A rotation by 3 to 17 degrees about a random axis."""
    axis = rng.standard_normal(3)
    angle = rng.uniform(0.05, 0.3)
    C = np.cross(np.eye(3), -axis / np.linalg.norm(axis))
    return np.asarray(np.eye(3) + np.sin(angle) * C + (1 - np.cos(angle)) * C @ C)


def scene(kind: str, m: int, noise: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Matches of one camera in two positions: "general", "planar" or "rotation"."""
    rays = np.column_stack([rng.uniform(-0.4, 0.4, m), rng.uniform(-0.3, 0.3, m), np.ones(m)])
    X = rays * rng.uniform(4, 8, m)[:, None]
    if kind == "planar":
        X = 6 * rays / (rays @ [*rng.uniform(-0.5, 0.5, 2), 1.0])[:, None]
    t = rng.standard_normal(3)
    t *= 0.0 if kind == "rotation" else 0.8 / np.linalg.norm(t)
    views = (X, X @ turned(rng).T + t)
    x1, x2 = (_FOCAL * Y[:, :2] / Y[:, 2:] + _CENTRE for Y in views)
    return x1 + noise * rng.standard_normal((m, 2)), x2 + noise * rng.standard_normal((m, 2))
