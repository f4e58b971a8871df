"""``epigauge demo``: the methods side by side on the simulated scenes of both papers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

import epigauge as eg
from epigauge._arguments import as_count
from epigauge.cli._common import NOT_CONVERGED, Json, console, shown, write_json
from epigauge.cli._demo_many import compare_many_views
from epigauge.errors import MissingPackageError
from epigauge.scenes import TwoViewScene, two_view_scene

#: The compared methods: name and the options of `refine_fundamental`.
METHODS: dict[str, dict[str, Any]] = {
    "joint": {"structure": "joint"},
    "eliminated, Gauss-Newton": {"hessian": "gauss-newton"},
    "eliminated, Newton": {},
}
_POINTS = 50
_START, _DEFAULT = "8-point, the start", "eliminated, Newton"


@dataclass
class Trials:
    """What was measured of one method, one entry a trial."""

    evaluations: list[int] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)
    error_px: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the pictures; made if absent.")
    ] = Path(),
    distance: Annotated[float, typer.Option(help="Cameras to points, in metres.")] = 10.0,
    trials: Annotated[int, typer.Option(help="Scenes to average over.")] = 20,
    no_plot: Annotated[bool, typer.Option("--no-plot", help="Draw no pictures.")] = False,
    json: Json = False,
) -> int:
    """Compare the methods on the simulated scenes of both papers.

    50 points in a cube of one metre, two cameras one metre apart that look at
    it from 10 m, noise of 2 pixels variance (their section 5.1.1). Every method
    starts from the same 8-point estimate; "joint" moves cameras and points,
    "eliminated" the fundamental matrix alone.

    Then 100 points in a slab 0.2 m thick in five views three metres apart, and
    bundle adjustment by several strategies (Bartoli, section 7.1).
    """
    as_count("--trials", trials)
    out = console()
    found = {name: Trials() for name in (_START, *METHODS)}
    seeds = range(trials)
    watched = out.is_terminal and not json
    for seed in track(seeds, "solving", console=out, transient=True) if watched else seeds:
        scene = two_view_scene(distance, n_points=_POINTS, seed=seed)
        F0 = _timed(found[_START], scene, eg.fundamental_8point)
        for name, options in METHODS.items():
            _timed(found[name], scene, eg.refine_fundamental, F0, **options)
    if not json:
        out.print(_table(found, distance, trials))
    picture = None if no_plot else _picture(output, two_view_scene(distance, n_points=_POINTS), out)
    code, many_views = compare_many_views(None if json else out, picture and picture.parent)
    if json:
        rows = {name: vars(measured) for name, measured in found.items()}
        two_views = {"distance": distance, "methods": rows, "picture": picture and str(picture)}
        write_json(two_views | {"many_views": many_views})
    return code if all(found[_DEFAULT].converged) else NOT_CONVERGED


def _timed(
    measured: Trials, scene: TwoViewScene, solve: Callable[..., Any], *start: Any, **options: Any
) -> Any:
    """Solve one scene, note cost, error and time, and return F."""
    begin = time.perf_counter()
    result = solve(scene.x1, scene.x2, *start, **options)
    measured.milliseconds.append(1e3 * (time.perf_counter() - begin))
    refined = isinstance(result, eg.FundamentalResult)
    F = result.F if refined else result
    d = eg.reprojection_distances(F, scene.x1, scene.x2)[0]
    true = eg.reprojection_distances(F, scene.x1_true, scene.x2_true)[0]
    measured.cost.append(float(0.5 * d @ d))
    measured.error_px.append(float(np.sqrt(np.mean(true**2))))
    measured.evaluations.append(result.nfev if refined else 0)
    measured.converged.append(result.status > 0 if refined else True)
    return F


def _table(found: dict[str, Trials], distance: float, trials: int) -> Table:
    """Put the means side by side."""
    scenes = "1 scene" if trials == 1 else f"mean of {trials} scenes"
    table = Table(
        title=f"{_POINTS} points at {distance:g} m, noise of 2 px variance, {scenes}",
        title_justify="left",
        caption="evals: evaluations of the cost; RMS: of the residual coordinates;\n"
        "error: RMS distance of the true points to the geometry found;\n"
        "ms: median time of one estimate",
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("method")
    for heading in ("evals", "cost px^2", "RMS px", "error px", "ms"):
        table.add_column(heading, justify="right")
    for name, measured in found.items():
        cost = np.array(measured.cost)
        evaluations = float(np.mean(measured.evaluations))
        table.add_row(
            name,
            f"{evaluations:.1f}" if evaluations else "-",
            f"{cost.mean():.4f}",
            f"{np.sqrt(2 * cost / (4 * _POINTS)).mean():.5f}",
            f"{np.mean(measured.error_px):.4f}",
            f"{np.median(measured.milliseconds):.2f}",
            style="bold" if name == _DEFAULT else None,
        )
    return table


def _picture(directory: Path, scene: TwoViewScene, out: Console) -> Path | None:
    """Draw the first scene; without Matplotlib say how to get it."""
    from epigauge.plots import plot_refinement, save_figure

    result = eg.refine_fundamental(scene.x1, scene.x2, noise_px=None)
    try:
        figure = plot_refinement(result, scene.x1, scene.x2)
    except MissingPackageError as error:
        out.print(f"no picture: {escape(str(error))}")
        return None
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "epigauge-demo.png"
    save_figure(figure, path)
    out.print(f"picture: {escape(shown(path))}", soft_wrap=True)
    return path
