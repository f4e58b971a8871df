"""Verdicts on reconstructions: what the observations leave open is said, and nothing else."""

from __future__ import annotations

import copy
import itertools
import pickle
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge import lm
from epigauge.multi_view import result as results
from epigauge.multi_view.parallax import fit_homographies
from epigauge.multi_view.seen import Seen
from epigauge.multi_view.verdicts.counting import missing_by_count
from epigauge.multi_view.verdicts.front import behind
from epigauge.multi_view.verdicts.verdict import Verdict
from epigauge.verdicts import FLAGS, usable
from numpy.typing import NDArray

Array = NDArray[np.float64]
K = np.diag([1000.0, 1000.0, 1.0])


def arc(n: int) -> Array:
    """Return cameras side by side."""
    return np.array([K @ np.c_[np.eye(3), [-k, 0.2 * k, 6 + 0.1 * k * k]] for k in range(n)])


def turned(n: int, step: float = 0.05) -> Array:
    """Return cameras at one place."""
    cameras = []
    for k in range(n):
        c, s = np.cos(step * k), np.sin(step * k)
        b, t = np.cos(0.03 * k), np.sin(0.03 * k)
        R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array(
            [[1, 0, 0], [0, b, -t], [0, t, b]]
        )
        cameras.append(K @ np.c_[R, R @ [0.0, 0.0, 6.0]])
    return np.array(cameras)


def images(P: Array, X: Array, seed: int, noise_px: float = 0.3) -> Array:
    rng = np.random.default_rng(seed)
    h = np.einsum("vij,pj->vpi", P, X)
    return np.asarray(h[..., :2] / h[..., 2:] + noise_px * rng.normal(size=(*h.shape[:2], 2)))


def cloud(m: int, seed: int) -> Array:
    rng = np.random.default_rng(100 + seed)
    return np.c_[rng.uniform(-1.5, 1.5, (m, 3)), np.ones(m)]


def all_seen(P: Array, X: Array, seed: int) -> eg.Tracks:
    view, point = np.mgrid[: len(P), : len(X)]
    return eg.Tracks(view.ravel(), point.ravel(), images(P, X, seed).reshape(-1, 2))


def of_pairs(n: int, edges: Sequence[tuple[int, int]], m: int, seed: int) -> eg.Tracks:
    """Return tracks of two views each, m for each pair of views."""
    P = arc(n)
    view, point, xy = [], [], []
    for e, (i, k) in enumerate(edges):
        xy.append(images(P[[i, k]], cloud(m, 10 * seed + e), 10 * seed + e).reshape(-1, 2))
        view += [i] * m + [k] * m
        point += 2 * list(range(e * m, (e + 1) * m))
    return eg.Tracks(view, point, np.concatenate(xy))


RINGS = {f"cycle of {n}": (n, [(k, (k + 1) % n) for k in range(n)]) for n in (4, 5, 6)}
STARS = {f"star of {n}": (n, [(0, k) for k in range(1, n)]) for n in (3, 4, 6)}
CHAINS = {f"chain of {n}": (n, [(k, k + 1) for k in range(n - 1)]) for n in (3, 5)}
TAIL = {"triangle with a tail": (4, [(0, 1), (1, 2), (2, 0), (2, 3)])}
OPEN = RINGS | STARS | CHAINS | TAIL


@pytest.mark.parametrize(("kind", "m"), [*zip(OPEN, itertools.cycle([30, 60]), strict=False)])
def test_undetermined_networks_end_flagged(kind: str, m: int) -> None:
    n, edges = OPEN[kind]
    tracks = of_pairs(n, edges, m, n)
    start = eg.initialize(tracks, method="factorization")
    found = eg.bundle_adjust(tracks, start)
    assert "undetermined" in found.flags
    assert not found.success
    assert found.condition == np.inf
    # Two views with all their matches fix 7 numbers, and 11 n - 15 are needed.
    assert found.rank <= 7 * len(edges) + 3 * tracks.n_points


