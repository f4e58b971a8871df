"""NumPy = C = CasADi for every kernel; batches are single calls stacked; sums are sums."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from epigauge import arrays, kernels
from epigauge.kernels import SIGNATURES
from epigauge_generated.signatures import MODELS
from laws import distance, factor_cases, fundamental_cases, matches, orthonormal

NUMPY = kernels.table("numpy")
#: Batch shapes; the longest one leaves a rest behind vectors of 2, 4 and 8.
BATCHES = [(), (1,), (3, 1, 2), (0,), (2, 0), (13,)]
#: The kernels that call sin, cos, atan2 or log1p, which each library rounds in its own way.
TRANSCENDENTAL = {
    "rotation",
    "rotate_columns",
    "retract_factors",
    "block_retract",
    "bilinear_frame",
    "loss_cauchy",
    *(f"{model.prefix}_retract" for model in MODELS.values() if model.metric),
}
#: Camera models whose lens is corrected on the measured side.
CORRECTED = tuple(f"{model.prefix}_" for model in MODELS.values() if model.corrects)
SUMMED = {name for name, s in SIGNATURES.items() if not all(a.batched for a in s.outputs)}
#: The kernels that take the matches of one F.
MATCHED = [
    name
    for name, s in SIGNATURES.items()
    if not s.inputs[0].batched and s.inputs[0].name in ("F", "R1")
]
#: F in rotated images.
FRAME = ("R1", "R2", "s", "b1", "b2", "f")


def pool(values, batch, rng):
    """Return a batch whose elements are drawn from a list of arrays of one shape."""
    count = int(np.prod(batch))
    chosen = [values[k] for k in rng.integers(len(values), size=count)]
    own = np.shape(values[0])
    return np.stack(chosen, axis=-1).reshape(own + batch) if count else np.empty(own + batch)


def definite(batch, rng, entries):
    """Return upper triangles, of so many entries, of positive definite matrices."""
    rows = {3: 2, 6: 3, 10: 4}[entries]
    root = rng.standard_normal((*batch, rows, rows + 2))
    upper = (root @ root.swapaxes(-1, -2))[..., *np.triu_indices(rows)]
    return np.moveaxis(upper, -1, 0)


def inputs(name, batch, seed, F=None):
    """Return arguments of a kernel, in general position and near the hard places.

    Matrices are drawn from the cases of `laws`; F, where given, is the one of all matches. What
    has no special meaning here is a batch of normal random numbers.
    """
    rng = np.random.default_rng(seed)
    signature = SIGNATURES[name]
    count = int(np.prod(batch))
    each = any(argument.name == "R1" and argument.batched for argument in signature.inputs)
    lam_each = any(argument.name == "lam" and argument.batched for argument in signature.inputs)
    if F is None:
        cases = list(fundamental_cases(seed).values())
        F = pool(cases, batch, rng) if each else cases[seed % len(cases)]
    frame = dict(zip(FRAME, NUMPY.bilinear_frame(F), strict=True))
    q1, q2 = (2.0 * q for q in matches(rng, F if F.ndim == 2 else np.eye(3), count, 0.1))
    if count > 2:
        q2[:, 1] += 30.0  # an outlier
    q1, q2 = q1.reshape(2, *batch), q2.reshape(2, *batch)
    foot_point = NUMPY.foot_point_safe_each if each else NUMPY.foot_point_safe
    factors = list(factor_cases(seed).values())
    shapes = {argument.name: argument.shape for argument in signature.inputs}
    special = {
        "U": lambda: pool([U for U, _, _ in factors], batch, rng),
        "V": lambda: pool([V for _, V, _ in factors], batch, rng),
        "sigma": lambda: pool([sigma for _, _, sigma in factors], batch, rng),
        "M": lambda: pool([orthonormal(rng)[:2, :2] for _ in range(5)], batch, rng),
        "theta": lambda: rng.uniform(-4.0, 4.0, (3, *batch)),
        "delta": lambda: rng.uniform(-4.0, 4.0, (*shapes["delta"], *batch)),
        "F": lambda: pool(list(fundamental_cases(seed).values()), batch, rng),
        "q1": lambda: q1,
        "q2": lambda: q2,
        "l": lambda: foot_point(*frame.values(), q1, q2)[0],
        "weight": lambda: rng.uniform(0.0, 2.0, batch),
        "squared": lambda: rng.uniform(0.0, 3.0, batch),
        "scale2": lambda: 0.7,
        "eta": lambda: 0.3,
        "damping": lambda: np.array([0.3, 0.2, 0.5, 0.4]),
        "N": lambda: definite(batch, rng, shapes["N"][0]),
        "W": lambda: definite(batch, rng, shapes["W"][0]),
        **{side: lambda: definite(batch, rng, 3) for side in ("S1", "S2")},
        "spread": lambda: np.concatenate([definite(batch, rng, 3) for _ in range(2)]),
        "lam": lambda: rng.uniform(0.0, 1.0, batch if lam_each else ()),
    }
    wanted = set(shapes)
    if wanted >= set(FRAME):
        special |= {key: (lambda value=value: value) for key, value in frame.items()}
    elif "q1" in wanted:
        special["F"] = lambda: F
    elif name == "two_view_focals":  # the cases of F have axes in one plane: 0 / 0
        del special["F"]
    if name.startswith(CORRECTED):  # Newton's steps to a measured point: of a lens that has one
        special["intrinsics"] = lambda: 0.01 * rng.standard_normal((*shapes["intrinsics"], *batch))
        size = shapes.get("camera", (0,))[0] - 12
        special["camera"] = lambda: np.concatenate(
            [rng.standard_normal((12, *batch)), 0.01 * rng.standard_normal((size, *batch))]
        )
    arguments = []
    for argument in signature.inputs:
        shape = argument.shape + (batch if argument.batched else ())
        value = special.get(argument.name, lambda shape=shape: rng.standard_normal(shape))()
        assert np.shape(value) == shape, argument.name
        arguments.append(value)
    return arguments


def as_tuple(result):
    return result if isinstance(result, tuple) else (result,)


def legal(name, batch):
    return len(batch) == 1 if name in SUMMED else True


def compare(name, other, arguments, tolerance):
    """Compare a back end with NumPy; at tolerance zero to the last bit, NaN included."""
    # A match on both epipoles is 0 / 0 in the approximate criteria.
    with np.errstate(all="ignore"):
        expected = as_tuple(getattr(NUMPY, name)(*arguments))
        actual = as_tuple(getattr(other, name)(*arguments))
    for argument, a, e in zip(SIGNATURES[name].outputs, actual, expected, strict=True):
        if argument.name == "last_change":  # rounding of the multiplier, when it has converged
            a, e = a + actual[0], e + expected[0]
        if tolerance:
            assert distance(a, e) <= tolerance, (argument.name, distance(a, e))
        else:
            np.testing.assert_array_equal(a, e, err_msg=argument.name, strict=True)


def backend(name):
    reason = kernels.available()[name]
    if reason:
        pytest.skip(f"back end {name} {reason}")
    return kernels.table(name)


@pytest.mark.parametrize("name", SIGNATURES)
def test_c_is_numpy(name):
    # Arithmetic and square roots round alike, to the last bit. Sums over observations are
    # associated differently; sine, cosine and arctangent may differ in the last bits.
    tolerance = 1e-13 if name in SUMMED else 1e-14 if name in TRANSCENDENTAL else 0.0
    for seed, batch in enumerate(BATCHES):
        if legal(name, batch):
            compare(name, backend("c"), inputs(name, batch, seed), tolerance)


@pytest.mark.parametrize("name", SIGNATURES)
def test_casadi_is_numpy(name):
    # CasADi rewrites expressions (x*x as a square, sums in another order), so that each value is
    # rounded differently; up to a thousand operations, and cancellation, leave 1e-12; the condition
    # of seven random matches costs some more.
    tolerance = 1e-9 if name == "seven_points" else 1e-12
    for seed, batch in enumerate(BATCHES):
        if legal(name, batch):
            compare(name, backend("casadi"), inputs(name, batch, seed), tolerance)


@pytest.mark.parametrize("name", SIGNATURES)
def test_the_functions_over_array_namespaces_are_numpy(name):
    # The same expressions in the same order: the same bits, but for the order of a sum.
    namespace = pytest.importorskip("array_api_compat.numpy", reason="needs array-api-compat")
    over = arrays.table(namespace)
    tolerance = 1e-14 if name in SUMMED else 0.0
    for seed, batch in enumerate(BATCHES[:4]):
        if legal(name, batch):
            with warnings.catch_warnings():  # scalars divide by zero with a warning of their own
                warnings.simplefilter("ignore", RuntimeWarning)
                compare(name, over, inputs(name, batch, seed), tolerance)


@pytest.mark.parametrize("case", fundamental_cases())
@pytest.mark.parametrize("name", MATCHED)
def test_backends_agree_on_the_matches_of_every_f(name, case):
    F = fundamental_cases()[case]
    arguments = inputs(name, (21,), 5, F)
    for other, tolerance in (("c", 1e-13 if name in SUMMED else 0.0), ("casadi", 1e-11)):
        if kernels.available()[other] is None:
            compare(name, kernels.table(other), arguments, tolerance)


@pytest.mark.parametrize("name", MATCHED)
def test_c_is_numpy_over_many_chunks(name):
    # C keeps intermediate results of at most 256 matches between the loops of a kernel.
    compare(name, backend("c"), inputs(name, (600,), 12), 1e-13 if name in SUMMED else 0.0)


@pytest.mark.parametrize("name", sorted(set(SIGNATURES) - SUMMED))
def test_a_batch_is_its_elements_stacked(table, name):
    batch = (3, 1, 2)
    arguments = inputs(name, batch, 3)
    together = as_tuple(getattr(table, name)(*arguments))
    for index in np.ndindex(batch):
        one = [
            value[(..., *index)] if argument.batched else value
            for argument, value in zip(SIGNATURES[name].inputs, arguments, strict=True)
        ]
        for a, e in zip(as_tuple(getattr(table, name)(*one)), together, strict=True):
            # The vector versions of sine and cosine may round differently from the scalar ones.
            tolerance = 1e-14 if name in TRANSCENDENTAL else 0.0
            assert distance(a, e[(..., *index)]) <= tolerance


@pytest.mark.parametrize("name", sorted(set(SIGNATURES) - SUMMED))
def test_batch_axes_broadcast(table, name):
    thin, whole = [], []
    arguments = zip(SIGNATURES[name].inputs, inputs(name, (2, 3), 4), strict=True)
    for k, (argument, value) in enumerate(arguments):
        if argument.batched:
            # In turn: all axes, an axis of length one, an axis less.
            stretched = value if k % 3 == 0 else value[..., :1, :]
            thin.append(value[..., 0, :] if k % 3 == 2 else stretched)
            whole.append(np.broadcast_to(stretched, value.shape))
        else:
            thin.append(value)
            whole.append(value)
    expected = as_tuple(getattr(table, name)(*whole))
    for a, e in zip(as_tuple(getattr(table, name)(*thin)), expected, strict=True):
        if a.shape != e.shape:  # no argument has all axes
            a = np.broadcast_to(a, e.shape)
        # Sine and cosine of one number may round differently in and behind a vector.
        assert distance(a, e) <= 1e-14


@pytest.mark.parametrize("name", [name for name in SIGNATURES if name.endswith("_each")])
def test_kernel_of_one_f_each_is_the_shared_kernel_one_by_one(table, name):
    shared = SIGNATURES[name.removesuffix("_each")]
    arguments = inputs(name, (20,), 11)
    together = as_tuple(getattr(table, name)(*arguments))
    for k in range(20):
        one = [
            value[..., k : k + 1] if argument.batched else value[..., k]
            for argument, value in zip(shared.inputs, arguments, strict=True)
        ]
        alone = as_tuple(getattr(table, name.removesuffix("_each"))(*one))
        for a, e in zip(together, alone, strict=True):
            # The same expressions, but their common parts may be shared differently.
            assert distance(a[..., k : k + 1], e) <= 1e-12


@pytest.mark.parametrize("name", sorted(SUMMED))
def test_a_sum_is_the_sum_of_its_observations(table, name):
    signature = SIGNATURES[name]
    arguments = inputs(name, (7,), 6)
    totals = as_tuple(getattr(table, name)(*arguments))
    singles = [
        as_tuple(
            getattr(table, name)(
                *(
                    value[..., k : k + 1] if argument.batched else value
                    for argument, value in zip(signature.inputs, arguments, strict=True)
                )
            )
        )
        for k in range(7)
    ]
    for argument, total, *parts in zip(signature.outputs, totals, *singles, strict=True):
        # Both add seven numbers, in any order.
        if not argument.batched:
            assert distance(total, np.sum(parts, axis=0)) <= 1e-14


@pytest.mark.parametrize("name", sorted(SUMMED))
def test_a_sum_over_no_observations_is_zero(table, name):
    for argument, total in zip(
        SIGNATURES[name].outputs,
        as_tuple(getattr(table, name)(*inputs(name, (0,), 1))),
        strict=True,
    ):
        assert total.shape == argument.shape
        assert not total.any()


@pytest.mark.parametrize("name", [n for n in sorted(SUMMED) if "weight" in str(SIGNATURES[n])])
def test_weights_act_linearly(table, name):
    names = [argument.name for argument in SIGNATURES[name].inputs]
    arguments = dict(zip(names, inputs(name, (9,), 7), strict=True))
    rng = np.random.default_rng(8)

    def call(**changed):
        return as_tuple(getattr(table, name)(*(arguments | changed).values()))

    mixed = [w for w in ("weight", "curvature") if w in names]
    first, second = ({w: rng.standard_normal(9) for w in mixed} for _ in range(2))
    both = {w: 2.0 * first[w] - 3.0 * second[w] for w in mixed}
    for a, b, c in zip(call(**first), call(**second), call(**both), strict=True):
        # Nine terms that partly cancel.
        assert distance(c, 2.0 * a - 3.0 * b) <= 1e-13
    nothing = call(**{w: np.zeros(9) for w in mixed})
    assert not any(output.any() for output in nothing)


@pytest.mark.parametrize("name", sorted(n for n in SUMMED if "curvature" in str(SIGNATURES[n])))
def test_curvature_adds_to_the_hessian_only_and_a_term_of_rank_one_a_match(table, name):
    *shared, _, _ = inputs(name, (1,), 9)
    one, none = np.ones(1), np.zeros(1)
    *rest, H = getattr(table, name)(*shared, one, none)
    *rest_robust, H_robust = getattr(table, name)(*shared, one, one)
    for value, other in zip(rest, rest_robust, strict=True):
        np.testing.assert_array_equal(value, other)
    term = np.zeros((9, 9))
    term[np.triu_indices(9)] = H_robust - H
    term += np.triu(term, 1).T
    values = np.linalg.eigvalsh(term)
    assert values[-1] > 0.0
    # Rounding of the difference of two Hessians.
    assert np.abs(values[:-1]).max() <= 1e-12 * max(values[-1], np.abs(H).max())


@pytest.mark.parametrize(
    "name", [n.removesuffix("_gauss_newton") for n in SIGNATURES if n.endswith("_gauss_newton")]
)
def test_newton_and_gauss_newton_share_all_but_the_hessian(table, name):
    arguments = inputs(f"{name}_newton", (6,), 10)
    *both, _ = getattr(table, f"{name}_newton")(*arguments)
    expected = getattr(table, f"{name}_gauss_newton")(*arguments[:-1])
    for value, other in zip(both, expected, strict=True):
        assert distance(value, other) <= 1e-14
