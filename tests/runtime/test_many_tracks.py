"""Tracks: every kind of bad input is refused by naming it; good input is sorted once and kept."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import many_views
import numpy as np
import pytest
from epigauge.errors import ArgumentError
from metric_scenes import metric_scene
from numpy.typing import NDArray


def rows(n: int = 3, m: int = 8) -> dict[str, Any]:
    """Return n views of m points, every point in every view, in a shuffled order."""
    rng = np.random.default_rng(0)
    view, point = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m)))
    shuffled = rng.permutation(n * m)
    xy = rng.uniform(0.0, 500.0, (n * m, 2))
    return {"view": view[shuffled], "point": point[shuffled], "xy": xy}


def refusal(**arguments: Any) -> str:
    with pytest.raises(ArgumentError) as caught:
        eg.Tracks(**arguments)
    return str(caught.value)


def dropped(data: dict[str, Any], keep: Any) -> dict[str, Any]:
    return {name: values[keep] for name, values in data.items()}


def test_sorted_by_point_then_view_with_the_rows_they_came_from() -> None:
    data = rows()
    weights = np.arange(1.0, 25.0)
    tracks = eg.Tracks(**data, weights=weights)
    key = tracks.point * 3 + tracks.view
    assert (np.diff(key) > 0).all()
    for name, values in (*data.items(), ("weights", weights)):
        np.testing.assert_array_equal(getattr(tracks, name), values[tracks.order])
    assert (tracks.n_views, tracks.n_points, len(tracks)) == (3, 8, 24)
    assert "3 views, 8 points, 24 observations" in repr(tracks)


def test_arrays_are_read_only_and_the_input_is_not_touched() -> None:
    data = rows()
    before = {name: values.copy() for name, values in data.items()}
    tracks = eg.Tracks(**data)
    for name in ("view", "point", "xy", "weights", "order"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(tracks, name)[0] = 1
    for name, values in data.items():
        np.testing.assert_array_equal(values, before[name])
        values[:] = 0  # the caller's arrays stay the caller's
    assert tracks.xy.any()


@pytest.mark.parametrize("kind", [list, np.int32, np.uint8])
def test_any_integers_and_lists_are_taken(kind: Any) -> None:
    data = rows()
    convert = list if kind is list else lambda a: a.astype(kind)
    xy = data["xy"].astype(np.float32)
    tracks = eg.Tracks(convert(data["view"]), convert(data["point"]), xy.tolist())
    assert tracks.view.dtype == np.intp
    np.testing.assert_array_equal(tracks.xy, xy[tracks.order])
    assert tracks.xy.dtype == np.float64


def test_duplicate_observation_names_both_rows() -> None:
    data = rows()
    doubled = {name: np.concatenate([values, values[5:6]]) for name, values in data.items()}
    message = refusal(**doubled)
    assert "rows 5 and 24" in message
    assert f"view {data['view'][5]}, point {data['point'][5]} twice" in message


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_coordinates_that_are_not_finite_name_the_row(bad: float) -> None:
    data = rows()
    data["xy"][7, 1] = bad
    assert "xy is not finite in row 7" in refusal(**data)


@pytest.mark.parametrize("name", ["view", "point"])
class TestIndices:
    def test_negative_names_the_row(self, name: str) -> None:
        data = rows()
        data[name][4] = -2
        assert f"{name} is -2 in row 4" in refusal(**data)

    def test_out_of_range_names_the_row(self, name: str) -> None:
        data = rows()
        row = int(np.argmax(data[name]))
        message = refusal(**data, **{f"n_{name}s": int(data[name].max())})
        assert f"{name} is {data[name].max()} in row {row}" in message

    def test_gap_names_the_missing_index(self, name: str) -> None:
        data = rows()
        data[name][data[name] > 0] += 1
        message = refusal(**data)
        assert f"{name} never is 1" in message
        assert "pruned" in message

    def test_an_unused_index_at_the_end_is_a_gap_too(self, name: str) -> None:
        data = rows()
        count = int(data[name].max()) + 1
        assert f"{name} never is {count}" in refusal(**data, **{f"n_{name}s": count + 1})

    def test_float_indices_are_refused(self, name: str) -> None:
        data = rows()
        data[name] = data[name].astype(float)
        assert f"{name} is float64 (24,)" in refusal(**data)

    def test_wrong_shape_is_refused(self, name: str) -> None:
        data = rows()
        data[name] = data[name][:, None]
        assert f"{name} is int64 (24, 1)" in refusal(**data)


@pytest.mark.parametrize("xy", [np.zeros((24, 3)), np.zeros((23, 2)), np.zeros(48)])
def test_wrong_shape_of_pixels_is_refused(xy: np.ndarray) -> None:
    data = rows()
    data["xy"] = xy
    assert "needed: real numbers, (24, 2)" in refusal(**data)


@pytest.mark.parametrize("kind", [complex, bool, str])
def test_pixels_must_be_real_numbers(kind: type) -> None:
    data = rows()
    data["xy"] = data["xy"].astype(kind)
    assert "needed: real numbers" in refusal(**data)


def test_unequal_lengths_are_refused() -> None:
    data = rows()
    data["point"] = data["point"][:-1]
    assert "point has 23 rows; needed: 24" in refusal(**data)


def test_no_observation_is_refused() -> None:
    empty = np.zeros(0, int)
    assert "view is empty" in refusal(view=empty, point=empty, xy=np.zeros((0, 2)))


def test_a_point_seen_once_is_named() -> None:
    data = rows()
    data = dropped(data, (data["point"] != 5) | (data["view"] == 1))
    message = refusal(**data)
    assert message.startswith("point 5 has fewer than 2 observations (1)")
    assert "pruned" in message


def test_a_view_of_five_points_is_named() -> None:
    data = rows()
    data = dropped(data, (data["view"] != 2) | (data["point"] < 5))
    assert refusal(**data).startswith("view 2 has fewer than 6 observations (5)")


def test_tracks_in_two_parts_name_views_of_the_second() -> None:
    data = rows(4, 16)
    # views 0, 2 see points below 8, views 1, 3 the others
    data = dropped(data, (data["view"] % 2 == 0) == (data["point"] < 8))
    message = refusal(**data)
    assert "2 parts" in message
    assert "views [1, 3]" in message


def test_a_chain_of_views_is_one_part() -> None:
    view = np.repeat(np.arange(9), 12)
    point = (6 * view.reshape(9, 12) + np.arange(12)).ravel()
    inner = (point >= 6) & (point < 54)
    view, point = view[inner], point[inner] - 6
    assert eg.Tracks(view, point, np.ones((len(view), 2))).n_views == 9


@pytest.mark.parametrize(
    "weights", [np.ones(23), -np.ones(24), np.full(24, np.nan), np.zeros(24), np.ones((24, 1))]
)
def test_bad_weights_are_refused(weights: np.ndarray) -> None:
    assert "weights" in refusal(**rows(), weights=weights)


class TestPruned:
    def test_drops_what_is_too_weak_and_renumbers(self) -> None:
        data = rows(4, 12)
        # Point 3 seen once; view 2 with five points, so that point 11, in views 2 and 3, falls too.
        keep = (data["point"] != 3) | (data["view"] == 0)
        keep &= (data["view"] != 2) | (data["point"] > 7) | (data["point"] == 7)
        keep &= (data["point"] != 11) | (data["view"] > 1)
        data = dropped(data, keep)
        weights = np.arange(1.0, len(data["view"]) + 1)
        tracks, views, points = eg.Tracks.pruned(**data, weights=weights)
        assert views.tolist() == [0, 1, 3]
        assert points.tolist() == [0, 1, 2, 4, 5, 6, 7, 8, 9, 10]
        for k in range(len(tracks)):
            same = (data["view"] == views[tracks.view[k]]) & (
                data["point"] == points[tracks.point[k]]
            )
            assert same.sum() == 1
            np.testing.assert_array_equal(tracks.xy[k], data["xy"][same][0])
            assert tracks.weights[k] == weights[same][0]

    def test_leaves_good_tracks_alone(self) -> None:
        data = rows()
        tracks, views, points = eg.Tracks.pruned(**data)
        assert (len(tracks), len(views), len(points)) == (24, 3, 8)
        np.testing.assert_array_equal(tracks.xy, eg.Tracks(**data).xy)

    def test_nothing_left_is_refused(self) -> None:
        data = rows(3, 5)
        with pytest.raises(ArgumentError, match="empty"):
            eg.Tracks.pruned(**data)


class TestReconstruction:
    P, Q = np.ones((2, 3, 4)), np.ones((5, 4))

    def test_lists_and_integers_become_float64(self) -> None:
        found = eg.Reconstruction([np.eye(3, 4, dtype=int).tolist()] * 2, self.Q.astype(int))  # type: ignore[arg-type]
        assert found.P.dtype == found.Q.dtype == np.float64
        assert found.P.shape == (2, 3, 4)

    @pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
    def test_zero_and_not_finite_rows_are_named(self, bad: float) -> None:
        P, Q = self.P.copy(), self.Q.copy()
        P[1], Q[3] = bad, bad
        with pytest.raises(ArgumentError, match=r"P .* row 1"):
            eg.Reconstruction(P, self.Q)
        with pytest.raises(ArgumentError, match=r"Q .* row 3"):
            eg.Reconstruction(self.P, Q)

    @pytest.mark.parametrize(
        ("P", "Q"),
        [
            (np.ones((3, 4)), Q),
            (np.ones((2, 4, 3)), Q),
            (P, np.ones((5, 3))),
            (P, np.ones(4)),
            (P.astype(complex), Q),
        ],
    )
    def test_wrong_shapes_and_types_are_refused(self, P: np.ndarray, Q: np.ndarray) -> None:
        with pytest.raises(ArgumentError, match="needed: real numbers"):
            eg.Reconstruction(P, Q)

    def test_projection_and_rms(self) -> None:
        tracks = eg.Tracks(**rows())
        rng = np.random.default_rng(1)
        found = eg.Reconstruction(rng.standard_normal((3, 3, 4)), rng.standard_normal((8, 4)))
        expected = []
        for i, j in zip(tracks.view, tracks.point, strict=True):
            h = found.P[i] @ found.Q[j]
            expected.append(h[:2] / h[2])
        np.testing.assert_allclose(found.project(tracks), expected, rtol=1e-12)
        squares = np.sum((tracks.xy - expected) ** 2)
        assert found.rms_px(tracks) == pytest.approx(np.sqrt(squares / 48), rel=1e-12)


def _twice_seen() -> dict[str, object]:
    rng = np.random.default_rng(8)
    view, point = np.divmod(np.arange(40), 20)
    again = rng.choice(40, 9)
    weights = rng.uniform(0.0, 2.0, 49)
    weights[[again[0], 40]] = 0.0
    rows = np.concatenate([np.arange(40), again])
    return {
        "view": view[rows],
        "point": point[rows],
        "xy": rng.normal(size=(49, 2)),
        "weights": weights,
    }


def test_merged_tracks_cost_the_same_up_to_a_constant_whatever_is_predicted() -> None:
    tracks = eg.Tracks(**_twice_seen(), repeated=True, names=["a", "b"])
    merged, constant = tracks.merged()
    assert (tracks.n_repeated, len(merged), merged.n_repeated, merged.names) == (
        *(9, 40, 0),
        ("a", "b"),
    )
    for seed in range(3):
        prediction = np.random.default_rng(seed).normal(size=(2, 20, 2))
        costs = [
            0.5 * t.weights @ np.sum((t.xy - prediction[t.view, t.point]) ** 2, axis=1)
            for t in (tracks, merged)
        ]
        assert costs[0] == pytest.approx(costs[1] + constant, rel=1e-13)


@pytest.mark.parametrize("metric", [False, True])
def test_adjusting_second_sightings_is_least_squares_of_all_observations(metric: bool) -> None:
    tracks, scene = metric_scene("SIMPLE_RADIAL", 4, noise_px=0.5, n_points=40)
    rows = np.concatenate([np.arange(len(tracks)), [3, 3, 9, 30]])
    xy = tracks.xy[rows] + np.random.default_rng(5).normal(0.0, 0.5, (len(rows), 2))
    tracks = eg.Tracks(tracks.view[rows], tracks.point[rows], xy, repeated=True)
    start = scene if metric else scene.to_projective()
    costs: list[float] = []
    options = {"ftol": 1e-14, "callback": lambda row: costs.append(row.cost)}
    result = eg.bundle_adjust(tracks, start, **options)
    assert (len(result.fun), len(result.rejected)) == (len(rows), len(rows))
    assert costs == [row.cost for row in result.history]
    assert min(costs) == pytest.approx(result.cost, rel=1e-12)
    assert result.cost == pytest.approx(0.5 * np.sum(result.fun**2), rel=1e-12)
    # Stationary by its points: J^T r of each vanishes, with every observation counted.
    found = result.reconstruction
    step = 1e-6
    for axis in range(3):
        if metric:
            moved = found.X.copy()
            moved[:, axis] += step
            near = eg.MetricReconstruction(found.R, found.t, moved, found.cameras)
        else:
            moved = found.Q.copy()
            moved[:, axis] += step
            near = eg.Reconstruction(found.P, moved)
        slope = (near.project(tracks) - found.project(tracks)) / step
        along = np.bincount(tracks.point, np.sum(slope * result.fun, axis=1))
        size = np.sqrt(np.bincount(tracks.point, np.sum(slope**2, axis=1)))
        assert (np.abs(along) < 1e-3 * size).all()
    with pytest.raises(eg.ArgumentError, match="robust"):
        eg.bundle_adjust(tracks, start, loss="huber")


def test_a_second_sighting_is_no_second_view() -> None:
    given = _twice_seen()
    with pytest.raises(eg.ArgumentError, match="twice"):
        eg.Tracks(**given)
    lone = {"view": [*given["view"], 0, 0], "point": [*given["point"], 20, 20]}
    with pytest.raises(eg.ArgumentError, match="20 has fewer than 2"):
        eg.Tracks(**lone, xy=np.zeros((51, 2)), repeated=True)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("names", ["a", "a"]),
        ("names", ["a"]),
        ("names", ["a", ""]),
        ("sizes", [[640, 480]]),
        ("sizes", [[640, 0], [1, 1]]),
        ("sizes", np.ones((2, 2))),
        ("colours", np.full((20, 3), 256)),
        ("colours", np.zeros((19, 3), int)),
    ],
)
def test_labels_that_do_not_fit_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(eg.ArgumentError) as refused:
        eg.Tracks(**_twice_seen(), repeated=True, **{name: value})
    assert refused.value.argument == name


# ---------------------------------------------------------------- a point twice in a view


def _with_seconds() -> tuple[eg.Tracks, NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Return tracks, and rows in which a wrong second measurement of five points comes first."""
    tracks = many_views.observed(many_views.cameras_and_points(5, 60))
    rows = np.arange(0, 50, 10)
    view, point = (np.concatenate([a[rows], a]) for a in (tracks.view, tracks.point))
    return tracks, view, point, np.concatenate([tracks.xy[rows] + 80.0, tracks.xy])