@pytest.mark.parametrize("n", [3, 4, 5, 6])
@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_of_all_views_are_solved(n: int, seed: int) -> None:
    edges = [(i, k) for i in range(n) for k in range(i + 1, n)]
    tracks = of_pairs(n, edges, 60, seed)
    found = eg.bundle_adjust(tracks)
    assert found.success
    assert found.flags == ()
    assert found.rank == 11 * n + 3 * tracks.n_points - 15
    assert 1.0 <= found.condition < 1e8
    # At the minimum each pair has 60 - 7 squares of noise; the cameras' have 15 - 11 n less.
    degrees = 60 * len(edges) - (11 * n - 15)
    assert found.cost / 0.5 == pytest.approx(0.3**2 * degrees, rel=4 * (2 / degrees) ** 0.5)


def test_triangle_of_the_smallest_start_is_found_by_registration_too() -> None:
    tracks = of_pairs(3, [(0, 1), (1, 2), (0, 2)], 60, 3)
    a, b = (
        eg.bundle_adjust(tracks, eg.initialize(tracks, method=method))
        for method in ("auto", "registration")
    )
    assert a.cost == pytest.approx(b.cost, rel=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("n", [3, 5, 8])
@pytest.mark.parametrize("kind", ["flat", "turned", "still"])
def test_scenes_without_parallax_end_flagged(kind: str, n: int, seed: int) -> None:
    X = cloud(80, seed)
    if kind == "flat":
        X[:, 2] = 0.0
    P = {"flat": arc(n), "turned": turned(n), "still": np.repeat(turned(1), n, axis=0)}[kind]
    found = eg.bundle_adjust(all_seen(P, X, seed))
    assert not found.success
    assert ("still camera" if kind == "still" else "planar scene") in found.flags
    assert FLAGS["still camera" if kind == "still" else "planar scene"].sentence in found.message
    if kind == "turned" and n > 3:
        assert "pure rotation" in found.flags


def approaching(n: int) -> Array:
    """Return cameras that come nearer, and turn to keep the scene in sight."""
    cameras = []
    for k in range(n):
        c, s = np.cos(0.5 * k / n), np.sin(0.5 * k / n)
        R = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        cameras.append(K @ np.c_[R, [0.1 * k, -0.1 * k, 9.0 - 6.5 * k / (n - 1)]])
    return np.array(cameras)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_flat_scene_is_told_at_all_scales(seed: int) -> None:
    """From 9 m to 2.5 m away the noise of far images is magnified, and is no relief."""
    X = cloud(60, seed)
    found = eg.bundle_adjust(all_seen(approaching(5), X, seed))
    assert not {"planar scene", "nearly planar"} & set(found.flags)
    X[:, 2] = 0.0
    found = eg.bundle_adjust(all_seen(approaching(5), X, seed))
    assert not found.success
    assert "planar scene" in found.flags


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("n", [3, 5, 15])
def test_general_scenes_raise_nothing(n: int, seed: int) -> None:
    found = eg.bundle_adjust(
        all_seen(arc(n) if n < 9 else many_views.cameras_and_points(n).P, cloud(80, seed), seed)
    )
    assert found.success
    assert found.flags == ()
    assert found.n_behind == 0
    assert not found.rejected.any()
    assert found.rank == 11 * n + 3 * 80 - 15


@pytest.mark.parametrize(
    "name", ["corridor", "house", "library", "merton_1", "dinosaur_trimmed", "dinosaur"]
)
def test_measured_sets_raise_nothing(data_dir: Path, name: str) -> None:
    found = eg.bundle_adjust(many_views.real_tracks(data_dir, name))
    assert (found.success, found.flags) == (True, ())


def test_rank_is_that_of_the_normal_matrix() -> None:
    truth = many_views.cameras_and_points(4, 30)
    tracks = many_views.observed(truth, seen=0.7)
    found = eg.bundle_adjust(tracks)
    problem = many_views.problem_of(tracks)
    N = many_views.dense(
        problem.linearize(problem.evaluate(many_views.in_units(found.reconstruction)))
    )
    scale = 1.0 / np.sqrt(np.diag(N))
    values = np.linalg.eigvalsh(scale[:, None] * N * scale)
    assert found.rank == np.count_nonzero(values > 1e-10 * values[-1])


def test_one_open_point_does_not_spoil_the_rest() -> None:
    truth = many_views.cameras_and_points(5, 60)
    tracks = many_views.observed(truth)
    found = eg.bundle_adjust(tracks)
    P, Q = found.reconstruction.P, found.reconstruction.Q.copy()
    assert found.rank == 11 * 5 + 3 * 60 - 15
    # A point at the centre of a camera that sees it: any line of sight will do.
    centre = -np.linalg.solve(P[0, :, :3], P[0, :, 3])
    Q[7] = np.append(centre, 1.0)
    seen, lost = Seen.of(tracks, eg.Reconstruction(P, Q), np.zeros(len(tracks), dtype=np.bool_))
    assert lost == 0
    assert missing_by_count(seen) == 0


@pytest.mark.parametrize("loss", ["linear", "huber"])
def test_a_view_whose_observations_weigh_nothing_is_undetermined(loss: str) -> None:
    scene = eg.multi_view_scene(seed=1)
    own = scene.tracks
    tracks = eg.Tracks(own.view, own.point, own.xy, weights=(own.view != 2).astype(float))
    result = eg.bundle_adjust(tracks, loss=loss)
    assert not result.success
    assert "undetermined" in result.flags


def test_points_behind_cameras_are_counted_whatever_the_signs() -> None:
    truth = many_views.cameras_and_points(5, 60)
    tracks = many_views.observed(truth, 0.0)
    rng = np.random.default_rng(0)
    change = many_views.gauge_change(rng, 5, 60)
    moved = many_views.changed(change, truth)
    none = np.zeros(len(tracks), dtype=np.bool_)
    seen, _ = Seen.of(tracks, moved, none)
    third = np.einsum("nj,nj->n", seen.P[seen.view, 2], seen.Q[seen.point])
    assert behind(seen, third) == 0
    # Points 0 to 2 are seen from behind by one camera of five.
    wrong = (seen.view == 3) & (seen.point < 3)
    assert behind(seen, np.where(wrong, -third, third)) == 3


def test_gross_errors_that_bend_least_squares_are_told() -> None:
    tracks = many_views.observed(many_views.cameras_and_points(5, 100))
    xy = tracks.xy.copy()
    xy[5] += 400.0
    spoiled = eg.Tracks(tracks.view, tracks.point, xy)
    start = eg.bundle_adjust(tracks).reconstruction
    found = eg.bundle_adjust(spoiled, start)
    assert "gross errors" in found.flags
    assert not found.success
    assert "gross errors" not in eg.bundle_adjust(spoiled, start, loss="cauchy").flags


def test_homographies_are_fitted_against_points_off_the_plane() -> None:
    rng = np.random.default_rng(0)
    H = np.array([[1.0, 0.1, 20.0], [-0.05, 0.9, 5.0], [1e-4, 2e-4, 1.0]])
    x1 = rng.uniform(0.0, 500.0, (60, 2))
    h = np.c_[x1, np.ones(60)] @ H.T
    x2 = h[:, :2] / h[:, 2:]
    x2[:12] += 40.0
    fits = fit_homographies(x1, x2, np.array([0, 60]))
    assert fits.distances[12:].max() < 1e-3
    assert fits.distances[:12].min() > 10.0


def test_words_of_the_message_come_from_the_vocabulary() -> None:
    found = eg.bundle_adjust(all_seen(turned(4), cloud(60, 0), 0))
    spoiling = [name for name in found.flags if not usable([name], "views")]
    assert spoiling
    for name in spoiling:
        assert name in found.message
    assert "lambda" not in found.message


@pytest.mark.parametrize("steps", [1, 2])
def test_an_end_by_the_number_of_steps_says_what_is_determined_least(steps: int) -> None:
    scene = eg.multi_view_scene(n_points=30, seed=2)
    found = eg.bundle_adjust(scene.tracks, eg.initialize(scene.tracks), max_iter=steps, ftol=0.0)
    assert found.status == 0
    assert not found.success
    assert found.weakest
    assert found.message.startswith(f"{lm.STATUS[0]} (weakest: {found.weakest})")


class TestVerdictWhenAsked:
    """The verdict waits until it is asked for, and is that on what was found."""

    @staticmethod
    def found() -> eg.BundleResult:
        scene = eg.multi_view_scene(n_points=30, seed=2)
        return eg.bundle_adjust(scene.tracks, eg.initialize(scene.tracks))

    def test_all_its_fields_are_there_once_one_was_asked_for(self) -> None:
        result = self.found()
        assert "flags" not in vars(result)
        assert result.success
        assert result.message
        assert "_judge" not in vars(result)
        assert result.flags == ()
        assert result.rank == 11 * 5 + 3 * 30 - 15

    def test_writing_to_the_result_does_not_change_it(self) -> None:
        result, untouched = self.found(), self.found()
        result.reconstruction.P[:] = 1.0
        assert result.condition == untouched.condition
        assert result.flags == untouched.flags

    def test_copies_and_pickles_are_judged(self) -> None:
        found = self.found
        pickled = pickle.loads(pickle.dumps(found()))  # noqa: S301
        for made in (copy.copy(found()), copy.deepcopy(found()), pickled):
            assert "flags" in vars(made)
            assert "_judge" not in vars(made)

    def test_changing_what_was_fixed_does_not_change_it(self) -> None:
        scene = eg.multi_view_scene(n_points=30, seed=2)
        found = []
        for factor in (1.0, 3.0):
            start = eg.initialize(scene.tracks)
            result = eg.bundle_adjust(scene.tracks, start, fixed_views=[0], fixed_points=[4])
            start.P[0, 1] *= factor
            start.Q[4, :2] *= factor
            found.append((result.condition, result.rank, result.n_behind, result.flags))
        assert found[0] == found[1]

    def test_threads_that_ask_together_judge_once(self) -> None:
        made = self.found()
        judge, calls = vars(made)["_judge"], []

        def slowly() -> Verdict:
            calls.append(made)
            time.sleep(0.1)
            return judge()

        vars(made)["_judge"] = slowly
        with ThreadPoolExecutor(4) as pool:
            told = list(pool.map(lambda _: made.condition, range(4)))
        assert len(calls) == 1
        assert told == [self.found().condition] * 4

    @pytest.mark.parametrize("kind", [AttributeError, np.linalg.LinAlgError])
    def test_a_verdict_that_fails_is_no_missing_field(self, kind: type[Exception]) -> None:
        made = self.found()

        def fails() -> Verdict:
            raise kind("within")

        vars(made)["_judge"] = fails
        for _ in range(2):  # nor is it forgotten that it is still to be made
            with pytest.raises((RuntimeError, np.linalg.LinAlgError), match="within"):
                getattr(made, "flags", ())
            with pytest.raises((RuntimeError, np.linalg.LinAlgError), match="within"):
                made.summary()

    def test_no_threads_are_left_to_the_verdict(self) -> None:
        scene = eg.multi_view_scene(n_views=8, n_points=2000, noise_px=0.5, seed=2)
        start = eg.initialize(scene.tracks)
        assert "flags" in vars(eg.bundle_adjust(scene.tracks, start, workers=2, max_iter=1))

    def test_only_the_last_adjustment_without_gross_errors_is_judged(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        scene = eg.multi_view_scene(n_points=60, noise_px=0.5, seed=4)
        xy = scene.tracks.xy.copy()
        xy[::4] += np.random.default_rng(0).uniform(-60.0, 60.0, xy[::4].shape)
        tracks = eg.Tracks(scene.tracks.view, scene.tracks.point, xy)
        made, judged = [], []
        unjudged, told = eg.BundleResult.unjudged, results.told

        def counted(*of: Any, **known: Any) -> eg.BundleResult:
            made.append(known)
            return unjudged(*of, **known)

        monkeypatch.setattr(eg.BundleResult, "unjudged", counted)
        monkeypatch.setattr(results, "told", lambda *of: judged.append(of) or told(*of))
        found = eg.bundle_adjust(tracks, eg.initialize(tracks, robust=True), robust=True)
        assert np.count_nonzero(found.rejected) > 0.8 * len(xy[::4])
        assert "set aside as gross errors" in found.message
        assert len(judged) == 1 < len(made)

    def test_what_no_result_has_is_no_attribute(self) -> None:
        with pytest.raises(AttributeError, match="no attribute 'weight'"):
            getattr(self.found(), "weight")  # noqa: B009
