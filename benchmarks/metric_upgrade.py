"""Metric upgrades: motions that leave intrinsics open, and measured tracks with known cameras.

    python benchmarks/metric_upgrade.py [--trials 50] [--motions axis point table]
    python benchmarks/metric_upgrade.py --lenses [--trials 50]
    python benchmarks/metric_upgrade.py --data FOLDER [--parts | --published]

The first prints which share of simulated scenes of each motion is flagged, and how the errors of
the focal length compare with their standard deviations; the second the same of lenses that the
camera model does not describe. The third takes a folder with one folder a data set, each with a
tracks.npz with K, as those of Strecha and of Olsson; with --parts halves of their views; with
--published how well their tracks agree with the published K (sets with a reference.npz).
"""

from __future__ import annotations

import argparse
import collections
import sys
import time
from pathlib import Path

import epigauge as eg
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from calibration import CENTRE, SIZE, tracks_of
from epigauge.metric.scene import Images, with_all_points

MOTIONS = ("general", "translation", "rotation", "axis", "point", "table")
NAMED = {
    "translation": "pure translation",
    "rotation": "pure rotation",
    "axis": "one rotation axis",
    "point": "one viewing point",
    "table": "one rotation axis",
}


def simulated(trials: int, motions: list[str]) -> None:
    """Print a line a motion."""
    print("motion        trials  flagged  named  success  rms (f - f0) / sigma   flags")
    for motion in motions:
        flags: collections.Counter[str] = collections.Counter()
        ratios, flagged, named, good = [], 0, 0, 0
        for seed in range(trials):
            rng = np.random.default_rng(seed)
            options = {"n_views": int(rng.integers(4, 9)), "n_points": int(rng.integers(60, 200))}
            noise = float(rng.choice([0.2, 0.5, 1.0]))
            tracks, _ = tracks_of(motion, 1000 + seed, noise_px=noise, **options)
            found = eg.metric_upgrade(tracks, image_size=SIZE)
            flags.update(found.flags)
            flagged += bool(found.flags)
            named += NAMED.get(motion, "") in found.flags
            if motion in NAMED and NAMED[motion] not in found.flags:
                print(
                    f"  {motion} of seed {seed}, {options}, {noise} px: {found.flags}", flush=True
                )
            good += found.success
            if found.success:
                ratios.append((found.focal_px - 900.0) / found.focal_std_px)
        spread = np.sqrt(np.mean(np.square(ratios))) if ratios else float("nan")
        words = ", ".join(f"{name} {count}" for name, count in flags.most_common())
        counts = f"{trials:7} {flagged:8} {named:6} {good:8}"
        print(f"{motion:12} {counts} {spread:12.2f}   {words}", flush=True)


def simulated_lenses(trials: int) -> None:
    """Print a line a kind of lens or track that the camera model does not describe."""
    print(
        f"{'lens':28} trials  success  largest error  < 3 sigma or flagged  flagged  rms of sigmas"
    )
    for name, change in LENSES.items():
        errors, sigmas, flagged, held, good = [], [], 0, 0, 0
        for seed in range(trials):
            rng = np.random.default_rng(5000 + seed)
            views, points = int(rng.integers(5, 20)), int(rng.integers(150, 600))
            _, scene = tracks_of("general", 5000 + seed, n_views=views, n_points=points)
            tracks = seen_by(scene, change(rng, views), rng)
            found = eg.metric_upgrade(tracks, image_size=SIZE)
            good += found.success
            if found.success:
                errors.append(abs(found.focal_px / 900.0 - 1.0))
                sigmas.append((found.focal_px - 900.0) / found.focal_std_px)
                flagged += bool(found.flags)
                held += abs(sigmas[-1]) < 3.0 or bool(found.flags)
        spread = float(np.sqrt(np.mean(np.square(sigmas))))
        worst = 100.0 * max(errors)
        print(
            f"{name:28} {trials:6} {good:8} {worst:13.2f}% {held:21} {flagged:8} {spread:14.2f}",
            flush=True,
        )


