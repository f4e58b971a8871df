"""From raw matches: inliers, accuracy, front ends, and what is refused."""

from __future__ import annotations

import contextlib
import importlib.util
from types import SimpleNamespace

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.errors import MissingPackageError
from epigauge.two_view import diagnostics
from epigauge.two_view.conditioning import condition
from epigauge.two_view.consensus import Consensus
from epigauge.two_view.mixture import Mixture
from epigauge.two_view.planes import _is_accidental, chance_pairs
from two_views import same_geometry

INSTALLED = [
    name
    for name, module in {"poselib": "poselib", "opencv": "cv2"}.items()
    if importlib.util.find_spec(module)
]
front_end = pytest.mark.skipif(not INSTALLED, reason="neither PoseLib nor OpenCV is installed")


def spoilt(
    wrong: int, *, m: int = 200, seed: int = 0, noise_px: float = 1.0, distance: float = 4.0
):
    """Return a scene, its matches with `wrong` replaced by random ones, and which are right."""
    scene = eg.two_view_scene(n_points=m, distance=distance, noise_px=noise_px, seed=seed)
    rng = np.random.default_rng(100 + seed)
    x1, x2 = scene.x1.copy(), scene.x2.copy()
    rows = rng.permutation(m)[:wrong]
    for x in (x1, x2):
        x[rows] = rng.uniform(x.min(axis=0), x.max(axis=0), (wrong, 2))
    right = np.ones(m, dtype=bool)
    right[rows] = False
    return scene, x1, x2, right


def error(F, scene) -> float:
    """Root mean square distance of the noise-free matches."""
    d = eg.reprojection_distances(F, scene.x1_true, scene.x2_true)[0]
    return float(np.sqrt(np.mean(d**2)))


def consensus_of(x1, x2):
    frame = condition(x1, x2)
    return frame, Consensus(kernels.table(), *frame.forward(x1, x2), np.inf)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_consensus_finds_the_right_matches_from_a_poor_start(share):
    # Without any front end: the truth turned until hardly a match fits.
    scene, x1, x2, right = spoilt(round(200 * share), seed=1)
    frame, consensus = consensus_of(x1, x2)
    rng = np.random.default_rng(0)
    F = frame.from_pixels(scene.F_true)
    start = consensus.judge(F + 0.02 * rng.standard_normal((3, 3)), 1.0)
    found = consensus.search([start], rng)
    assert found.score > start.score + 50.0
    assert found.share == pytest.approx(1.0 - share, abs=0.1)
    assert found.sigma * frame.scale == pytest.approx(1.0, rel=0.2)
    inlier = found.inliers(found.mixture.even)
    assert np.mean(inlier[right]) > 0.95
    assert np.mean(inlier[~right]) < 0.2 if share else True


@pytest.mark.parametrize("m", [14, 24])
@pytest.mark.parametrize("seed", range(4))
def test_noise_of_an_agreement_allows_for_the_seven_parameters_of_f(m, seed):
    # All matches right, F their own minimum: what is left are m - 7 squares of the noise.
    scene = eg.two_view_scene(6.0, n_points=m, seed=seed)
    frame, consensus = consensus_of(scene.x1, scene.x2)
    result = eg.refine_fundamental(scene.x1, scene.x2)
    found = consensus.judge(frame.from_pixels(result.F), 1.0 / frame.scale, 0.95)
    variance = (found.sigma * frame.scale) ** 2
    assert variance == pytest.approx(2.0 * result.cost / (m - 7), rel=0.02)


@pytest.mark.parametrize("wrong", [60, 120])
def test_blunt_matches_are_not_cut_off(wrong):
    # The scene is small in the image: three deviations of the noise are more
    # than the distance within which raw matches agree by no chance.
    scene, x1, x2, right = spoilt(wrong, distance=10.0, noise_px=0.9, seed=2)
    result = eg.estimate_fundamental(x1, x2)
    assert result.noise_px == pytest.approx(0.9, rel=0.25)
    assert result.threshold_px > 2.4 * 0.9
    assert np.mean(result.inlier[right]) > 0.95
    best = eg.refine_fundamental(x1[right], x2[right])
    assert error(result.F, scene) < 3.0 * error(best.F, scene)


