"""Table 3 of B&S: how often a method is not improved by any other one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from epigauge.reproduce.common import DISTANCES, ELIMINATED, LM, METHODS, SEBER, XI, Setup, Study
from epigauge.reproduce.figures import Panel, curves
from epigauge.reproduce.report import Claim, Picture, Section, Table, lower

__all__ = ["methods_section", "success", "table3"]

Array = NDArray[np.float64]

#: B&S Table 3, success in percent; FREE and NORM share a line.
PAPER_SUCCESS = {
    "ORTHO": (83, 97, 97, 100, 100, 98, 100, 99),
    "MAPS": (88, 95, 96, 100, 100, 99, 98, 99),
    "PARFREE": (100, 100, 94, 100, 100, 100, 100, 100),
    "FREE": (100,) * 8,
    "NORM": (100,) * 8,
}

#: Dampings, and thresholds from the upper half of the paper's range 1e-8 to 1e-4.
_CASES = ((LM, "LM", 1e-4), (LM, "LM", XI), (SEBER, "SEBER", XI))


def success(E_initial: Array, E_after: Array, xi: float) -> NDArray[np.bool_]:
    """Tell which methods were successful in a trial (B&S section 5.1.3).

    Success(M) iff for all M' != M: |E_M(INIT) - E_M(M')| <= xi. The paper prints E_M(M) for
    E_M(M'), which would make the quantifier void; its sentence "not improved by any of the other
    compared methods" and its definition of E_M(M') leave no doubt.

    Parameters
    ----------
    E_initial : ndarray, shape (k,)
        E_M(INIT), the error of method M started from the initial estimate.
    E_after : ndarray, shape (k, k)
        Entry (M, M') is E_M(M'), the error of M started from the result of M'. The diagonal is
        not looked at.
    xi : float
        Threshold, the one that stops the iterations.

    Returns
    -------
    ndarray of bool, shape (k,)
        Success of each method.
    """
    agrees = np.abs(E_initial[:, None] - E_after) <= xi
    np.fill_diagonal(agrees, True)
    return np.asarray(agrees.all(axis=1))


def restarted(study: Study, setup: Setup, damping: str, xi: float) -> Array:
    """Return the error of each method (rows) started where each other one (columns) ended."""
    return np.array(
        [
            [study.run(setup, M, damping, xi, after=other).error_px for other in METHODS]
            for M in METHODS
        ]
    )


def table3(study: Study) -> Section:
    """Run Table 3 with the paper's definition.

    Parameters
    ----------
    study : Study
        Trials.

    Returns
    -------
    Section
        The experiment.
    """
    names = [method.label for method in METHODS]
    rates = {}
    broken = {}
    for damping, label, xi in _CASES:
        case = f"{label}, xi = {xi:g}"
        found = np.zeros((len(DISTANCES), study.trials, len(METHODS)))
        count = np.zeros(len(METHODS), dtype=int)
        for i, distance in enumerate(study.track(DISTANCES, f"success, {case}")):
            for k, setup in enumerate(study.setups(distance=distance)):
                runs = [study.run(setup, method, damping, xi) for method in METHODS]
                errors = np.array([run.error_px for run in runs])
                found[i, k] = success(errors, restarted(study, setup, damping, xi), xi)
                count += [run.broke for run in runs]
        rates[case] = 100.0 * found.mean(axis=1).T
        broken[case] = count
    columns = [f"{distance} m" for distance in DISTANCES]
    rows: list[tuple[str | float, ...]] = [
        ("paper", name, *map(float, PAPER_SUCCESS[name]), float(np.mean(PAPER_SUCCESS[name])))
        for name in names
    ]
    rows += [
        (case, name, *map(float, rate), float(rate.mean()))
        for case, rates_of_case in rates.items()
        for name, rate in zip(names, rates_of_case, strict=True)
    ]
    table = Table(
        "table3",
        f"Success in percent of {study.trials} trials.",
        ("case", "method", *columns, "mean"),
        rows,
        ("", "", ".0f", ".0f", ".0f", ".0f", ".0f", ".0f", ".0f", ".0f", ".1f"),
    )
    stops = Table(
        "table3_breakdowns",
        f"Runs from INIT of {len(DISTANCES) * study.trials} that a singular matrix ended.",
        ("case", *names),
        [(case, *map(int, count)) for case, count in broken.items()],
    )
    standard = rates[f"LM, xi = {XI:g}"]
    axis = ("distance scene to cameras (m)", "success (%)")
    figure = curves(
        [
            Panel("Paper", *axis, DISTANCES, PAPER_SUCCESS, "", (0.0, 104.0)),
            *[
                Panel(
                    f"epigauge, {case}",
                    *axis,
                    DISTANCES,
                    dict(zip(names, rates[case], strict=True)),
                    "",
                    (0.0, 104.0),
                )
                for case in ("LM, xi = 0.0001", f"LM, xi = {XI:g}")
            ],
        ]
    )
    claims = []
    for case, rate in rates.items():
        mean = dict(zip(names, rate.mean(axis=1), strict=True))
        minimal = max(mean["ORTHO"], mean["MAPS"])
        redundant = min(mean["PARFREE"], mean["FREE"], mean["NORM"])
        numbers = ", ".join(f"{name} {value:.1f} %" for name, value in mean.items())
        claims.append(
            Claim(
                "Table 3, 5.1.3",
                f"methods with minimal parameters fall into local minima more often ({case})",
                lower(minimal, redundant, 0.01),
                f"mean success: {numbers}",
            )
        )
    near, far = standard[:, :2].mean(), standard[:, -2:].mean()
    trend = {True: "falls with", False: "grows with", None: "does not depend on"}
    minimal = np.mean([PAPER_SUCCESS[name] for name in ("ORTHO", "MAPS")], axis=0)
    near_there, far_there = minimal[:2].mean(), minimal[-2:].mean()
    return Section(
        "Table 3: success rates",
        [
            "Success(M) iff for every other method M': |E_M(INIT) - E_M(M')| <= xi, where E_M(M') "
            "is the error that M reaches from the result of M'. The paper's formula prints E_M(M) "
            "where its definition needs E_M(M'). Errors are in pixels and xi is the threshold that "
            "stops the iterations, as in the paper, which does not say which value of its range "
            "1e-8 to 1e-4 it took: the upper end and the middle are shown. A run that stops early "
            "where the cost is flat counts as improved by a longer one, so the rates measure slow "
            "convergence together with local minima; the smaller xi, the more they do.",
            Picture("table3", "Success against distance.", figure),
            table,
            stops,
            f"With LM and xi = {XI:g} the mean rate of all methods is {near:.0f} % at 6 and 8 m "
            f"and {far:.0f} % at 18 and 20 m: it {trend[lower(far, near, 0.02)]} the distance. In "
            f"the paper that of the minimal methods is {near_there:.0f} % and {far_there:.0f} %: "
            f"it {trend[lower(far_there, near_there, 0.02)]} it.",
        ],
        claims,
    )


def methods_section(study: Study) -> Section:
    """Compare evaluations and success of all methods, with those the paper does not have.

    Parameters
    ----------
    study : Study
        Trials.

    Returns
    -------
    Section
        The experiment.
    """
    methods = (*METHODS, *ELIMINATED)
    shape = (len(methods), len(DISTANCES), study.trials)
    errors, evaluations, seconds = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for i, distance in enumerate(study.track(DISTANCES, "all methods")):
        for j, setup in enumerate(study.setups(distance=distance)):
            for k, method in enumerate(methods):
                run = study.run(setup, method, LM, 1e-8)
                errors[k, i, j] = run.error_px
                evaluations[k, i, j] = run.evaluations
                seconds[k, i, j] = run.seconds
    reached = 100.0 * (errors <= errors.min(axis=0) + XI).mean(axis=2)
    counts = evaluations.mean(axis=2)
    milliseconds = 1e3 * np.median(seconds, axis=2)
    names = [method.label for method in methods]

    def table(name: str, caption: str, values: Array, form: str) -> Table:
        rows: list[tuple[str | float, ...]] = [
            (method, *map(float, row), float(row.mean()))
            for method, row in zip(names, values, strict=True)
        ]
        header = ("method", *[f"{distance} m" for distance in DISTANCES], "mean")
        return Table(name, caption, header, rows, ("", form))

    def by_name(values: Array) -> dict[str, Sequence[float]]:
        return dict(zip(names, values.tolist(), strict=True))

    axis = "distance scene to cameras (m)"
    figure = curves(
        [
            Panel("Evaluations, mean", axis, "evaluations", DISTANCES, by_name(counts), "y"),
            Panel("Lowest error reached", axis, "trials (%)", DISTANCES, by_name(reached)),
        ]
    )
    exact = names.index("ORTHO eliminated, exact Hessian")
    others = [k for k in range(len(names)) if not names[k].endswith("exact Hessian")]
    fewest = counts.mean(axis=1)
    best = reached.mean(axis=1)
    cheapest = milliseconds.mean(axis=1)
    return Section(
        "All methods: evaluations and success",
        [
            "LM and xi = 1e-8, from INIT. A method succeeds here if its error is within 1e-6 px of "
            "the lowest that any of these methods reached in the trial.",
            Picture("methods", "Evaluations and success of all methods.", figure),
            table("methods_evaluations", "Mean evaluations of the cost.", counts, ".1f"),
            table("methods_success", "Trials with the lowest error, percent.", reached, ".0f"),
            table("methods_milliseconds", "Median time, ms.", milliseconds, ".3f"),
        ],
        [
            Claim(
                "not in the paper",
                "ORTHO eliminated with exact Hessian needs the fewest evaluations",
                lower(fewest[exact], fewest[others].min(), 0.02),
                f"{fewest[exact]:.1f} on average over the distances; BLOCK likewise "
                f"{fewest[-1]:.1f}; best of the others {fewest[others].min():.1f} "
                f"({names[others[int(np.argmin(fewest[others]))]]})",
            ),
            Claim(
                "not in the paper",
                "ORTHO eliminated with exact Hessian reaches the lowest error most often",
                lower(-best[exact], -best[others].max(), 0.01),
                f"{best[exact]:.1f} % of the trials; BLOCK likewise {best[-1]:.1f} %; best of the "
                f"others {best[others].max():.1f} % "
                f"({names[others[int(np.argmax(best[others]))]]})",
            ),
            Claim(
                "not in the paper",
                "ORTHO eliminated with exact Hessian takes the least time",
                lower(cheapest[exact], cheapest[others].min(), 0.1),
                f"{cheapest[exact]:.3f} ms; BLOCK likewise {cheapest[-1]:.3f} ms; best of the "
                f"others {cheapest[others].min():.3f} ms "
                f"({names[others[int(np.argmin(cheapest[others]))]]})",
            ),
        ],
    )
