"""What may import what: see "Layout" in CONTRIBUTING.md."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
OPTIONAL = {
    *("casadi", "cv2", "matplotlib", "pooch", "requests", "rich", "scipy", "sympy", "typer"),
    "epigauge_derive",
}


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


def test_importing_epigauge_imports_no_optional_package() -> None:
    code = "import sys, epigauge; print(*{name.split('.')[0] for name in sys.modules})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "numpy" in loaded
    assert not loaded & OPTIONAL


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
