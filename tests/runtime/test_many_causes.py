"""Named causes of weak calibrated scenes: each is seen, and its healthy counterpart is silent."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge.multi_view.verdicts.gross import TailOfArrays, gross_flags
from epigauge.multi_view.verdicts.network import loose_parts, only_pairs
from epigauge.reproduce.metrology import load_network
from numpy.typing import NDArray

Array = NDArray[np.float64]
Scene = tuple[eg.Tracks, eg.MetricReconstruction]

SEEDS = (0, 1)
DEGENERATE = {
    *("not tied", "two-view tracks", "open intrinsics", "flat scene", "collinear centres"),
    *("points at infinity", "still camera", "pure rotation", "undetermined", "weak geometry"),
    *("near-affine", "planar scene", "nearly planar", "no common geometry"),
}


def looking(centres: Array, targets: Array) -> Array:
    """Return rotations of cameras at centres that look at targets, y down."""
    z = targets - centres
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def seen_from(
    centres: Array,
    X: Array,
    seed: int,
    *,
    R: Array | None = None,
    f: float = 800.0,
    visible: NDArray[np.bool_] | None = None,
) -> Scene:
    """Return images with noise of 0.3 px, and the scene; all cameras share f and the centre."""
    n = len(centres)
    R = looking(centres, np.zeros((n, 3))) if R is None else R
    t = -np.einsum("nij,nj->ni", R, centres)
    cameras = eg.Cameras("SIMPLE_PINHOLE", [[f, 320.0, 240.0]], np.zeros(n, int))
    scene = eg.MetricReconstruction(R, t, X, cameras)
    sees = np.ones((n, len(X)), np.bool_) if visible is None else visible
    blank = eg.Tracks(*np.nonzero(sees), np.zeros((int(sees.sum()), 2)))
    noise = np.random.default_rng(seed).normal(0.0, 0.3, (len(blank), 2))
    return eg.Tracks(blank.view, blank.point, scene.project(blank) + noise), scene


def cloud(seed: int, m: int = 60) -> Array:
    return np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, (m, 3))


def ring(n: int = 6, distance: float = 6.0) -> Array:
    angle = np.linspace(-0.6, 0.6, n)
    return distance * np.stack([np.sin(angle), 0.1 * np.cos(3.0 * angle), -np.cos(angle)], axis=1)


def side(n: int = 6) -> Array:
    """Return centres beside each other, about on a line."""
    a = np.linspace(-1.5, 1.5, n)
    return np.stack([a, 0.3 * np.sin(5.0 * a), -6.0 + 0.2 * np.cos(3.0 * a)], axis=1)


def flat(seed: int) -> Array:
    return cloud(seed) * [1.0, 1.0, 0.0]


def of_pairs(n: int, pairs: Sequence[tuple[int, int]], each: int, seed: int) -> Scene:
    visible = np.zeros((n, each * len(pairs)), np.bool_)
    for e, pair in enumerate(pairs):
        visible[list(pair), e * each : (e + 1) * each] = True
    return seen_from(ring(n), cloud(seed, each * len(pairs)), seed, visible=visible)


SAME = np.repeat(np.eye(3)[None], 6, axis=0)
CASES: dict[str, tuple[Callable[[int], Scene], Any, set[str], bool | None]] = {
    "ring": (lambda s: seen_from(ring(), cloud(s), s), ("f",), set(), True),
    "all free": (lambda s: seen_from(ring(), cloud(s), s), "all", set(), True),
    "flat and slanted, K known": (lambda s: seen_from(ring(), flat(s), s), "pose", set(), True),
    "flat and slanted": (lambda s: seen_from(ring(), flat(s), s), ("f",), {"flat scene"}, True),
    "flat, from straight above": (
        lambda s: seen_from(side(), flat(s), s, R=SAME),
        ("f",),
        {"flat scene", "open intrinsics", "near-affine"},
        None,
    ),
    "parallel views, K known": (lambda s: seen_from(side(), cloud(s), s, R=SAME), "pose", set(), 1),
    "parallel views": (
        lambda s: seen_from(side(), cloud(s), s, R=SAME),
        "all",
        {"open intrinsics"},
        None,
    ),
    "forward, K known": (
        lambda s: seen_from(
            np.outer(np.arange(6.0), [0.0, 0.0, 0.5]) - [0.0, 0.0, 6.0], cloud(s), s, R=SAME
        ),
        "pose",
        set(),
        True,
    ),
    "forward": (
        lambda s: seen_from(
            np.outer(np.arange(6.0), [0.0, 0.0, 0.5]) - [0.0, 0.0, 6.0], cloud(s), s, R=SAME
        ),
        "all",
        {"open intrinsics", "collinear centres"},
        None,
    ),
    "narrow": (
        lambda s: seen_from(100.0 * ring(), cloud(s), s, f=8e4),
        ("f",),
        {"near-affine", "open intrinsics"},
        None,
    ),
    "still": (
        lambda s: seen_from(np.repeat(ring()[:1], 6, axis=0), cloud(s), s),
        "pose",
        {"still camera"},
        False,
    ),
    "turned": (
        lambda s: seen_from(
            np.repeat(ring()[:1], 6, axis=0),
            cloud(s),
            s,
            R=looking(np.repeat(ring()[:1], 6, axis=0), 0.8 * cloud(s + 9, 6)),
        ),
        "pose",
        {"pure rotation"},
        False,
    ),
    "half at infinity": (
        lambda s: seen_from(
            side(), np.r_[cloud(s, 30), 1e5 * (0.3 * cloud(s + 1, 30) + [0.0, 0.0, 1.0])], s
        ),
        "pose",
        {"points at infinity"},
        True,
    ),
    "half at ten times the distance": (
        lambda s: seen_from(
            side(), np.r_[cloud(s, 30), 50.0 * (0.3 * cloud(s + 1, 30) + [0.0, 0.0, 1.0])], s
        ),
        "pose",
        set(),
        True,
    ),
    "chain": (
        lambda s: of_pairs(6, [(k, k + 1) for k in range(5)], 12, s),
        "pose",
        {"undetermined", "two-view tracks"},
        False,
    ),
    "star": (
        lambda s: of_pairs(4, [(0, k) for k in (1, 2, 3)], 20, s),
        "pose",
        {"undetermined", "two-view tracks"},
        False,
    ),
    "ring of six pairs": (
        lambda s: of_pairs(6, [(k, (k + 1) % 6) for k in range(6)], 12, s),
        "pose",
        {"undetermined", "two-view tracks"},
        False,
    ),
    "triangle": (lambda s: of_pairs(3, [(0, 1), (1, 2), (0, 2)], 20, s), "pose", set(), True),
    "all pairs of four": (
        lambda s: of_pairs(4, list(itertools.combinations(range(4), 2)), 15, s),
        "pose",
        set(),
        True,
    ),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", CASES)
def test_causes_are_named(name: str, seed: int) -> None:
    made, refine, expected, success = CASES[name]
    tracks, scene = made(seed)
    found = eg.bundle_adjust(tracks, scene, refine=refine)
    named = DEGENERATE & set(found.flags)
    assert expected <= named
    if not expected:
        assert not named
        assert found.n_behind == 0
    if success is not None:
        assert found.success is bool(success)
    else:  # undetermined to the noise: said by a flag, whatever success
        assert named & {"undetermined", "weak geometry"}
    assert found.weakest


def parted(seed: int) -> Scene:
    """Return two parts that share points which do not count."""
    tracks, scene = seen_from(ring(), cloud(seed), seed)
    weights = np.ones(len(tracks))
    weights[(tracks.view < 3) == (tracks.point < 30)] = 0.0
    return tracks.weighted(weights), scene


@pytest.mark.parametrize("kind", ["metric", "projective"])
def test_parts_that_share_nothing_that_counts_are_not_tied(kind: str) -> None:
    tracks, scene = parted(3)
    start = scene if kind == "metric" else scene.to_projective()
    options: dict[str, Any] = {"refine": "pose"} if kind == "metric" else {}
    found = eg.bundle_adjust(tracks, start, **options)
    assert {"not tied", "undetermined"} <= set(found.flags)
    assert not found.success
    whole = tracks.weighted(np.ones(len(tracks)))
    assert not DEGENERATE & set(eg.bundle_adjust(whole, start, **options).flags)


def test_positions_on_a_line_leave_the_turn_about_it() -> None:
    line = np.stack([np.linspace(-1.5, 1.5, 6), np.zeros(6), np.full(6, -6.0)], axis=1)
    for centres, expected in ((line, True), (ring(), False)):
        tracks, scene = seen_from(centres, cloud(2), 2)
        priors = [eg.PositionPrior(i, c, sigma=0.1) for i, c in enumerate(centres)]
        found = eg.bundle_adjust(tracks, scene, refine="pose", priors=priors)
        assert ("collinear centres" in found.flags) is expected
        # A known point beside the line holds it.
        priors.append(eg.PointPrior(0, scene.X[0], sigma=0.1))
        found = eg.bundle_adjust(tracks, scene, refine="pose", priors=priors)
        assert "collinear centres" not in found.flags


@pytest.mark.parametrize("share", [0.02, 0.06])
@pytest.mark.parametrize("kind", ["metric", "projective"])
def test_gross_errors_that_are_left_are_told(kind: str, share: float) -> None:
    tracks, scene = seen_from(ring(), cloud(4, 100), 4)
    rng = np.random.default_rng(7)
    start = scene if kind == "metric" else scene.to_projective()
    options: dict[str, Any] = {"refine": "pose"} if kind == "metric" else {}
    clean = eg.bundle_adjust(tracks, start, **options)
    assert not {"outliers", "gross errors"} & set(clean.flags)
    xy = tracks.xy.copy()
    wrong = rng.choice(len(xy), round(share * len(xy)), replace=False)
    xy[wrong] += rng.uniform(5.0, 12.0, (len(wrong), 1)) * rng.choice([-1.0, 1.0], (len(wrong), 2))
    spoiled = eg.Tracks(tracks.view, tracks.point, xy)
    found = eg.bundle_adjust(spoiled, start, **options)
    assert {"outliers", "gross errors"} & set(found.flags)
    aside = eg.bundle_adjust(spoiled, start, robust=True, **options)
    assert not {"outliers", "gross errors"} & set(aside.flags)


def test_tails_are_no_outliers() -> None:
    """Laplacian residuals have many beyond four standard deviations, none apart."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, 2.0 * np.pi, 4000)
    length = rng.gamma(2.0, 0.7, 4000)
    xy, usual = rng.uniform(0.0, 600.0, (4000, 2)), float(np.median(length)) / 1.1774
    assert np.mean(length > 4.0 * usual) > 0.01
    assert gross_flags(TailOfArrays(length, xy), usual) == ()
    normal = np.linalg.norm(rng.normal(0.0, usual, (4000, 2)), axis=1)
    assert gross_flags(TailOfArrays(normal, xy), usual) == ()
    far = np.where(angle < 0.03, 30.0 * usual, normal)
    assert gross_flags(TailOfArrays(far, xy), usual) == ("outliers",)


