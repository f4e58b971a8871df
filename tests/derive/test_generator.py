"""The machinery between models and languages: it prints what it was given or refuses."""

from __future__ import annotations

import importlib
import math
import pkgutil
import random
import re

import numpy as np
import pytest

pytest.importorskip("sympy")

import sympy as sp
from epigauge_derive import kernel as registry
from epigauge_derive import models
from epigauge_derive.emitters import numpy as numpy_emitter
from epigauge_derive.kernel import Input, Kernel, Let, Loop, Output, floor, select
from epigauge_derive.printer import Printer
from epigauge_derive.program import compile_kernel

X, Y, W = sp.symbols("x y w", real=True)
PYTHON = Printer(
    {"sqrt": "sqrt", "sin": "sin", "cos": "cos", "atan2": "atan2", "abs": "abs"},
    select="({then} if {condition} > 0.0 else {other})",
)
MATH = {name: getattr(math, name) for name in ("sqrt", "sin", "cos", "atan2")}


INPUTS = (Input("x"), Input("y"))


def toy(*entries, stages=(), inputs=INPUTS, name="toy", output="value"):
    """Return a kernel of scalars."""
    return Kernel(name, "a toy.", inputs, (Output(output, (len(entries),), entries),), stages)


def run(kernel, *inputs):
    """Compile a kernel, print it for NumPy, and call it on scalars."""
    (text,) = (
        text
        for name, text in numpy_emitter.emit([compile_kernel(kernel)]).items()
        if not name.endswith("__init__.py")
    )
    space = {}
    exec(text, space)
    outputs = [np.empty(output.shape) for output in kernel.outputs]
    space[kernel.name](*map(np.asarray, inputs), *outputs)
    return outputs[0].tolist()


@pytest.mark.parametrize(
    "expression",
    [
        sp.Max(X, Y),
        sp.Min(X, Y),
        sp.sign(X),
        sp.Piecewise((X, X > 0), (Y, True)),
        sp.Function("mystery")(X),
        sp.tan(X),
        sp.exp(X),
        X**Y,
        sp.cbrt(X),
        X ** sp.Rational(2, 3),
        2**X,
        sp.I * X,
        sp.oo,
        sp.nan,
        sp.zoo,
        X > 0,
        sp.Derivative(sp.Function("f")(X), X),
    ],
    ids=str,
)
def test_printer_refuses_what_it_has_no_rule_for(expression):
    with pytest.raises(TypeError, match="no rule to print"):
        PYTHON(expression)


def test_printer_refuses_unknown_nodes_inside_an_expression():
    with pytest.raises(TypeError, match="Max"):
        PYTHON(1 + Y * sp.sqrt(sp.Max(X, 0)))


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (X**2, "x*x"),
        (X**5, "x*x*x*x*x"),
        (Y * X**3, "x*x*x*y"),
        (1 / X, "1.0/x"),
        (X**-3, "1.0/(x*x*x)"),
        (sp.sqrt(X), "sqrt(x)"),
        (X ** sp.Rational(3, 2), "x*sqrt(x)"),
        (1 / sp.sqrt(X), "1.0/sqrt(x)"),
        (Y / X**2, "y/(x*x)"),
    ],
    ids=str,
)
def test_powers_are_printed_as_products(expression, text):
    assert PYTHON(expression) == text


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (sp.Integer(3), "3.0"),
        (sp.Rational(1, 4), "0.25"),
        (sp.Rational(1, 3), "1.0/3.0"),
        (sp.Rational(-2, 3), "-2.0/3.0"),
        (sp.Float("1e-300"), "1e-300"),
        (1 - sp.Rational(1, 2**46), repr(1 - 2.0**-46)),
    ],
    ids=str,
)
def test_numbers_are_printed_to_the_last_bit(number, text):
    assert PYTHON(number) == text
    assert eval(text) == float(number)


@pytest.mark.parametrize("power", [2, 3, -2])
def test_the_base_of_a_power_is_computed_once(power):
    files = numpy_emitter.emit([compile_kernel(toy((X + Y) ** power))])
    (text,) = (text for name, text in files.items() if not name.endswith("__init__.py"))
    assert len(re.findall(r"x ?\+ ?y", text)) == 1