@pytest.mark.parametrize("repeated", ["first", "best", "drop"])
def test_repeated_measurements_are_pruned(repeated: str) -> None:
    tracks, view, point, xy = _with_seconds()
    with pytest.raises(ArgumentError, match="twice"):
        eg.Tracks.pruned(view, point, xy)
    found, views, points = eg.Tracks.pruned(view, point, xy, repeated=repeated)
    assert (views.tolist(), len(points)) == (list(range(5)), 60)
    rows = np.arange(0, 50, 10)
    if repeated == "drop":
        np.testing.assert_array_equal(found.xy, np.delete(tracks.xy, rows, axis=0))
    else:
        expected = tracks.xy.copy()
        expected[rows] += 80.0 if repeated == "first" else 0.0
        np.testing.assert_array_equal(found.xy, expected)


def test_pruned_refuses_another_word() -> None:
    _, view, point, xy = _with_seconds()
    with pytest.raises(ArgumentError, match="repeated"):
        eg.Tracks.pruned(view, point, xy, repeated="last")


def test_what_no_reconstruction_shows_is_kept_as_it_comes_first() -> None:
    # The last view is seen twice throughout: without its repetitions there is nothing of it.
    tracks, view, point, xy = _with_seconds()
    again = tracks.view == 4
    view, point = (
        np.concatenate([a, b[again]]) for a, b in ((view, tracks.view), (point, tracks.point))
    )
    xy = np.concatenate([xy, tracks.xy[again] + 40.0])
    found, views, _ = eg.Tracks.pruned(view, point, xy, repeated="best")
    assert views.tolist() == list(range(5))
    first, _, _ = eg.Tracks.pruned(view, point, xy, repeated="first")
    np.testing.assert_array_equal(found.xy[found.view == 4], first.xy[first.view == 4])
    np.testing.assert_array_equal(found.xy[found.view < 4], tracks.xy[tracks.view < 4])


def test_the_image_whose_size_is_refused_is_named() -> None:
    with pytest.raises(ArgumentError, match=r"\[640, 0\] in row 1"):
        eg.Tracks(**_twice_seen(), repeated=True, sizes=[[640, 480], [640, 0]])
