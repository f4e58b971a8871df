"""The gauge of a camera is found from its projection, also of cameras that nobody has tried."""

from __future__ import annotations

import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive.camera_model import POSE, CameraModel, camera_models
from epigauge_derive.gauge import camera_generators, gauge
from epigauge_derive.kernel import cross, select
from epigauge_derive.models.cameras import pinhole, projective


def made_up(image, **parameters):
    """Return a camera that no file states."""
    return CameraModel("MADE_UP", "made up", parameters, image)


def scaled_orthographic(h, k):
    f, cx, cy = k
    return [f * h[0] + cx, f * h[1] + cy]


def skewed(h, k):
    fx, fy, cx, cy, skew = k
    return [(fx * h[0] + skew * h[1]) / h[2] + cx, fy * h[1] / h[2] + cy]


@pytest.mark.parametrize(
    ("model", "dimension"),
    [
        (made_up(scaled_orthographic, f="px", cx="px", cy="px"), 7),
        # With all five parameters free in each view any matrix is a camera: affinities remain.
        (made_up(skewed, fx="px", fy="px", cx="px", cy="px", skew="1"), 12),
        (made_up(lambda h, k: [h[0] / h[2], select(h[1], h[1], 2 * h[1]) / h[2]]), 7),
    ],
    ids=["scaled orthographic", "all of K", "with a branch"],
)
def test_dimension_of_the_gauge_follows_from_the_projection(model, dimension):
    assert len(gauge(model)) == dimension


def test_camera_without_an_image_is_an_error():
    model = made_up(lambda h, k: [sp.sqrt(-(h[0] ** 2)), h[1] / h[2]])
    with pytest.raises(ValueError, match="MADE_UP: points in general position have no image"):
        gauge(model)


def test_similarities_move_a_pose_as_they_should():
    """w = R omega, d = R (omega x c), R b and s R c about the centre c = -R^T t, on rotations."""
    R = sp.Matrix([[2, -1, 2], [2, 2, -1], [-1, 2, 2]]) / 3
    t = sp.Matrix([3, 5, -7])
    symbols = [sp.Symbol(name, real=True) for name in POSE.entries]
    values = dict(zip(symbols, R.row_join(t), strict=True))
    found = camera_generators(pinhole.MODEL)[:6, :].subs(values)
    names = [name for name, _ in gauge(pinhole.MODEL)]
    centre = -R.T * t
    for name, column in zip(names, range(found.cols), strict=True):
        kind, _, axis = name.partition(" ")
        unit = sp.Matrix([int(axis == a) for a in "xyz"])
        w, d = {
            "rotation": (R * unit, R * cross(unit) * centre),
            "translation": (sp.zeros(3, 1), R * unit),
            "scale": (sp.zeros(3, 1), R * centre),
        }[kind]
        # The update turns and moves back what the field has done: exp(-w) and +d.
        assert found[:, column] == (-w).col_join(d), name


def test_projective_generators_are_those_of_b03_eq_5():
    P = sp.Matrix(3, 4, sp.symbols("P0:3(0:4)", real=True))
    found = camera_generators(projective.MODEL)
    fields = gauge(projective.MODEL)
    assert found.shape == (12, 15)
    for column, (_, B) in enumerate(fields):
        assert B.trace() == 0
        assert found[:, column] == sp.Matrix(12, 1, list(-P * B))


def test_update_is_exponential_to_second_order():
    w = sp.symbols("w0:3", real=True)
    delta = [*w, 0, 0, 0]
    half_sine, half_cosine = POSE.even(delta)
    M = POSE.moved(sp.eye(3, 4), delta)[:, :3]
    W = cross(w)
    angle = sp.Symbol("a", positive=True)
    # exp(W) = I + sin(a)/a W + (1 - cos a)/a^2 W^2, by half the angle.
    expected = sp.eye(3) + sp.sin(angle) / angle * W + (1 - sp.cos(angle)) / angle**2 * W * W
    M = M.subs({half_sine: sp.sin(angle / 2) / angle, half_cosine: sp.cos(angle / 2)})
    assert (M - expected).applyfunc(lambda e: sp.simplify(sp.expand_trig(e.expand()))) == sp.zeros(
        3
    )


def test_every_camera_has_a_name_of_its_own():
    models = camera_models()
    names = [name for model in models for name in (model.name, *model.aliases)]
    assert len(set(names)) == len(names)
    assert {"OPENCV", "bal", "brown", "spherical", "affine", "projective"} <= set(names)