def random_expression(rng, depth):
    """Return an expression of any of the nodes that have a rule."""
    if depth == 0:
        constants = [sp.Integer(rng.randint(-3, 3)), sp.Rational(rng.randint(-5, 5), 3)]
        return rng.choice([X, Y, W, X, Y, W, *constants])
    a, b, c = (random_expression(rng, depth - 1) for _ in range(3))
    return rng.choice(
        [
            a + b,
            a - b,
            a * b,
            -a,
            a / (1 + b**2),
            a ** rng.randint(2, 4),
            (2 + b**2) ** -rng.randint(1, 3),
            (1 + a**2) ** sp.Rational(rng.choice([-3, -1, 1, 3]), 2),
            sp.sin(a) * sp.cos(b),
            sp.atan2(X + a**2, Y - b**2),
            sp.Abs(a),
            select(a - b, c, a),
        ]
    )


def exact(expression, point):
    """Evaluate an expression to 30 digits by SymPy alone."""
    value = expression.replace(select, lambda c, a, b: sp.Piecewise((a, c > 0), (b, True)))
    return float(sp.N(value.subs(point), 30))


def test_printed_text_has_the_value_of_the_expression():
    rng = random.Random(1)
    point = {X: sp.Rational(3, 8), Y: sp.Rational(-5, 4), W: sp.Rational(7, 16)}
    values = {symbol.name: float(value) for symbol, value in point.items()}
    for _ in range(100):
        expression = random_expression(rng, rng.randint(1, 3))
        expected = exact(expression, point)
        # A dozen operations, each rounded, on values up to a few thousand.
        assert eval(PYTHON(expression), MATH | values) == pytest.approx(
            expected, rel=1e-11, abs=1e-11
        ), expression


def raw(head, *arguments):
    """Return an expression that SymPy has not simplified, as it occurs inside shared parts."""
    return head(*arguments, evaluate=False)


@pytest.mark.parametrize(
    "expression",
    [
        raw(sp.Add, W, raw(sp.Mul, -1, X + Y)),
        raw(sp.Add, W, raw(sp.Mul, -1, X - Y)),
        raw(sp.Add, raw(sp.Mul, -1, X + Y), W),
        raw(sp.Add, W, raw(sp.Add, X, Y)),
        raw(sp.Mul, W, raw(sp.Mul, X, Y)),
        raw(sp.Mul, W, raw(sp.Mul, -1, X + Y)),
        raw(sp.Mul, W, raw(sp.Pow, raw(sp.Mul, X, Y), -1)),
        raw(sp.Mul, W, raw(sp.Pow, X + Y, -1), raw(sp.Pow, X - Y, -2)),
        raw(sp.Mul, sp.Rational(-2, 3), raw(sp.Pow, X, -1)),
        raw(sp.Pow, raw(sp.Pow, X, 2), 3),
        raw(sp.Pow, sp.Rational(2, 3), 2),
        raw(sp.Pow, raw(sp.Mul, -2, X), 2),
    ],
    ids=str,
)
def test_parentheses_keep_the_value_of_unsimplified_expressions(expression):
    point = {X: sp.Rational(3, 8), Y: sp.Rational(-5, 4), W: sp.Rational(7, 16)}
    values = {symbol.name: float(value) for symbol, value in point.items()}
    expected = pytest.approx(exact(expression, point), rel=1e-14)
    assert eval(PYTHON(expression), MATH | values) == expected


def test_compiled_kernel_has_the_value_of_its_expressions():
    rng = random.Random(2)
    inputs = (Input("x"), Input("y"), Input("w"))
    point = {X: sp.Rational(3, 8), Y: sp.Rational(-5, 4), W: sp.Rational(7, 16)}
    for _ in range(25):
        a, b = (random_expression(rng, 2) for _ in range(2))
        p, q = sp.symbols("p q", real=True)
        # Names defined out of order and by each other.
        kernel = toy(p * q + a, q - b, inputs=inputs, stages=(Let({q: p**2 + b, p: a * b}),))
        got = run(kernel, *map(float, point.values()))
        value_p = a * b
        expected = [value_p * (value_p**2 + b) + a, value_p**2]
        assert got == pytest.approx([exact(e, point) for e in expected], rel=1e-11, abs=1e-11)


def test_loop_updates_all_states_at_once():
    a, b = sp.symbols("a b", real=True)
    fibonacci = Loop(start={a: X, b: Y}, body={}, update={a: b, b: a + b}, passes=10)
    assert run(toy(a, b, stages=(fibonacci,)), 0.0, 1.0) == [55.0, 89.0]
    swap = Loop(start={a: X, b: Y}, body={}, update={a: b, b: a}, passes=3)
    assert run(toy(a, b, stages=(swap,)), 2.0, 5.0) == [5.0, 2.0]


