"""The cheap tests of plain pairs say what the whole diagnosis says, or nothing."""

from __future__ import annotations

import epigauge as eg
import numpy as np
import pytest
from epigauge.kernels import available
from epigauge.two_view import diagnostics, native, quick
from epigauge.two_view.planes import share_on_a_plane
from epigauge.two_view.refine import plan_of
from two_views import Array, scene

needs_c = pytest.mark.skipif(available()["c"] is not None, reason="needs the C library")


def quickly(
    x1: Array, x2: Array, weights: Array | None = None
) -> tuple[tuple[str, ...] | None, bool]:
    """The verdict of the cheap tests alone."""
    offsets = np.array([0, len(x1)], np.intp)
    options = plan_of({}).native
    assert options is not None
    pair = native.refine_pairs(x1, x2, offsets, None, weights, options)
    return quick.verdicts_of(pair, x1, x2, offsets, weights)[0]


def kinds() -> list[tuple[str, Array, Array]]:
    """Pairs of all kinds: healthy, weak, planar, turned, still, half wrong, random."""
    rng = np.random.default_rng(11)
    found = []
    for m, noise in ((20, 0.3), (60, 1.0), (400, 0.5)):
        found += [(kind, *scene(kind, m, noise, rng)) for kind in ("general", "planar", "rotation")]
        x1, x2 = scene("general", m, noise, rng)
        found.append(("still", x1, x1 + noise * rng.standard_normal(x1.shape)))
        wrong = rng.permutation(m)[: m // 3]
        x2 = x2.copy()
        x2[wrong] = rng.uniform([0.0, 0.0], [1024.0, 768.0], (len(wrong), 2))
        found.append(("wrong", x1, x2))
        found.append(("random", *rng.uniform([0.0, 0.0], [1024.0, 768.0], (2, m, 2))))
    for distance in (4.0, 8.0, 10.0, 16.0):
        view = eg.two_view_scene(distance, seed=5)
        found.append(("weak", view.x1, view.x2))
    return found


@needs_c
@pytest.mark.parametrize("case", kinds(), ids=lambda case: f"{case[0]}-{len(case[1])}")
def test_c_numpy_and_the_batch_agree(case) -> None:
    kind, x1, x2 = case
    whole = eg.refine_fundamental(x1, x2, backend="numpy")
    flags, success = quickly(x1, x2)
    assert (flags is not None) == (kind in ("general", "weak"))
    if flags is not None:
        assert (flags, success) == (whole.flags, whole.success)
    single = eg.refine_fundamental(x1, x2)
    batch = eg.refine_fundamental_batch(x1, x2, [0, len(x1)])
    assert single.flags == batch.flags[0] == whole.flags
    assert single.success == batch.success[0] == whole.success


@needs_c
def test_matches_of_weight_zero_do_not_count() -> None:
    x1, x2 = scene("general", 80, 0.5, np.random.default_rng(2))
    w = np.ones(80)
    w[::4] = 0.0
    x2[::4] += 300.0
    assert quickly(x1, x2, w) == quickly(x1[w > 0].copy(), x2[w > 0].copy()) == ((), True)


@needs_c
@pytest.mark.parametrize("distance", [6.0, 10.0])
def test_gross_errors_are_left_to_the_diagnosis(distance: float) -> None:
    for seed in (0, 2):
        rng = np.random.default_rng(seed)
        x1, x2 = scene("general", 60, 0.5, rng)
        x2 = x2.copy()
        x2[:2] += distance * rng.choice([-1.0, 1.0], (2, 2))
        assert "gross errors" in eg.refine_fundamental(x1, x2, backend="numpy").flags
        assert quickly(x1, x2)[0] is None


@needs_c
@pytest.mark.parametrize("share", [0.3, 0.6, 0.8])
def test_c_counts_on_the_plane_what_numpy_counts(share: float, monkeypatch) -> None:
    rng = np.random.default_rng(5)
    m, on = 100, round(100 * share)
    X = np.column_stack([rng.uniform(-2.0, 2.0, (m, 2)), rng.uniform(4.0, 8.0, m)])
    X[:on, 2] = 6.0 + 0.3 * X[:on, 0] - 0.2 * X[:on, 1]
    Y = X + np.array([0.8, 0.1, 0.2])
    x1, x2 = (
        500.0 + 900.0 * Z[:, :2] / Z[:, 2:] + 0.3 * rng.standard_normal((m, 2)) for Z in (X, Y)
    )
    counted: list[float] = []
    own_flags, own_doubt = quick.flags, diagnostics.is_suspicious

    def flags(own, scale):
        counted.append(own.on_plane)
        return own_flags(own, scale)

    def is_suspicious(found):
        counted.append(share_on_a_plane(found))
        return own_doubt(found)

    monkeypatch.setattr(quick, "flags", flags)
    monkeypatch.setattr(diagnostics, "is_suspicious", is_suspicious)
    quickly(x1, x2)
    _ = eg.refine_fundamental(x1, x2, backend="numpy").flags
    assert counted[0] == pytest.approx(counted[1], abs=1e-12)
    assert share - 0.1 < counted[0] < share + 0.25


@needs_c
def test_points_that_many_are_matched_to_count_once() -> None:
    view = eg.two_view_scene(16.0, seed=3)
    x1, x2 = view.x1.copy(), view.x2.copy()
    assert quickly(x1, x2)[0] is not None
    x2[10:] = x2[10]  # every line through this point agrees
    assert quickly(x1, x2)[0] is None


def raw_kinds() -> list[tuple[str, Array, Array]]:
    """Raw matches of all kinds, a third of them wrong."""
    rng, found = np.random.default_rng(7), []
    for m, noise in ((40, 0.5), (150, 0.4), (600, 0.8)):
        for kind in ("general", "planar", "rotation", "random"):
            x1, x2 = scene("general" if kind == "random" else kind, m, noise, rng)
            share = 1.0 if kind == "random" else 0.3
            bad = rng.random(m) < share
            x2 = x2.copy()
            x2[bad] = rng.uniform([0.0, 0.0], [1024.0, 768.0], (np.count_nonzero(bad), 2))
            found.append((kind, x1, x2))
    view = eg.two_view_scene(16.0, n_points=300, seed=5)
    found.append(("weak", view.x1, view.x2))
    x1, x2 = scene("general", 300, 0.4, rng)
    x2 = x2.copy()
    x2[:60] = x2[0]  # one point that many are matched to
    found.append(("many to one", x1, x2))
    return found


@needs_c
@pytest.mark.parametrize("case", raw_kinds(), ids=lambda case: f"{case[0]}-{len(case[1])}")
def test_raw_matches_are_told_by_cheap_tests_what_the_diagnosis_says(case, monkeypatch) -> None:
    kind, x1, x2 = case
    told = []
    whole = quick.verdict_of_raw

    def asked(*arguments):
        told.append(whole(*arguments))
        return told[-1]

    monkeypatch.setattr(quick, "verdict_of_raw", asked)
    found = eg.estimate_fundamental(x1, x2)
    own = found.flags, found.success
    monkeypatch.setattr(quick, "verdict_of_raw", lambda *_: (None, False))
    thorough = eg.estimate_fundamental(x1, x2)
    assert own == (thorough.flags, thorough.success)
    assert len(told) == 1
    assert (told[0][0] is not None) == (kind not in ("random", "weak"))


@needs_c
def test_weights_of_raw_matches_reach_the_cheap_tests() -> None:
    x1, x2 = scene("general", 300, 0.5, np.random.default_rng(3))
    w = np.ones(300)
    w[::3] = 0.0
    flags = eg.estimate_fundamental(x1, x2, weights=w).flags
    assert flags == eg.estimate_fundamental(x1, x2, weights=w, backend="numpy").flags == ()
