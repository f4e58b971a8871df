"""Pictures of results, by Matplotlib without its global state.

Matplotlib is imported only when a picture is made: ``pip install 'epigauge[plot]'``.
"""

from epigauge.plots._style import save_figure
from epigauge.plots.comparison import plot_comparison
from epigauge.plots.many_views import plot_bundle
from epigauge.plots.pair import plot_pair
from epigauge.plots.precision import plot_precision
from epigauge.plots.results import plot_result
from epigauge.plots.two_views import plot_refinement

__all__ = [
    "plot_bundle",
    "plot_comparison",
    "plot_pair",
    "plot_precision",
    "plot_refinement",
    "plot_result",
    "save_figure",
]
