"""Pictures of the experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from epigauge.errors import MissingPackageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["STYLES", "Panel", "curves"]

#: Line of each method, told apart by colour, marker and dashes.
STYLES: dict[str, dict[str, Any]] = {
    "INIT": {"color": "0.6", "marker": "s", "ls": ":"},
    "ORTHO": {"color": "#c1121f", "marker": "o", "ls": "-"},
    "MAPS": {"color": "#f4a259", "marker": "^", "ls": "--"},
    "PARFREE": {"color": "#2a6f97", "marker": "D", "ls": "-."},
    "FREE": {"color": "#4daf4a", "marker": "v", "ls": "--"},
    "NORM": {"color": "#7b2d8b", "marker": "P", "ls": "-"},
    "ORTHO eliminated, Gauss-Newton": {"color": "0.45", "marker": "x", "ls": "--"},
    "ORTHO eliminated, exact Hessian": {"color": "black", "marker": "*", "ls": "-"},
    "LEVENBERG": {"color": "0.35", "marker": "s", "ls": ":"},
    "MARQUARDT": {"color": "#8c564b", "marker": "<", "ls": ":"},
    "HARTLEY": {"color": "#2a6f97", "marker": "D", "ls": "-."},
    "BARTOLI": {"color": "#f4a259", "marker": "^", "ls": "--"},
    "FAUGERAS": {"color": "#e377c2", "marker": "h", "ls": "--"},
    "MCLAUCHLAN": {"color": "#7b2d8b", "marker": "P", "ls": "-"},
    "KANATANI": {"color": "#17becf", "marker": "d", "ls": "-."},
    "MCLAUCHLAN, without constraints": {"color": "#7b2d8b", "marker": "1", "ls": ":"},
    "KANATANI, pseudo-inverse": {"color": "#17becf", "marker": "2", "ls": ":"},
    "GAUGE_INVARIANT": {"color": "#c1121f", "marker": "o", "ls": "-"},
    "GAUGE_INVARIANT, rank one": {"color": "#c1121f", "marker": "x", "ls": ":"},
    "GAUGE_INVARIANT, with step 3": {"color": "#c1121f", "marker": "s", "ls": "--"},
    "COVARIANT": {"color": "black", "marker": "*", "ls": "-"},
    "COVARIANT, points not embedded": {"color": "black", "marker": "+", "ls": "--"},
    "BLOCK eliminated, exact Hessian": {"color": "#17becf", "marker": "d", "ls": "-"},
}


class Panel:
    """One diagram: curves over a common abscissa.

    Parameters
    ----------
    title, xlabel, ylabel : str
        Texts.
    x : sequence of float
        Abscissa.
    series : mapping of str to sequence of float
        Ordinates by method; the name chooses the style, up to a ``/`` that begins a remark.
    log : str
        Axes of logarithmic scale: "", "x", "y" or "xy".
    ylim : pair of float, optional
        Range of the ordinate.
    """

    def __init__(
        self,
        title: str,
        xlabel: str,
        ylabel: str,
        x: Sequence[float],
        series: Mapping[str, Sequence[float]],
        log: str = "",
        ylim: tuple[float, float] | None = None,
    ) -> None:
        self.title, self.xlabel, self.ylabel = title, xlabel, ylabel
        self.x, self.series, self.log, self.ylim = x, series, log, ylim

    def draw(self, axes: Axes) -> None:
        """Draw it."""
        from matplotlib.ticker import LogLocator

        for name, y in self.series.items():
            method, _, remark = name.partition("/")
            style = dict(STYLES[method])
            if remark:
                style |= {"ls": ":", "mfc": "white", "alpha": 0.8}
            axes.plot(self.x, y, label=name.replace("/", ", "), lw=1.5, ms=5.5, **style)
        if "x" in self.log:
            axes.set_xscale("log")
        if "y" in self.log:
            axes.set_yscale("log")
        if self.ylim is not None:
            axes.set_ylim(*self.ylim)
        axes.set(xlabel=self.xlabel, ylabel=self.ylabel)
        if "x" in self.log:
            axes.set_xticks(list(self.x), [f"{value:g}" for value in self.x])
        if "y" in self.log:
            low, high = axes.get_ylim()
            subs = (1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)
            axes.yaxis.set_major_locator(LogLocator(subs=subs))
            axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_title(self.title, loc="left", fontsize=11)
        axes.grid(color="0.9", lw=0.7)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=9)


def _columns(panels: int, longest: int) -> int:
    """Return how many columns the legend has room for."""
    return max(1, min(6, panels * 66 // (longest + 8)))


def curves(panels: Sequence[Panel]) -> Figure:
    """Draw panels side by side with one legend.

    Parameters
    ----------
    panels : sequence of Panel
        The diagrams.

    Returns
    -------
    matplotlib.figure.Figure
        The picture.

    Raises
    ------
    MissingPackageError
        If Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError:
        raise MissingPackageError("matplotlib", "plot") from None

    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.08)
    figure = Figure(figsize=(4.7 * len(panels), 4.1), dpi=110, layout=layout)
    labels: dict[str, Any] = {}
    for column, panel in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), column + 1)
        panel.draw(axes)
        lines, names = axes.get_legend_handles_labels()
        labels = dict(zip(names, lines, strict=True)) | labels
    figure.legend(
        list(labels.values()),
        list(labels),
        loc="outside lower center",
        ncols=_columns(len(panels), max(map(len, labels))),
        fontsize=9,
        frameon=False,
    )
    return figure
