"""Nanoseconds a match of one evaluation, by every variant of the library this processor can run.

    python benchmarks/kernels.py [--json FILE] [--quick]

One Gauss-Newton evaluation finds all foot points (Sampson start, two Newton passes) and adds up
gradient and normal equations; the exact Hessian takes the place of J^T J in the second half.
"In the loop" is the time from one cost to the next in the history of `refine_fundamental`: the same
kernels, weights, and the seven-parameter algebra. Operations are those that the header of a kernel
states, with one addition a sum, against the dgemm rate of NumPy's BLAS, which multiplies and adds
in one instruction where these kernels, that agree with NumPy to the last bit, use two.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import inspect
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import epigauge as eg
import numpy as np
from _measure import described, interleaved, machine, markdown
from epigauge import _library, kernels
from epigauge.two_view.conditioning import condition
from epigauge_generated.numpy_backend import criteria, reprojection

SIZES = (10_000, 100_000)
ROUNDS = 7
FRAME = ("R1", "R2", "s", "b1", "b2", "f")
#: Kernels by what they are called in the table.
TIMED = {
    "foot points": "foot_point",
    "Gauss-Newton sums": "reprojection_gauss_newton",
    "exact Hessian sums": "reprojection_newton",
    "Sampson distances": "sampson",
    "Sampson, Gauss-Newton sums": "sampson_gauss_newton",
}
#: Doubles a match that the two halves of an evaluation read and write.
DOUBLES = 4 + 3 + 4 + 2


def operations(kernel: str) -> int:
    """Return the arithmetic operations of a kernel for one match, additions to sums included."""
    family = reprojection if hasattr(reprojection, kernel) else criteria
    text = inspect.getsource(getattr(family, kernel))
    (stated,) = re.findall(r"Operations: (\d+)", text)
    return int(stated) + len(set(re.findall(r"= np\.add\.reduce\((.*)\)", text)))


def calls(m: int) -> dict[str, Callable[[], object]]:
    """Return one call of each kernel, on the scene's matches in the coordinates of the solver."""
    scene = eg.two_view_scene(10.0, n_points=m)
    units = condition(scene.x1, scene.x2)
    F = units.from_pixels(eg.refine_fundamental(scene.x1, scene.x2).F)
    table = kernels.table("c")
    values = dict(zip(FRAME, table.bilinear_frame(F), strict=True))
    values |= dict(zip(("q1", "q2"), units.forward(scene.x1, scene.x2), strict=True))
    values |= {"F": F, "weight": np.ones(m), "curvature": np.zeros(m)}
    values["l"] = table.foot_point(*(values[name] for name in (*FRAME, "q1", "q2")))[0]
    made = {}
    for label, name in TIMED.items():
        signature = kernels.SIGNATURES[name]
        arrays = [np.ascontiguousarray(values[argument.name]) for argument in signature.inputs]
        arrays += [np.zeros(o.shape + (m,) * o.batched) for o in signature.outputs]
        made[label] = _call(getattr(_library.library(), f"eg_{name}"), m, arrays)
    return made


def _call(
    function: Callable[..., object], m: int, arrays: list[np.ndarray]
) -> Callable[[], object]:
    import ctypes

    pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    # The arrays are an argument so that they live as long as the call.
    return lambda kept=arrays: function(ctypes.c_ssize_t(m), *pointers)


def in_the_loop(m: int, seconds: float) -> dict[str, float]:
    """Return the median seconds from one accepted cost to the next."""
    scene = eg.two_view_scene(10.0, n_points=m)
    found = {}
    for label, hessian in (("Gauss-Newton", "gauss-newton"), ("exact Hessian", "exact")):
        spent: list[float] = []
        begun = time.perf_counter()
        while not spent or time.perf_counter() - begun < seconds:
            rows = eg.refine_fundamental(scene.x1, scene.x2, hessian=hessian).history
            for a, b in zip(rows, rows[1:], strict=False):
                if a.accepted and b.accepted:
                    spent.append(b.seconds - a.seconds)
        found[f"{label}, in the loop"] = float(np.median(spent))
    return found


def child(m: int, seconds: float) -> dict[str, float]:
    """Return seconds by kernel, of the variant that the environment names."""
    times = interleaved(calls(m), seconds)
    return {name: float(np.median(spent)) for name, spent in times.items()} | in_the_loop(
        m, seconds
    )


