"""Tracks from matches of pairs: verified, merged without contradictions, what is left out named."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from calibration import SIZE, tracks_of
from epigauge.images.pairwise import _matched, _ranked
from epigauge.images.tracks import NoTracks, _united

pytest.importorskip("cv2", reason="estimate_fundamental needs a front end")


def pairwise(
    motion: str = "general",
    seed: int = 0,
    *,
    flat: bool = False,
    unrelated: bool = False,
    wrong: float = 0.2,
    n: int = 5,
) -> tuple[eg.PairwiseMatches, eg.Tracks]:
    """Return matches of all pairs of a made-up scene, a share of them wrong, and its tracks."""
    tracks, scene = tracks_of(motion, seed, n_views=n, n_points=160)
    rng = np.random.default_rng(seed)
    xy = tracks.xy
    if flat:
        X = scene.X * [1.0, 1.0, 0.0]
        xy = eg.MetricReconstruction(scene.R, scene.t, X, scene.cameras).project(tracks)
    xy = xy + rng.normal(0.0, 0.3, xy.shape)
    points, pairs, number = [], {}, {}
    for i in range(n):
        rows = rng.permutation(np.flatnonzero(tracks.view == i))
        points.append(xy[rows])
        number[i] = dict(zip(tracks.point[rows].tolist(), range(len(rows)), strict=True))
    if unrelated:
        points.append(rng.uniform(0.0, 1.0, (160, 2)) * SIZE)
        number[n] = dict(zip(range(160), rng.permutation(160).tolist(), strict=True))
    for i, j in itertools.combinations(range(len(points)), 2):
        common = sorted(number[i].keys() & number[j].keys())
        rows = np.array([(number[i][k], number[j][k]) for k in common])
        out = rng.random(len(rows)) < wrong
        rows[out, 1] = rng.permutation(rows[out, 1])
        pairs[i, j] = rows
    names = tuple(f"{k}.jpg" for k in range(len(points)))
    sizes = np.tile(SIZE, (len(points), 1))
    colours = tuple(np.full((len(p), 3), (10, 20, 30), np.uint8) for p in points)
    return eg.PairwiseMatches(names, sizes, tuple(points), pairs, colours), tracks


def test_pairs_become_tracks_that_lead_to_the_camera() -> None:
    matches, truth = pairwise()
    tracks = eg.build_tracks(matches)
    assert tracks.names == matches.names
    assert tracks.source.left_out == {}
    assert (tracks.colours == [10, 20, 30]).all()
    # Long tracks come back whole: more observations than half of the right ones.
    assert len(tracks) > 0.5 * len(truth)
    found = eg.metric_upgrade(tracks, image_size=tracks.sizes)
    assert found.success
    assert abs(found.focal_px - 900.0) < 4.0 * found.focal_std_px


def test_an_image_of_something_else_is_left_out() -> None:
    matches, _ = pairwise(unrelated=True, n=3)
    tracks = eg.build_tracks(matches)
    assert tracks.names == matches.names[:3]
    assert list(tracks.source.left_out) == ["3.jpg"]
    assert "agrees with no other image" in tracks.source.left_out["3.jpg"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"flat": True}, "planar scene"),
        ({"motion": "rotation"}, "pure rotation"),
        ({"wrong": 1.0}, "nothing in common"),
    ],
)
def test_what_cannot_start_a_scene_is_said(arguments: dict, words: str) -> None:
    matches, _ = pairwise(n=3, **arguments)
    with pytest.raises(NoTracks, match=words):
        eg.build_tracks(matches)


@pytest.mark.parametrize(
    ("images", "words"),
    [
        (Path(), "is a folder"),
        ([np.zeros((50, 50), np.uint8)] * 2, "has no paths"),
        (None, "has no paths"),
        (["a.jpg"], "holds 1"),
        (["a.jpg", "b.jpg", Path("a.jpg")], "twice"),
    ],
)
def test_what_names_no_photographs_is_told_before_any_work(images: object, words: str) -> None:
    with pytest.raises(eg.ArgumentError, match=words) as error:
        eg.build_tracks(images)
    assert error.value.argument == "images"


def together(*parts: eg.PairwiseMatches) -> eg.PairwiseMatches:
    """Return matches of images of several scenes."""
    pairs, first = {}, 0
    for part in parts:
        pairs |= {(first + i, first + j): rows for (i, j), rows in part.pairs.items()}
        first += len(part.points)
    points = tuple(xy for part in parts for xy in part.points)
    names = tuple(f"{k}.jpg" for k in range(first))
    return eg.PairwiseMatches(names, np.tile(SIZE, (first, 1)), points, pairs)


def test_images_of_another_scene_are_left_out_with_those_that_they_agree_with() -> None:
    tracks = eg.build_tracks(together(pairwise(seed=4, n=2)[0], pairwise(seed=5, n=3)[0]))
    assert tracks.names == ("2.jpg", "3.jpg", "4.jpg")
    assert tracks.source.left_out == {
        "0.jpg": "belongs to a part of its own, with 1.jpg",
        "1.jpg": "belongs to a part of its own, with 0.jpg",
    }


@pytest.mark.parametrize("moved_px", [0.0, 0.2])
def test_a_photograph_given_twice_does_no_harm(moved_px: float) -> None:
    found, _ = pairwise(seed=6, n=3)
    # Most features of one photograph have a match in its copy, and in no other image.
    rng = np.random.default_rng(0)
    first = np.vstack([found.points[0], rng.uniform(0.0, 1.0, (300, 2)) * SIZE])
    copy = first + rng.normal(0.0, 1.0, first.shape) * moved_px
    pairs = found.pairs | {(j, 3): rows[:, ::-1] for (i, j), rows in found.pairs.items() if i == 0}
    pairs[0, 3] = np.column_stack([np.arange(len(first))] * 2)
    twice = eg.PairwiseMatches(
        tuple(f"{k}.jpg" for k in range(4)),
        np.tile(SIZE, (4, 1)),
        (first, *found.points[1:], copy),
        pairs,
    )
    tracks = eg.build_tracks(twice)
    assert tracks.n_views == 4
    lengths = np.bincount(tracks.point)
    in_both = np.isin(tracks.view, (0, 3))
    assert (np.bincount(tracks.point[in_both], minlength=tracks.n_points) < lengths).all()
    result = eg.metric_upgrade(tracks, image_size=SIZE)
    assert result.success
    assert abs(result.focal_px - 900.0) < 4.0 * result.focal_std_px < 0.2 * 900.0
    np.testing.assert_allclose(
        result.reconstruction.centres[0], result.reconstruction.centres[3], atol=0.02
    )


def test_no_track_has_two_features_of_one_image() -> None:
    rng = np.random.default_rng(0)
    image_of = np.repeat(np.arange(6), 40)
    for _ in range(5):
        edges = rng.integers(0, 240, (600, 2))
        edges = edges[image_of[edges[:, 0]] != image_of[edges[:, 1]]]
        track_of = _united(edges, image_of)
        seen = {(t, i) for t, i in zip(track_of.tolist(), image_of.tolist(), strict=True) if t >= 0}
        assert len(seen) == np.count_nonzero(track_of >= 0)
        # What is joined without contradiction is one track: the first edge always.
        assert track_of[edges[0, 0]] == track_of[edges[0, 1]] >= 0


def test_a_file_begins_where_it_was_left(tmp_path: Path) -> None:
    matches, _ = pairwise()
    matches.save(tmp_path / "matches.npz")
    again = eg.PairwiseMatches.load(tmp_path / "matches.npz")
    assert again.names == matches.names
    for one, other in zip(again.points, matches.points, strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.pairs.keys() == matches.pairs.keys()
    for pair, rows in matches.pairs.items():
        np.testing.assert_array_equal(again.pairs[pair], rows)
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises((eg.FileFormatError, OSError)):
        eg.PairwiseMatches.load(tmp_path / "broken.npz")


def test_matching_is_the_same_from_both_sides_and_in_any_blocks() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(1300, 16)).astype(np.float32)
    b = np.concatenate([a[rng.permutation(1300)[:900]], rng.normal(size=(500, 16))])
    b = (b + 0.05 * rng.normal(size=b.shape)).astype(np.float32)
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    rows = _matched(a, b, 0.8)
    swapped = _matched(b, a, 0.8)
    assert {tuple(r) for r in rows.tolist()} == {tuple(r[::-1]) for r in swapped.tolist()}
    squared = 2.0 - 2.0 * (a @ b.T)
    order = np.argsort(squared, axis=1)
    expected = set()
    for i in range(len(a)):
        j, second = order[i, :2]
        column = np.sort(squared[:, j])
        clear = squared[i, j] < 0.64 * squared[i, second] and column[0] < 0.64 * column[1]
        if clear and squared[i, j] == column[0]:
            expected.add((i, int(j)))
    assert {tuple(r) for r in rows.tolist()} == expected


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"sizes": np.ones((2, 2))}, "sizes"),
        ({"points": ()}, "points"),
        ({"pairs": {(1, 0): np.zeros((1, 2), int)}}, "pairs"),
        ({"pairs": {(0, 1): np.full((1, 2), 10**6)}}, "pairs"),
        ({"pairs": {(0, 1): np.zeros((1, 3), int)}}, "pairs"),
    ],
)
def test_bad_matches_are_named(change: dict, named: str) -> None:
    matches, _ = pairwise()
    fields = {k: getattr(matches, k) for k in ("names", "sizes", "points", "pairs")} | change
    with pytest.raises(eg.ArgumentError) as error:
        eg.PairwiseMatches(**fields)
    assert error.value.argument == named


def test_ranked_pairs_are_those_with_most_in_common() -> None:
    rng = np.random.default_rng(0)
    scenes = rng.normal(size=(2, 300, 32))
    strongest = []
    for k in range(30):  # of two scenes in turn; of each image two thirds of the features
        own = scenes[k % 2][rng.permutation(300)[:200]]
        own = own + 0.05 * rng.normal(size=own.shape)
        strongest.append((own / np.linalg.norm(own, axis=1)[:, None]).astype(np.float32))
    chosen = _ranked(strongest, 0.8)
    assert all((i - j) % 2 == 0 for i, j in chosen)
    partners = np.bincount(np.ravel(chosen), minlength=30)
    assert partners.min() >= 12
    assert len(chosen) < 30 * 29 // 2
    # A few images: all of them, in order.
    assert _ranked(strongest[:5], 0.8) == [(i, j) for i in range(5) for j in range(i + 1, 5)]


def test_threads_verify_the_same() -> None:
    matches, _ = pairwise()
    one, two = (eg.build_tracks(matches, workers=workers) for workers in (1, 2))
    assert np.array_equal(one.xy, two.xy)
    assert one.source == two.source


def test_damaged_caches_are_named_and_left_as_they_are(tmp_path: Path) -> None:
    matches, _ = pairwise(n=3)
    matches.save(tmp_path / "whole.npz")
    whole = (tmp_path / "whole.npz").read_bytes()
    assert eg.PairwiseMatches.load(tmp_path / "whole.npz").names == matches.names
    rng = np.random.default_rng(0)
    damaged = [b"", b"PK", whole[:1000], whole[:-30], whole[500:], b"\x93NUMPY" + whole[:50]]
    for _ in range(40):
        data = bytearray(whole)
        for at in rng.integers(0, len(whole), 30):
            data[at] = rng.integers(0, 256)
        damaged.append(bytes(data))
    refused = 0
    for data in damaged:
        (tmp_path / "d.npz").write_bytes(data)
        try:
            eg.PairwiseMatches.load(tmp_path / "d.npz")
        except (eg.FileFormatError, eg.ArgumentError):
            refused += 1
        assert (tmp_path / "d.npz").read_bytes() == data
    # The archive has check sums: hardly anything passes.
    assert refused >= 44


def test_matches_of_places_that_are_no_numbers_are_refused() -> None:
    matches, _ = pairwise(n=3)
    rows = matches.pairs[0, 1]
    matches.points[1][rows[0, 1]] = np.nan
    with pytest.raises(eg.ArgumentError, match=r"of image 1 .* not all finite"):
        replace(matches)


@pytest.mark.parametrize("name", ["count", "matches"])
def test_caches_with_other_counts_are_refused(name: str, tmp_path: Path) -> None:
    matches, _ = pairwise(n=3)
    matches.save(tmp_path / "c.npz")
    with np.load(tmp_path / "c.npz") as file:
        arrays = dict(file)
    arrays[name] = arrays[name] - 5
    np.savez(tmp_path / "c.npz", **arrays)
    with pytest.raises(eg.FileFormatError):
        eg.PairwiseMatches.load(tmp_path / "c.npz")


def _photographs(folder: Path) -> list[Path]:
    """Write three photographs of which each has some features."""
    import cv2

    rng = np.random.default_rng(0)
    whole = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (220, 300)), (0, 0), 2.0)
    whole = cv2.normalize(whole, None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)
    paths = [folder / f"{k}.png" for k in range(3)]
    for k, path in enumerate(paths):
        cv2.imwrite(str(path), whole[5 * k :, 8 * k : 8 * k + 240])
    return paths


def test_interrupted_matching_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths, cache = _photographs(tmp_path), tmp_path / "matches.npz"
    plain = eg.match_photographs(paths)

    def stopped(at: str) -> None:
        def told(what: str, done: int, count: int) -> None:
            if (what, done) == (at, 2):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            eg.match_photographs(paths, cache=cache, progress=told)

    partial = tmp_path / "matches.npz.partial"
    stopped("features")
    assert len(list(partial.glob("features-*.npz"))) == 2
    stopped("pairs")
    assert len(list(partial.glob("features-*.npz"))) == 3
    assert len(list(partial.glob("matches-*.npz"))) == 1
    assert not cache.exists()
    # What is damaged is made anew; the rest is not sought again.
    next(partial.glob("features-*.npz")).write_bytes(b"PK")
    sought = []
    from epigauge.images import pairwise as module

    original = module._features
    monkeypatch.setattr(
        module, "_features", lambda *a, **k: (sought.append(a[1]), original(*a, **k))[1]
    )
    found = eg.match_photographs(paths, cache=cache)
    assert len(sought) == 1
    assert cache.exists()
    assert not partial.exists()
    again = eg.match_photographs(paths, cache=cache)
    assert len(sought) == 1
    for other in (found, again):
        assert other.names == plain.names
        assert all(np.array_equal(a, b) for a, b in zip(other.points, plain.points, strict=True))
        assert all(np.array_equal(other.pairs[p], rows) for p, rows in plain.pairs.items())
    with pytest.raises(eg.ArgumentError, match="of other images"):
        eg.match_photographs(paths[:2], cache=cache)


def test_changed_photographs_and_options_are_not_taken_from_an_interrupted_run(
    tmp_path: Path,
) -> None:
    from epigauge.images.unfinished import Unfinished

    paths = _photographs(tmp_path)
    made = []

    def get(options: dict) -> None:
        kept = Unfinished(tmp_path / "c.npz", options)
        kept.get("features", paths[:1], lambda: (made.append(1), {"a": np.arange(3)})[1])

    get({"ratio": 0.8})
    get({"ratio": 0.8})
    assert len(made) == 1
    get({"ratio": 0.7})
    assert len(made) == 2
    paths[0].write_bytes(paths[0].read_bytes() + b" ")
    get({"ratio": 0.8})
    assert len(made) == 3
