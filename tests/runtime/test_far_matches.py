"""A wrong match far outside of the images changes nothing: it is none of them."""

from __future__ import annotations

from typing import Any

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from epigauge.multi_view.agreement import agreed_fundamental
from epigauge.two_view.conditioning import condition, condition_raw
from epigauge.two_view.diagnostics import _is_affine
from two_views import same_geometry, up_to_sign

_SCENE = eg.two_view_scene(n_points=60, seed=4)
_AWAY = [1e4, 1e6, 1e9]

#: In NumPy a search takes seconds.
_NEEDS_C = pytest.mark.skipif(kernels.available()["c"] is not None, reason="needs the C library")


def _slow(value: Any) -> Any:
    return pytest.param(value, marks=_NEEDS_C)


def _raw(away: float = 0.0) -> tuple[Any, Any]:
    """Return matches with a quarter of wrong ones, and three that are so far away."""
    rng = np.random.default_rng(1)
    x1, x2 = _SCENE.x1.copy(), _SCENE.x2.copy()
    x2[:15] = x2[rng.permutation(60)[:15]]
    if not away:
        return x1, x2
    rows = away * np.array([[1.0, 0.3], [-0.2, -1.0], [-1.0, 1.0]])
    return np.vstack([x1, x1[:3] + 1.0]), np.vstack([x2, rows])


def _pixels(H: Any, x: Any) -> Any:
    h = np.column_stack([x, np.ones(len(x))]) @ H.T
    return h[:, :2] / h[:, 2:]


@pytest.mark.parametrize("away", _AWAY)
def test_homography_does_not_see_them(away: float) -> None:
    H = np.array([[1.0, 0.1, 20.0], [-0.1, 1.0, 5.0], [1e-4, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    x1 = rng.uniform(0.0, 1000.0, (40, 2))
    x2 = _pixels(H, x1) + 0.5 * rng.standard_normal((40, 2))
    x2[:10] = rng.uniform(0.0, 1000.0, (10, 2))
    plain = eg.estimate_homography(x1, x2)
    y1, y2 = np.vstack([x1, x1[:1] + 1.0]), np.vstack([x2, [[away, away]]])
    for a, b in ((y1, y2), (y2, y1)):
        result = eg.estimate_homography(a, b)
        assert result.success
        assert not result.inlier[-1]
        found = result.H if a is y1 else np.linalg.inv(result.H)
        assert np.allclose(_pixels(found, x1[10:]), _pixels(plain.H, x1[10:]), atol=0.05)


@pytest.mark.study
@pytest.mark.parametrize(
    "estimate",
    [
        lambda x1, x2: eg.estimate_fundamental(x1, x2),
        _slow(lambda x1, x2: eg.estimate_essential(x1, x2, _SCENE.K, _SCENE.K)),
        _slow(lambda x1, x2: eg.estimate_two_view(x1, x2).fit),
    ],
)
@pytest.mark.parametrize("swapped", [False, _slow(True)])
def test_no_search_sees_them(estimate: Any, swapped: bool) -> None:
    x1, x2 = _raw(1e9)[::-1] if swapped else _raw(3e4)
    result = estimate(x1, x2)
    F = result.F.T if swapped else result.F
    assert result.success
    assert not result.inlier[-3:].any()
    true = eg.sampson_distances(F, _SCENE.x1_true, _SCENE.x2_true)
    assert np.sqrt(np.mean(true**2)) < 1.0


@_NEEDS_C
def test_batch_and_tracks_do_not_see_them() -> None:
    x1, x2 = _raw(1e7)
    batch = eg.estimate_fundamental_batch(x1, x2, [0, len(x1)])
    assert batch.success[0]
    single = eg.estimate_fundamental(x1, x2)
    assert up_to_sign(batch.F[0], single.F) == 0.0
    _, agrees = agreed_fundamental(kernels.table(), x1, x2)
    assert not agrees[-3:].any()
    assert agrees[15:60].all()


@_NEEDS_C
def test_one_that_agrees_by_accident_is_no_inlier() -> None:
    """Somewhere on each epipolar line is a place a million pixels off."""
    x1, x2 = _raw()
    F = eg.estimate_fundamental(x1, x2).F
    a, b, c = F @ [*x1[20], 1.0]
    along = 1e6 * np.array([[b, -a], [-b, a]]) / np.hypot(a, b)
    on_line = np.array([-a * c, -b * c]) / (a * a + b * b) + along
    result = eg.estimate_fundamental(np.vstack([x1, x1[[20, 20]]]), np.vstack([x2, on_line]))
    assert result.success
    assert not result.inlier[-2:].any()
    assert same_geometry(result.F, F, _SCENE.x1_true, _SCENE.x2_true) < 1e-3


def test_matches_of_images_keep_their_frame() -> None:
    x1, x2 = _raw()
    frame, is_near = condition_raw(x1, x2, 8)
    assert is_near.all()
    assert frame.scale == condition(x1, x2).scale


@pytest.mark.parametrize("few", [5, 7, 8])
def test_too_few_that_are_near_are_not_left(few: int) -> None:
    x1, x2 = _raw(1e6)
    _, is_near = condition_raw(x1[-few:], x2[-few:], few)
    assert is_near.all()


def test_no_match_is_no_affine_scene() -> None:
    evidence = eg.refine_fundamental(_SCENE.x1, _SCENE.x2)._evidence
    assert not _is_affine(evidence, np.zeros(60, np.bool_))
