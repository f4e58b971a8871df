"""Picture of methods side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from epigauge.bundle.strategies import STRATEGIES
from epigauge.plots._style import GREY, RED, count_whole, finish, heading, new_figure
from epigauge.verdicts import ordered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from epigauge.multi_view.compare import ComparedMethod, Comparison

__all__ = ["plot_comparison"]

Array = NDArray[np.float64]

_WIDTH = 11.0  # inches
#: Decades of cost within which two curves are one line to the eye.
_APART = 0.05
#: Length of a dash, in line widths.
_DASH = 3.0
#: Colour-blind safe (Okabe and Ito) and told apart by markers and dashes, too; one a strategy.
_LOOKS: dict[str, dict[str, Any]] = {
    name: {"color": colour, "marker": marker, "ls": dashes}
    for name, colour, marker, dashes in zip(
        STRATEGIES,
        (
            *("#000000", "#7f7f7f", "#56b4e9", "#009e73", "#0072b2", "#cc79a7", "#e69f00"),
            *("#8c6d46", "#6a4c93", "#b0b0b0", "#d1002c"),
        ),
        "vs^D<>PXdpo",
        ("-", "--", "-", "-", "--", "-", "-", ":", "-", "-", "-"),
        strict=True,
    )
}
_SQUARED_PX = "px\N{SUPERSCRIPT TWO}"


def plot_comparison(comparison: Comparison, title: str = "") -> Figure:
    """Show for each method the lowest cost so far, less the best of all, by evaluations.

    Beside the curves a table of the methods, the one with the fewest evaluations first and those
    that did not converge last.

    Parameters
    ----------
    comparison : Comparison
        What `compare` returned.
    title : str
        What to call the tracks.

    Returns
    -------
    matplotlib.figure.Figure
        The picture, not yet drawn: see `save_figure`.

    Raises
    ------
    MissingPackageError
        If Matplotlib is not installed.

    Examples
    --------
    >>> plot_comparison(eg.compare(tracks))  # doctest: +SKIP
    """
    figure = new_figure(_WIDTH, 5.6)
    flags = ordered(flag for row in comparison.rows for flag in row.flags)
    heading(figure, "Convergence of the methods" + (f": {title}" if title else ""), flags=flags)
    axes, table = figure.subplots(1, 2, width_ratios=(1.4, 1.0))
    best = min((row.cost for row in comparison.rows if np.isfinite(row.cost)), default=0.0)
    # Below this the costs of two converged runs do not differ by anything but where they stopped.
    floor = max(best * 1e-9, 1e-300)
    curves = [_curve(row, best, floor) for row in comparison.rows]
    for row, curve, (place, shared) in zip(comparison.rows, curves, _shared(curves), strict=True):
        _draw_method(axes, row, curve, place, shared)
    axes.axhline(floor, color=GREY, lw=0.8, ls=":")
    axes.annotate(
        "no difference: 10\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT NINE} of the best cost",
        *((0.0, floor), (4, -3)),  # no curve goes below
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        va="top",
        fontsize=8,
        color=GREY,
    )
    axes.set(yscale="log", xlabel="evaluations of the cost")
    highest = max(float(curve[np.isfinite(curve)].max(initial=floor)) for curve in curves)
    axes.set_ylim(bottom=floor * (floor / highest) ** 0.08 / 1.2)
    axes.set(ylabel=f"lowest cost so far, above the best ({_SQUARED_PX})")
    count_whole(axes, "x")
    slowest = max(row.nfev for row in comparison.rows)
    if slowest > 30:
        ticks = [tick for tick in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if tick <= slowest]
        axes.set(xscale="log")
        axes.set_xticks(ticks, list(map(str, ticks)))
        axes.set_xticks([], minor=True)
    best_cost = f"best cost {best:.7g} {_SQUARED_PX}"
    finish(axes, f"{best_cost}, start RMS {comparison.start_rms_px:.4g} px", legend=False)
    _draw_table(table, sorted(comparison.rows, key=lambda row: (not row.success, row.nfev)))
    return figure


def _curve(row: ComparedMethod, best: float, floor: float) -> Array:
    """Return the lowest cost so far of one method, above the best."""
    costs = np.array(
        [np.inf if not r.accepted and i else r.cost for i, r in enumerate(row.history)]
    )
    return np.asarray(np.maximum(np.minimum.accumulate(costs) - best, floor))


def _shared(curves: list[Array]) -> list[tuple[int, int]]:
    """Return of each curve which one it is of how many that coincide in the picture."""
    groups: list[list[int]] = []
    for k, curve in enumerate(curves):
        for group in groups:
            other = curves[group[0]]
            n = min(len(curve), len(other))
            if np.abs(np.log10(curve[:n]) - np.log10(other[:n])).max() < _APART:
                group.append(k)
                break
        else:
            groups.append([k])
    places = {k: (i, len(group)) for group in groups for i, k in enumerate(group)}
    return [places[k] for k in range(len(curves))]


def _draw_method(
    axes: Axes, row: ComparedMethod, above: Array, place: int = 0, shared: int = 1
) -> None:
    """Draw one method, with a mark where it ended; curves that coincide take turns in dashes.

    Their marks lie in one another, the last one's smallest.
    """
    at = np.arange(1, len(above) + 1)
    look = _look(row.method)
    if shared > 1:
        look |= {"ls": (_DASH * place, (_DASH, _DASH * (shared - 1)))}
        look |= {"ms": look["ms"] + 2.2 * (shared - 1 - place), "dash_capstyle": "butt"}
        look |= {"zorder": look["zorder"] + 0.1 * place}
        look["lw"] = 2.2
    axes.plot(at, above, markevery=max(1, len(above) // 12), label=f"_{row.method}", **look)
    end = {"marker": "o", "ms": look["ms"] + 5, "mfc": "none", "mew": 1.2}
    if not row.success:
        end |= {"marker": "x"}
    axes.plot(at[-1:], above[-1:], ls="", color=look["color"], zorder=look["zorder"], **end)


def _look(method: str) -> dict[str, Any]:
    """Return how a method's curve is drawn, the default method's over the others."""
    strong = method == "covariant"
    size = {"lw": 2.8, "ms": 6.5, "zorder": 5} if strong else {"lw": 1.5, "ms": 4.5, "zorder": 3}
    return _LOOKS[method] | size


def _draw_table(axes: Axes, rows: list[ComparedMethod]) -> None:
    """Draw a row a method: its line, its name, evaluations, seconds and RMS."""
    axes.axis("off")
    axes.set(xlim=(0.0, 1.0), ylim=(max(len(rows), 8) + 0.8, -1.0))
    right = (0.64, 0.79, 1.0)
    for x, name in zip(right, ("evals", "seconds", "RMS px"), strict=True):
        axes.text(x, -0.35, name, ha="right", va="center", fontsize=9, color=GREY)
    axes.text(0.13, -0.35, "method", va="center", fontsize=9, color=GREY)
    axes.plot([0.0, 1.0], [0.1, 0.1], color="0.8", lw=0.8)
    for k, row in enumerate(rows):
        y = k + 0.6
        axes.plot([0.0, 0.05, 0.1], [y] * 3, markevery=[1], label=row.method, **_look(row.method))
        style: dict[str, Any] = {
            "va": "center",
            "fontsize": 9.5,
            "weight": "bold" if row.method == "covariant" else "normal",
            "color": "black" if row.success else RED,
        }
        axes.text(0.13, y, row.method, **style)
        for x, text in zip(
            right, (f"{row.nfev}", f"{row.seconds:.3f}", f"{row.rms_px:.6f}"), strict=True
        ):
            axes.text(x, y, text, ha="right", **style)
    ends = "\N{WHITE CIRCLE} converged"
    if not all(row.success for row in rows):
        ends += ", red and \N{MULTIPLICATION SIGN} not converged"
    axes.text(0.13, len(rows) + 0.6, ends, va="center", fontsize=9, color=GREY)