def test_compiled_and_numpy_distances_and_climbs_are_the_same():
    if kernels.available()["c"]:
        pytest.skip("no compiled library")
    _, x1, x2, _ = spoilt(60, seed=3)
    q = condition(x1, x2).forward(x1, x2)
    one, other = (Consensus(kernels.table(name), *q) for name in ("c", "numpy"))
    F = eg.fundamental_8point(*(np.ascontiguousarray(a.T) for a in q))
    for a, b in zip(one.measured(F), other.measured(F), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-14)
    assert 0 < np.count_nonzero(one.measured(F)[1])
    best, same = (c.climb(c.judge(F, 0.05)) for c in (one, other))
    assert best.score > one.judge(F, 0.05).score + 1.0
    assert best.score == pytest.approx(same.score, rel=1e-6)
    np.testing.assert_allclose(best.signed, same.signed, atol=1e-4)


def test_score_of_an_agreement_does_not_depend_on_the_start_of_its_scale():
    scene, x1, x2, _ = spoilt(60)
    frame, consensus = consensus_of(x1, x2)
    F = frame.from_pixels(scene.F_true)
    scores = [consensus.judge(F, sigma).score for sigma in (0.02, 0.1, 0.5)]
    assert np.ptp(scores) < 0.1


def test_matches_behind_a_camera_are_no_inliers():
    scene, x1, x2, _ = spoilt(0)
    frame, consensus = consensus_of(x1, x2)
    F = frame.from_pixels(scene.F_true)
    assert consensus.oriented(F).all()
    assert consensus.oriented(-3.0 * F).all()
    # Beyond the epipole on its own epipolar line, a match has distance zero all the same.
    epipole = np.linalg.svd(scene.F_true)[0][:, 2]
    x2 = x2.copy()
    x2[0] = 2.0 * epipole[:2] / epipole[2] - scene.x2_true[0]
    frame, consensus = consensus_of(x1, x2)
    agreement = consensus.judge(frame.from_pixels(scene.F_true), 0.1)
    assert abs(agreement.signed[0]) < 1.0
    assert not agreement.inliers(1.0)[0]
    assert agreement.oriented[1:].all()


def test_no_collapse_onto_a_few_matches_that_fit_exactly():
    # Eleven matches: any seven of them fit some F exactly, with no noise at all.
    scene, x1, x2, _ = spoilt(0, m=11)
    frame, consensus = consensus_of(x1, x2)
    start = consensus.judge(frame.from_pixels(scene.F_true), 0.1)
    found = consensus.search([start], np.random.default_rng(0))
    assert np.count_nonzero(found.inliers(found.mixture.even)) >= 10


# ---------------------------------------------------------------- the whole function


@front_end
@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize("wrong", [0, 60, 100])
def test_estimate_is_as_good_as_that_of_the_right_matches(name, wrong):
    errors = []
    for seed in range(4):
        scene, x1, x2, right = spoilt(wrong, seed=seed)
        result = eg.estimate_fundamental(x1, x2, robust=name)
        best = eg.refine_fundamental(x1[right], x2[right])
        errors.append([error(result.F, scene), error(best.F, scene)])
        assert result.success
        assert np.mean(result.inlier[right]) > 0.95
        assert np.mean(result.inlier[~right]) < 0.2 if wrong else True
        assert result.noise_px == pytest.approx(1.0, rel=0.2)
        assert result.start in (name, "8point")
    ours, possible = np.median(errors, axis=0)
    assert ours < 2.0 * possible