def limits(seconds: float) -> dict[str, float]:
    """Return the rates of dgemm, in operations a second, and of a triad, in bytes a second."""
    rng = np.random.default_rng(0)
    A, B = rng.standard_normal((2, 768, 768))
    b, c = rng.standard_normal((2, 4_000_000))
    product, total = np.empty_like(A), np.empty_like(b)

    def triad() -> None:
        np.multiply(c, 3.0, out=total)
        np.add(total, b, out=total)

    times = interleaved({"dgemm": lambda: np.matmul(A, B, out=product), "triad": triad}, seconds)
    # Two passes: read, write; read, read, write
    return {
        "dgemm": 2.0 * len(A) ** 3 / times["dgemm"].min(),
        "triad": 5.0 * b.nbytes / times["triad"].min(),
    }


def measured(
    variants: tuple[str, ...], sizes: tuple[int, ...], rounds: int, seconds: float
) -> tuple[dict[str, dict[int, dict[str, list[float]]]], dict[str, float]]:
    """Return the seconds of each round by variant, size and kernel, and the machine's limits."""
    rng = np.random.default_rng(0)
    found: dict[str, dict[int, dict[str, list[float]]]] = {
        v: {m: {} for m in sizes} for v in variants
    }
    reached: dict[str, float] = {}
    tasks = [(variant, m) for variant in variants for m in sizes]
    for _ in range(rounds):
        for variant, m in rng.permutation(np.array(tasks, dtype=object)):
            command = [sys.executable, __file__, "--child", str(m), str(seconds)]
            environment = {**os.environ, _library.CHOICE: variant}
            done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE)
            for name, spent in json.loads(done.stdout).items():
                found[variant][m].setdefault(name, []).append(spent)
        for name, rate in limits(seconds).items():
            reached[name] = max(rate, reached.get(name, 0.0))
    return found, reached


def main() -> int:
    """Print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there, too")
    parser.add_argument("--quick", action="store_true", help="one short round, to see that it runs")
    parser.add_argument("--child", nargs=2, metavar=("M", "SECONDS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        m, seconds = arguments.child
        print(json.dumps(child(int(m), float(seconds))))
        return 0
    about = machine()
    print(described(about), end="\n\n", flush=True)
    if reason := kernels.available()["c"]:
        print(f"No compiled kernels: the library {reason}.")
        return 0
    quick = arguments.quick
    variants, sizes = _library.usable(), (1_000,) if quick else SIZES
    found, reached = measured(variants, sizes, 1 if quick else ROUNDS, 0.01 if quick else 0.3)
    print(_table(found, reached))
    print(
        f"\ndgemm {reached['dgemm'] / 1e9:.0f} GFLOP/s, triad {reached['triad'] / 1e9:.0f} GB/s. "
        f"An evaluation has {_evaluation_operations()} operations and moves "
        f"{8 * DOUBLES} bytes a match."
    )
    if arguments.json:
        text = {"machine": about, "seconds": found, "limits": reached}
        arguments.json.write_text(json.dumps(text, indent=1))
    return 0


def _evaluation_operations() -> int:
    return operations("foot_point") + operations("reprojection_gauss_newton")


def _table(found: dict[str, dict[int, dict[str, list[float]]]], reached: dict[str, float]) -> str:
    """Return nanoseconds a match, medians of the rounds with minima, and shares of the limits."""
    columns = [(variant, m) for variant, sizes in found.items() for m in sizes]
    header = ["ns a match: median (min) of the rounds"] + [f"{v}, m = {m:,}" for v, m in columns]
    each = {
        column: {n: 1e9 * np.array(t) / column[1] for n, t in found[column[0]][column[1]].items()}
        for column in columns
    }
    for own in each.values():
        own["**Gauss-Newton evaluation**"] = own["foot points"] + own["Gauss-Newton sums"]
        own["**exact Hessian evaluation**"] = own["foot points"] + own["exact Hessian sums"]
    rows = [
        [name, *(f"{np.median(each[c][name]):.1f} ({each[c][name].min():.1f})" for c in columns)]
        for name in each[columns[0]]
    ]
    whole = {c: float(each[c]["**Gauss-Newton evaluation**"].min()) for c in columns}
    exact = {c: float(each[c]["**exact Hessian evaluation**"].min()) for c in columns}
    rows.append(["exact over Gauss-Newton", *(f"{exact[c] / whole[c]:.2f}" for c in columns)])
    for label, most, amount in (
        ("of the dgemm rate", reached["dgemm"], _evaluation_operations()),
        ("of the memory bandwidth", reached["triad"], 8 * DOUBLES),
    ):
        shares = (100.0 * amount / (1e-9 * whole[c]) / most for c in columns)
        rows.append([f"Gauss-Newton evaluation, {label}", *(f"{s:.0f} %" for s in shares)])
    return markdown(header, rows)


if __name__ == "__main__":
    sys.exit(main())
