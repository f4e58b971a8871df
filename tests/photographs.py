"""Photographs for tests: two views, rendered, of textured planes at several depths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Camera matrix; the images have 640 x 480 pixels.
K = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])


def rendered(t: tuple[float, float, float], seed: int = 0) -> tuple[Image, Image, Array]:
    """Return two grey photographs and the F between them, for a camera that moves by `t`.

    Eight squares stand at depths of 4 to 9 in front of a wall at 12; all carry smoothed noise.
    The camera does not turn, so that both epipoles are where `t` points to.
    """
    import cv2

    rng = np.random.default_rng(seed)
    planes = [(np.array([-9.0, -7.0, 12.0]), np.array([9.0, -7.0, 14.0]), 14.0)]
    for depth in np.linspace(9.0, 4.0, 8):
        x, y = rng.uniform((-0.45, -0.34), (0.45, 0.34)) * depth
        half = 0.1 * depth
        left = np.array([x - half, y - half, depth])
        planes.append((left, left + np.array([2 * half, 0.0, rng.uniform(-1.0, 1.0)]), 2 * half))
    views = np.zeros((2, 480, 640), dtype=np.uint8)
    for left, right, height in planes:
        texture = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (500, 500)), (0, 0), 1.5)
        texture = cv2.normalize(texture, None, 20.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)
        # Corners of the texture's pixels to corners of the plane
        down = np.array([0.0, height, 0.0])
        to_plane = np.column_stack([(right - left) / 500, down / 500, left])
        for view, centre in enumerate((np.zeros(3), np.array(t))):
            H = K @ (to_plane - np.outer(centre, (0.0, 0.0, 1.0)))
            H = H @ np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # centres of its pixels
            mask = cv2.warpPerspective(np.full((500, 500), 255, np.uint8), H, (640, 480))
            seen = cv2.warpPerspective(texture, H, (640, 480), flags=cv2.INTER_AREA)
            views[view][mask > 127] = seen[mask > 127]
    x, y, z = t
    inverse = np.linalg.inv(K)
    F = inverse.T @ np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ inverse
    return views[0], views[1], F / np.linalg.norm(F)