def test_loop_body_is_computed_anew_in_each_pass():
    a, half = sp.symbols("a half", real=True)
    newton = Loop(start={a: X}, body={half: a / 2}, update={a: half + X / (2 * a)}, passes=6)
    # Six steps of Heron's rule from 2 give the square root of 2 to rounding.
    (root,) = run(toy(a, stages=(newton,), inputs=(Input("x"),)), 2.0)
    assert root == pytest.approx(math.sqrt(2.0), rel=1e-15)


def test_undefined_symbol_is_an_error_that_names_it():
    with pytest.raises(ValueError, match=r"kernel toy: symbol z is neither input nor computed"):
        compile_kernel(toy(X + sp.Symbol("z", real=True)))


def test_symbol_with_other_assumptions_is_undefined():
    with pytest.raises(ValueError, match="symbol x is neither"):
        compile_kernel(toy(sp.Symbol("x", positive=True)))


def test_dummy_symbol_is_undefined():
    with pytest.raises(ValueError, match="neither input nor computed"):
        compile_kernel(toy(X + sp.Dummy("x", real=True)))


def test_undefined_symbol_in_a_stage_is_an_error_that_names_it():
    p = sp.Symbol("p", real=True)
    with pytest.raises(ValueError, match="symbol missing is neither"):
        compile_kernel(toy(p, stages=(Let({p: sp.Symbol("missing", real=True) + 1}),)))


@pytest.mark.parametrize("name", ["x", "p", "t0"])
def test_output_named_like_a_symbol_is_an_error(name):
    p = sp.Symbol("p", real=True)
    kernel = toy(p + sp.sin(X + Y) + (X + Y) ** 2, stages=(Let({p: 2 * X}),), output=name)
    with pytest.raises(ValueError, match=f"output {name} is also a symbol"):
        compile_kernel(kernel)


def test_two_inputs_that_share_an_entry_name_are_an_error():
    # q of shape (2,) has the entries q0 and q1.
    clash = (Input("q", (2,)), Input("q1"))
    with pytest.raises(ValueError, match="kernel toy: two symbols are named q1"):
        compile_kernel(toy(clash[0].entries()[0] + clash[1].symbol(), inputs=clash))


def test_stage_that_would_overwrite_an_input_is_an_error():
    with pytest.raises(ValueError, match="kernel toy: two symbols are named x"):
        compile_kernel(toy(X + Y, stages=(Let({X: 2 * Y}),)))


def test_two_symbols_of_one_name_and_other_assumptions_are_an_error():
    other = sp.Symbol("x", positive=True)
    with pytest.raises(ValueError, match="kernel toy: two symbols are named x"):
        compile_kernel(toy(X + other, stages=(Let({other: 2 * Y}),)))


def test_temporaries_never_take_the_name_of_an_input():
    t = Input("t", (3,))
    t0, t1, t2 = t.entries()
    kernel = toy((t0 + t1) ** 2 + sp.sin(t0 + t1), t2 * (t0 * t1 + 1) ** 2, inputs=(t,))
    expected = [9.0 + math.sin(3.0), 5.0 * 9.0]
    assert run(kernel, [1.0, 2.0, 5.0]) == pytest.approx(expected, rel=1e-14)


def test_entries_of_an_input_have_names_of_their_own():
    for shape in [(11, 11), (2, 12), (30,), (3, 4), (7, 11, 3)]:
        names = [entry.name for entry in Input("A", shape).entries()]
        assert len(set(names)) == len(names) == math.prod(shape)
    assert [e.name for e in Input("A", (11,)).entries()][:2] == ["A_0", "A_1"]
    assert [e.name for e in Input("k", (2,), names=("f", "k1")).entries()] == ["f", "k1"]
    with pytest.raises(ValueError, match="1 names"):
        Input("k", (2,), names=("f",)).entries()
    # A digit at the end of the name is set off from the index.
    assert [e.name for e in Input("P2", (2,)).entries()] == ["P2_0", "P2_1"]


@pytest.mark.parametrize("name", ["n", "i", "k", "x"])
def test_entry_with_a_name_that_is_taken_is_an_error(name):
    inputs = (Input("k", (1,), names=(name,)), Input("x"))
    with pytest.raises(ValueError, match=f"named {name}, or it is taken"):
        compile_kernel(toy(X, inputs=inputs))


