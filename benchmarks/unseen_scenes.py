"""Focal lengths of scenes as people photograph them: rings, arcs, streets, aerial blocks, rooms.

    python benchmarks/unseen_scenes.py [--trials 20] [--kinds ring street] [--seed 0] [--two]

Lenses with distortion (k from -0.3 to 0.1), principal points 2 to 5 % of the width off the centre,
wide and long focal lengths, noise of 0.3 to 1 px, up to 5 % of the observations wrong, and tracks
that break off, as those of a matcher do. A line a scene with its error in percent and in standard
deviations, and a line a kind: how many errors exceed three of them without a flag. With --two the
views are by two cameras of different focal length, which is told.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import epigauge as eg
import numpy as np
from epigauge.rotations import from_rodrigues
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIZE = np.array([1600, 1200])

#: Smallest cosine between the normal of a surface and the line of sight at which it is matched.
GRAZING = 0.35

#: What a kind of scene is made of: centres and targets of the cameras, points and their normals.
Parts = tuple[Array, Array, Array, Array]


def ring(rng: np.random.Generator, reach: float) -> Parts:
    """Go once around an object."""
    n = int(rng.integers(10, 25))
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False) + rng.normal(0.0, 0.05, n)
    C = _around(angle, 1.3 * reach * rng.uniform(0.9, 1.1, n), 0.3 + rng.normal(0.0, 0.15, n))
    X = rng.normal(size=(60 * n, 3))
    normals = X / np.linalg.norm(X, axis=1)[:, None]
    X = normals * rng.uniform(0.6, 1.0, (len(X), 1))
    return C, rng.normal(0.0, 0.12, (n, 3)), X, normals


def arc(rng: np.random.Generator, reach: float) -> Parts:
    """Look at a front from some directions."""
    n = int(rng.integers(5, 11))
    angle = np.linspace(-0.6, 0.6, n) + rng.normal(0.0, 0.05, n)
    C = _around(angle, 1.2 * reach * rng.uniform(0.85, 1.15, n), rng.normal(0.0, 0.2, n))
    X = rng.uniform(-1.0, 1.0, (500, 3)) * [1.0, 0.7, 0.2]
    return C, rng.normal(0.0, 0.2, (n, 3)) * [1.0, 1.0, 0.0], X, np.tile([0.0, 0, 1], (len(X), 1))


def street(rng: np.random.Generator, reach: float) -> Parts:
    """Go along a street, looking half ahead to either side."""
    del reach
    n = int(rng.integers(10, 25))
    along = 1.5 * np.arange(n) + rng.normal(0.0, 0.3, n)
    C = np.column_stack([rng.normal(0.0, 0.3, n), 1.6 + rng.normal(0.0, 0.1, n), along])
    side = np.where(rng.random() < 0.5, 1.0, np.sign(np.sin(0.8 * np.arange(n) + rng.random())))
    aim = np.column_stack(
        [6.0 * side + rng.normal(0.0, 1.0, n), rng.normal(2.5, 0.6, n), along + 9]
    )
    X = np.column_stack(
        [np.zeros(100 * n), rng.uniform(0.0, 7.0, 100 * n), rng.uniform(0.0, 1.5 * n + 20, 100 * n)]
    )
    wall = rng.choice([-1.0, 1.0], len(X))
    X[:, 0] = wall * (6.0 - np.abs(rng.normal(0.0, 0.5, len(X))))
    return C, aim, X, np.column_stack([-wall, 0.0 * wall, 0.0 * wall])


def aerial(rng: np.random.Generator, reach: float) -> Parts:
    """Fly strips of nearly vertical images, each second one back."""
    strips, each = int(rng.integers(2, 4)), int(rng.integers(4, 7))
    base = np.array([0.55, 0.3]) / reach * 1.2
    i, k = np.divmod(np.arange(strips * each), each)
    x = np.where(i % 2 == 0, k, each - 1 - k)
    C = np.column_stack([base[0] * i, base[1] * x, np.ones(len(i))])
    C += rng.normal(0.0, 0.03, C.shape)
    low, high = C.min(axis=0)[:2] - 0.6 / reach, C.max(axis=0)[:2] + 0.6 / reach
    X = np.column_stack([rng.uniform(low, high, (60 * len(i), 2)), np.zeros(60 * len(i))])
    X[:, 2] = 0.12 * rng.random(len(X)) * (rng.random(len(X)) < 0.5)
    aim = C * [1.0, 1.0, 0.0] + rng.normal(0.0, 0.05, C.shape) * [1.0, 1.0, 0.0]
    return C, aim, X, np.tile([0.0, 0.0, 1.0], (len(X), 1))


def room(rng: np.random.Generator, reach: float) -> Parts:
    """Look from within a room at its walls, all around."""
    del reach
    n = int(rng.integers(14, 25))
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False) + rng.normal(0.0, 0.05, n)
    C = _around(angle + np.pi, rng.uniform(0.8, 1.6, n), rng.normal(0.0, 0.2, n))
    X = rng.uniform(-1.0, 1.0, (120 * n, 3))
    wall = rng.choice([0, 2], len(X))
    side = rng.choice([-1.0, 1.0], len(X))
    X[np.arange(len(X)), wall] = side * (1.0 - 0.15 * np.abs(rng.normal(size=len(X))))
    normals = np.zeros_like(X)
    normals[np.arange(len(X)), wall] = -side
    aim = _around(angle, np.full(n, 3.0), rng.normal(0.0, 0.4, n))
    return C, aim, X * [3.5, 1.3, 3.0], normals


def _around(angle: Array, radius: Array, height: Array) -> Array:
    return np.column_stack([radius * np.sin(angle), height, radius * np.cos(angle)])


KINDS: dict[str, Callable[[np.random.Generator, float], Parts]] = {
    "ring": ring,
    "arc": arc,
    "street": street,
    "aerial": aerial,
    "room": room,
}


def scene_of(
    kind: str, seed: int, two: bool, again: int = 0
) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return tracks of a scene, gross errors among them, and its true cameras."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), again])
    count = 2 if two else 1
    width = SIZE[0]
    # In widths; within a room and in a street long ones see too little to go on.
    longest = 1.2 if kind in ("street", "room") else 2.0
    reach = float(np.exp(rng.uniform(np.log(0.6), np.log(longest))))
    focal = reach * width * np.append(1.0, rng.uniform(0.75, 1.3))[:count]
    C, aim, X, normals = KINDS[kind](rng, 2.0 * reach)
    n = len(C)
    turn, off = rng.uniform(0.0, 2.0 * np.pi, count), width * rng.uniform(0.02, 0.05, count)
    centre = (SIZE - 1.0) / 2.0 + off[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    params = np.column_stack([focal, centre, rng.uniform(-0.3, 0.1, count)])
    group = np.arange(n) % count
    R = np.stack([_looking(c, a, rng.normal(0.0, 0.05), kind) for c, a in zip(C, aim, strict=True)])
    cameras = eg.Cameras("SIMPLE_RADIAL", params, group)
    truth = eg.MetricReconstruction(R, -np.einsum("nij,nj->ni", R, C), X, cameras)
    view, point = np.divmod(np.arange(n * len(X)), len(X))
    every = eg.Tracks(view, point, np.zeros((len(view), 2)))
    view, point, xy = every.view, every.point, truth.project(every)
    rays = C[view] - X[point]
    facing = np.sum(rays * normals[point], axis=1) > GRAZING * np.linalg.norm(rays, axis=1)
    # The model folds back far outside of the image: what is undistorted must be near it, too.
    plain = eg.MetricReconstruction(
        R, truth.t, X, eg.Cameras("SIMPLE_RADIAL", params * [1.0, 1.0, 1.0, 0.0], group)
    ).project(every)
    near = np.abs(plain - centre[group[view]]).max(axis=1) < 0.65 * width
    inside = near & (xy > 0.0).all(axis=1) & (xy < SIZE - 1.0).all(axis=1)
    seen = (
        facing
        & inside
        & (truth.depths(every) > 0.0)
        & (rng.random(len(xy)) < rng.uniform(0.5, 0.9))
    )
    try:
        tracks = _broken(view[seen], point[seen], xy[seen], rng)
        lost = tracks.n_views < n
    except eg.ArgumentError:  # it falls into parts
        lost = True
    if lost:
        return scene_of(kind, seed, two, again + 1)
    xy = tracks.xy + rng.normal(0.0, rng.uniform(0.3, 1.0), tracks.xy.shape)
    wrong = rng.random(len(xy)) < rng.uniform(0.0, 0.05)
    far = wrong & (rng.random(len(xy)) < 0.5)
    xy[wrong] += rng.normal(0.0, 15.0, (int(wrong.sum()), 2))
    xy[far] = rng.uniform(0.0, 1.0, (int(far.sum()), 2)) * SIZE
    return eg.Tracks(tracks.view, tracks.point, xy), truth


def _looking(centre: Array, aim: Array, roll: float, kind: str) -> Array:
    z = (aim - centre) / np.linalg.norm(aim - centre)
    down = np.array([0.0, -1.0, 0.0])
    x = np.cross(down, z) if kind != "aerial" else np.cross([1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.asarray(from_rodrigues(np.array([0.0, 0.0, roll])) @ np.stack([x, np.cross(z, x), z]))


def _broken(view: Array, point: Array, xy: Array, rng: np.random.Generator) -> eg.Tracks:
    """Return tracks that break off: one step in five begins a new one."""
    order = np.lexsort((view, point))
    view, point, xy = view[order], point[order], xy[order]
    new = np.append(True, point[1:] != point[:-1]) | (rng.random(len(point)) < 0.2)
    track = np.cumsum(new) - 1
    long = np.bincount(track)[track] >= 2
    part, *_ = eg.Tracks.pruned(view[long], track[long], xy[long])
    return part


def tried(kind: str, seed: int, two: bool) -> tuple[float, bool, tuple[str, ...]]:
    """Print a line of a scene; return its error in deviations, its success and its flags."""
    tracks, truth = scene_of(kind, seed, two)
    true = truth.cameras.params[:, 0]
    begin = time.process_time()
    found = eg.metric_upgrade(
        tracks, image_size=SIZE, shared=truth.cameras.camera_of_view if two else True
    )
    seconds = time.process_time() - begin
    with np.errstate(invalid="ignore"):
        sigmas = (np.atleast_1d(found.focal_px) - true) / np.atleast_1d(found.focal_std_px)
    worst = int(np.argmax(np.nan_to_num(np.abs(sigmas), nan=np.inf)))
    f, std = np.atleast_1d(found.focal_px)[worst], np.atleast_1d(found.focal_std_px)[worst]
    print(
        f"{kind:7}{seed:4}{tracks.n_views:4}{tracks.n_points:6}{len(tracks):7} "
        f"f {true[worst]:7.1f} k {truth.cameras.params[worst, 3]:+.2f} "
        f"{100.0 * (f / true[worst] - 1.0):+8.2f} % +- {100.0 * std / f:6.2f} "
        f"{sigmas[worst]:+8.2f} sigmas {'yes' if found.success else 'no ':3} {seconds:6.2f} s "
        f"{','.join(found.refined)}  {', '.join(found.flags)}",
        flush=True,
    )
    return float(sigmas[worst]), found.success, found.flags


def main() -> None:
    """Print a line a scene, and a line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--two", action="store_true", help="two cameras")
    options = parser.parse_args()
    lines = []
    for kind in options.kinds:
        some = range(options.seed, options.seed + options.trials)
        results = [tried(kind, seed, options.two) for seed in some]
        good = [(z, flags) for z, success, flags in results if success]
        silent = sum(abs(z) > 3.0 and not flags for z, flags in good)
        told = sum(abs(z) > 3.0 and bool(flags) for z, flags in good)
        rms = float(np.sqrt(np.mean([z**2 for z, _ in good]))) if good else float("nan")
        lines.append(
            f"{kind:8}{len(results):7}{len(good):9}{silent:14}{told:14}"
            f"{sum(bool(flags) for _, flags in good):9}{rms:8.2f}"
        )
    print("kind     scenes  success  > 3, no flag  > 3, flagged  flagged  rms of sigmas")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
