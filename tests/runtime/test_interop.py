"""Matches and F to and from OpenCV, pycolmap and PoseLib: conventions checked against them."""

from __future__ import annotations

import sys

import epigauge as eg
import numpy as np
import pytest
from epigauge import interop
from two_views import same_geometry, up_to_sign

SCENE = eg.two_view_scene(noise_px=0.0, n_points=60, distance=5.0, seed=3)
SHIFT = np.array([600.0, 500.0])
X1, X2 = SCENE.x1 + SHIFT, SCENE.x2 + SHIFT
TO_PIXELS = np.array([[1.0, 0.0, 600.0], [0.0, 1.0, 500.0], [0.0, 0.0, 1.0]])
K = TO_PIXELS @ SCENE.K
F = np.linalg.inv(TO_PIXELS).T @ SCENE.F_true @ np.linalg.inv(TO_PIXELS)


@pytest.fixture(scope="module")
def cv2():
    return pytest.importorskip("cv2", reason="needs OpenCV")


@pytest.fixture(scope="module")
def pycolmap():
    return pytest.importorskip("pycolmap", reason="needs pycolmap")


@pytest.fixture(scope="module")
def poselib():
    return pytest.importorskip("poselib", reason="needs PoseLib")


# pixels


def test_moving_there_and_back_is_nothing_and_F_goes_with_the_points() -> None:
    y1, y2 = (interop.move_points(x, "opencv", "colmap") for x in (X1, X2))
    np.testing.assert_array_equal(y1, X1 + 0.5)
    np.testing.assert_array_equal(interop.move_points(y1, "colmap", "opencv"), X1)
    G = interop.move_fundamental(F, "opencv", "colmap")
    np.testing.assert_allclose(eg.reprojection_distances(G, y1, y2)[0], 0.0, atol=1e-6)
    assert np.abs(eg.reprojection_distances(F, y1, y2)[0]).max() > 1e-3
    np.testing.assert_allclose(interop.move_fundamental(G, "colmap", "opencv"), F, atol=1e-12)
    np.testing.assert_array_equal(interop.move_fundamental(F, "colmap", "colmap"), F)


def test_opencv_and_colmap_differ_by_half_a_pixel(cv2, pycolmap, tmp_path) -> None:
    """The middle of a blob at pixel (60, 45), counted from zero, found by either library."""
    y, x = np.mgrid[:96, :128]
    blob = np.exp(-((x - 60) ** 2 + (y - 45) ** 2) / (2.0 * 4.0**2))
    image = np.round(255.0 * blob).astype(np.uint8)
    moments = cv2.moments(image)
    in_opencv = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    np.testing.assert_allclose(in_opencv, [60.0, 45.0], atol=0.01)

    cv2.imwrite(str(tmp_path / "blob.png"), image)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    pycolmap.extract_features(
        tmp_path / "d.db", tmp_path, extraction_options=options, device=pycolmap.Device.cpu
    )
    database = pycolmap.Database.open(tmp_path / "d.db")
    found = database.read_keypoints(1)[:, :2]
    database.close()
    expected = interop.move_points(in_opencv, "opencv", "colmap")
    assert np.linalg.norm(found - expected, axis=1).min() < 0.05


# OpenCV


def test_opencv_roundtrip_and_order(cv2) -> None:
    keypoints1, keypoints2, matches = interop.to_opencv(X1, X2, size=7.0)
    assert (type(keypoints1[0]), type(matches[0])) == (cv2.KeyPoint, cv2.DMatch)
    x1, x2 = interop.from_opencv(keypoints1, keypoints2, matches)
    np.testing.assert_array_equal(x1, X1.astype(np.float32))
    np.testing.assert_array_equal(x2, X2.astype(np.float32))
    # A matcher's own answer: query is image 1, train is image 2.
    random = np.random.default_rng(0)
    order = random.permutation(len(X1))
    descriptors = random.uniform(size=(len(X1), 32)).astype(np.float32)
    found = cv2.BFMatcher().match(descriptors, descriptors[order])
    x1, x2 = interop.from_opencv(keypoints1, [keypoints2[k] for k in order], found)
    np.testing.assert_array_equal(x2, X2.astype(np.float32))


