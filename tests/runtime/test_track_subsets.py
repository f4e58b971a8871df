"""A subset of tracks: what is left is the same, under other numbers."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest

Tracks = eg.Tracks


@pytest.fixture(scope="module")
def tracks() -> Tracks:
    plain = eg.multi_view_scene(n_points=20, seed=1).tracks
    random = np.random.default_rng(0).permutation(len(plain))
    S = np.array([[2.0, 0.5], [0.5, 1.0]]) * np.linspace(1, 2, len(plain))[:, None, None]
    return Tracks(
        *(plain.view[random], plain.point[random], plain.xy[random]),
        weights=np.linspace(0.5, 1.0, len(plain)),
        covariance=S,
        names=list("abcde"),
        sizes=np.arange(10, 20).reshape(5, 2),
        colours=np.arange(60).reshape(20, 3),
    )


def test_what_is_left_is_measured_as_before(tracks: Tracks) -> None:
    keep = (tracks.point % 3 > 0) & (tracks.view != 2)
    some, views, points = tracks.subset(keep)
    assert views.tolist() == [0, 1, 3, 4]
    assert some.n_points == len(points) == 13
    assert (views[some.view] == tracks.view[keep]).all()
    assert (points[some.point] == tracks.point[keep]).all()
    assert (some.xy == tracks.xy[keep]).all()
    assert (some.weights == tracks.weights[keep]).all()
    assert (some.whitening == tracks.whitening[:, :, keep]).all()
    assert some.unit == tracks.unit
    assert some.names == ("a", "b", "d", "e")
    assert (some.sizes == tracks.sizes[views]).all()
    assert (some.colours == tracks.colours[points]).all()


def test_second_sightings_stay(tracks: Tracks) -> None:
    rows = np.append(np.arange(len(tracks)), 7)
    parts = tracks.view[rows], tracks.point[rows], tracks.xy[rows]
    twice = Tracks(*parts, repeated=True)
    assert twice.subset(np.ones(len(twice), np.bool_))[0].n_repeated == 1


@pytest.mark.parametrize(
    ("keep", "message"),
    [
        (lambda tracks: np.ones(len(tracks)), "keep is float64"),
        (lambda tracks: np.ones(3, np.bool_), r"keep is bool \(3,\)"),
        (lambda tracks: np.zeros(len(tracks), np.bool_), "no observation"),
        (lambda tracks: tracks.point < 5, "fewer than 6"),
        (lambda tracks: (tracks.point > 3) | (tracks.view == 0), "0, 1, 2, 3 has fewer than 2"),
    ],
)
def test_what_is_too_little_is_refused(tracks: Tracks, keep: object, message: str) -> None:
    with pytest.raises(eg.ArgumentError, match=message):
        tracks.subset(keep(tracks))  # type: ignore[operator]


def test_a_calibrated_camera_needs_fewer_points(tracks: Tracks) -> None:
    assert tracks.subset(tracks.point < 5, min_points=1)[0].n_points == 5


def test_the_least_number_of_points_is_a_number(tracks: Tracks) -> None:
    wrong: Any = "three"
    with pytest.raises(eg.ArgumentError, match="min_points is 'three'"):
        tracks.subset(tracks.point < 12, min_points=wrong)