@front_end
def test_result_is_the_refinement_of_its_inliers():
    _, x1, x2, _ = spoilt(60)
    result = eg.estimate_fundamental(x1, x2)
    assert isinstance(result, eg.FundamentalResult)
    np.testing.assert_array_equal(result.used, np.flatnonzero(result.inlier))
    assert len(result.points) == len(result.fun) == len(result.used)
    refined = eg.refine_fundamental(x1[result.used], x2[result.used])
    assert same_geometry(result.F, refined.F, x1, x2) < 1e-5
    d = np.abs(eg.reprojection_distances(result.F, x1, x2)[0])
    assert d[result.inlier].max() <= result.threshold_px * (1.0 + 1e-9)
    assert 1 <= result.rounds <= 20


@front_end
def test_same_seed_same_answer_and_another_seed_the_same_minimum():
    _, x1, x2, _ = spoilt(60)
    first, again = (eg.estimate_fundamental(x1, x2, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.F, again.F)
    np.testing.assert_array_equal(first.inlier, again.inlier)
    other = eg.estimate_fundamental(x1, x2, seed=4)
    assert same_geometry(first.F, other.F, x1, x2) < 1e-3


@front_end
def test_exact_duplicates_count_once_and_share_their_fate():
    _, x1, x2, _ = spoilt(60)
    rows = np.concatenate([np.arange(200), np.arange(0, 200, 3), np.arange(0, 200, 3)])
    once, often = eg.estimate_fundamental(x1, x2), eg.estimate_fundamental(x1[rows], x2[rows])
    np.testing.assert_array_equal(often.F, once.F)
    np.testing.assert_array_equal(often.inlier, once.inlier[rows])
    np.testing.assert_array_equal(often.used, once.used)


@front_end
@pytest.mark.parametrize("name", INSTALLED)
def test_large_offsets_and_other_units_do_not_matter(name):
    # OpenCV computes with single precision: an offset of 1e6 px ruins it.
    _, x1, x2, _ = spoilt(60)
    plain = eg.estimate_fundamental(x1, x2, robust=name)
    moved = eg.estimate_fundamental(x1 + 1e6, x2 - 1e6, robust=name)
    scaled = eg.estimate_fundamental(x1 / 1024.0, x2 / 1024.0, robust=name)
    np.testing.assert_array_equal(moved.inlier, plain.inlier)
    np.testing.assert_array_equal(scaled.inlier, plain.inlier)
    assert moved.threshold_px == pytest.approx(plain.threshold_px, rel=1e-4)
    assert scaled.threshold_px * 1024.0 == pytest.approx(plain.threshold_px, rel=1e-6)


@front_end
def test_given_threshold_is_kept():
    _, x1, x2, _ = spoilt(60)
    for threshold_px in (1.5, 6):
        result = eg.estimate_fundamental(x1, x2, threshold_px=threshold_px)
        assert result.threshold_px == pytest.approx(threshold_px, rel=1e-12)
        d = np.abs(eg.reprojection_distances(result.F, x1, x2)[0])
        oriented = np.count_nonzero(d <= threshold_px) - np.count_nonzero(result.inlier)
        assert 0 <= oriented <= 5


@front_end
def test_noise_free_matches_with_gross_errors_give_the_truth():
    scene, x1, x2, right = spoilt(80, noise_px=0.0)
    result = eg.estimate_fundamental(x1, x2)
    np.testing.assert_array_equal(result.inlier, right)
    assert same_geometry(result.F, scene.F_true, x1, x2) < 1e-9


@front_end
def test_options_reach_the_refinement_and_those_of_matches_are_selected():
    _, x1, x2, _ = spoilt(60)
    weights = np.random.default_rng(0).uniform(0.5, 2.0, 200)
    covariance = np.eye(2) / weights[:, None, None]
    weighted = eg.estimate_fundamental(x1, x2, weights=weights, parameterization="block")
    whitened = eg.estimate_fundamental(x1, x2, covariance1=covariance, covariance2=covariance)
    np.testing.assert_array_equal(weighted.inlier, whitened.inlier)
    assert same_geometry(weighted.F, whitened.F, x1, x2) < 1e-4
    used = weighted.used
    expected = eg.refine_fundamental(x1[used], x2[used], weights=weights[used])
    assert weighted.cost == pytest.approx(expected.cost, rel=1e-8)
    assert eg.estimate_fundamental(x1, x2, noise_px=2.0).noise_px == 2.0


@front_end
def test_measured_pairs_agree_with_what_their_makers_call_right(pair):
    with np.load(pair) as data:
        x1, x2, inlier = data["x1"], data["x2"], data["inlier"]
        planes = np.unique(data["label"][data["label"] > 0]) if "label" in data else ()
    result = eg.estimate_fundamental(x1, x2)
    assert result.status > 0
    # Where all right matches bear the label of one plane, the makers call the scene flat.
    assert result.success or (len(planes) == 1 and result.flags == ("planar scene",))
    # They drop duplicates and took another threshold, for the whole image or per plane. In the
    # smallest sets, several geometries have about the same support.
    assert np.mean(result.inlier[inlier]) > 0.7


@pytest.mark.parametrize("name", ["poselib", "opencv"])
def test_without_a_front_end_the_message_names_the_remedy(monkeypatch, name):
    _, x1, x2, _ = spoilt(0)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"pip install 'epigauge\[cv\]'"):
        eg.estimate_fundamental(x1, x2, robust=name)
    assert eg.estimate_fundamental(x1, x2).success


