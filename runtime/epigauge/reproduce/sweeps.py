"""Figure 1 of B&S: error and time against distance, noise and number of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge.reproduce.common import DISTANCES, LM, METHODS, SEBER, XI, Study
from epigauge.reproduce.figures import Panel, curves
from epigauge.reproduce.report import Claim, Picture, Section, Table, lower

__all__ = ["ERROR_SWEEPS", "TIME_SWEEPS", "Sweep", "error_section", "time_section"]

Array = NDArray[np.float64]

_DAMPINGS = {"LM": LM, "SEBER": SEBER}


@dataclass(frozen=True)
class Sweep:
    """One varied quantity: argument of `Setup`, values, axis; whether the paper has no figure."""

    argument: str
    values: tuple[Any, ...]
    label: str
    log: str = ""
    unseen: bool = False


_DISTANCE = Sweep("distance", DISTANCES, "distance scene to cameras (m)")
_NOISE = Sweep("noise_px", (0.5, 1.0, 2.0**0.5, 2.0, 3.0), "noise, standard deviation (px)")
_POINTS = Sweep("n_points", (10, 20, 50, 100, 200), "number of points", "x")
_FOCAL = Sweep("focal", (500, 750, 1000, 1500, 2000), "focal length (px)", "", unseen=True)
_BASELINE = Sweep("baseline", (1, 1.5, 2, 2.5, 3), "baseline (m)", "", unseen=True)

#: The rows of the figure by panel, and what the paper varies, too, but does not show.
ERROR_SWEEPS = {
    "fig1a": _DISTANCE,
    "fig1c": _NOISE,
    "fig1e": _POINTS,
    "focal_error": _FOCAL,
    "baseline_error": _BASELINE,
}
TIME_SWEEPS = {
    "fig1b": _DISTANCE,
    "fig1d": _NOISE,
    "fig1f": _POINTS,
    "focal_time": _FOCAL,
    "baseline_time": _BASELINE,
}


def error_section(study: Study, name: str) -> Section:
    """Run one error panel: the mean reprojection error of INIT and the five methods.

    Parameters
    ----------
    study : Study
        Trials.
    name : str
        Key of `ERROR_SWEEPS`.

    Returns
    -------
    Section
        The experiment.
    """
    sweep = ERROR_SWEEPS[name]
    errors, initial = _measure(study, sweep, "error_px"), _initial(study, sweep)
    mean = {damping: values.mean(axis=2) for damping, values in errors.items()}
    start = initial.mean(axis=1)
    rows: list[tuple[str | float, ...]] = [
        (label, float(x), float(start[i]), *map(float, mean[label][i]))
        for label in _DAMPINGS
        for i, x in enumerate(sweep.values)
    ]
    names = [method.label for method in METHODS]
    table = Table(
        name,
        f"Mean reprojection error over {study.trials} trials, px.",
        ("damping", sweep.label, "INIT", *names),
        rows,
        ("", "g", ".5f"),
        shown=False,
    )
    # What no method reaches in a trial is not of its making: compare with the best of the trial.
    best = np.minimum.reduce([values.min(axis=1) for values in errors.values()])
    above = {
        f"{method}/{label}" if label == "SEBER" else method: np.maximum(
            (values[:, k] - best).mean(axis=1), 1e-9
        )
        for label, values in errors.items()
        for k, method in enumerate(names)
    }
    figure = curves(
        [
            Panel(
                "Error at convergence, LM",
                sweep.label,
                "reprojection error E (px), mean",
                sweep.values,
                {"INIT": start.tolist()} | dict(zip(names, mean["LM"].T.tolist(), strict=True)),
                sweep.log,
            ),
            Panel(
                "The same, above the best of the trial",
                sweep.label,
                "mean of E - best E (px)",
                sweep.values,
                above,
                sweep.log + "y",
            ),
        ]
    )
    ratio = {label: values / values.min(axis=1, keepdims=True) for label, values in mean.items()}
    spread = {label: float(values.max()) - 1.0 for label, values in ratio.items()}
    worst = {label: names[int(values.max(axis=0).argmax())] for label, values in ratio.items()}
    gain = float(np.mean(1.0 - mean["LM"].mean(axis=1) / start))
    worse = mean["SEBER"].mean() / mean["LM"].mean() - 1.0
    return Section(
        f"{_title(sweep, name)}: error against {sweep.label}",
        [
            "E is the root mean square of all 4 m residual coordinates, averaged over the trials. "
            "On the left as in the paper; on the right what each method leaves on average above "
            "the lowest error that any method and damping reached in the same trial (dotted: "
            f"SEBER). The minimisation lowers the error of INIT by {gain:.1%} on average. All "
            f"start from the 8-point estimate and stop at xi = {XI:g}.",
            Picture(name, f"Error against {sweep.label}.", figure),
            table,
        ],
        [
            Claim(
                f"5.1.2, {_where(sweep, name)}",
                "all methods have roughly the same accuracy",
                spread["LM"] <= 0.01,
                "largest mean error over the lowest of another method: "
                f"{spread['LM']:+.2g} relative with LM ({worst['LM']}), "
                f"{spread['SEBER']:+.2g} with SEBER ({worst['SEBER']})",
            ),
            Claim(
                f"5.1.2, {_where(sweep, name)}",
                "SEBER gives a larger error than LM",
                lower(mean["LM"].mean(), mean["SEBER"].mean(), 1e-3),
                f"mean error with SEBER is {worse:+.2g} relative to LM",
            ),
        ],
    )


def time_section(study: Study, name: str) -> Section:
    """Run one panel of time to convergence.

    Parameters
    ----------
    study : Study
        Trials.
    name : str
        Key of `TIME_SWEEPS`.

    Returns
    -------
    Section
        The experiment.
    """
    sweep = TIME_SWEEPS[name]
    seconds = _measure(study, sweep, "seconds")
    evaluations = _measure(study, sweep, "evaluations")
    names = [method.label for method in METHODS]
    median = {label: 1e3 * np.median(values, axis=2) for label, values in seconds.items()}
    count = {label: values.mean(axis=2) for label, values in evaluations.items()}
    header = ("damping", sweep.label, *names)
    tables = [
        Table(
            f"{name}_{kind}",
            caption,
            header,
            [
                (label, float(x), *map(float, values[label][i]))
                for label in _DAMPINGS
                for i, x in enumerate(sweep.values)
            ],
            ("", "g", form),
            shown=kind == "evaluations",
        )
        for kind, values, form, caption in (
            ("milliseconds", median, ".2f", "Median time to convergence, ms."),
            ("evaluations", count, ".1f", "Mean evaluations of the cost to convergence."),
        )
    ]
    top = 1.25 * max(float(values.max()) for values in median.values())
    low = 0.8 * min(float(values.min()) for values in median.values())
    figure = curves(
        [
            Panel(
                label,
                sweep.label,
                "time (ms), median",
                sweep.values,
                dict(zip(names, median[label].T.tolist(), strict=True)),
                sweep.log + "y",
                (low, top),
            )
            for label in _DAMPINGS
        ]
    )
    # Ratios to ORTHO at each abscissa, their geometric mean
    ratio = {
        label: np.exp(np.log(values / values[:, :1]).mean(axis=0))
        for label, values in median.items()
    }
    text = ", ".join(f"{n} {r:.2f}" for n, r in zip(names, ratio["LM"], strict=True))
    cpu = float(np.exp(np.log(median["SEBER"] / median["LM"]).mean()))
    fewer = float(count["SEBER"].mean() / count["LM"].mean())
    return Section(
        f"{_title(sweep, name)}: time against {sweep.label}",
        [
            "Time of the minimisation alone, from its first to its last evaluation; "
            f"median of {study.trials} trials, because the machine is shared.",
            Picture(name, f"Time against {sweep.label}.", figure),
            *tables,
        ],
        [
            Claim(
                f"5.1.2, {_where(sweep, name)}",
                "FREE and NORM cost most, then PARFREE; MAPS and ORTHO least, about the same",
                in_the_papers_order(ratio["LM"]),
                f"time over that of ORTHO (LM, geometric mean): {text}",
            ),
            Claim(
                f"5.1.2, {_where(sweep, name)}",
                "SEBER costs more than LM",
                lower(1.0, fewer, 0.02),
                f"SEBER over LM: evaluations {fewer:.2f}, time {cpu:.2f}",
            ),
        ],
    )


def _where(sweep: Sweep, name: str) -> str:
    """Return where the paper has a panel."""
    return f"not shown: {sweep.label}" if sweep.unseen else f"Fig. 1 ({name[-1]})"


def _title(sweep: Sweep, name: str) -> str:
    """Return what the section is called."""
    return "Not shown in the paper" if sweep.unseen else f"Figure 1 ({name[-1]})"


def in_the_papers_order(times: Array) -> bool:
    """Tell whether FREE and NORM take longest, then PARFREE, then MAPS and ORTHO."""
    ortho, maps, parfree, free, norm = times
    return bool(min(free, norm) > parfree > max(ortho, maps))


def _measure(study: Study, sweep: Sweep, quantity: str) -> dict[str, Array]:
    """Return a field of `Run`, shape (values, methods, trials), by damping."""
    found = {
        label: np.zeros((len(sweep.values), len(METHODS), study.trials)) for label in _DAMPINGS
    }
    for i, setups in _trials(study, sweep):
        for label, damping in _DAMPINGS.items():
            for k, method in enumerate(METHODS):
                runs = [study.run(setup, method, damping) for setup in setups]
                found[label][i, k] = [getattr(run, quantity) for run in runs]
    return found


def _initial(study: Study, sweep: Sweep) -> Array:
    """Return the error of INIT, shape (values, trials)."""
    return np.array(
        [
            [study.initial_error(setup) for setup in study.setups(**{sweep.argument: value})]
            for value in sweep.values
        ]
    )


def _trials(study: Study, sweep: Sweep) -> Any:
    """Iterate over the index of each value and its trials."""
    configurations = [study.setups(**{sweep.argument: value}) for value in sweep.values]
    return study.track(list(enumerate(configurations)), f"sweep of {sweep.argument}")
