"""What may import what: see "Layout" in CONTRIBUTING.md."""

from __future__ import annotations

import ast
import contextlib
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import epigauge
import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
OPTIONAL = {
    *("casadi", "cv2", "matplotlib", "pooch", "requests", "rich", "scipy", "sympy", "typer"),
    "epigauge_derive",
}
#: Parts of the standard library that take long to import, or that a Python may come without.
COSTLY = {"asyncio", "email", "http", "multiprocessing", "sqlite3", "ssl", "unittest", "xml"}


def imported(tree: ast.AST, *, inside_functions: bool = True) -> Iterator[str]:
    """Top-level names of the packages that a module imports."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (name.name.split(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.split(".")[0]
        elif inside_functions or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from imported(node, inside_functions=inside_functions)


def imports_below(folder: str, **options: bool) -> dict[str, set[str]]:
    """Packages that each module below `folder` imports, by its path."""
    modules = sorted((CHECKOUT / folder).rglob("*.py"))
    assert modules
    return {
        path.relative_to(CHECKOUT).as_posix(): set(imported(ast.parse(path.read_text()), **options))
        for path in modules
    }


def printed(code: str) -> list[str]:
    """Run code in a new interpreter; return the words that it prints."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.split()


@pytest.mark.parametrize("used", ["", "[getattr(epigauge, name) for name in epigauge.__all__]"])
def test_importing_epigauge_imports_nothing_optional_or_costly(used: str) -> None:
    code = f"import sys, numpy; before = set(sys.modules); import epigauge; {used}\n"
    loaded = printed(code + "print(*{name.split('.')[0] for name in set(sys.modules) - before})")
    assert "epigauge" in loaded
    assert not set(loaded) & (OPTIONAL | COSTLY)


def test_only_what_a_name_needs_is_imported() -> None:
    code = "import sys, numpy, epigauge; {}; print(*sys.modules)"
    alone = printed(code.format("epigauge.__version__"))
    assert [name for name in alone if name.startswith("epigauge")] == ["epigauge"]
    solvers = "epigauge.refine_fundamental, epigauge.bundle_adjust"
    loaded = {".".join(name.split(".")[:2]) for name in printed(code.format(solvers))}
    assert {"epigauge.bundle", "epigauge.two_view"} <= loaded
    others = "cli", "datasets", "distributed", "images", "io", "metric", "plots", "reports"
    assert not loaded & {f"epigauge.{name}" for name in (*others, "reproduce", "uncertainty")}


def test_public_names_are_imported_from_where_the_checker_finds_them() -> None:
    """What `epigauge.__getattr__` does is what the imports for type checkers say."""
    tree = ast.parse(Path(epigauge.__file__).read_text())
    found = {
        alias.name: (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.startswith("epigauge")
        for alias in node.names
    }
    assert set(found) == set(epigauge.__all__)
    for name, (module, _) in found.items():
        home = importlib.import_module(module)
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(f"{module}.{name}")
        assert getattr(epigauge, name) is getattr(home, name)
    assert set(epigauge.__all__) <= set(dir(epigauge))
    with pytest.raises(AttributeError, match="no attribute 'refine'"):
        epigauge.refine  # noqa: B018


def test_threads_that_ask_first_get_the_same_names() -> None:
    code = """
import threading, epigauge
barrier = threading.Barrier(8)
found = [None] * 8
def ask(k):
    barrier.wait()
    names = epigauge.__all__[5 * k:] + epigauge.__all__[:5 * k]
    found[k] = {name: getattr(epigauge, name) for name in names}
threads = [threading.Thread(target=ask, args=(k,)) for k in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(all(one == found[0] and len(one) == len(epigauge.__all__) for one in found))
"""
    assert printed(code) == ["True"]


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("derive", {"epigauge", "epigauge_generated"}),
        ("generated", {"epigauge", "epigauge_derive", "sympy"}),
        ("runtime", {"epigauge_derive", "sympy"}),
    ],
)
def test_imports_go_one_way(folder: str, forbidden: set[str]) -> None:
    wrong = {path: names & forbidden for path, names in imports_below(folder).items()}
    assert not {path: names for path, names in wrong.items() if names}


def test_casadi_is_imported_only_inside_functions() -> None:
    names = imports_below("runtime", inside_functions=False)
    assert not [path for path, packages in names.items() if "casadi" in packages]