def test_opencv_has_the_same_F(cv2) -> None:
    found, _ = cv2.findFundamentalMat(X1, X2, cv2.FM_8POINT)
    # OpenCV computes in double, from points in single precision.
    assert same_geometry(found, F, X1, X2) < 1e-4
    lines = cv2.computeCorrespondEpilines(X1[:, None], 1, F)[:, 0]
    np.testing.assert_allclose(np.sum(lines * np.c_[X2, np.ones(len(X2))], axis=1), 0, atol=1e-3)


# COLMAP


def test_colmap_roundtrip_through_a_database(pycolmap, tmp_path) -> None:
    keypoints1, keypoints2, matches = interop.to_colmap(X1, X2)
    database = pycolmap.Database.open(tmp_path / "d.db")
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=1200, height=1000, params=[1.0, 2.0, 3.0], camera_id=1
    )
    database.write_camera(camera, use_camera_id=True)
    for image, keypoints in ((1, keypoints1), (2, keypoints2)):
        database.write_image(
            pycolmap.Image(name=f"{image}", camera_id=1, image_id=image), use_image_id=True
        )
        database.write_keypoints(image, keypoints)
    database.write_matches(1, 2, matches)
    database.write_two_view_geometry(1, 2, interop.to_two_view_geometry(F, matches))
    read = database.read_keypoints(1), database.read_keypoints(2)
    x1, x2 = interop.from_colmap(*read, database.read_matches(1, 2))
    np.testing.assert_array_equal(x1, X1.astype(np.float32))
    np.testing.assert_array_equal(x2, X2.astype(np.float32))
    there = interop.from_two_view_geometry(database.read_two_view_geometry(1, 2))
    back = interop.from_two_view_geometry(database.read_two_view_geometry(2, 1))
    database.close()
    np.testing.assert_array_equal(there[0], F)
    np.testing.assert_array_equal(there[1], matches)
    np.testing.assert_array_equal(back[0], F.T)
    assert eg.colmap.refine_database(tmp_path / "d.db").config.tolist() == [3]


def test_colmap_has_the_same_F(pycolmap) -> None:
    found = pycolmap.estimate_fundamental_matrix(X1, X2)
    assert same_geometry(found["F"], F, X1, X2) < 1e-6


def test_colmaps_objects_are_taken_too(pycolmap) -> None:
    keypoints1, keypoints2, matches = interop.to_colmap(X1, X2)
    objects = [
        pycolmap.FeatureKeypoints([pycolmap.FeatureKeypoint(x=x, y=y) for x, y in points.tolist()])
        for points in (keypoints1, keypoints2)
    ]
    reverse = pycolmap.matches_from_matrix(matches[::-1].copy())
    x1, x2 = interop.from_colmap(*objects, reverse)
    np.testing.assert_array_equal(x1, X1.astype(np.float32)[::-1])
    np.testing.assert_array_equal(x2, X2.astype(np.float32)[::-1])


def test_a_geometry_without_F_is_refused(pycolmap) -> None:
    with pytest.raises(eg.ArgumentError, match="holds no F"):
        interop.from_two_view_geometry(pycolmap.TwoViewGeometry())


@pytest.mark.parametrize(
    ("matches", "reason"),
    [
        ([[0, 60]], "keypoint 60 of image 2 in row 0"),
        ([[0, 0], [-1, 0]], "keypoint -1 of image 1 in row 1"),
        ([[0, 1, 2]], r"shape \(1, 3\)"),
        ([[0.0, 1.0]], "float64"),
    ],
)
def test_matches_without_keypoints_are_refused(matches, reason) -> None:
    with pytest.raises(eg.ArgumentError, match=reason):
        interop.from_colmap(X1, X2, np.array(matches))


def test_no_matches_are_no_points() -> None:
    for x in interop.from_colmap(X1, X2, np.zeros((0, 2), np.uint32)):
        assert x.shape == (0, 2)
    for x in interop.from_opencv([], [], []):
        assert x.shape == (0, 2)


# PoseLib


def test_poselib_has_the_same_F(poselib) -> None:
    found, _ = poselib.refine_fundamental(X1, X2, F, {"loss_type": "TRIVIAL"})
    assert same_geometry(found, F, X1, X2) < 1e-6


