"""The forms that ``epigauge bundle`` answers in for tracks of cameras without calibration."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape

import epigauge as eg
from epigauge.cli._common import facts, named, shown, told
from epigauge.cli._lines import arrays_beside, line_facts, save_residuals_beside
from epigauge.cli._scenes import save_cloud
from epigauge.cli._tables import save_residuals
from epigauge.errors import ArgumentError
from epigauge.io import TrackFile, plain, save_colmap_model, save_result
from epigauge.io._track_writing import arrays_of
from epigauge.multi_view.display import Display, display
from epigauge.multi_view.pinhole import PinholeModel, pinhole_model
from epigauge.verdicts import explained, usable

__all__ = ["TracksAnswer"]


class TracksAnswer:
    """A result and the forms it is given in."""

    def __init__(
        self,
        result: eg.BundleResult,
        file: TrackFile,
        source: Path,
        y_up: bool,
        seconds: float,
        lines: eg.LineTracks | None,
    ) -> None:
        self.result, self.file, self.source = result, file, source
        self.y_up, self.seconds, self.lines = y_up, seconds, lines
        self.model: PinholeModel | None = None

    @cached_property
    def frame(self) -> Display:
        """Where to look at it."""
        return display(self.result.reconstruction, self.file.tracks, y_up=self.y_up)

    @cached_property
    def pieces(self) -> NDArray[np.float64] | None:
        """What is seen of each line, homogeneous, (L, 2, 4)."""
        found: Any = self.result.reconstruction
        return None if self.lines is None else self.lines.pieces(found)

    def more(self) -> dict[str, Any]:
        """Return what the result does not hold."""
        return {
            "source": told(self.source),
            "n_views": self.file.tracks.n_views,
            "n_points": self.file.tracks.n_points,
            "view_numbers": self.file.views,
            "point_numbers": self.file.points,
            "seconds": self.seconds,
            **({} if self.lines is None else {"n_lines": self.lines.n_lines}),
        }

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        document: dict[str, Any] = plain(self.result)
        document |= document.pop("reconstruction")
        if self.model is not None:
            document["colmap_rms_px"] = self.model.rms_px
        return document | self.more()

    def save(self, path: Path) -> None:
        """Write the result, with the tracks it belongs to, or a cloud of points and centres."""
        if path.suffix.lower() == ".npz":
            own = arrays_of(self.file.tracks) | arrays_beside(self.lines)
            save_result(path, self.result, **own, **self.more())
            return
        if path.suffix.lower() == ".csv":
            save_residuals(path, self.result, self.file.tracks, self.file.views, self.file.points)
            save_residuals_beside(path, self.result, self.lines, self.file.tracks)
            return
        frame = self.frame
        note = "points blue, cameras orange; a basis to look at, not a calibration"
        pieces = None if self.pieces is None else frame.placed_pieces(self.pieces)
        save_cloud(path, frame.points[frame.shown], frame.centres, note, pieces=pieces)

    def draw(self, path: Path) -> None:
        """Draw a picture, or write a page."""
        result, tracks = self.result, self.file.tracks
        title = named(self.source)
        if path.suffix.lower() == ".html":
            from epigauge.reports import save_viewer

            numbers: dict[str, Any] = {
                "view_numbers": self.file.views,
                "point_numbers": self.file.points,
            }
            numbers["pieces"] = self.pieces
            save_viewer(path, result, tracks, title, frame=self.frame, **numbers)
            return
        from epigauge.plots import plot_bundle, save_figure

        figure = plot_bundle(result, tracks, title, frame=self.frame, pieces=self.pieces)
        save_figure(figure, path)

    def save_colmap(self, directory: Path) -> ArgumentError | None:
        """Write a text model, the views called as in the file of tracks, or return why not."""
        tracks, found = self.file.tracks, self.result.reconstruction
        assert isinstance(found, eg.Reconstruction)
        try:
            self.model = pinhole_model(found, tracks, frame=self.frame)
        except ArgumentError as error:
            return error
        names: Sequence[str] = [f"view{number:04d}" for number in self.file.views.tolist()]
        if tracks.names is not None and all(name.split() == [name] for name in tracks.names):
            names = tracks.names
        save_colmap_model(directory, self.model, tracks, names=names)
        return None

    def report(self, out: Console, interrupted: bool) -> None:
        """Tell people on stderr what came out."""
        result, tracks = self.result, self.file.tracks
        rows = {
            "tracks": f"{tracks.n_views} views, {tracks.n_points} points, "
            f"{len(tracks)} observations",
            "method": result.method,
            "rms_px": f"{result.rms_px:.6g} per coordinate",
            "cost": f"{result.cost:.8g} px^2",
            "evaluations": f"{result.nfev}, with {result.njev} linearisations",
            "status": "interrupted" if interrupted else escape(result.message),
            "seconds": f"{self.seconds:.2f}",
        }
        rows |= line_facts(self.lines, result)
        if result.flags:
            rows["flags"] = ", ".join(result.flags)
        if result.rejected.any():
            count = int(np.count_nonzero(result.rejected))
            rows["set aside"] = f"{count} of {len(tracks)} observations, as gross errors"
        if result.loss_scale_px:
            rows["loss_scale_px"] = f"{result.loss_scale_px:.4g}"
        if self.model is not None:
            rows["colmap"] = (
                f"{self.model.rms_px:.6g} px RMS by pinhole cameras, "
                f"{self.model.projective_rms_px:.6g} px by the projective ones: their skew is "
                "left out; a start for `colmap bundle_adjuster`, no calibration"
            )
        out.print(facts(escape(shown(self.source)), rows))
        for name, text in explained(result.flags).items():
            style = "bold yellow" if usable([name], "views") else "bold red"
            out.print(f"[{style}]{name}:[/] {escape(text)}")
        if result.status <= 0 and not interrupted:
            out.print(f"[bold red]did not converge:[/] {escape(result.message)}")
