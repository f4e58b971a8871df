"""The common look of the pictures, and how they are written."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from epigauge.errors import MissingPackageError
from epigauge.io._common import PathLike, check_suffix
from epigauge.io.output import writing
from epigauge.lm import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Letters of a heading that fit over a picture.
_LETTERS = 112
GREY, BLUE, RED = "0.45", "#2a6f97", "#c1121f"


def need_matplotlib() -> None:
    """Say how to get Matplotlib where it is not installed."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise MissingPackageError("matplotlib", "plot") from None


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, or say how to get Matplotlib."""
    need_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1, hspace=0.04)
    return Figure(figsize=(width, height), dpi=110, layout=layout)


def heading(figure: Figure, text: str, failure: str = "", flags: Sequence[str] = ()) -> None:
    """Write over the picture what was done and, in red, its flags and why it did not converge."""
    text += f"  (not converged: {failure})" if failure else ""
    text += f"\n{', '.join(flags)}" if flags else ""
    text = "\n".join(line for part in text.splitlines() for line in wrap(part, _LETTERS) or [""])
    colour = RED if failure or flags else "black"
    figure.suptitle(text, x=0.01, ha="left", fontsize=13, color=colour)


def save_figure(figure: Figure, path: PathLike) -> None:
    """Write a picture as PNG, PDF or SVG; the same picture gives the same bytes.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        The picture.
    path : str or path
        The file; ``.png``, ``.pdf`` or ``.svg`` chooses the form.

    Raises
    ------
    ArgumentError
        If the suffix is none of these.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> save_figure(result.plot(x1, x2), "refined.png")  # doctest: +SKIP
    """
    suffix = check_suffix(path, ".png", ".pdf", ".svg")
    with writing(path) as file:
        write_figure(figure, file, suffix[1:])


def write_figure(figure: Figure, file: IO[bytes], form: str) -> None:
    """Write a picture without the time and the program that made it."""
    from matplotlib import rc_context

    undated: dict[str, dict[str, Any]] = {
        "png": {"Software": None},
        "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
        "svg": {"Date": None, "Creator": None},
    }
    with rc_context({"svg.hashsalt": "epigauge"}):
        figure.savefig(file, format=form, metadata=undated[form])


def draw_history(axes: Axes, history: Sequence[Row]) -> None:
    """Draw the cost of each evaluation, less the lowest, accepted and rejected steps apart."""
    cost = np.array([row.cost for row in history], dtype=np.float64)
    accepted = np.array([row.accepted for row in history], dtype=np.bool_)
    accepted[:1] = True  # the start
    shown = np.isfinite(cost)
    lowest = float(cost[accepted & shown].min(initial=np.inf))
    above = np.where(shown, cost - lowest, np.nan)
    positive = above[above > 0.0]
    floor = float(positive.min()) / 4.0 if len(positive) else 1.0
    at = np.arange(1, len(cost) + 1)
    drawn = np.maximum(above, floor)
    axes.plot(at[accepted], drawn[accepted], "-", color=BLUE, lw=1.4, zorder=2)
    higher = accepted & (above > 0.0)
    style = {"ls": "", "color": BLUE, "ms": 6}
    axes.plot(at[higher], drawn[higher], marker="o", label="accepted", **style)  # type: ignore[arg-type]
    last = accepted & ~(above > 0.0)
    label = f"lowest: {lowest:.6g} px\N{SUPERSCRIPT TWO}"
    axes.plot(at[last], drawn[last], marker="v", label=label, **style | {"ms": 8})  # type: ignore[arg-type]
    rejected = ~accepted & shown
    if rejected.any():
        cross = {"ls": "", "marker": "x", "color": RED, "ms": 7, "mew": 1.8}
        axes.plot(at[rejected], drawn[rejected], label="rejected", **cross)  # type: ignore[arg-type]
    axes.set_yscale("log")
    count_whole(axes, "x")
    axes.set(xlabel="evaluation", ylabel="cost above the lowest (px\N{SUPERSCRIPT TWO})")
    finish(axes, "Convergence")


def count_whole(axes: Axes, which: str = "y") -> None:
    """Let the ticks of axes on which things are counted, x, y or both, be whole numbers."""
    from matplotlib.ticker import MaxNLocator

    for axis in which:
        ticks = MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True, min_n_ticks=1)
        getattr(axes, f"{axis}axis").set_major_locator(ticks)


def finish(axes: Axes, title: str, legend: bool = True, place: Any = "best") -> None:
    """Give a panel of curves the common look."""
    axes.set_title(title, loc="left", fontsize=11)
    axes.grid(color="0.9", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.6")
    axes.tick_params(which="both", labelsize=8, color=GREY)
    if legend:
        axes.legend(fontsize=9, frameon=False, loc=place)
