"""Covariances against the report of a metrology network, and against simulated errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.prior_kinds import Distance
from epigauge.cameras import Cameras, MetricReconstruction, camera_model
from epigauge.multi_view.adjust import bundle_adjust
from epigauge.multi_view.gauge import (
    Gauge,
    five_points,
    reference_camera,
    similarity,
    transform,
    two_cameras,
)
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.uncertainty import covariance
from epigauge.reproduce.report import Claim, Section, Table
from epigauge.reproduce.run import Paper
from epigauge.reproduce.study import Experiments
from epigauge.rotations import from_rodrigues

__all__ = ["EXPERIMENTS", "PAPER", "load_network"]

Array = NDArray[np.float64]

#: Camera models of the simulation, and what of their intrinsics is refined.
_MODELS = {"pinhole": ("fx", "fy"), "bal": ("f", "k1"), "brown": ("c", "A1")}
_NOISE = 0.5
#: Pixels to the unit of projective images: H* of the gauge of two cameras mixes pixels and ratios,
#: and unit norm of it is far from linear where its third column is in single pixels.
_UNIT = 500.0
#: What the images of projective cameras are stretched by: with none, all pairs of views are at the
#: one place (sigma = 1) where the gauge of two cameras has a kink.
_ZOOMS = np.array([[1.0, 1.0], [1.3, 1.2], [0.8, 0.9], [1.5, 1.0], [0.9, 1.3]])
#: Most runs a line where the effect to be shown is large.
_FEW = 500
#: 95 % points of chi-square by degrees of freedom, from 1.
_CHI2 = (3.841, 5.991, 7.815, 9.488, 11.07, 12.592, 14.067, 15.507, 16.919, 18.307, 19.675, 21.026)


def load_network(
    path: Path,
) -> tuple[dict[str, Any], Tracks, MetricReconstruction, Distance]:
    """Read the network: the whole file, observations, start and scale bar.

    Parameters
    ----------
    path : path
        `network.npz`, as its README describes it.
    """
    with np.load(path) as archive:
        file = {name: archive[name] for name in archive.files}
    axes = np.eye(3)
    turns = [from_rodrigues(file["start_angles"][:, k : k + 1] * axes[k]) for k in range(3)]
    R = np.swapaxes(turns[0] @ turns[1] @ turns[2], 1, 2)
    c, x0, y0, A1, A2, B1, B2 = file["start_camera"]
    fixed = file["fixed_C1"], file["fixed_C2"], file["r0"]
    row = [c, x0, y0, A1, A2, file["fixed_A3"], B1, B2, *fixed]
    cameras = Cameras("brown", np.array([row], np.float64), np.zeros(len(R), np.intp))
    t = -np.einsum("nij,nj->ni", R, file["start_position"])
    start = MetricReconstruction(R, t, file["start_points"], cameras)
    tracks = Tracks(file["view"], file["point"], file["xy"], sigma=file["sigma"], min_points=3)
    first, second = (int(k) for k in file["scale_bar_points"])
    bar = Distance(first, second, float(file["scale_bar_length"]), float(file["scale_bar_sigma"]))
    return file, tracks, start, bar


def aligned(
    reconstruction: MetricReconstruction, X: Array, *, scaled: bool
) -> MetricReconstruction:
    """Return a reconstruction turned, shifted and, if asked for, scaled onto points X."""
    a, b = reconstruction.X - reconstruction.X.mean(axis=0), X - X.mean(axis=0)
    U, values, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    R, s = (U * signs) @ Vt, float(values @ signs / np.sum(a**2)) if scaled else 1.0
    shift = X.mean(axis=0) - s * R @ reconstruction.X.mean(axis=0)
    return transform(reconstruction, similarity(s, R, shift))


def network(study: Experiments) -> Section:
    """Adjust the network from its start and compare with the commercial report."""
    title = "A network of 115 views against its commercial report"
    path = study.file("metrology_aicon", "network.npz")
    if path is None:
        return Section(title, ["No measured data was found: set EPIGAUGE_DATA."])
    file, tracks, start, bar = load_network(path)
    free = tuple(file["camera_names"].tolist())
    result = bundle_adjust(tracks, start, refine=free, priors=[bar], ftol=1e-10)
    assert isinstance(result.reconstruction, MetricReconstruction)
    cov = covariance(
        tracks,
        aligned(result.reconstruction, file["own_points"], scaled=False),
        refine=free,
        priors=[bar],
    )
    std = cov.std
    own = [camera_model("brown").adjusted.index(name) for name in free]
    intrinsics = std.intrinsics[0, own]
    length, sigma = cov.distance(50, 55)
    rows: list[tuple[Any, ...]] = [
        ("sigma of unit weight (mm)", 0.00040536263, cov.noise_px, 1e-7),
        ("redundancy", 18804, cov.redundancy, 0.0),
        ("longest distance (mm)", 1651.0013, length, 1e-4 / 1651.0),
        ("its sigma (mm), gauge free", 0.01196, sigma, 5e-4),
        *(
            (f"sigma of {name}", float(a), float(b), 1e-5)
            for name, a, b in zip(free, file["camera_sd"], intrinsics, strict=True)
        ),
    ]
    for label, report, ours in (
        ("positions", file["position_sd"], std.centres),
        ("points", file["points_sd"], std.points),
        ("rotations, twice", file["rotation_sd_report"], 2.0 * std.rotations),
    ):
        rms = (float(np.sqrt(np.mean(a**2))) for a in (report, ours))
        largest = float(np.abs(report - ours).max())
        rows.append((f"RMS sigma of {label}", *rms, 1e-3))
        # Half a unit of the last digit that is printed.
        printed = 5.1e-7 if label.startswith("rot") else 5.1e-5
        rows.append((f"largest difference, {label}", 0.0, largest, printed))
    good = [abs(a - b) <= tol * (abs(a) or 1.0) for _, a, b, tol in rows]
    cells = [(*row[:3], "yes" if ok else "no") for row, ok in zip(rows, good, strict=True)]
    return Section(
        title,
        [
            "Start: camera constant 28, no distortion, positions off by 20 mm, angles by 0.02 rad, "
            "points by 10 mm. One scale bar holds the scale; rotation and place are left to inner "
            f"constraints over all 150 points. {result.nit} steps. The report prints four decimals "
            "of positions and points.",
            Table(
                "network",
                "Report and ours; within: to the digits that the report has.",
                ("quantity", "report", "ours", "within"),
                cells,
                ("", ".8g"),
            ),
        ],
        [
            Claim(
                "report",
                "all standard deviations of the network are reached",
                all(good),
                f"{sum(good)} of {len(good)} lines of the table",
            )
        ],
    )


def simulated(model: str, seed: int) -> tuple[Tracks, MetricReconstruction]:
    """Return five views of thirty points with noise, and the truth; the same but for the noise."""
    random = np.random.default_rng(list(_MODELS).index(model))
    along = -1.0 if model in ("bal", "brown") else 1.0
    X = random.uniform(-1.0, 1.0, (30, 3))
    R, t = np.empty((5, 3, 3)), np.empty((5, 3))
    for i, angle in enumerate(np.linspace(0.0, 1.8, 5)):
        z = -np.array([np.cos(angle), 0.3 * np.sin(3.0 * angle), np.sin(angle)])
        z *= along / np.linalg.norm(z)
        x = np.cross([0.1 * i, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        R[i] = [x, np.cross(z, x), z]
        t[i] = 5.0 * along * np.array([0.0, 0.0, 1.0])
    known = camera_model(model)
    values = {"f": 800.0, "fx": 800.0, "fy": 820.0, "c": 800.0, "k1": -0.1, "A1": -2e-7}
    row = [values.get(name, 0.0) for name in known.params]
    cameras = Cameras(model, np.array([row]), np.zeros(5, np.intp))
    truth = MetricReconstruction(R, t, X, cameras)
    view, point = np.divmod(np.arange(150), 30)
    blank = Tracks(view, point, np.zeros((150, 2)))
    noise = np.random.default_rng([seed, 1]).normal(0.0, _NOISE, (150, 2))
    return Tracks(blank.view, blank.point, truth.project(blank) + noise), truth


def _moved_to(
    datum: Any, found: MetricReconstruction, truth: MetricReconstruction
) -> MetricReconstruction:
    """Return an estimate moved so that it agrees with the truth in what the datum holds."""
    if datum == "inner":
        return aligned(found, truth.X, scaled=True)
    here, there = (datum.similarity(r.vectors, r.X) for r in (found, truth))
    back = there.inverse()
    s, R = here.scale * back.scale, back.rotation @ here.rotation
    return transform(found, similarity(s, R, back.positions(here.positions(np.zeros((1, 3))))[0]))


class _Tally:
    """Errors and what was promised of them, by datum and part."""

    def __init__(self) -> None:
        self.inside: dict[tuple[str, str], list[bool]] = {}
        self.errors: dict[tuple[str, str], list[Array]] = {}
        self.promised: dict[tuple[str, str], list[Array]] = {}

    def count(self, name: str, part: str, errors: Array, blocks: Array) -> None:
        """Count the errors (k, b) of all parts of a kind with their covariances (k, b, b)."""
        sizes = np.sqrt(np.maximum(np.einsum("kii->ki", blocks), 0.0)).max(axis=1)
        for k in np.flatnonzero(sizes > 1e-6 * np.median(sizes)):  # a gauge holds the others
            self._count(name, part, errors[k], blocks[k])

    def _count(self, name: str, part: str, error: Array, block: Array) -> None:
        """Count one error with its covariance, which may be singular where a gauge holds."""
        size = np.sqrt(np.maximum(np.diagonal(block), 0.0))
        free = np.flatnonzero(size > 1e-11 * size.max())
        size = size[free]
        values, axes = np.linalg.eigh(block[np.ix_(free, free)] / np.outer(size, size))
        kept = values > 1e-9 * values[-1]
        along = axes[:, kept].T @ (error[free] / size)
        square = float(np.sum(along**2 / values[kept]))
        key = name, part
        self.inside.setdefault(key, []).append(square <= _CHI2[int(np.count_nonzero(kept)) - 1])
        self.errors.setdefault(key, []).append(error)
        self.promised.setdefault(key, []).append(np.diagonal(block))

    def rows(self, model: str) -> list[tuple[Any, ...]]:
        """Return a row of the table for each."""
        found = []
        for (name, part), hits in self.inside.items():
            spread = np.sqrt(np.mean(np.square(self.errors[name, part]), axis=0))
            ours = np.sqrt(np.mean(self.promised[name, part], axis=0))
            free = ours > 1e-11 * ours.max()  # what a gauge holds has none
            ratio = ours[free] / spread[free]
            share = 100.0 * float(np.mean(hits))
            found.append((model, name, part, share, float(ratio.min()), float(ratio.max())))
        return found


def _count_metric(tally: _Tally, model: str, seed: int, datums: dict[str, Any]) -> None:
    free, known = _MODELS[model], camera_model(model)
    tracks, truth = simulated(model, seed)
    found = bundle_adjust(tracks, truth, refine=free).reconstruction
    assert isinstance(found, MetricReconstruction)
    own = [known.adjusted.index(p) for p in free]
    places = [known.params.index(p) for p in free]
    for name, datum in datums.items():
        moved = _moved_to(datum, found, truth)
        there = covariance(tracks, moved, datum, _NOISE, refine=free)
        values = (moved.cameras.params - truth.cameras.params)[:, places]
        tally.count(name, "points", moved.X - truth.X, there.point_blocks)
        tally.count(name, "centres", moved.centres - truth.centres, there.centre_blocks)
        tally.count(name, "intrinsics", values, there.intrinsics(0)[None, own][:, :, own])


def projective_gauges(Q: Array) -> dict[str, Gauge]:
    """Return the gauges of the simulation; the five points are the best ones of Q."""
    return {
        "first camera": reference_camera(),
        "two cameras": two_cameras(0, 4),
        "five points": five_points(five_points.choose(Q)),
    }


def _count_projective(tally: _Tally, seed: int, noise_px: float, unit: float) -> None:
    blank, scene = simulated("pinhole", 0)
    P = scene.to_projective().P.copy()
    P[:, :2] *= _ZOOMS[:, :, None] / unit
    truth = Reconstruction(P, scene.to_projective().Q)
    noise = np.random.default_rng([seed, 1]).normal(0.0, noise_px / unit, (len(blank), 2))
    tracks = Tracks(blank.view, blank.point, truth.project(blank) + noise)
    found = bundle_adjust(tracks, truth).reconstruction
    assert isinstance(found, Reconstruction)
    spread = covariance(tracks, found, noise_px=noise_px / unit)
    errors = found.project(tracks) - truth.project(tracks)
    tally.count("any", "projections", errors, spread.projections)
    for name, gauge in projective_gauges(truth.Q).items():
        there, known = spread.in_gauge(gauge), gauge.transformation(truth.P, truth.Q)
        P, Q = known.apply(truth.P, truth.Q)
        ours = there.reconstruction
        for part, a, b, blocks in (
            ("points", ours.Q, Q, there.points),
            ("cameras", ours.P.reshape(-1, 12), P.reshape(-1, 12), there.cameras),
        ):
            signs = np.sign(np.sum(a * b, axis=1, keepdims=True))
            tally.count(name, part, a - signs * b, blocks)


def units(study: Experiments) -> Section:
    """Show that a gauge is linear, or not, by the unit that images are in."""
    trials = min(study.trials, _FEW)
    rows: list[tuple[Any, ...]] = []
    for unit, noise in study.track([(1.0, 0.5), (1.0, 0.05), (1.0, 0.005), (_UNIT, 0.5)], "units"):
        tally = _Tally()
        for trial in range(trials):
            _count_projective(tally, study.seed + trial, noise, unit)
        rows += [(unit, noise, *row[2:]) for row in tally.rows("") if row[1] == "two cameras"]
    shares = [row[3] for row in rows if row[0] == _UNIT]
    return Section(
        "The gauge of two cameras, by the unit of the images",
        [
            "The second camera is (H* | e') with |H*| = 1. In single pixels the third column of H* "
            "is a shift in pixels, known to a tenth of one, and the others are ratios about one: "
            "they change by the square of the shift, which is more than what noise does to them to "
            "first order. With a hundredth of the noise, or in a unit as large as the image, the "
            "regions hold as in the other gauges: neither the datum nor the alignment is at fault. "
            "The projected points, which no gauge changes, are the same in all of these runs. "
            f"{trials} runs a line.",
            Table(
                "units",
                "Coverage (%) and ratio of standard deviations of the gauge of two cameras.",
                ("unit (px)", "noise (px)", "of", "inside", "ratio, least", "largest"),
                rows,
                ("g", "g", "", ".1f", ".3f"),
            ),
        ],
        [
            Claim(
                "not in the paper",
                "in a unit as large as the image the gauge of two cameras is linear enough",
                all(abs(share - 95.0) <= max(2.0, _slack(trials)) for share in shares),
                f"{min(shares):.1f} to {max(shares):.1f} %; in pixels "
                f"{rows[0][3]:.1f} and {rows[1][3]:.1f} %",
            )
        ],
    )


def _slack(trials: int) -> float:
    """Return three standard deviations of a share of 95 %, in per cent."""
    return 300.0 * float(np.sqrt(0.95 * 0.05 / trials))


def coverage(study: Experiments) -> Section:
    """Count how often the truth lies in the regions of 95 %, and compare standard deviations."""
    datums: dict[str, Any] = {
        "inner": "inner",
        "two cameras": two_cameras(0, 4),
        "three points": five_points([0, 1, 2]),
    }
    rows: list[tuple[Any, ...]] = []
    for model in study.track(["projective", *_MODELS], "simulated runs"):
        tally = _Tally()
        for trial in range(study.trials):
            if model == "projective":
                _count_projective(tally, study.seed + trial, _NOISE, _UNIT)
            else:
                _count_metric(tally, model, study.seed + trial, datums)
        rows += tally.rows(model)
    shares, ratios = [row[3] for row in rows], [r for row in rows for r in row[4:]]
    # What so many runs can show: three standard deviations of a share, and of a spread.
    slack = _slack(study.trials), 3.0 / np.sqrt(2.0 * study.trials)
    holds = all(abs(s - 95.0) <= max(2.0, slack[0]) for s in shares)
    limit = max(2.0, slack[0])
    out = [", ".join(row[:3]) for row in rows if abs(row[3] - 95.0) > limit]
    outside = f"; beyond: {'; '.join(out)}" if out else ""
    close = all(abs(r - 1.0) <= max(0.07, slack[1]) for r in ratios)
    return Section(
        "Regions of 95 % in simulated runs",
        [
            f"Five views of 30 points, noise {_NOISE:g} px, {study.trials} runs a model; estimates "
            "are moved to where they agree with the truth in what the datum holds, projective ones "
            "into the gauge. Share of the points (or others) of all runs with the truth inside, "
            "and promised over found standard deviations, least and largest of the coordinates; "
            "what the gauge holds does not count. Projective images are in a unit of "
            f"{_UNIT:g} px (see below).",
            Table(
                "coverage",
                "Coverage of regions of 95 % (%), and ratio of standard deviations.",
                ("model", "datum", "of", "inside", "ratio, least", "largest"),
                rows,
                ("", "", "", ".1f", ".3f"),
            ),
        ],
        [
            Claim(
                "not in the paper",
                "regions of 95 % hold the truth in 95 % of the cases, within two",
                holds,
                f"{min(shares):.1f} to {max(shares):.1f} %; {study.trials} runs leave "
                f"{slack[0]:.1f} (three standard deviations){outside}",
            ),
            Claim(
                "not in the paper",
                "promised standard deviations are those found, within 7 %",
                close,
                f"{min(ratios):.3f} to {max(ratios):.3f}; {study.trials} runs leave {slack[1]:.2f}",
            ),
        ],
    )


#: The experiments by name, in the order of the report.
EXPERIMENTS: dict[str, Callable[[Experiments], Section]] = {
    "network": network,
    "coverage": coverage,
    "units": units,
}


def introduction(study: Experiments) -> list[str]:
    """Return the paragraphs above the claims."""
    return [
        "Covariances of calibrated cameras, their intrinsics and points, checked twice: by the "
        "report that a commercial program made of a metrology network (AICON; camera model brown, "
        "every coordinate with its own sigma, a scale bar), and by simulated errors: epigauge "
        f"reproduce metrology --trials {study.trials} --seed {study.seed}.",
        "Beside COLMAP (Ceres), in the gauge that it has, two views held fixed: poses and "
        "intrinsics have the covariances of pycolmap.estimate_ba_covariance to 1e-4 of their size "
        "(tests/runtime/test_colmap_covariance.py). It counts rotations by half, and points with "
        "all else held fixed.",
    ]


PAPER = Paper("metrology", "Covariances against a metrology network", EXPERIMENTS, introduction)
