"""What ``epigauge bundle`` does with segments of lines beside points, calibrated or not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import epigauge as eg
from epigauge.cli._tables import save_line_residuals
from epigauge.errors import ArgumentError
from epigauge.io import TrackFile, load_line_tracks
from epigauge.io.line_files import arrays_of_lines

__all__ = ["arrays_beside", "check_kept", "line_facts", "save_residuals_beside", "segments_of_file"]


def segments_of_file(path: Path, file: TrackFile) -> eg.LineTracks:
    """Return the segments in the views of a file of tracks."""
    gaps = (file.views != np.arange(len(file.views))).any()
    if gaps and path.suffix.lower() == ".npz":
        was = f"is {path.name!r}, whose views have no names, with tracks that lack some views"
        raise ArgumentError("--lines", was, "CSV, with the numbers or names of the tracks' file")
    return load_line_tracks(path, file.tracks)


def check_kept(start: Any, lines: eg.LineTracks | None, what: str) -> None:
    """Refuse to lose the lines of a start without a word."""
    if start.lines is not None and lines is None:
        was = f"has {len(start.lines)} lines, which would be lost"
        raise ArgumentError(what, was, "their segments: --lines FILE")


def line_facts(lines: eg.LineTracks | None, result: eg.BundleResult) -> dict[str, str]:
    """Return what the report says of lines."""
    if lines is None or result.line_fun is None:
        return {}
    rms = float(np.sqrt(np.mean(result.line_fun**2)))
    text = f"{lines.n_lines}, {len(lines)} segments, {rms:.6g} RMS of their end points' distances"
    return {"lines": f"{text} over sigma"}


def arrays_beside(lines: eg.LineTracks | None) -> dict[str, Any]:
    """Return the segments as NPZ holds them beside a result."""
    own = {} if lines is None else arrays_of_lines(lines)
    return {f"line_tracks_{name}": array for name, array in own.items()}


def save_residuals_beside(
    path: Path, result: eg.BundleResult, lines: eg.LineTracks | None, tracks: eg.Tracks
) -> None:
    """Write the residuals of segments beside those of points."""
    if lines is not None:
        beside = path.with_name(f"{path.stem}.lines.csv")
        save_line_residuals(beside, result, lines, tracks)