def seen_by(
    scene: eg.MetricReconstruction, params: np.ndarray, rng: np.random.Generator
) -> eg.Tracks:
    """Return tracks of a scene seen by other cameras (OPENCV, a row a view), 1 % of them wrong."""
    views, points = len(scene.R), len(scene.X)
    sees = rng.random((views, points)) < 0.5
    sees[:2] = True
    view, point = np.nonzero(sees)
    cameras = eg.Cameras("OPENCV", params, np.arange(views))
    other = eg.MetricReconstruction(scene.R, scene.t, scene.X, cameras)
    blank = eg.Tracks(view, point, np.zeros((len(view), 2)))
    xy = other.project(blank)
    xy = xy + rng.normal(0.0, 0.4, xy.shape)
    wrong = rng.random(len(xy)) < 0.01
    xy[wrong] += rng.uniform(-80.0, 80.0, (int(wrong.sum()), 2))
    return eg.Tracks(blank.view, blank.point, xy)


def lens(views: int, **given: float | np.ndarray) -> np.ndarray:
    """Return OPENCV cameras of 900 px but for what is given, a row a view."""
    value = {
        "stretch": 0.0,
        "centre": 0.0,
        "k1": -0.1,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "focus": 0.0,
    }
    value |= given
    f = 900.0 * (1.0 + np.broadcast_to(value["focus"], views))
    rows = [f * (1.0 - 0.5 * value["stretch"]), f * (1.0 + 0.5 * value["stretch"])]
    rows += [np.full(views, centre + value["centre"]) for centre in CENTRE]
    rows += [np.full(views, value[name]) for name in ("k1", "k2", "p1", "p2")]
    return np.column_stack(rows)


LENSES = {
    "as the model": lambda rng, n: lens(n, centre=rng.normal(0.0, 8.0)),
    "fx and fy 0.17 % apart": lambda rng, n: lens(n, stretch=0.0017),
    "k2 = 0.1 beside k1": lambda rng, n: lens(n, k2=0.1),
    "k2 = 0.3 beside k1 = -0.3": lambda rng, n: lens(n, k1=-0.3, k2=0.3),
    "tangential 0.002": lambda rng, n: lens(n, p1=0.002, p2=-0.002),
    "focus varies by 0.1 %": lambda rng, n: lens(n, focus=rng.normal(0.0, 1e-3, n)),
    "focus varies by 0.5 %": lambda rng, n: lens(n, focus=rng.normal(0.0, 5e-3, n)),
}


