"""What the experiments share: methods, scenes, and one timed run of a method."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels, lm
from epigauge.reproduce.study import Experiments
from epigauge.scenes import TwoViewScene, two_view_scene
from epigauge.two_view.conditioning import Conditioning
from epigauge.two_view.geometry import reprojection_distances
from epigauge.two_view.initial import fundamental_8point
from epigauge.two_view.solve import Matches, Options, minimize

__all__ = [
    "DISTANCES",
    "ELIMINATED",
    "LM",
    "METHODS",
    "SEBER",
    "XI",
    "Method",
    "Run",
    "Setup",
    "Study",
    "converge",
    "reprojection_rms",
]

Array = NDArray[np.float64]

#: The paper's two step controls by our names.
LM, SEBER = "levenberg", "seber"

#: Stopping threshold unless another is stated: the middle of the paper's range 1e-8 to 1e-4.
XI = 1e-6

#: Trial steps allowed: enough that xi stops nearly every run.
MAX_ITER = 300

#: Distances of the cameras from the scene, in metres (B&S Table 3).
DISTANCES = (6, 8, 10, 12, 14, 16, 18, 20)


@dataclass(frozen=True)
class Method:
    """A compared method: its name in the report and what it is made of."""

    label: str
    parameterization: str
    structure: str = "joint"
    hessian: str = "exact"


#: The five methods of the paper, bundle adjustment over motion and structure.
METHODS = (
    Method("ORTHO", "ortho"),
    Method("MAPS", "maps"),
    Method("PARFREE", "parfree"),
    Method("FREE", "free"),
    Method("NORM", "normalized"),
)

#: Methods that the paper does not have: each match at its foot point, seven unknowns in all.
ELIMINATED = (
    Method("ORTHO eliminated, Gauss-Newton", "ortho", "eliminated", "gauss-newton"),
    Method("ORTHO eliminated, exact Hessian", "ortho", "eliminated"),
    Method("BLOCK eliminated, exact Hessian", "block", "eliminated"),
)


@dataclass(frozen=True)
class Setup:
    """One trial of the paper's simulation (section 5.1.1)."""

    seed: int
    distance: float = 10.0
    noise_px: float = 2.0**0.5
    n_points: int = 50
    baseline: float = 1.0
    focal: float = 1000.0

    def scene(self) -> TwoViewScene:
        """Return the scene."""
        configuration = asdict(self)
        return two_view_scene(**configuration)


@dataclass(frozen=True)
class Run:
    """What one run of a method came to.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        The estimate; the start value if the method broke down.
    error_px : float
        Reprojection error: root mean square of the 4 m residual coordinates.
    evaluations : int
        Evaluations of the cost, the start included.
    seconds : float
        Time from the first to the last evaluation.
    step_seconds : float
        Median time of a trial step.
    broke : bool
        Whether the normal equations became singular.
    """

    F: Array
    error_px: float
    evaluations: int
    seconds: float
    step_seconds: float
    broke: bool


def reprojection_rms(F: Array, x1: Array, x2: Array) -> float:
    """Return the reprojection error of F: the root mean square of the 4 m residual coordinates."""
    d = reprojection_distances(F, x1, x2)[0]
    return float(np.sqrt(np.mean(d**2) / 4.0))


def converge(
    x1: Array,
    x2: Array,
    F0: Array,
    method: Method,
    damping: str = LM,
    xi: float = XI,
    frame: Conditioning | None = None,
) -> Run:
    """Run a method and measure it.

    Parameters
    ----------
    x1, x2 : ndarray, shape (m, 2)
        Matches in pixels.
    F0 : ndarray, shape (3, 3)
        Start value.
    method : Method
        The method.
    damping : {"levenberg", "seber"}
        LM or SEBER.
    xi : float
        The run stops when an accepted step lowers the cost by less than `xi` times itself. The
        error being proportional to the root of the cost and below 2 px here, its change is then
        below the paper's threshold xi as well.
    frame : Conditioning, optional
        Coordinates to compute in; by default those of `refine_fundamental`.

    Returns
    -------
    Run
        The outcome. A method breaks down when a matrix that it must invert is exactly singular;
        it is then judged by the last estimate that it accepted.
    """
    matches = Matches.of(x1, x2, np.ones(len(x1)), F0, kernels.table())
    if frame is not None:
        matches = Matches(matches.table, frame, *frame.forward(x1, x2), matches.weights)
    options = Options(
        parameterization=method.parameterization,
        structure=method.structure,
        hessian=method.hessian,
        damping=damping,
        stopping=lm.Stopping(ftol=xi, xtol=0.0, gtol=0.0, max_iter=MAX_ITER),
    )
    rows: list[lm.Row] = []
    # Only methods with points break down; without a callback the others take the compiled loop.
    note = rows.append if method.structure == "joint" else None
    try:
        solution = minimize(matches, options, matches.frame.from_pixels(F0), note)
        F, broke = matches.frame.to_pixels(solution.F), False
        rows = list(solution.outcome.history)
    except np.linalg.LinAlgError:
        F, broke = F0, True
    clock = [row.seconds for row in rows]
    cost = min(row.cost for row in rows if row.accepted)
    return Run(
        F=F,
        error_px=float(np.sqrt(2.0 * cost / (4.0 * len(x1)))),
        evaluations=len(rows),
        seconds=clock[-1] - clock[0],
        step_seconds=float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0,
        broke=broke,
    )


@dataclass
class Study(Experiments):
    """Experiments on two views; simulated runs are made once and remembered.

    The data are the directory of the measured image pairs.
    """

    trials: int = 25
    _scenes: dict[Setup, TwoViewScene] = field(default_factory=dict)
    _runs: dict[tuple[Any, ...], Run] = field(default_factory=dict)

    def setups(self, **configuration: Any) -> list[Setup]:
        """Return the trials of one configuration."""
        return [Setup(self.seed + k, **configuration) for k in range(self.trials)]

    def scene(self, setup: Setup) -> TwoViewScene:
        """Return the scene of a trial."""
        if setup not in self._scenes:
            self._scenes[setup] = setup.scene()
        return self._scenes[setup]

    def initial(self, setup: Setup) -> Array:
        """Return INIT, the 8-point estimate of a trial."""
        scene = self.scene(setup)
        return fundamental_8point(scene.x1, scene.x2)

    def initial_error(self, setup: Setup) -> float:
        """Return the reprojection error of INIT."""
        scene = self.scene(setup)
        return reprojection_rms(self.initial(setup), scene.x1, scene.x2)

    def run(
        self,
        setup: Setup,
        method: Method,
        damping: str = LM,
        xi: float = XI,
        after: Method | None = None,
    ) -> Run:
        """Run a method from INIT, or from the result of another method that started there."""
        key = (setup, method, damping, xi, after)
        if key not in self._runs:
            scene = self.scene(setup)
            F0 = self.initial(setup) if after is None else self.run(setup, after, damping, xi).F
            self._runs[key] = converge(scene.x1, scene.x2, F0, method, damping, xi)
        return self._runs[key]