def test_derivative_of_a_branch_is_that_of_the_side_taken():
    value = select(X - 1, X**2, sp.sin(X) * Y)
    for x, expected in ((3.0, [6.0, 0.0]), (0.5, [2.0 * math.cos(0.5), math.sin(0.5)])):
        found = run(toy(value.diff(X), value.diff(Y)), x, 2.0)
        assert found == pytest.approx(expected, rel=1e-15)


def test_pi_and_whole_numbers_below_are_printed():
    (value,) = run(toy(sp.pi * floor(X / sp.pi)), 7.0, 0.0)
    assert value == math.pi * 2.0


@pytest.fixture
def families(monkeypatch):
    """Return a function that gives families kernels of these names, and all others none."""

    def give(**names):
        for module in pkgutil.iter_modules(models.__path__):
            toys = [toy(X, name=name) for name in names.get(module.name, ())]
            family = importlib.import_module(f"epigauge_derive.models.{module.name}")
            monkeypatch.setattr(family, "kernels", lambda toys=toys: toys)

    return give


def test_kernels_come_with_the_family_they_are_from(families):
    families(camera=["one"], rotations=["two", "three"])
    found = [(kernel.name, kernel.family) for kernel in registry.kernels()]
    assert found == [("one", "camera"), ("two", "rotations"), ("three", "rotations")]


@pytest.mark.parametrize(
    "names", [{"camera": ["same", "same"]}, {"camera": ["same"], "rotations": ["other", "same"]}]
)
def test_two_kernels_of_one_name_are_an_error(families, names):
    families(**names)
    with pytest.raises(ValueError, match="two kernels are named same"):
        list(registry.kernels())


@pytest.mark.parametrize("language", ["c", "casadi", "latex", "numpy", "signatures"])
def test_emitters_do_not_depend_on_the_order_of_symbols_in_memory(language):
    emitter = importlib.import_module(f"epigauge_derive.emitters.{language}")
    kernel = toy(X * Y + sp.sin(X * Y) + X**2 * Y, Y - X)
    texts = []
    for _ in range(2):
        sp.core.cache.clear_cache()
        texts.append(emitter.emit([compile_kernel(kernel)]))
    assert texts[0] == texts[1]


def test_outputs_keep_the_shape_of_their_value():
    matrix = sp.Matrix([[X, Y], [Y, X]])
    assert Output.of("a", matrix).shape == (2, 2)
    assert Output.of("a", matrix[:, 0]).shape == (2,)
    assert Output.of("a", X).shape == ()
    assert Output.of("a", [[X, Y, 0]]).shape == (1, 3)
    assert Output.of("a", [[[X], [Y]]]).entries == (X, Y)
    assert Output.of("a", list(matrix), shape=(2, 2)).entries == (X, Y, Y, X)


def subscripts(text):
    """Return (name, digits) of both sides of every equation of a LaTeX file."""
    found = []
    for line in text.splitlines():
        if match := re.fullmatch(r"\\mathtt\{(\w+)\}_\{(.*?)\} &= (?:\w+_\{(.*?)\})?.*", line):
            found.append(match.groups())
    return found


@pytest.mark.parametrize("shape", [(3,), (10,), (3, 4), (2, 3, 2)])
def test_latex_gives_an_output_the_subscript_of_the_entry_it_copies(shape):
    emitter = importlib.import_module("epigauge_derive.emitters.latex")
    a = Input("a", shape)
    copied = Output("copy", shape, tuple(a.entries()))
    (text,) = emitter.emit([compile_kernel(Kernel("copy", "copy = a.", (a,), (copied,)))]).values()
    lines = subscripts(text)
    assert [left for _, left, _ in lines] == [right for *_, right in lines]
    assert [left for _, left, _ in lines] == ["".join(map(str, i)) for i in np.ndindex(*shape)]


def test_latex_names_the_entries_of_a_sparse_output_and_tells_two_digits_apart():
    emitter = importlib.import_module("epigauge_derive.emitters.latex")
    entries = [sp.S.Zero] * 144
    entries[2 * 12 + 11], entries[11 * 12 + 3] = X, Y
    kernel = Kernel("sparse", "two entries.", INPUTS, (Output("s", (12, 12), tuple(entries)),))
    (text,) = emitter.emit([compile_kernel(kernel)]).values()
    assert r"\mathtt{s} &= 0 \text{ but for}" in text
    assert [left for _, left, _ in subscripts(text)] == ["2,11", "11,3"]