@front_end
def test_front_end_that_finds_nothing_is_replaced(monkeypatch):
    from epigauge.two_view import front_ends

    monkeypatch.setattr(front_ends, "_FRONT_ENDS", {INSTALLED[0]: lambda *arguments: None})
    scene, x1, x2, _ = spoilt(20)
    result = eg.estimate_fundamental(x1, x2, robust=INSTALLED[0])
    assert result.start == "8point"
    assert error(result.F, scene) < 0.5


@front_end
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robust": "poslib"}, "robust.*did you mean 'poselib'"),
        ({"threshold_px": 0.0}, "threshold_px"),
        ({"threshold_px": "large"}, "threshold_px"),
        ({"seed": -1}, "seed"),
        ({"F0": np.eye(3)}, "F0"),
        ({"weights": np.ones(3)}, "weights"),
    ],
)
def test_bad_options_are_refused(options, message):
    _, x1, x2, _ = spoilt(0, m=30)
    with pytest.raises(eg.ArgumentError, match=message):
        eg.estimate_fundamental(x1, x2, **options)


@front_end
def test_too_few_different_matches_are_refused():
    _, x1, x2, _ = spoilt(0, m=7)
    with pytest.raises(eg.ArgumentError, match="7 matches"):
        eg.estimate_fundamental(x1, x2)
    with pytest.raises(eg.ArgumentError, match="7 different matches"):
        eg.estimate_fundamental(np.tile(x1, (3, 1)), np.tile(x2, (3, 1)))


@front_end
def test_threshold_that_leaves_fewer_than_eight_inliers_leaves_nothing_in_common():
    _, x1, x2, _ = spoilt(0, m=20)
    result = eg.estimate_fundamental(x1, x2, threshold_px=1e-9)
    assert "no common geometry" in result.flags
    assert not result.success


@front_end
@pytest.mark.parametrize(("depth", "plain"), [(0.5, True), (0.0, False)])
def test_plain_relief_is_told_without_a_fit_and_a_plane_is_not(depth, plain, monkeypatch):
    rng = np.random.default_rng(5)
    rays = np.column_stack([*rng.uniform(-0.5, 0.5, (2, 300)), np.ones(300)])
    X = rays * (6.0 / (rays @ [0.2, -0.1, 1.0]) * (1.0 + depth * rng.uniform(-1, 1, 300)))[:, None]
    x1, x2 = (
        1000.0 * Y[:, :2] / Y[:, 2:] + rng.normal(0.0, 0.4, (300, 2))
        for Y in (X, X + np.array([1.0, 0.2, 0.3]))
    )
    x2[::3] = rng.uniform(-500.0, 500.0, x2[::3].shape)
    fits = []
    judge = diagnostics.judge_plane
    monkeypatch.setattr(
        diagnostics, "judge_plane", lambda *a, **k: fits.append(a) or judge(*a, **k)
    )
    flags = eg.estimate_fundamental(x1, x2).flags
    assert ("planar scene" in flags, not fits) == (not plain, plain)