def measured(folder: Path, parts: bool) -> None:
    """Print a line a data set with known K, or a line a part of its views."""
    print(f"{'set':38} views focal_px     std    true   error  sigmas  rms_px  seconds  flags")
    for path in sorted(folder.glob("*/tracks*.npz")):
        with np.load(path) as data:
            z = {name: data[name] for name in data.files}
        size = z.get("image_size", SIZES.get(path.parent.name))
        if "K" not in z or size is None:
            continue
        tracks = eg.Tracks(z["view"], z["point"], z["xy"])
        true = np.array(z["K"]).reshape(-1, 3, 3)[0, [0, 1], [0, 1]].mean()
        name = path.parent.name + path.stem.removeprefix("tracks")
        if not parts:
            row(name, tracks, size, true)
            continue
        n, order = tracks.n_views, np.arange(tracks.n_views)
        for label, views in {
            "even": order[::2],
            "odd": order[1::2],
            "first half": order[: n // 2 + 1],
            "last half": order[n // 2 :],
            "middle third": order[n // 3 : -(n // 3)],
        }.items():
            if len(views) < 4:
                continue
            keep = np.isin(tracks.view, views)
            try:
                kept, *_ = eg.Tracks.pruned(tracks.view[keep], tracks.point[keep], tracks.xy[keep])
            except eg.ArgumentError:
                continue
            row(f"{name} {label}", kept, size, true)


def published(folder: Path) -> None:
    """Print how well tracks agree with the published calibration, and with a free one."""
    print(
        "RMS a coordinate, px; first of the observations of the reference, K fixed, from two starts"
    )
    for path in sorted(folder.glob("*/reference.npz")):
        with np.load(path.with_name("tracks.npz")) as z, np.load(path) as other:
            if "K" not in z or "used" not in other:
                continue
            K, size = np.array(z["K"]).reshape(-1, 3, 3)[0], z["image_size"]
            view, point = z["view"], z["point"]
            tracks = eg.Tracks(view, point, z["xy"])
            used = np.zeros((tracks.n_views, tracks.n_points))
            used[view, point] = other["used"]
            R, t, X = other["R"], other["t"], other["X"].copy()
        X[~np.isfinite(X).all(axis=1)] = np.nanmedian(X, axis=0)
        found = eg.metric_upgrade(tracks, image_size=size)
        scene = found.reconstruction
        f, cx, cy, k = scene.cameras.params[0]
        fixed = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        bend, centre = ("k1", "k2", "p1", "p2"), ("cx", "cy")
        of_all = tracks.weighted(np.where(found.rejected, 0.0, 1.0))
        of_reference = tracks.weighted(used[tracks.view, tracks.point])
        # Points of which the upgrade set observations aside, by those of the reference.
        images = Images(np.tile(size, (tracks.n_views, 1)), np.zeros(tracks.n_views, dtype=int))
        again = with_all_points(scene, of_reference, images, eg.kernels.table())
        other_start = eg.MetricReconstruction(R, t, X, scene.cameras)
        print(path.parent.name, flush=True)
        for label, start, kept, model, params, refine in (
            ("from the upgrade", again, of_reference, "PINHOLE", fixed, ()),
            ("from the reference", other_start, of_reference, "PINHOLE", fixed, ()),
            ("K fixed", scene, of_all, "OPENCV", [*fixed, 0, 0, 0, 0], ()),
            ("K fixed, distortion free", scene, of_all, "OPENCV", [*fixed, k, 0, 0, 0], bend),
            ("f fixed", scene, of_all, "OPENCV", [*fixed[:2], cx, cy, k, 0, 0, 0], centre + bend),
            ("all free", scene, of_all, "OPENCV", [f, f, cx, cy, k, 0, 0, 0], "all"),
        ):
            cameras = eg.Cameras(model, [params], np.zeros(tracks.n_views, dtype=int))
            begin = eg.MetricReconstruction(start.R, start.t, start.X, cameras)
            if label == "from the upgrade":  # a point 860 px off would bend least squares
                rough = eg.bundle_adjust(kept, begin, refine=refine, loss="cauchy", ftol=1e-4)
                begin = rough.reconstruction
            end = eg.bundle_adjust(kept, begin, refine=refine, ftol=1e-8, max_iter=100)
            rms = np.sqrt(np.mean(end.fun[kept.weights > 0.0] ** 2))
            focal = end.reconstruction.cameras.params[0, :2]
            print(f"  {label:26} {rms:.6f}  fx, fy {focal[0]:.1f}, {focal[1]:.1f}", flush=True)


#: Of sets that do not tell.
SIZES = {"sba_demo": np.array([640, 480])}


def row(name: str, tracks: eg.Tracks, size: np.ndarray, true: float) -> None:
    """Print how far the focal length of tracks is from the true one."""
    begin = time.process_time()
    found = eg.metric_upgrade(tracks, image_size=size)
    seconds = time.process_time() - begin
    flags = ", ".join(found.flags) or "-"
    if not found.success:
        print(f"{name:38} {tracks.n_views:5} not determined {seconds:8.2f}  {flags}", flush=True)
        return
    error = 100.0 * (found.focal_px / true - 1.0)
    sigmas = (found.focal_px - true) / found.focal_std_px
    print(
        f"{name:38} {tracks.n_views:5} {found.focal_px:8.2f} {found.focal_std_px:7.2f} {true:7.1f} "
        f"{error:+6.2f}% {sigmas:+7.2f} {found.rms_px:7.4f} {seconds:8.2f}  {flags}",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--data", type=Path)
    parser.add_argument("--parts", action="store_true")
    parser.add_argument("--published", action="store_true")
    parser.add_argument("--lenses", action="store_true")
    options = parser.parse_args()
    if options.data is not None and options.published:
        published(options.data)
    elif options.data is not None:
        measured(options.data, options.parts)
    elif options.lenses:
        simulated_lenses(options.trials)
    else:
        simulated(options.trials, options.motions)