def test_poselib_roundtrip_and_motion(poselib) -> None:
    result = eg.refine_fundamental(X1, X2, essential=True, K1=K, K2=K)
    pair = interop.to_poselib(result.R, result.t, K, K, ((1200, 1000), (1200, 1000)))
    assert (pair.camera1.width, pair.camera2.height) == (1200, 1000)
    G, K1, K2 = interop.from_poselib(pair)
    assert same_geometry(G, F, X1, X2) < 1e-6
    np.testing.assert_array_equal(K1, K)
    np.testing.assert_array_equal(K2, K)
    # PoseLib, started there, stays there.
    pose, _ = poselib.refine_relative_pose(X1, X2, pair.pose, pair.camera1, pair.camera2, {})
    np.testing.assert_allclose(pose.R, result.R, atol=1e-6)
    assert up_to_sign(pose.t, result.t) < 1e-6
    np.testing.assert_allclose(pair.pose.R @ [1.0, 2.0, 3.0], result.R @ [1.0, 2.0, 3.0])


def test_poselibs_calibrations_stay_with_their_images(poselib) -> None:
    K1, K2 = np.diag([900.0, 950.0, 1.0]), np.diag([1300.0, 1250.0, 1.0])
    K1[:2, 2], K2[:2, 2] = (500.0, 420.0), (650.0, 480.0)
    result = eg.refine_fundamental(X1, X2, essential=True, K1=K, K2=K)
    pair = interop.to_poselib(result.R, result.t, K1, K2, ((1000, 840), (1300, 960)))
    G, one, two = interop.from_poselib(pair)
    np.testing.assert_array_equal(one, K1)
    np.testing.assert_array_equal(two, K2)
    # Of points seen by these cameras, and not by the exchanged ones.
    rng = np.random.default_rng(1)
    X = rng.uniform((-1.0, -1.0, 5.0), (1.0, 1.0, 7.0), (30, 3))
    q1, q2 = X @ K1.T, (X @ result.R.T + result.t) @ K2.T
    d, *_ = eg.reprojection_distances(G, q1[:, :2] / q1[:, 2:], q2[:, :2] / q2[:, 2:])
    assert np.abs(d).max() < 1e-9


def test_poselibs_estimate_is_a_start(poselib) -> None:
    camera = poselib.Camera("SIMPLE_PINHOLE", [1000.0, 600.0, 500.0], 1200, 1000)
    pose, _ = poselib.estimate_relative_pose(X1, X2, camera, camera, {"max_epipolar_error": 1.0})
    pair = poselib.ImagePair()
    pair.pose, pair.camera1, pair.camera2 = pose, camera, camera
    start, K1, K2 = interop.from_poselib(pair)
    result = eg.refine_fundamental(X1, X2, start, essential=True, K1=K1, K2=K2)
    assert result.rms_px < 1e-6


def test_what_poselib_cannot_hold_is_refused(poselib) -> None:
    skewed = K + np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    with pytest.raises(eg.ArgumentError, match="K2 has skew"):
        interop.to_poselib(np.eye(3), [1.0, 0.0, 0.0], K, skewed)
    with pytest.raises(eg.ArgumentError, match="R is no rotation"):
        interop.to_poselib(-np.eye(3), [1.0, 0.0, 0.0], K, K)
    pair = interop.to_poselib(np.eye(3), [0.0, 0.0, 0.0], K, K)
    with pytest.raises(eg.ArgumentError, match="same centre"):
        interop.from_poselib(pair)
    pair.camera2 = poselib.Camera("SIMPLE_RADIAL", [1.0, 2.0, 3.0, 0.1], 640, 480)
    with pytest.raises(eg.ArgumentError, match="camera2 is of the model SIMPLE_RADIAL"):
        interop.from_poselib(pair)


# absent


@pytest.mark.parametrize(
    ("module", "call"),
    [
        ("cv2", lambda: interop.to_opencv(X1, X2)),
        ("pycolmap", lambda: interop.to_two_view_geometry(F, [[0, 0]])),
        ("poselib", lambda: interop.to_poselib(np.eye(3), [1.0, 0.0, 0.0], K, K)),
    ],
)
def test_a_missing_library_is_named_with_the_extra(monkeypatch, module, call) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"epigauge\[interop\]"):
        call()
