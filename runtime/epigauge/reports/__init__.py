"""Reports in HTML, each one file that needs nothing else: no network, no other file."""

from epigauge.reports.pair import save_pair_report
from epigauge.reports.picture import save_picture_page
from epigauge.reports.viewer import save_viewer

__all__ = ["save_pair_report", "save_picture_page", "save_viewer"]
