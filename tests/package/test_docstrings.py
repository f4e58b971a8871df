"""Docstrings of public names: their examples run, and those of the package itself all have one."""

from __future__ import annotations

import doctest
import importlib
import inspect
from collections.abc import Iterator
from typing import Any

import epigauge as eg
import numpy as np
import pytest

MODULES = (
    *("arrays", "casadi", "colmap", "datasets", "distributed", "gauge", "images", "interop"),
    *("io", "kernels"),
    *("plots", "reports", "samples", "verdicts"),
)


def public() -> Iterator[tuple[str, Any]]:
    """Yield the names that users write, and what they stand for."""
    for name in eg.__all__:
        yield name, getattr(eg, name)
    for module in MODULES:
        found = getattr(eg, module, None) or importlib.import_module(f"epigauge.{module}")
        for name in found.__all__:
            yield f"{module}.{name}", getattr(found, name)


NAMED = {
    name: value
    for name, value in public()
    if inspect.isfunction(value) or (inspect.isclass(value) and value.__module__ != "builtins")
}


#: What all gauges do alike is shown at `Gauge` and `transform`.
GAUGES = ("identity", "reference_camera", "two_cameras", "five_points", "normalized")

#: Methods that the solvers call, public to one another only, and those that draw or write what
#: the example of a function draws or writes.
WITHOUT = {
    *(f"{name}.{method}" for name in GAUGES for method in ("transformation", "similarity")),
    "normalized.moved",
    *("BundleResult.judge", "BundleResult.unjudged", "FundamentalResult.judged"),
    *("Partial.partial", "Comparison.plot", "PairwiseMatches.load", "PairwiseMatches.save"),
}


def methods() -> dict[str, Any]:
    """Return the methods of public classes by the class that defines them; no properties."""
    found = {}
    for value in NAMED.values():
        if not inspect.isclass(value) or issubclass(value, Exception):
            continue
        for name in dir(value):
            method = inspect.getattr_static(value, name)
            method = getattr(method, "__func__", method)  # of a class, or static
            own = inspect.isfunction(method) and method.__module__.startswith("epigauge")
            if own and not name.startswith("_"):
                found[method.__qualname__] = method
    return found


METHODS = methods()
SHOWN = {n: v for n, v in (NAMED | METHODS).items() if ">>>" in (v.__doc__ or "")}


@pytest.mark.parametrize("name", SHOWN)
def test_examples_run_and_print_what_they_show(name: str) -> None:
    value = SHOWN[name]
    module = importlib.import_module(inspect.unwrap(value).__module__)
    parsed = doctest.DocTestParser().get_doctest(
        value.__doc__ or "", vars(module) | {"eg": eg, "np": np}, name, None, 0
    )
    printed: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    failed = runner.run(parsed, out=printed.append).failed
    text = "".join(printed)
    if "MissingPackageError" in text or "ModuleNotFoundError" in text:
        pytest.skip("needs a package that is not installed")
    assert failed == 0, text


def test_every_public_function_and_class_has_an_example() -> None:
    """Errors have none: they are met, not made."""
    wanted = {
        name: value.__doc__ or ""
        for name, value in NAMED.items()
        if not (inspect.isclass(value) and issubclass(value, Exception))
    }
    assert [name for name, text in wanted.items() if "Examples\n" not in text] == []
    assert [name for name, text in wanted.items() if ">>>" not in text] == []


def test_every_public_method_has_an_example() -> None:
    missing = {name for name, method in METHODS.items() if ">>>" not in (method.__doc__ or "")}
    assert missing - WITHOUT == set()
    assert WITHOUT <= missing  # none that has one by now