class TestPlanesWithWrongMatches:
    """A few wrong matches always fit an F through a homography; they must not hide the plane."""

    K = np.array([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]])
    ROTATION = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    PLANE = np.array([[1.1, 0.1, 3.0], [-0.1, 0.95, 20.0], [1e-4, -2e-4, 1.0]])

    def flags(self, H, wrong, depth=0.0, seed=0):
        """Return the flags of 200 matches by a homography, some wrong, some off the plane."""
        rng = np.random.default_rng(seed)
        x1 = rng.uniform((0, 0), (640, 480), (200, 2))
        x2 = np.column_stack([x1, np.ones(200)]) @ H.T
        x2 = x2[:, :2] / x2[:, 2:]
        x2[:60] += depth * rng.uniform(0, 1, (60, 1)) * ([900.0, 200.0] - x2[:60])
        x1, x2 = (x + 0.5 * rng.standard_normal(x.shape) for x in (x1, x2))
        x2[200 - wrong :] = rng.uniform((0, 0), (640, 480), (wrong, 2))
        return eg.estimate_fundamental(x1, x2).flags

    @pytest.mark.parametrize("wrong", [0, 40])
    @pytest.mark.parametrize("seed", [0, 1])
    def test_plane_is_flagged(self, wrong, seed) -> None:
        assert self.flags(self.PLANE, wrong, seed=seed) == ("planar scene",)

    def test_rotation_is_flagged(self) -> None:
        H = self.K @ self.ROTATION @ np.linalg.inv(self.K)
        assert self.flags(H, 40) == ("planar scene", "pure rotation")

    def test_true_matches_off_the_plane_are_believed(self) -> None:
        assert "planar scene" not in self.flags(self.PLANE, 40, depth=0.1)


