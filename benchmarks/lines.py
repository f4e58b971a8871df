"""Whether errors of points, lines and cameras fall as their covariances say, and what lines cost.

    python benchmarks/lines.py [--runs 60] [--lines 60] [--points 60] [--views 8]
                               [--projective] [--speed]

Each run is a scene of its own (`line_scene`, 1 px of noise), adjusted from its truth with points
alone and with points and lines. The truth is brought to the datum of the covariances: inner
constraints over the points. For each kind the mean of e^T C^+ e over its rank is told, one where
covariances are right, and how far off the median camera is. With --projective cameras are any
matrices, and it is the images of points and lines that are compared: they are the same in all
bases. With --speed a scene of 5,000 lines in 20 views is adjusted, and a step of it is timed.
"""

from __future__ import annotations

import argparse
import time

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def aligned(
    true: eg.MetricReconstruction, found: eg.MetricReconstruction
) -> eg.MetricReconstruction:
    """Return the truth where it is nearest to the points found."""
    a, b = true.X.mean(axis=0), found.X.mean(axis=0)
    U, values, Vt = np.linalg.svd((found.X - b).T @ (true.X - a))
    R, scale = U @ Vt, float(values.sum() / np.sum((true.X - a) ** 2))
    moved = eg.gauge.transform(true, eg.gauge.similarity(scale, R, b - scale * R @ a))
    assert isinstance(moved, eg.MetricReconstruction)
    return moved


def square(error: Array, C: Array, rank: int) -> float:
    """Return e^T C^+ e over the rank."""
    values, axes = np.linalg.eigh(C)
    return float(np.sum((axes.T @ error)[-rank:] ** 2 / values[-rank:]) / rank)


def run(scene: eg.LineScene, with_lines: bool) -> dict[str, float]:
    lines = scene.line_tracks if with_lines else None
    found = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose", ftol=1e-12)
    here = found.reconstruction
    assert isinstance(here, eg.MetricReconstruction)
    options = {} if lines is None else {"lines": lines}
    C = eg.covariance(scene.tracks, here, noise_px=1.0, refine="pose", **options)
    true = aligned(scene.true, here)
    off = here.centres - true.centres
    turns = here.R @ np.swapaxes(true.R, 1, 2)
    told = {
        "centres": np.mean([square(e, C.camera(i)[3:, 3:], 3) for i, e in enumerate(off)]),
        "points": np.mean(
            [square(e, C.point(j), 3) for j, e in enumerate(here.X - true.X)],
        ),
        "sigma of a centre": np.median(C.std.centres),
        "error of a centre": np.sqrt(np.mean(off**2)),
        "sigma of a rotation": np.median(C.std.rotations),
        "error of a rotation": np.sqrt(np.mean((turns - np.eye(3)) ** 2) * 9 / 6),
    }
    if here.lines is not None and true.lines is not None:
        side = np.sign(np.sum(here.lines[:, 3:] * true.lines[:, 3:], axis=1))[:, None]
        errors = here.lines - side * true.lines
        told["lines"] = np.mean([square(e, C.line(k), 4) for k, e in enumerate(errors)])
    return {name: float(value) for name, value in told.items()}


def distances(scene: eg.LineScene, at: eg.Reconstruction) -> tuple[Array, Array]:
    """Return the distances of end points from images of lines (S, 2), and these images (S, 3)."""
    lines, kernels = scene.line_tracks, eg.kernels.table("numpy")
    assert at.lines is not None
    P, L = at.P[lines.view].transpose(1, 2, 0), at.lines[lines.line].T
    seen = kernels.line_project(P, L).T
    seen = seen / np.linalg.norm(seen[:, :2], axis=1, keepdims=True)
    ends = lines.segments.reshape(-1, 2, 2)
    return np.einsum("ski,si->sk", ends, seen[:, :2]) + seen[:, 2:], seen


def run_projective(scene: eg.LineScene, with_lines: bool) -> dict[str, float]:
    lines = scene.line_tracks if with_lines else None
    true, tracks = scene.true.to_projective(), scene.tracks
    here = eg.bundle_adjust(tracks, true, lines=lines, ftol=1e-12).reconstruction
    assert isinstance(here, eg.Reconstruction)
    C = eg.covariance(tracks, here, noise_px=1.0, lines=lines)
    off = here.project(tracks) - true.project(tracks)
    told = {
        "images of points": np.mean(
            [square(e, S, 2) for e, S in zip(off, C.projections, strict=True)]
        ),
        "sigma of an image, px": np.sqrt(np.mean(np.einsum("nii->n", C.projections)) / 2.0),
        "error of an image, px": np.sqrt(np.mean(off**2)),
    }
    if with_lines:
        (found, seen), (wanted, image) = (distances(scene, at) for at in (here, true))
        side = np.sign(np.sum(seen[:, :2] * image[:, :2], axis=1))[:, None]
        errors = side * found - wanted
        both = zip(errors, C.line_projections, strict=True)
        told["images of lines"] = np.mean([square(e, S, 2) for e, S in both])
    return {name: float(value) for name, value in told.items()}


def study(args: argparse.Namespace) -> None:
    rows: dict[bool, list[dict[str, float]]] = {False: [], True: []}
    for seed in range(args.runs):
        scene = eg.line_scene(args.views, args.points, args.lines, seed=seed)
        for with_lines, known in rows.items():
            known.append((run_projective if args.projective else run)(scene, with_lines))
    print("| | points alone | points and lines |\n|---|---:|---:|")
    for name in rows[True][0]:
        cells = []
        for with_lines in (False, True):
            values = np.array([row.get(name, np.nan) for row in rows[with_lines]])
            if name.startswith("error"):
                cells.append(f"{np.sqrt(np.mean(values**2)):.5f}")
            elif name.startswith("sigma"):
                cells.append(f"{np.mean(values):.5f}")
            elif np.isnan(values).all():
                cells.append("")
            else:
                doubt = np.std(values) / np.sqrt(len(values))
                cells.append(f"{np.mean(values):.3f} +- {doubt:.3f}")
        print(f"| {name} | {cells[0]} | {cells[1]} |")


def speed() -> None:
    scene = eg.line_scene(20, 2000, 5000, seed=0)
    for name, lines in (("points alone", None), ("points and lines", scene.line_tracks)):
        begin = time.process_time()
        found = eg.bundle_adjust(scene.tracks, scene.true, lines=lines, refine="pose")
        spent = time.process_time() - begin
        print(f"{name}: {spent:.2f} s of processor time, {found.nfev} evaluations")
    begin = time.process_time()
    eg.triangulate_lines(scene.line_tracks, scene.true)
    print(f"triangulation: {time.process_time() - begin:.2f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for option, default in (("--runs", 60), ("--lines", 60), ("--points", 60), ("--views", 8)):
        parser.add_argument(option, type=int, default=default)
    parser.add_argument("--projective", action="store_true", help="cameras without calibration")
    parser.add_argument("--speed", action="store_true")
    given = parser.parse_args()
    speed() if given.speed else study(given)
