"""generated/ is what derive/ derives, byte by byte, and a change of either is noticed."""

from __future__ import annotations

import ast
import getpass
import os
import platform
import re
import socket
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("sympy")

import epigauge_derive
import sympy as sp
from epigauge_derive import __main__ as generator
from epigauge_derive.models import orthonormal

CHECKOUT = Path(__file__).resolve().parents[2]
GENERATED = CHECKOUT / "generated"


def tree(root):
    """Return the bytes of every file below a folder, by name."""
    return {name: (root / name).read_bytes() for name in generator.existing(root)}


@pytest.fixture(scope="module")
def files():
    """Return the checked-in files as the generator would return them."""
    return {name: content.decode() for name, content in tree(GENERATED).items()}


@pytest.fixture
def copy(tmp_path, files, monkeypatch):
    """Return a copy of generated/ for a generator that derives just that."""
    monkeypatch.setattr(generator, "generate", lambda: files)
    generator.write(tmp_path, files)
    return tmp_path


@pytest.mark.slow
def test_regeneration_is_byte_identical_under_another_hash_seed(tmp_path):
    """What is checked in was written, and is checked by tox, under hash seeds of chance."""
    environment = os.environ | {
        "PYTHONHASHSEED": "1",
        "PYTHONPATH": str(Path(epigauge_derive.__file__).parents[1]),
    }
    command = [sys.executable, "-m", "epigauge_derive", "--output", str(tmp_path)]
    run = subprocess.run(command, env=environment, capture_output=True, cwd=tmp_path, check=True)
    assert run.stdout
    written = {name: content.decode() for name, content in tree(tmp_path).items()}
    assert generator.differences(GENERATED, written) == ""


def check(root):
    return generator.main(["--check", "--output", str(root)])


def test_check_passes_on_what_was_written(copy, capsys):
    assert check(copy) == 0
    assert "up to date" in capsys.readouterr().out


def refused(root, capsys):
    """Return what a failing check prints."""
    before = tree(root)
    assert check(root) == 1
    assert tree(root) == before, "a check writes nothing"
    printed = capsys.readouterr().out
    assert "Repair it with: make derive" in printed
    return printed


@pytest.mark.parametrize(
    "name", ["c/criteria.c", "epigauge_generated/numpy_backend/camera.py", "latex/sampson.tex"]
)
def test_check_shows_a_changed_byte_as_a_unified_diff(copy, capsys, name):
    path = copy / name
    lines = path.read_text().splitlines(keepends=True)
    number = len(lines) // 2
    changed = lines[number].replace("\n", "") + " \n"
    path.write_bytes("".join([*lines[:number], changed, *lines[number + 1 :]]).encode())
    printed = refused(copy, capsys)
    assert f"--- {name}" in printed
    assert f"+++ {name}" in printed
    assert f"\n-{changed}" in printed
    assert f"\n+{lines[number]}" in printed


def test_check_leaves_compiled_libraries_alone(copy):
    (copy / "epigauge_generated/c_backend/libkernels.so").write_bytes(b"\x7fELF")
    assert check(copy) == 0


def test_check_sees_other_line_ends(copy, capsys):
    path = copy / "c/digest.c"
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert "c/digest.c" in refused(copy, capsys)


def test_check_sees_a_byte_that_is_no_text(copy, capsys):
    path = copy / "c/digest.c"
    path.write_bytes(path.read_bytes() + b"\xff")
    assert "c/digest.c" in refused(copy, capsys)


@pytest.mark.parametrize("name", ["c/criteria.c", "epigauge_generated/py.typed"])
def test_check_sees_a_missing_file(copy, capsys, name):
    (copy / name).unlink()
    assert name in refused(copy, capsys)


@pytest.mark.parametrize("text", ["left over\n", ""])
def test_check_sees_a_stale_file(copy, capsys, text):
    (copy / "latex/stale.tex").write_text(text)
    assert "latex/stale.tex" in refused(copy, capsys)


def test_check_leaves_compiled_python_alone(copy):
    cache = copy / "epigauge_generated/__pycache__"
    cache.mkdir()
    (cache / "signatures.cpython-311.pyc").write_bytes(b"\xff")
    assert check(copy) == 0


def test_writing_repairs_what_a_check_refuses(copy, files):
    (copy / "c/criteria.c").write_text("changed")
    (copy / "latex/sampson.tex").unlink()
    (copy / "latex/stale.tex").write_text("left over")
    assert generator.main(["--output", str(copy)]) == 0
    assert tree(copy) == {name: text.encode() for name, text in files.items()}
    assert check(copy) == 0


def test_a_changed_formula_changes_every_language_and_fails_the_check(
    tmp_path, monkeypatch, capsys
):
    def one_kernel():
        found = (k for k in orthonormal.kernels() if k.name == "canonical_camera")
        return [replace(k, family="orthonormal") for k in found]

    monkeypatch.setattr(generator, "kernels", one_kernel)
    assert generator.main(["--output", str(tmp_path)]) == 0
    assert check(tmp_path) == 0
    capsys.readouterr()
    right = orthonormal.canonical_camera
    monkeypatch.setattr(orthonormal, "canonical_camera", lambda u, v, s: right(u, v, -s))
    printed = refused(tmp_path, capsys)
    for name in (
        "c/orthonormal.c",
        "c/digest.c",
        "epigauge_generated/numpy_backend/orthonormal.py",
        "epigauge_generated/casadi_backend/orthonormal.py",
        "epigauge_generated/c_backend/__init__.py",
        "latex/canonical_camera.tex",
    ):
        assert f"--- {name}" in printed, name


