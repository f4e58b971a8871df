"""Measured image pairs: the default call reaches the published optimum, whatever the form."""

from __future__ import annotations

from pathlib import Path

import epigauge as eg
import numpy as np
import pytest
from epigauge import kernels
from two_views import inliers, published_rms, same_geometry

#: Reaches the minimum to rounding, whichever rule ends it.
EXACT = {"ftol": 1e-14, "max_iter": 300}


def test_table_of_optima_covers_the_pairs(data_dir) -> None:
    published = published_rms(data_dir / "pairs" / "README.md")
    assert set(published) == {path.stem for path in (data_dir / "pairs").glob("*.npz")}
    assert len(published) == 24
    assert all(0.05 < rms < 0.5 for rms in published.values())  # pixels


def test_default_call_reaches_the_published_optimum(pair: Path) -> None:
    published = published_rms(pair.parent / "README.md")[pair.stem]
    result = eg.refine_fundamental(*inliers(pair))
    assert result.success, result.message
    assert result.rms_px <= 1.002 * published
    # Nor can it be lower than the optimum of an independent program, which has five digits.
    assert result.rms_px >= 0.998 * published
    assert result.nfev <= 20
    assert result.rank == 7
    assert np.isfinite(result.covariance).all()


def test_joint_and_eliminated_structure_agree(pair: Path) -> None:
    x1, x2 = inliers(pair)
    eliminated = eg.refine_fundamental(x1, x2)
    joint = eg.refine_fundamental(x1, x2, structure="joint", max_iter=300)
    assert joint.success
    assert joint.cost == pytest.approx(eliminated.cost, rel=1e-8)


@pytest.mark.parametrize("damping", ["levenberg", "seber"])
@pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
def test_every_hessian_and_damping_reaches_the_same_minimum(pair: Path, hessian, damping) -> None:
    x1, x2 = inliers(pair)
    best = eg.refine_fundamental(x1, x2, **EXACT)
    result = eg.refine_fundamental(x1, x2, hessian=hessian, damping=damping, **EXACT)
    assert result.success
    assert result.cost == pytest.approx(best.cost, rel=1e-11)
    assert same_geometry(result.F, best.F, x1, x2) < 1e-5


@pytest.mark.parametrize("backend", kernels.NAMES)
def test_backends_agree(pair: Path, backend) -> None:
    reason = kernels.available()[backend]
    if reason is not None:
        pytest.skip(f"backend {backend} {reason}")
    x1, x2 = inliers(pair)
    reference = eg.refine_fundamental(x1, x2, backend="numpy")
    result = eg.refine_fundamental(x1, x2, backend=backend)
    assert result.status == reference.status
    # The formulas agree to rounding and so do the iterates; the cost is a sum of up to 1464
    # squares whose order may differ.
    assert result.cost == pytest.approx(reference.cost, rel=1e-11)
    assert same_geometry(result.F, reference.F, x1, x2) < 1e-8


@pytest.mark.parametrize("factor", [-3.0, 1e6])
def test_any_scale_of_the_given_start_is_the_same_start(pair: Path, factor) -> None:
    x1, x2 = inliers(pair)
    with np.load(pair) as data:
        F0 = data["F_ransac"]
    plain = eg.refine_fundamental(x1, x2, F0)
    scaled = eg.refine_fundamental(x1, x2, factor * F0)
    assert scaled.nfev == plain.nfev
    # The same iterates but for the rounding of F0.
    assert scaled.cost == pytest.approx(plain.cost, rel=1e-11)
    assert same_geometry(scaled.F, plain.F, x1, x2) < 1e-7


@pytest.mark.parametrize("structure", ["eliminated", "joint"])
def test_rectified_pair_with_equal_singular_values_converges(data_dir, structure) -> None:
    x1, x2 = inliers(data_dir / "pairs" / "motorcycle_rectified.npz")
    with np.load(data_dir / "pairs" / "motorcycle_rectified.npz") as data:
        F_true = data["F_true"]
    assert eg.canonical_cameras(F_true)[1].shape == (3, 4)
    values = np.linalg.svd(F_true, compute_uv=False)
    assert values[1] / values[0] == pytest.approx(1.0, abs=1e-12)  # the singular case itself
    published = published_rms(data_dir / "pairs" / "README.md")["motorcycle_rectified"]
    for start in (None, F_true):
        result = eg.refine_fundamental(x1, x2, start, structure=structure)
        assert result.success
        assert result.rms_px <= 1.002 * published
        assert np.isfinite(result.covariance).all()
        assert result.rank == 7
