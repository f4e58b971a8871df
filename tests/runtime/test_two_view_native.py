"""The compiled loop and the readable one: the same course, evaluation by evaluation."""

from __future__ import annotations

import epigauge as eg
import pytest
from epigauge import kernels
from epigauge.scenes import two_view_scene
from epigauge.two_view import solve

pytestmark = pytest.mark.skipif(kernels.available()["c"] is not None, reason="needs the C library")


def both(monkeypatch, x1, x2, **options):
    """Return the results of the compiled loop and of the one in Python, on the same kernels."""
    compiled = eg.refine_fundamental(x1, x2, backend="c", callback=None, **options)
    with monkeypatch.context() as patch:
        patch.setattr(solve, "_is_native", lambda *_: False)
        reference = eg.refine_fundamental(
            x1, x2, backend="c", callback=lambda row: False, **options
        )
    return compiled, reference


def assert_same_course(a, b, tolerance=1e-9):
    """Rows agree until the cost stands still, where rounding decides."""
    assert (a.status, a.nfev, a.njev, a.nit) == (b.status, b.nfev, b.njev, b.nit)
    for row, other in zip(a.history, b.history, strict=True):
        assert (row.iteration, row.accepted) == (other.iteration, other.accepted)
        assert row.cost == pytest.approx(other.cost, rel=tolerance)
        assert row.lam == pytest.approx(other.lam, rel=1e-6)
        assert row.step_norm == pytest.approx(other.step_norm, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("parameterization", ["ortho", "block"])
@pytest.mark.parametrize("criterion", ["reprojection", "sampson", "epipolar"])
@pytest.mark.parametrize("damping", ["levenberg", "seber"])
@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
@pytest.mark.parametrize("distance", [6.0, 14.0])
def test_same_course(monkeypatch, parameterization, criterion, damping, hessian, distance):
    scene = two_view_scene(distance, n_points=40, seed=5)
    options = {
        "parameterization": parameterization,
        "criterion": criterion,
        "damping": damping,
        "hessian": hessian,
    }
    assert_same_course(*both(monkeypatch, scene.x1, scene.x2, **options), 1e-6)