@pytest.fixture(scope="module")
def signatures(files):
    """Return the generated table of kernels."""
    module = types.ModuleType("signatures")
    with pytest.MonkeyPatch.context() as patch:  # its dataclasses look their module up by name
        patch.setitem(sys.modules, module.__name__, module)
        exec(files["epigauge_generated/signatures.py"], module.__dict__)
    return module.SIGNATURES


def headers(name, family, files):
    """Return the header of a kernel in each language as one line, without marks of comments."""
    python = rf"def {name}\(.*?((?:\n    #.*)+)"
    found = {}
    for path, pattern in {
        f"epigauge_generated/numpy_backend/{family}.py": python,
        f"epigauge_generated/casadi_backend/{family}.py": python,
        f"c/{family}.c": rf"/\* ((?:(?!\*/)[\s\S])*?) \*/\nEG_EXPORT void eg_{name}\(",
        f"latex/{name}.tex": r"% .*\n((?:% .*\n)+)",
    }.items():
        header = re.search(pattern, files[path])
        assert header, (path, name)
        found[path] = " ".join(re.sub(r"(?m)^\s*[#%]", "", header[1]).split())
    return found


def test_headers_name_formula_arguments_and_operation_counts(files, signatures):
    for name, (family, inputs, outputs, formula) in signatures.items():
        counts = set()
        for path, header in headers(name, family, files).items():
            match = re.fullmatch(
                r"Formula: (.*) Inputs: (.*) Outputs: (.*) "
                r"(Operations: \d+, temporaries: \d+\.)",
                header,
            )
            assert match, (path, header)
            assert match[1] == formula, path
            for text, arguments, note in ((2, inputs, " shared"), (3, outputs, " summed")):
                expected = [
                    f"{argument.name} {argument.shape}{'' if argument.batched else note}"
                    for argument in arguments
                ]
                assert match[text] == ", ".join(expected), path
            counts.add(match[4])
        assert len(counts) == 1, name


def count(body, names, passes=1):
    """Add the names that a NumPy kernel computes to `names`; return its arithmetic operations.

    The states of a loop are counted once; its operations in every pass.
    """
    operations, outer = 0, set(names)
    for node in body:
        if isinstance(node, ast.For):
            operations += count(node.body, names, ast.literal_eval(node.iter.args[0]))
            continue
        assert isinstance(node, ast.Assign), ast.dump(node)
        (target,) = node.targets
        value = node.value
        if isinstance(target, ast.Name):
            if isinstance(value, ast.Subscript):
                continue  # an entry of an input
            if passes == 1 or target.id not in outer:
                names.append(target.id)
        if isinstance(value, ast.Call) and ast.unparse(value.func) == "np.add.reduce":
            value = value.args[0]
        arithmetic = ast.BinOp | ast.UnaryOp | ast.Call
        operations += passes * sum(isinstance(part, arithmetic) for part in ast.walk(value))
    return operations


def test_counts_in_headers_are_those_of_the_code(files, signatures):
    modules = {}
    for name, (family, *_) in signatures.items():
        path = f"epigauge_generated/numpy_backend/{family}.py"
        if path not in modules:
            modules[path] = {getattr(f, "name", ""): f for f in ast.parse(files[path]).body}
        names = []
        operations = count(modules[path][name].body, names)
        header = headers(name, family, files)[path]
        stated = re.search(r"Operations: (\d+), temporaries: (\d+)", header)
        assert len(names) == int(stated[2]), name
        # SymPy counts a power as one operation, which is printed as one or two (R0^6: as five).
        assert operations == pytest.approx(int(stated[1]), rel=0.1, abs=8), name


def test_first_line_says_where_a_file_comes_from_and_not_to_edit_it(files):
    for name, text in files.items():
        if text:
            first = text.splitlines()[0]
            assert "Generated by `make derive` from derive/epigauge_derive" in first, name
            assert "Do not edit." in first, name
            source = re.search(r"from (derive/\S+?)\. ", first)[1]
            assert (CHECKOUT / source).exists(), name


def test_no_file_tells_where_when_or_by_whom_it_was_made(files):
    date = re.compile(r"\b(19|20)\d\d[-/]\d\d[-/]\d\d\b|\b\d\d:\d\d:\d\d\b")
    absolute = re.compile(r"(?<![\w.*/)}])(/[a-z]\w*){2,}|[A-Z]:\\\\")
    secrets = [str(CHECKOUT), str(Path.home()), platform.python_version()]
    secrets += [word for word in (socket.gethostname(), getpass.getuser()) if len(word) > 4]
    for name, text in files.items():
        assert not date.search(text), name
        assert not absolute.search(text), name
        for secret in secrets:
            assert secret == "/" or secret not in text, name
        assert (sp.__version__ in text) == (name == "provenance.toml"), name


def test_every_file_ends_in_one_newline_and_has_unix_line_ends(files):
    for name, text in files.items():
        assert "\r" not in text, name
        assert not text or (text.endswith("\n") and not text.endswith("\n\n")), name
        assert not re.search(r"[ \t]$", text, re.MULTILINE), name
