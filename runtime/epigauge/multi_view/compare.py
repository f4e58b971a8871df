"""All methods on the same tracks from the same start."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal, Unpack, cast

from epigauge import lm
from epigauge._arguments import as_choice
from epigauge._options import AdjustOptions, Method, known_options
from epigauge._results import Result
from epigauge.bundle.run import PROJECTIVE_ONLY
from epigauge.bundle.strategies import STRATEGIES
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.multi_view.adjust import bundle_adjust
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["ComparedMethod", "Comparison", "compare"]


@dataclass(frozen=True)
class ComparedMethod:
    """How one method did; the fields are those of `BundleResult`.

    Attributes
    ----------
    seconds : float
        Time of the adjustment, the common start not counted.
    """

    method: str
    nfev: int
    nit: int
    rms_px: float
    cost: float
    seconds: float
    status: int
    success: bool
    flags: tuple[str, ...]
    message: str
    history: tuple[lm.Row, ...] = field(repr=False)


@dataclass(frozen=True)
class Comparison(Result):
    """Methods side by side.

    Attributes
    ----------
    rows : tuple of ComparedMethod
        One a method, in the order asked for.
    start_rms_px : float
        RMS of the common start.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> result = eg.compare(tracks, ["covariant", "free"])
    >>> [(row.method, row.success) for row in result.rows]
    [('covariant', True), ('free', True)]
    """

    rows: tuple[ComparedMethod, ...]
    start_rms_px: float

    def _heading(self) -> str:
        return f"Comparison: {len(self.rows)} methods from a start of {self.start_rms_px:.6g} px"

    def _summary_rows(self) -> dict[str, str]:
        return {
            row.method: f"{row.rms_px:.6f} px RMS, {row.nfev} evaluations, {row.seconds:.2f} s: "
            f"{row.message}"
            for row in self.rows
        }

    def _arrays(self) -> dict[str, Any]:
        names = [f.name for f in fields(ComparedMethod) if f.name not in ("flags", "history")]
        arrays: dict[str, Any] = {name: [getattr(r, name) for r in self.rows] for name in names}
        arrays["flags"] = ["; ".join(row.flags) for row in self.rows]
        histories = {f"{row.method}_history": row.history for row in self.rows}
        return arrays | histories | {"start_rms_px": self.start_rms_px}

    def to_markdown(self) -> str:
        """Return a table in Markdown.

        Returns
        -------
        str
            One line a method.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.multi_view_scene(n_views=4, n_points=20, seed=1)
        >>> found = eg.compare(scene.tracks, methods=["covariant"])
        >>> found.to_markdown().count("covariant")
        1
        """
        head = ("method", "evaluations", "steps", "RMS (px)", "cost (px^2)", "seconds", "end")
        lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * 5 + "---|"]
        lines += [
            f"| {row.method} | {row.nfev} | {row.nit} | {row.rms_px:.6f} | {row.cost:.8g} "
            f"| {row.seconds:.2f} | {row.message} |"
            for row in self.rows
        ]
        return "\n".join(lines) + "\n"

    def plot(self, title: str = "") -> Figure:
        """Draw the lowest cost so far of each method, by evaluations.

        Parameters
        ----------
        title : str
            What to call the tracks.

        Returns
        -------
        matplotlib.figure.Figure
            That of `plots.plot_comparison`.
        """
        from epigauge.plots import plot_comparison

        return plot_comparison(self, title)


def compare(
    tracks: Tracks,
    methods: Literal["all"] | Sequence[Method] = "all",
    start: Reconstruction | MetricReconstruction | None = None,
    *,
    on_method: Callable[[str], object] | None = None,
    **options: Unpack[AdjustOptions],
) -> Comparison:
    """Adjust the same tracks from the same start by several methods.

    Parameters
    ----------
    tracks : Tracks
        Observations.
    methods : "all" or sequence of str
        Names of strategies, see `bundle_adjust`.
    start : Reconstruction or MetricReconstruction, optional
        Where all begin; by default `initialize(tracks)`.
    on_method : callable, optional
        Called with the name of each method before it runs; a true return value leaves out this
        one and the rest, but never the first.
    **options
        For `bundle_adjust`, the same for all.

    Returns
    -------
    Comparison
        Rows of plain data; `Comparison.to_markdown`, `Comparison.plot`.

    Raises
    ------
    ArgumentError
        On unknown or repeated names, and as `bundle_adjust`.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.multi_view_scene(seed=1).tracks
    >>> table = eg.compare(tracks, ["covariant", "free"])
    >>> [row.method for row in table.rows if row.success]
    ['covariant', 'free']
    """
    known = known_options("compare", options, AdjustOptions)
    names: str | Sequence[str] = methods
    if methods == "all":
        metric = isinstance(start, MetricReconstruction)
        names = [name for name in STRATEGIES if not (metric and name in PROJECTIVE_ONLY)]
    if isinstance(names, str) or not names or len(set(names)) != len(names):
        raise ArgumentError("methods", f"is {methods!r}", '"all" or a list of different names')
    for name in names:
        as_choice("methods", name, STRATEGIES)
    chosen = cast(Sequence[Method], names)
    if start is None:
        start = initialize(tracks, backend=known.get("backend"))
    rows: list[ComparedMethod] = []
    for name in chosen:
        if on_method is not None and on_method(name) and rows:
            break
        begin = time.perf_counter()
        result = bundle_adjust(tracks, start, method=name, **known)
        seconds = time.perf_counter() - begin
        rows.append(
            ComparedMethod(
                name,
                result.nfev,
                result.nit,
                result.rms_px,
                result.cost,
                seconds,
                result.status,
                result.success,
                result.flags,
                result.message,
                result.history,
            )
        )
    return Comparison(tuple(rows), start.rms_px(tracks))