def test_weakest_names_what_moves() -> None:
    tracks, scene = of_pairs(4, [(0, k) for k in (1, 2, 3)], 20, 1)
    found = eg.bundle_adjust(tracks, scene, refine="pose")
    assert "undetermined" in found.weakest
    tracks, scene = seen_from(side(), cloud(0), 0, R=SAME)
    assert "f of view" in eg.bundle_adjust(tracks, scene, refine=("f",)).weakest
    tracks, scene = seen_from(ring(), cloud(0), 0)
    # The last view has six points, which fix it barely.
    sees = np.ones((6, 60), np.bool_)
    sees[5, 6:] = False
    tracks, scene = seen_from(ring(), cloud(0), 0, visible=sees)
    projective = eg.bundle_adjust(tracks, scene.to_projective())
    assert projective.weakest.startswith("cameras of views 5 (")


def test_perspective_that_does_not_show_is_told_of_projective_cameras() -> None:
    for times, expected in ((400.0, True), (1.0, False)):
        tracks, scene = seen_from(times * ring(), cloud(1), 1, f=800.0 * times)
        found = eg.bundle_adjust(tracks, scene.to_projective())
        assert ("near-affine" in found.flags) is expected


@pytest.mark.parametrize("plane", [False, True])
def test_a_point_that_went_far_away_neither_hides_nor_makes_a_plane(plane: bool) -> None:
    # As a point whose observations were set aside: they have no weight.
    tracks, scene = seen_from(ring(), flat(1) if plane else cloud(1), 1)
    X = scene.X.copy()
    X[0] = [2e9, 1e9, 1e8]
    far = eg.MetricReconstruction(scene.R, scene.t, X, scene.cameras)
    kept = tracks.weighted(np.where(tracks.point == 0, 0.0, 1.0))
    found = eg.bundle_adjust(kept, far, refine=("f",))
    assert ("flat scene" in found.flags) is plane


def test_networks_fall_into_parts() -> None:
    view, point = np.array([0, 1, 1, 2, 3, 4]), np.array([0, 0, 1, 1, 2, 2])
    (part,) = loose_parts(view, point, 5)
    assert part.tolist() == [3, 4]
    assert [p.tolist() for p in loose_parts(view, point, 6)] == [[3, 4], [5]]
    assert loose_parts(view[:4], point[:4], 3) == ()
    assert only_pairs(point)
    assert not only_pairs(np.array([0, 0, 0, 1, 1]))


def test_measured_calibrated_sets_are_sound(data_dir: Path) -> None:
    path = data_dir / "metrology_aicon" / "network.npz"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    file, tracks, start, bar = load_network(path)
    names = tuple(file["camera_names"].tolist())
    found = eg.bundle_adjust(tracks, start, refine=names, priors=[bar])
    assert (found.success, found.flags) == (True, ())
    path = data_dir / "bal" / "problem-49-7776-pre.txt.bz2"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    assert not DEGENERATE & set(eg.bundle_adjust(*eg.load_scene(path)).flags)
