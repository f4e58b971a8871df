"""Metric scenes from tracks alone: exact recovery, invariances, motions that leave things open."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from calibration import CENTRE, SIZE, tracks_of
from epigauge.metric.quadric import Views, metric_bases
from epigauge.metric.scene import Images


def _focal_error(found: eg.MetricUpgrade, focal: float = 900.0) -> float:
    return abs(float(np.max(found.focal_px)) / focal - 1.0)


@pytest.mark.parametrize("n_views", [3, 4, 8])
def test_exact_tracks_give_the_exact_camera(n_views: int) -> None:
    tracks, truth = tracks_of(n_views=n_views, seed=n_views, bend=-0.05)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.success
    assert found.flags == ()
    assert found.refined == ("f", "cx", "cy", "k")
    np.testing.assert_allclose(
        found.reconstruction.cameras.params, truth.cameras.params, rtol=1e-6, atol=1e-6
    )
    # Angles between the views are those of the truth: the scene is metric, and not mirrored.
    R = found.reconstruction.R
    np.testing.assert_allclose(
        R[1:] @ R[:1].transpose(0, 2, 1), truth.R[1:] @ truth.R[:1].transpose(0, 2, 1), atol=1e-6
    )
    assert (found.reconstruction.depths(tracks) > 0.0).all()


def test_two_views_give_the_focal_length() -> None:
    tracks, _ = tracks_of(n_views=2, seed=5)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.refined == ("f",)
    assert _focal_error(found) < 1e-4


def test_a_principal_point_that_is_held_counts_in_the_standard_deviation() -> None:
    sigmas = []
    for seed in (3, 4, 5, 6, 8, 9):
        tracks, _ = tracks_of("general", 400 + seed, n_views=2, noise_px=0.3, n_points=80)
        off = np.random.default_rng(seed).normal(0.0, 0.012 * sum(SIZE), 2)
        moved = eg.Tracks(tracks.view, tracks.point, tracks.xy + off)
        found = eg.metric_upgrade(moved, image_size=SIZE)
        assert found.refined == ("f",)
        sigmas.append((found.focal_px - 900.0) / found.focal_std_px)
    assert np.abs(sigmas).max() < 2.0  # 3.6 of those of noise alone


def test_the_standard_deviation_is_that_of_the_errors() -> None:
    errors = []
    for seed in range(12):
        tracks, _ = tracks_of(seed=seed, noise_px=0.5, n_points=80)
        found = eg.metric_upgrade(tracks, image_size=SIZE)
        assert found.success
        errors.append((found.focal_px - 900.0) / found.focal_std_px)
    # chi^2 of 12 normal numbers: within 4 and 28 but for one case in a hundred
    assert 3.5 < np.sum(np.square(errors)) < 30.0


def test_gross_errors_are_set_aside() -> None:
    tracks, truth = tracks_of(seed=3, noise_px=0.3, wrong=0.05, n_points=300)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.success
    assert _focal_error(found) < 0.01
    far = np.linalg.norm(tracks.xy - truth.project(tracks), axis=1) > 5.0
    assert found.rejected[far].mean() > 0.95
    assert found.rejected[~far].mean() < 0.05
    kept, scene = found.kept(tracks)
    assert scene.rms_px(kept) < 0.35


@pytest.mark.study
def test_each_view_may_have_its_own_camera() -> None:
    focal = np.array([700.0, 800.0, 950.0, 1100.0, 900.0, 750.0])
    tracks, _ = tracks_of(seed=2, focal=focal)
    found = eg.metric_upgrade(tracks, image_size=SIZE, shared=False)
    np.testing.assert_allclose(found.focal_px, focal, rtol=1e-4)
    two = eg.metric_upgrade(tracks, image_size=SIZE, shared=True)
    assert not two.success
    assert "unlike cameras" in two.flags


def test_any_projective_basis_leads_to_the_same_cameras() -> None:
    tracks, truth = tracks_of(seed=4, noise_px=0.3)
    rng = np.random.default_rng(0)
    bundle = eg.bundle_adjust(tracks, truth.to_projective())
    focal = []
    for _ in range(3):
        T = np.linalg.qr(rng.normal(size=(4, 4)))[0] @ np.diag(rng.uniform(0.3, 3.0, 4))
        P = (
            bundle.reconstruction.P
            @ T
            * rng.choice([-2.0, 1.0, 0.5], tracks.n_views)[:, None, None]
        )
        Q = bundle.reconstruction.Q @ np.linalg.inv(T).T
        moved = eg.Reconstruction(P, Q)
        focal.append(eg.metric_upgrade(tracks, moved, image_size=SIZE).focal_px)
    np.testing.assert_allclose(focal, focal[0], rtol=1e-5)


def test_bases_do_not_depend_on_the_frame_beforehand() -> None:
    _, truth = tracks_of(seed=6)
    images = Images(np.tile(SIZE, (6, 1)).astype(float), np.zeros(6, dtype=np.intp))
    P = images.cameras_in(truth.P)
    rng = np.random.default_rng(1)
    for scale in (1.0, 3.0):
        T = rng.normal(size=(4, 4)) * scale
        views = Views(P @ T, images.group, eg.kernels.table())
        best = metric_bases(views)[0]
        assert best.focal * 1400.0 == pytest.approx(900.0, rel=1e-5)
        assert best.cost < 1e-8


def test_the_order_of_views_and_the_unit_of_images_are_conventions() -> None:
    tracks, _ = tracks_of(seed=7, noise_px=0.3)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    turned = eg.Tracks(5 - tracks.view, tracks.point, tracks.xy)
    other = eg.metric_upgrade(turned, image_size=SIZE)
    assert other.focal_px == pytest.approx(found.focal_px, rel=1e-4)
    large = eg.Tracks(tracks.view, tracks.point, 4.0 * (tracks.xy + 0.5) - 0.5)
    other = eg.metric_upgrade(large, image_size=(3200, 2400))
    assert other.focal_px == pytest.approx(4.0 * found.focal_px, rel=1e-4)
    assert other.focal_std_px == pytest.approx(4.0 * found.focal_std_px, rel=1e-2)


@pytest.mark.parametrize(
    ("motion", "flag", "usable"),
    [
        ("translation", "pure translation", False),
        ("rotation", "pure rotation", False),
        ("axis", "one rotation axis", True),
        ("point", "one viewing point", True),
    ],
)
def test_motions_that_leave_intrinsics_open_are_named(motion: str, flag: str, usable: bool) -> None:
    for seed in range(3):
        tracks, _ = tracks_of(motion, seed, noise_px=0.5)
        found = eg.metric_upgrade(tracks, image_size=SIZE)
        assert flag in found.flags
        assert usable or not found.success
        if usable and found.success:
            assert abs(found.focal_px - 900.0) < 4.0 * found.focal_std_px


@pytest.mark.parametrize("seed", range(3))
def test_a_turntable_tells_the_focal_length_no_better_than_without_distortion(seed: int) -> None:
    tracks, _ = tracks_of("table", seed, n_views=5, n_points=200, noise_px=0.4, bend=-0.15)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert {"one rotation axis", "one viewing point"} <= set(found.flags)
    bent = found.reconstruction
    params = bent.cameras.params * [1.0, 1.0, 1.0, 0.0]
    straight = eg.Cameras("SIMPLE_RADIAL", params, bent.cameras.camera_of_view)
    options = {"refine": tuple(name for name in found.refined if name != "k")}
    kept = tracks.weighted(np.where(found.rejected, 0.0, 1.0))
    start = eg.MetricReconstruction(bent.R, bent.t, bent.X, straight)
    plain = eg.bundle_adjust(kept, start, max_iter=100, **options).reconstruction
    known = eg.covariance(kept, plain, noise_px=found.noise_px, **options)
    # Where only the distortion, which is about the principal point here, tells where that is.
    assert found.focal_std_px > np.sqrt(known.intrinsics(0)[0, 0])
    assert not found.success
    # A lens that has none is no worse for what is not known of it.
    tracks, _ = tracks_of("table", seed, n_views=5, n_points=200, noise_px=0.4)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert found.success
    assert abs(found.focal_px - 900.0) < 3.0 * found.focal_std_px < 0.05 * 900.0


def test_general_motions_are_not_flagged() -> None:
    for seed in range(6):
        tracks, _ = tracks_of(seed=seed + 100, noise_px=0.5)
        assert eg.metric_upgrade(tracks, image_size=SIZE).flags == ()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"image_size": (800, 600, 3)}, "image_size"),
        ({"image_size": (0, 600)}, "image_size"),
        ({"image_size": (np.nan, 600)}, "image_size"),
        ({"image_size": (1, 1)}, "image_size"),
        ({"image_size": SIZE, "shared": [0, 1]}, "shared"),
        ({"image_size": SIZE, "shared": [0, 0, 0, 0, 0, 2]}, "shared"),
        ({"image_size": SIZE, "camera": "OPENCV_FISHEYE"}, "camera"),
        ({"image_size": [SIZE] * 5 + [(600, 800)]}, "shared"),
    ],
)
def test_bad_arguments_are_named(arguments: dict, named: str) -> None:
    tracks, _ = tracks_of()
    with pytest.raises(eg.ArgumentError) as error:
        eg.metric_upgrade(tracks, **arguments)
    assert error.value.argument == named


@pytest.mark.parametrize("moved", [(-400.0, -300.0), (300.0, 0.0)])
def test_tracks_from_another_corner_are_told(moved: tuple[float, float]) -> None:
    tracks, _ = tracks_of()
    other = eg.Tracks(tracks.view, tracks.point, tracks.xy + moved)
    assert "outside the images" in eg.metric_upgrade(other, image_size=SIZE).flags
    # A few gross errors beside the images are none of the origin.
    few = tracks.xy.copy()
    few[::20] += 2000.0
    found = eg.metric_upgrade(eg.Tracks(tracks.view, tracks.point, few), image_size=SIZE)
    assert found.success
    assert "outside the images" not in found.flags


def test_a_reconstruction_of_other_tracks_is_refused() -> None:
    tracks, truth = tracks_of()
    projective = truth.to_projective()
    with pytest.raises(eg.ArgumentError, match="reconstruction"):
        eg.metric_upgrade(
            tracks, eg.Reconstruction(projective.P[:5], projective.Q), image_size=SIZE
        )


class TestTwoViews:
    """Bougnoux's formula."""

    @staticmethod
    def fundamental(seed: int, focal: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return F of two general views, and their projection matrices."""
        _, scene = tracks_of(seed=seed, n_views=2, focal=np.array(focal))
        P = scene.P
        C = np.append(scene.centres[0], 1.0)
        e = P[1] @ C
        F = np.cross(np.eye(3), e).T @ P[1] @ np.linalg.pinv(P[0])
        return F / np.linalg.norm(F), P

    @pytest.mark.parametrize("seed", range(4))
    def test_exact_matrices_give_exact_focal_lengths(self, seed: int) -> None:
        F, _ = self.fundamental(seed, (850.0, 1000.0))
        for matrix in (F, -3.0 * F):
            found = eg.focal_lengths(matrix, CENTRE, CENTRE)
            np.testing.assert_allclose(found.focal_px, (850.0, 1000.0), rtol=1e-6)
        swapped = eg.focal_lengths(F.T, CENTRE, CENTRE)
        np.testing.assert_allclose(swapped.focal_px, (1000.0, 850.0), rtol=1e-6)
        np.testing.assert_allclose(swapped.std_px, found.std_px[::-1], rtol=1e-6)

    def test_the_deviation_is_the_derivative(self) -> None:
        F, P = self.fundamental(1, (850.0, 1000.0))
        h = 1e-3
        moved = [eg.focal_lengths(F, CENTRE + d, CENTRE).focal_px for d in h * np.eye(2)]
        moved += [eg.focal_lengths(F, CENTRE, CENTRE + d).focal_px for d in h * np.eye(2)]
        slopes = (np.array(moved) - [850.0, 1000.0]) / h
        expected = 7.0 * np.linalg.norm(slopes, axis=0)
        found = eg.focal_lengths(F, CENTRE, CENTRE, centre_std_px=7.0)
        np.testing.assert_allclose(found.std_px, expected, rtol=1e-3)
        # A change of F that keeps its rank: move the second camera a little.
        dP = P[1] + 1e-7 * np.random.default_rng(0).normal(size=(3, 4)) * np.abs(P[1])
        C = np.linalg.svd(P[0])[2][3]
        G = np.cross(np.eye(3), dP @ C).T @ dP @ np.linalg.pinv(P[0])
        G *= np.sign(np.sum(F * G)) / np.linalg.norm(G)
        away = (G - F).ravel()
        change = np.array(eg.focal_lengths(G, CENTRE, CENTRE).focal_px) - [850.0, 1000.0]
        only = eg.focal_lengths(
            F, CENTRE, CENTRE, covariance=np.outer(away, away), centre_std_px=0.0
        )
        np.testing.assert_allclose(only.std_px, np.abs(change), rtol=1e-3)

    def test_axes_in_one_plane_are_flagged(self) -> None:
        for motion in ("axis", "translation", "point"):
            _, scene = tracks_of(motion, 1, n_views=2)
            P = scene.P
            F = np.cross(np.eye(3), P[1] @ np.append(scene.centres[0], 1.0)).T
            F = F @ P[1] @ np.linalg.pinv(P[0])
            assert eg.focal_lengths(F, CENTRE, CENTRE).flag == "undetermined"

    @staticmethod
    def shared(motion: str, seed: int) -> np.ndarray:
        """Return F of two views of 900 px."""
        _, scene = tracks_of(motion, seed, n_views=2)
        P = scene.P
        F = np.cross(np.eye(3), P[1] @ np.append(scene.centres[0], 1.0)).T
        F = F @ P[1] @ np.linalg.pinv(P[0])
        return F / np.linalg.norm(F)

    @pytest.mark.parametrize("motion", ["general", "axis"])
    def test_a_shared_focal_length_is_known_where_axes_meet(self, motion: str) -> None:
        # Axes of the second kind are in one plane: each view's own is open.
        for seed in range(3):
            F = self.shared(motion, seed)
            for matrix in (F, -3.0 * F.T):
                found = eg.focal_lengths(matrix, CENTRE, CENTRE, centre_std_px=3.0, shared=True)
                np.testing.assert_allclose(found.focal_px, 900.0, rtol=1e-6)
                assert found.flag == ""

    @pytest.mark.parametrize("motion", ["point", "translation"])
    def test_a_shared_focal_length_is_open_at_equal_distances(self, motion: str) -> None:
        for seed in range(3):
            found = eg.focal_lengths(self.shared(motion, seed), CENTRE, CENTRE, shared=True)
            assert found.flag == "undetermined"
            assert not np.isfinite(found.std_px).any()

    def test_the_deviation_of_a_shared_focal_length_is_the_derivative(self) -> None:
        F, h = self.shared("general", 1), 1e-3
        moved = [eg.focal_lengths(F, CENTRE + d, CENTRE, shared=True) for d in h * np.eye(2)]
        moved += [eg.focal_lengths(F, CENTRE, CENTRE + d, shared=True) for d in h * np.eye(2)]
        slopes = (np.array([found.focal_px[0] for found in moved]) - 900.0) / h
        found = eg.focal_lengths(F, CENTRE, CENTRE, centre_std_px=7.0, shared=True)
        assert found.std_px[0] == pytest.approx(7.0 * np.linalg.norm(slopes), rel=1e-3)
        away = 1e-7 * np.random.default_rng(0).normal(size=9)
        G = F + away.reshape(3, 3)
        change = eg.focal_lengths(G, CENTRE, CENTRE, shared=True).focal_px[0] - 900.0
        C = np.outer(away, away)
        only = eg.focal_lengths(F, CENTRE, CENTRE, covariance=C, centre_std_px=0.0, shared=True)
        assert only.std_px[0] == pytest.approx(abs(change), rel=2e-2)

    def test_bad_input_is_named(self) -> None:
        F = np.eye(3)
        for arguments, name in (
            ((F[:2], CENTRE, CENTRE), "F"),
            ((0.0 * F, CENTRE, CENTRE), "F"),
            ((np.nan * F, CENTRE, CENTRE), "F"),
            ((F, CENTRE[:1], CENTRE), "centre1"),
        ):
            with pytest.raises(eg.ArgumentError) as error:
                eg.focal_lengths(*arguments)
            assert error.value.argument == name


@pytest.mark.parametrize(("depth", "flat"), [(0.0, True), (0.05, False)])
def test_a_poster_is_flat_through_any_lens(depth: float, flat: bool) -> None:
    _, truth = tracks_of(n_views=6, n_points=150, seed=8, bend=0.08)
    X = truth.X * [1.6, 1.3, depth]
    poster = eg.MetricReconstruction(truth.R, truth.t, X, truth.cameras)
    view, point = np.divmod(np.arange(900), 150)
    blank = eg.Tracks(view, point, np.zeros((900, 2)))
    xy = poster.project(blank) + np.random.default_rng(0).normal(0.0, 0.2, (900, 2))
    found = eg.metric_upgrade(eg.Tracks(blank.view, blank.point, xy), image_size=SIZE)
    # No homography explains the pairs, as the lens bends lines; the cameras are right all the same.
    assert _focal_error(found) < 0.01
    assert ("planar scene" in found.flags) == flat
    assert found.success != flat


@pytest.mark.parametrize(("seed", "n_points", "noise"), [(1027, 157, 0.2), (1035, 107, 1.0)])
def test_four_views_of_a_camera_that_turned_are_named(
    seed: int, n_points: int, noise: float
) -> None:
    tracks, _ = tracks_of("rotation", seed, n_views=4, n_points=n_points, noise_px=noise)
    found = eg.metric_upgrade(tracks, image_size=SIZE)
    assert "pure rotation" in found.flags
    assert not found.success