class TestAgreementByChance:
    """How many wrong matches agree with an F whose epipole a homography leaves free."""

    def test_any_two_do(self) -> None:
        nothing = np.zeros(30)
        assert chance_pairs(nothing, 2) == np.inf
        assert chance_pairs(nothing, 3) == 0.0

    def test_pairs_are_counted_as_simulated(self) -> None:
        rng = np.random.default_rng(0)
        chances = rng.uniform(0.0, 0.6, 12)
        agreeing = np.sum(rng.random((100_000, 12)) < chances, axis=1)
        for k in (3, 5, 7, 9):
            share = np.mean(agreeing >= k - 2)
            assert chance_pairs(chances, k) / 66.0 == pytest.approx(share, abs=5e-3)

    def test_the_order_of_the_matches_does_not_count(self) -> None:
        chances = np.random.default_rng(1).uniform(0.0, 0.2, 40)
        assert chance_pairs(chances[::-1], 9) == pytest.approx(chance_pairs(chances, 9), rel=1e-6)

    @staticmethod
    def flags(off: int, beside: int = 1) -> tuple[str, ...]:
        """Return what is said of a plane with matches on the lines through one epipole.

        Of `off` places well off the plane, each has `beside` matches side by side.
        """
        rng = np.random.default_rng(8)
        x1 = rng.uniform((20.0, 20.0), (620.0, 460.0), (300, 2))
        x2 = x1 + 0.03 * (x1 - [320.0, 240.0]) + 1e-4 * x1[:, :1] * x1 + [4.0, -9.0]
        chosen = np.arange(off * beside)
        x1[chosen] = x1[chosen // beside] + rng.uniform(-1.0, 1.0, (off * beside, 2))
        x2[chosen] = x1[chosen] + 0.03 * (x1[chosen] - [320.0, 240.0])
        x2[chosen] += 1e-4 * x1[chosen, :1] * x1[chosen] + [4.0, -9.0]
        direction = x2[chosen] - [900.0, 100.0]
        x2[chosen] += 30.0 * direction / np.linalg.norm(direction, axis=1)[:, None]
        x1, x2 = (x + 0.35 * rng.standard_normal(x.shape) for x in (x1, x2))
        return eg.refine_fundamental(x1, x2).flags

    def test_matches_side_by_side_fix_one_line(self) -> None:
        assert "nearly planar" in self.flags(8)
        assert "planar scene" in self.flags(2, beside=4)

    @pytest.mark.parametrize(("times", "expected"), [(1.5, True), (50.0, False)])
    def test_matches_slightly_off_agree_easily(self, times, expected) -> None:
        """Eight of twelve on their epipolar lines, so many times the limit off the plane."""
        q = np.random.default_rng(3).uniform(-3.0, 3.0, (2, 2, 112))
        found = SimpleNamespace(all1=q[0], all2=q[1], limit=0.01, inlier=np.arange(112) < 108)
        off = np.arange(112) >= 100
        apart = np.where(off, (times * found.limit) ** 2, 0.0)
        assert _is_accidental(found, apart, off) == expected


@front_end
@pytest.mark.parametrize("essential", [False, True])
def test_hostile_matches_end_with_a_verdict_or_a_named_argument(essential: bool) -> None:
    """Points on a line or a grid, far and near, whole numbers, some in the wrong order."""
    options = {"essential": True, "K1": np.diag([500.0, 500.0, 1.0])} if essential else {}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(8, 16))
        X = np.column_stack([rng.integers(-3, 4, (m, 2)) * 0.1, rng.choice([2.0, 1e3, 1e6], m)])
        if seed % 4 == 0:
            X[:, 0] = 0.0
        move = rng.choice([0.0, 0.05, -0.3, 1.0], 3)
        x1, x2 = (500.0 * Y[:, :2] / Y[:, 2:] for Y in (X, X + move))
        if seed % 2:
            x1, x2 = np.round(x1), np.round(x2)
        if seed % 3 == 0:
            x1[m // 2 :] = x1[m // 2 :][::-1]
        with contextlib.suppress(eg.ArgumentError):
            assert np.isfinite(eg.estimate_fundamental(x1, x2, **options).F).all()


@front_end
def test_a_geometry_without_distances_ends_the_search() -> None:
    # Forward motion over a grid: an F whose epipoles lie on matches has no distance there (NaN).
    xy = [-3, 2, 0, 1, -2, 0, -2, -3, 3, 3, 3, 0, 1, 2, -3, 1, 3, -3, 2, -2, -1, -3, 0, 0]
    z = np.array([2.0, 1.0, 1.0, 2.0, 1.0, 1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0])[:, None]
    X = np.array(xy, np.float64).reshape(-1, 2) / 10.0
    for unit in (11365.0, 1000.0):
        result = eg.estimate_fundamental(unit * X / z + 320.0, unit * X / (z + 0.05) + 320.0)
        assert np.isfinite(result.F).all()
        assert "few matches" in result.flags


# ---------------------------------------------------------------- wrong matches near right ones


def beside(seed: int = 0, m: int = 80, wrong: int = 38):
    """Return a scene whose wrong matches are normal about the right point, 8 px wide."""
    scene = eg.two_view_scene(n_points=m, distance=4.0, noise_px=0.3, seed=seed)
    rng = np.random.default_rng(200 + seed)
    x2 = scene.x2.copy()
    x2[:wrong] += 8.0 * rng.standard_normal((wrong, 2))
    return scene, scene.x1, x2


@pytest.mark.parametrize("seed", [0, 6, 7])
def test_wrong_matches_beside_the_right_point_are_not_taken_for_noise(seed):
    scene, x1, x2 = beside(seed)
    result = eg.estimate_fundamental(x1, x2)
    assert error(result.F, scene) < 0.5
    assert result.threshold_px < 2.0
    assert result.inlier[38:].mean() > 0.8


@pytest.mark.parametrize("seed", [0, 1, 4])
def test_what_moved_on_its_own_does_not_bend_a_sharp_geometry(seed):
    """As clouds between two photographs: all matches agree with an F in between, but bluntly."""
    scene = eg.two_view_scene(n_points=150, distance=4.0, noise_px=0.2, seed=seed)
    x2, top = scene.x2.copy(), np.argsort(scene.x1[:, 1])[:40]
    angle = np.random.default_rng(300 + seed).uniform(0.0, 2.0 * np.pi)
    x2[top] += 8.0 * np.array([np.cos(angle), np.sin(angle)])
    result = eg.estimate_fundamental(scene.x1, x2)
    assert error(result.F, scene) < 0.3
    assert not result.inlier[top].any()
    assert np.mean(np.delete(result.inlier, top)) > 0.95


def test_normal_distances_have_no_wrong_ones_about_them():
    # Nothing is gained by a core and what is around it: the noise stays that of all.
    for seed in range(2):
        _, x1, x2, right = spoilt(60, noise_px=3.0, seed=seed)
        result = eg.estimate_fundamental(x1, x2)
        assert result.noise_px == pytest.approx(3.0, rel=0.3)
        assert np.mean(result.inlier[right]) > 0.9


@pytest.mark.parametrize("seed", [1, 3, 7])
def test_a_third_that_is_sharp_counts_among_matches_all_about_it(seed):
    scene = eg.two_view_scene(n_points=200, distance=4.0, noise_px=0.3, seed=seed)
    x2 = scene.x2.copy()
    x2[60:] += np.random.default_rng(seed).uniform(-30.0, 30.0, (140, 2))
    result = eg.estimate_fundamental(scene.x1, x2)
    assert result.success
    assert result.noise_px == pytest.approx(0.35, abs=0.15)
    assert error(result.F, scene) < 0.3


@pytest.mark.study
@pytest.mark.parametrize("seed", [4, 5])
def test_many_matches_of_a_few_points_do_not_decide(seed):
    # An epipole at such a point agrees with all of its matches, and exactly.
    scene = eg.two_view_scene(n_points=100, noise_px=0.3, seed=seed)
    rng = np.random.default_rng(seed)
    x2 = scene.x2.copy()
    few = rng.uniform(x2.min(axis=0), x2.max(axis=0), (8, 2))
    x2[40:] = few[rng.integers(8, size=60)]
    there, back = eg.estimate_fundamental(scene.x1, x2), eg.estimate_fundamental(x2, scene.x1)
    for result, F in ((there, there.F), (back, back.F.T)):
        assert result.success
        assert error(F, scene) < 0.5
        assert np.mean(result.inlier[:40]) > 0.9


@pytest.mark.parametrize("about", [(0.0, 1.0), (0.2, 0.4)])
def test_compiled_and_numpy_mixtures_are_the_same(about):
    if kernels.available()["c"]:
        pytest.skip("no compiled library")
    scene, x1, x2 = beside()
    frame = condition(x1, x2)
    q = frame.forward(x1, x2)
    one, other = (Consensus(kernels.table(name), *q) for name in ("c", "numpy"))
    F = frame.from_pixels(scene.F_true)
    a, b = (c.judge(F, 0.01, about=about) for c in (one, other))
    for name in ("sigma", "share", "score", "near", "spread"):
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-7)
    assert (a.near > 0.1) == (about[0] > 0.0)
    a, b = one.climb(a), other.climb(b)
    assert a.score == pytest.approx(b.score, rel=1e-6)
    assert a.mixture.even == pytest.approx(b.mixture.even, rel=1e-3)


def test_mixture_is_a_density_and_even_parts_it():
    for mixture in (Mixture(0.02, 0.6, 7.0), Mixture(0.02, 0.5, 7.0, 0.3, 0.3)):
        d = np.linspace(-10.0, 10.0, 200_001)
        total, right, near = mixture.parts(d**2)
        assert 1e-4 * np.sum(right) == pytest.approx(mixture.share, rel=1e-6)
        assert 1e-4 * np.sum(near) == pytest.approx(mixture.near, rel=1e-6, abs=1e-12)
        assert total - right - near == pytest.approx((1 - mixture.share - mixture.near) / 7.0)
        assert mixture.right(np.array(mixture.even**2)) == pytest.approx(0.5, abs=1e-6)
