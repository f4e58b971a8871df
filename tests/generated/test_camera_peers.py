"""The camera models against COLMAP, OpenCV and a published photogrammetric adjustment."""

from __future__ import annotations

import numpy as np
import pytest
from epigauge import kernels
from epigauge_generated.signatures import MODELS

TABLE = kernels.table("numpy")

#: Parameters of every size that cameras have, in COLMAP's order.
COLMAP = {
    "SIMPLE_PINHOLE": [712.0, 318.5, 243.25],
    "PINHOLE": [712.0, 705.5, 318.5, 243.25],
    "SIMPLE_RADIAL": [712.0, 318.5, 243.25, -0.21],
    "RADIAL": [712.0, 318.5, 243.25, -0.21, 0.08],
    "OPENCV": [712.0, 705.5, 318.5, 243.25, -0.21, 0.08, 1.3e-3, -2.1e-3],
    "FULL_OPENCV": [
        *(712.0, 705.5, 318.5, 243.25, -0.21, 0.08, 1.3e-3, -2.1e-3, -0.02, 0.11, 0.03, 0.004)
    ],
    "OPENCV_FISHEYE": [312.0, 305.5, 318.5, 243.25, -0.021, 0.008, -0.003, 0.0011],
    "EQUIRECTANGULAR": [640.0, 320.0],
}


def rays(count=400, spread=1.2):
    """Return points of the camera frame in front of the camera, also on its axis and next to it."""
    rng = np.random.default_rng(3)
    h = np.stack([*rng.uniform(-spread, spread, (2, count)), np.ones(count)])
    h[:2, :6] = 0.0
    h[0, 1:6] = 1e-300, 1e-20, 1e-12, 1e-8, 1e-4
    return h * rng.uniform(0.01, 100.0, count)


def image(name, h, k):
    """Project points of the camera frame."""
    model = MODELS[name]
    camera = np.concatenate([np.eye(3, 4).ravel(), k])[:, None]
    return getattr(TABLE, f"{model.prefix}_project")(camera, h)


@pytest.mark.parametrize("name", COLMAP)
def test_projection_is_colmap_s(name):
    pycolmap = pytest.importorskip("pycolmap")
    if name not in pycolmap.CameraModelId.__members__:
        pytest.skip(f"this pycolmap has no camera {name}")
    k = COLMAP[name]
    theirs = pycolmap.Camera(model=name, width=640, height=480, params=k)
    assert theirs.params_info.replace(" ", "").split(",") == (
        ["w", "h"] if name == "EQUIRECTANGULAR" else list(MODELS[name].params)
    )
    h = rays()
    if name == "EQUIRECTANGULAR":
        h *= np.random.default_rng(4).choice([-1.0, 1.0], h.shape)
    q_hat, depth = image(name, h, k)
    expected = np.array([theirs.img_from_cam(one) for one in h.T]).T
    assert np.abs(q_hat - expected).max() <= 1e-9
    assert (depth > 0.0).all()


@pytest.mark.parametrize("name", [name for name in COLMAP if name != "EQUIRECTANGULAR"])
def test_depth_tells_what_lies_behind(name):
    """COLMAP gives such points no image; here the image is that of the formula, and depth < 0."""
    h = rays()
    h[2] *= -1.0
    q_hat, depth = image(name, h, COLMAP[name])
    assert (depth < 0.0).all()
    beside = np.hypot(h[0], h[1]) > 1e-3  # opposite to its axis a fisheye has no image
    assert np.isfinite(q_hat[:, beside]).all()


@pytest.mark.parametrize("name", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_projection_is_opencv_s(name):
    cv2 = pytest.importorskip("cv2")
    fx, fy, cx, cy, *distortion = COLMAP[name]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    h, zero = rays()[:, 3:], np.zeros(3)
    points = np.ascontiguousarray(h.T[:, None])
    project = cv2.fisheye.projectPoints if name == "OPENCV_FISHEYE" else cv2.projectPoints
    distortion = np.array(distortion or [0.0] * 4)
    expected, _ = project(points, zero, zero, K, distortion)
    # OpenCV's fisheye leaves a circle of 1e-8 about the axis undistorted.
    np.testing.assert_allclose(image(name, h, COLMAP[name])[0], expected[:, 0].T, atol=1e-9)


def test_bal_is_its_formula():
    """p = -X / X_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, as the page of the data set writes it."""
    f, k1, k2 = 612.0, -0.13, 0.02
    h = rays()
    h[2] *= -1.0
    p = -h[:2] / h[2]
    squared = (p**2).sum(axis=0)
    q_hat, depth = image("bal", h, [f, k1, k2])
    np.testing.assert_allclose(q_hat, f * (1 + k1 * squared + k2 * squared**2) * p, rtol=1e-13)
    assert (depth > 0.0).all()


def test_sphere_is_seen_without_a_seam():
    model, (width, height) = MODELS["spherical"], (640.0, 320.0)
    rng = np.random.default_rng(5)
    h = rng.standard_normal((3, 300))
    q_hat, depth = image("spherical", h, [width, height])
    np.testing.assert_allclose(depth, np.linalg.norm(h, axis=0))
    longitude, latitude = 2 * np.pi * (q_hat[0] / width - 0.5), np.pi * (q_hat[1] / height - 0.5)
    direction = [
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
        np.cos(latitude) * np.cos(longitude),
    ]
    np.testing.assert_allclose(direction, h / depth, atol=1e-14)
    # A whole number of turns changes no residual; none is longer than half a turn.
    camera = np.concatenate([np.eye(3, 4).ravel(), [width, height]])[:, None]
    shift = np.array([[3.0], [-2.0]])
    for turns in (-2, -1, 0, 1, 2):
        q = q_hat + shift + np.array([[turns * width], [0.0]])
        r = getattr(TABLE, f"{model.prefix}_residual")(camera, h, q)
        np.testing.assert_allclose(r, np.broadcast_to(shift, r.shape), atol=1e-11)


def test_brown_gives_the_residuals_of_a_published_adjustment(data_dir):
    """The report prints 19944 residuals of a network that a commercial program has adjusted."""
    path = data_dir / "metrology_aicon" / "network.npz"
    if not path.exists():
        pytest.skip(f"no {path.name} of the metrology network")
    network = np.load(path)
    given = dict(zip(network["camera_names"].astype(str), network["camera"], strict=True))
    given |= {"A3": float(network["fixed_A3"]), "R0": float(network["r0"])}
    given |= {"C1": float(network["fixed_C1"]), "C2": float(network["fixed_C2"])}
    k = [given[name] for name in MODELS["brown"].params]
    poses = []
    for (omega, phi, kappa), X0 in zip(network["angles"], network["position"], strict=True):
        a, b, c = (np.array([[np.cos(x), -np.sin(x)], [np.sin(x), np.cos(x)]]) for x in
                   (omega, phi, kappa))
        Rx, Ry, Rz = np.eye(3), np.eye(3), np.eye(3)
        Rx[1:, 1:], Rz[:2, :2], Ry[::2, ::2] = a, c, b.T
        R = (Rx @ Ry @ Rz).T
        poses.append(np.concatenate([np.column_stack([R, -R @ X0]).ravel(), k]))
    camera = np.array(poses)[network["view"]].T
    X = network["points"][network["point"]].T
    r = TABLE.brown_residual(camera, X, network["xy"].T)
    # All printed values are rounded to some nanometres; the residuals are computed - observed.
    assert np.abs(r + network["residual_report"].T).max() <= 5e-6
    assert (TABLE.brown_project(camera, X)[1] > 0.0).all()
