"""What the experiments on gauges share: scenes, runs by method, random bases, defects of a step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge.bundle.dampings import DAMPINGS
from epigauge.bundle.observations import ObservationGraph
from epigauge.bundle.problem import BundleProblem, Estimate
from epigauge.bundle.run import bundle_problem
from epigauge.bundle.solve import BundleSystem
from epigauge.cameras import camera_model
from epigauge.multi_view.adjust import BundleResult, bundle_adjust
from epigauge.multi_view.frame import Frame
from epigauge.multi_view.gauge import Gauge, Transformation, identity, normalized
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.reproduce.study import Experiments
from epigauge.scenes import multi_view_scene

__all__ = [
    "LABELS",
    "STEPS",
    "GaugeStudy",
    "Step",
    "lowest",
    "moved",
    "perturbed",
    "random_transformation",
    "step_defect",
]

Array = NDArray[np.float64]

#: Methods in the order of tables, with their names in the paper.
LABELS = {
    "free": "FREE",
    "levenberg": "LEVENBERG",
    "marquardt": "MARQUARDT",
    "hartley": "HARTLEY",
    "bartoli": "BARTOLI",
    "faugeras": "FAUGERAS",
    "mclauchlan": "MCLAUCHLAN",
    "mclauchlan_free": "MCLAUCHLAN, without constraints",
    "kanatani": "KANATANI",
    "kanatani_inverse": "KANATANI, pseudo-inverse",
    "gauge_invariant": "GAUGE_INVARIANT",
    "gauge_invariant_normalized": "GAUGE_INVARIANT, with step 3",
    "gauge_invariant_factor": "GAUGE_INVARIANT, rank one",
    "covariant_alone": "COVARIANT, points not embedded",
    "covariant": "COVARIANT",
}

#: What is passed to `bundle_adjust` for entries of `LABELS` that are no methods of it. Step 3 of
#: Table 1 is a projection onto a global gauge after each step, which the paper recommends.
#: MCLAUCHLAN without its constraints, and KANATANI with FREE's pseudo-inverse, are normalised after
#: each step.
_OPTIONS: dict[str, dict[str, Any]] = {
    "gauge_invariant_normalized": {"method": "gauge_invariant", "gauge": normalized()},
    "covariant_alone": {"method": "covariant", "embedded": False},
    "mclauchlan_free": {"method": "levenberg", "gauge": normalized()},
    "kanatani_inverse": {"method": "free", "gauge": normalized()},
}

_FTOL, _MAX_ITER = 1e-8, 100


@dataclass
class GaugeStudy(Experiments):
    """Experiments on many views; runs are made once and remembered."""

    _starts: dict[tuple[float, int], tuple[Tracks, Reconstruction]] = field(default_factory=dict)
    _runs: dict[tuple[float, int, str], BundleResult] = field(default_factory=dict)

    def start(self, flatness: float, trial: int) -> tuple[Tracks, Reconstruction]:
        """Return scene and initial reconstruction of a trial."""
        key = (flatness, trial)
        if key not in self._starts:
            scene = multi_view_scene(flatness, seed=self.seed + trial)
            self._starts[key] = scene.tracks, initialize(scene.tracks)
        return self._starts[key]

    def run(self, flatness: float, trial: int, method: str) -> BundleResult:
        """Run a method on a trial."""
        key = (flatness, trial, method)
        if key not in self._runs:
            self._runs[key] = self.adjust(*self.start(flatness, trial), method)
        return self._runs[key]

    def adjust(self, tracks: Tracks, start: Reconstruction, method: str) -> BundleResult:
        """Run a method with the stopping rule of all experiments."""
        options = _OPTIONS.get(method, {"method": method})
        return bundle_adjust(tracks, start, ftol=_FTOL, max_iter=_MAX_ITER, **options)

    def measured(self, name: str, step: int = 1) -> Tracks | None:
        """Return a measured sequence, its clean tracks in every `step`-th view, or None."""
        path = self.file(name, "tracks.npz")
        if path is None:
            return None
        with np.load(path, allow_pickle=False) as file:
            view, point, xy = file["view"], file["point"], file["xy"]
            keep = view % step == 0
            if "clean" in file:
                keep &= file["clean"][point]
        return Tracks.pruned(view[keep], point[keep], xy[keep])[0]


def random_transformation(
    random: np.random.Generator, condition: float, n: int, m: int
) -> Transformation:
    """Return a random change of basis with random scales.

    Parameters
    ----------
    random : numpy.random.Generator
        Source.
    condition : float
        Ratio of the largest to the smallest singular value of T; with 1, T is orthonormal.
    n, m : int
        Numbers of cameras and points.

    Returns
    -------
    Transformation
        Scales are log-normal of unit deviation.
    """
    U, V = (np.linalg.qr(random.normal(size=(4, 4)))[0] for _ in range(2))
    T = (U * np.geomspace(1.0, condition, 4)) @ V
    return Transformation(T, np.exp(random.normal(size=n)), np.exp(random.normal(size=m)))


def moved(start: Reconstruction, there: Transformation) -> Reconstruction:
    """Return a reconstruction in another basis."""
    return Reconstruction(*there.apply(start.P, start.Q))


def perturbed(
    random: np.random.Generator,
    frame: Frame,
    start: Reconstruction,
    share: float,
    condition: float,
) -> Reconstruction:
    """Return a reconstruction with errors of a share of each norm, in a random basis."""
    P, Q = frame.cameras_in(start.P), start.Q
    P, Q = normalized().transformation(P, Q).apply(P, Q)
    P = P + share * random.normal(size=P.shape) / np.sqrt(12.0)
    Q = Q + share * random.normal(size=Q.shape) / 2.0
    there = random_transformation(random, condition, len(P), len(Q))
    return moved(Reconstruction(frame.cameras_out(P), Q), there)


def lowest(error: Array) -> NDArray[np.bool_]:
    """Tell which methods (first axis) end at the lowest error of a trial, to a millionth of it."""
    return np.asarray(error <= error.min(axis=0) * (1.0 + 1e-6))


@dataclass(frozen=True)
class Step:
    """A damping, and where its steps are made.

    Attributes
    ----------
    label : str
        Name in tables.
    damping : str
        Name of what turns a system and lambda into a step.
    gauge : Gauge
        Basis that the step is computed in before it is moved back.
    """

    label: str
    damping: str
    gauge: Gauge = field(default_factory=identity)


#: The dampings whose single steps are compared.
STEPS = (
    Step("lambda I", "levenberg"),
    Step("lambda diag N", "marquardt"),
    Step("pseudo-inverse", "none"),
    Step("Table 1, norm of R^T R", "gauge_invariant"),
    Step("Table 1, norm of vec R", "gauge_invariant_factor"),
    Step("covariant, in the basis given", "covariant"),
    Step("covariant, in the normalised basis", "covariant", normalized()),
)


def step_defect(tracks: Tracks, start: Reconstruction, step: Step, there: Transformation) -> float:
    """Return |delta' - T~ delta| / |delta'| of one step (B03 eq. 7), lambda being the same.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    start : Reconstruction
        Where the step is made from.
    step : Step
        How.
    there : Transformation
        T~.

    Returns
    -------
    float
        Zero for a gauge invariant iteration.
    """
    frame = Frame.of(tracks)
    graph = ObservationGraph(tracks.view, tracks.point, tracks.n_views, tracks.n_points)
    table, q = kernels.table(), frame.conditioned(tracks)
    problem = bundle_problem(camera_model("projective"), table, graph, q, np.ones(len(tracks)))
    damping = DAMPINGS[step.damping](table)
    P, Q = frame.cameras_in(start.P), start.Q
    lam = damping.start(_linearized(problem, P, Q))
    expected = _blocks_times(there, _made(problem, P, Q, step.gauge, damping, lam))
    found = _made(problem, *there.apply(P, Q), step.gauge, damping, lam)
    return float(np.linalg.norm(found - expected) / np.linalg.norm(found))


def _linearized(problem: BundleProblem, P: Array, Q: Array) -> BundleSystem:
    return problem.linearize(problem.evaluate(Estimate(P.reshape(-1, 12), Q)))


def _made(
    problem: BundleProblem, P: Array, Q: Array, gauge: Gauge, damping: lm.Damping, lam: float
) -> Array:
    """Return a step as one vector, made in a gauge and moved back."""
    home = gauge.transformation(P, Q)
    system = _linearized(problem, *home.apply(P, Q))
    return _blocks_times(home.inverse(), np.asarray(damping.step(system, lam)))


def _blocks_times(there: Transformation, vector: Array) -> Array:
    """Return T~ times a vector of all parameters."""
    cameras, points = there.blocks()
    x, y = vector[: 12 * len(cameras)].reshape(-1, 12), vector[12 * len(cameras) :].reshape(-1, 4)
    parts = np.einsum("nij,nj->ni", cameras, x), np.einsum("nij,nj->ni", points, y)
    return np.concatenate([part.ravel() for part in parts])
