"""``epigauge metric``: tracks without any calibration to a metric scene."""

from __future__ import annotations

import time
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

import epigauge as eg
from epigauge._options import UpgradeModel
from epigauge.cameras import camera_model
from epigauge.cli._common import (
    DONE,
    NOT_CONVERGED,
    Json,
    choice,
    console,
    facts,
    given,
    named,
    shown,
    told,
    write_json,
)
from epigauge.cli._scenes import save_cloud
from epigauge.cli._targets import Plot, Targets, check_folder, check_target, outputs
from epigauge.cli.bundle import Backend, Clean, Prune, Repeated
from epigauge.io import load_track_file, plain, save_scene
from epigauge.io._npz_scene import write_npz_scene
from epigauge.multi_view.display import display
from epigauge.verdicts import explained, usable

__all__ = ["Camera", "camera_rows", "metric"]

Camera = Annotated[UpgradeModel, choice(UpgradeModel, "Camera model.")]


def metric(
    tracks: Annotated[
        Path,
        typer.Argument(
            help="NPZ, CSV (view, point, x, y) or BAL (.txt, .bz2).", show_default=False
        ),
    ],
    image_size: Annotated[
        tuple[float, float],
        typer.Option(help="Width and height of the images in pixels.", metavar="W H"),
    ],
    output: Annotated[
        list[Path] | None,
        outputs(
            "Save NPZ: scene with everything known; PLY: a cloud to look at; or, without a suffix, "
            "a folder: COLMAP model."
        ),
    ] = None,
    plot: Plot = None,
    camera: Camera = "SIMPLE_RADIAL",
    own_cameras: Annotated[
        bool, typer.Option("--own-cameras", help="Each view has a camera of its own.")
    ] = False,
    clean: Clean = False,
    prune: Prune = False,
    repeated: Repeated = "first",
    backend: Backend = None,
    json: Json = False,
) -> int:
    """Reconstruct calibrated cameras from tracks, knowing nothing of the cameras.

    Finds the focal length, the principal point and the distortion with the
    scene: cameras with square pixels, principal points near the middle of the
    images, and one focal length (or with --own-cameras one each) are all that is
    assumed. Gross errors in the tracks are set aside.

    Writes the focal lengths to stdout, one line of value and standard
    deviation in pixels each; with --json everything known. Exit code 1 where
    the views do not determine them, with a sentence why; then only what is
    asked for as JSON is written.
    """
    targets = Targets(plot, output, json=json, check=_check_output)
    tracks = given(tracks)
    file = load_track_file(tracks, clean, prune=repeated if prune else None)
    begin = time.perf_counter()
    result = eg.metric_upgrade(
        file.tracks,
        image_size=image_size,
        shared=not own_cameras,
        camera=camera,
        backend=backend,
    )
    answer = _Answer(result, file.tracks, tracks, time.perf_counter() - begin)
    if result.success:
        targets.save(answer.save)
        targets.draw(answer.draw)
    if json:
        write_json(answer.document())
    elif result.reconstruction is not None and not targets.on_stdout:
        for value, std in zip(*answer.focal, strict=True):
            typer.echo(f"{value:.17g} {std:.17g}")
    answer.report(console())
    return DONE if result.success else NOT_CONVERGED


def _check_output(path: Path) -> None:
    """Check what a run that may be long will write, before it starts."""
    if path.suffix:
        check_target(path, ".npz", ".ply")
    else:
        check_folder(path)


class _Answer:
    """A metric scene and the forms it is given in."""

    def __init__(
        self, result: eg.MetricUpgrade, tracks: eg.Tracks, source: Path, seconds: float
    ) -> None:
        self.result, self.tracks, self.source, self.seconds = result, tracks, source, seconds

    @property
    def focal(self) -> tuple[Any, Any]:
        """Focal lengths and their standard deviations, one a camera."""
        return np.atleast_1d(self.result.focal_px), np.atleast_1d(self.result.focal_std_px)

    @cached_property
    def kept(self) -> tuple[eg.Tracks, eg.MetricReconstruction]:
        """Observations that were not set aside, and the scene of their points."""
        return self.result.kept(self.tracks)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        result = self.result
        document: dict[str, Any] = {
            "source": told(self.source),
            "n_views": self.tracks.n_views,
            "n_points": self.tracks.n_points,
            "n_observations": len(self.tracks),
            "focal_px": plain(result.focal_px),
            "focal_std_px": plain(result.focal_std_px),
            "flags": list(result.flags),
            "success": result.success,
            "message": result.message,
            "rms_px": plain(result.rms_px),
            "noise_px": plain(result.noise_px),
            "rejected": plain(result.rejected),
            "refined": list(result.refined),
            "candidates": [plain(candidate) for candidate in result.candidates],
            "seconds": self.seconds,
        }
        if result.reconstruction is not None:
            scene: dict[str, Any] = plain(result.reconstruction)
            document |= scene.pop("cameras") | scene
        return document

    def save(self, path: Path) -> None:
        """Write the scene without what was set aside, or a cloud of points and centres."""
        tracks, scene = self.kept
        match path.suffix.lower():
            case ".ply":
                note = "points, cameras orange"
                save_cloud(path, scene.X, scene.centres, note, tracks.colours)
            case ".npz":
                focal, std = self.focal
                more = {"focal_px": focal, "focal_std_px": std, "source": told(self.source)}
                write_npz_scene(path, tracks, scene, more)
            case _:
                save_scene(path, tracks, scene)

    def draw(self, path: Path) -> None:
        """Draw a picture, or write a page."""
        bundle = self.result.bundle
        assert bundle is not None  # of a success
        frame = display(bundle.reconstruction, self.tracks, y_up=False)
        title = named(self.source)
        if path.suffix.lower() == ".html":
            from epigauge.reports import save_viewer

            sure = self.result.covariance
            save_viewer(path, bundle, self.tracks, title, frame=frame, covariance=sure)
            return
        from epigauge.plots import plot_bundle, save_figure

        save_figure(plot_bundle(bundle, self.tracks, title, frame=frame), path)

    def report(self, out: Console) -> None:
        """Tell people on stderr what came out."""
        result, tracks = self.result, self.tracks
        rows = {
            "tracks": f"{tracks.n_views} views, {tracks.n_points} points, "
            f"{len(tracks)} observations",
        }
        if result.reconstruction is not None:
            rows |= camera_rows(result, result.reconstruction.cameras)
            count = int(np.count_nonzero(result.rejected))
            rows["rms_px"] = f"{result.rms_px:.6g} per coordinate"
            rows["set aside"] = f"{count} of {len(tracks)} observations, as gross errors"
        rows["status"] = escape(result.message)
        rows["seconds"] = f"{self.seconds:.2f}"
        out.print(facts(escape(shown(self.source)), rows))
        for name, text in explained(result.flags).items():
            style = "bold yellow" if usable([name], "views") else "bold red"
            out.print(f"[{style}]{name}:[/] {escape(text)}", soft_wrap=True)
        if not result.success:
            out.print(f"[bold red]not determined:[/] {escape(result.message)}", soft_wrap=True)


def camera_rows(result: eg.MetricUpgrade, cameras: eg.Cameras) -> dict[str, str]:
    """Return the parameters of up to three cameras with their standard deviations."""
    model = camera_model(cameras.model)
    rows = {"cameras": f"{len(cameras)} of the model {cameras.model}"}
    for c in range(min(len(cameras), 3)):
        std = np.full(len(model.params), np.inf)
        if result.covariance is not None:
            std[: len(model.adjusted)] = np.sqrt(np.diag(result.covariance.intrinsics(c)))
        if len(model.focal) == 1:  # not of the noise alone
            std[model.focal[0]] = np.atleast_1d(result.focal_std_px)[c]
        for name, unit, value, sigma in zip(
            model.params, model.units, cameras.params[c], std, strict=True
        ):
            label = name if len(cameras) == 1 else f"{name} of camera {c}"
            end = f"+- {sigma:.3g}" if name in result.refined else "(not refined)"
            rows[label] = f"{value:.7g} {end}{' px' if unit == 'px' else ''}"
        if len(model.focal) > 1:
            label = "mean f" if len(cameras) == 1 else f"mean f of camera {c}"
            focal, sigma = np.atleast_1d(result.focal_px)[c], np.atleast_1d(result.focal_std_px)[c]
            rows[label] = f"{focal:.7g} +- {sigma:.3g} px"
    if len(cameras) > 3:
        focal, std = np.atleast_1d(result.focal_px), np.atleast_1d(result.focal_std_px)
        rows["all f"] = ", ".join(f"{f:.5g} +- {s:.2g}" for f, s in zip(focal, std, strict=True))
    if result.covariance is not None:
        wide = "f" if len(model.focal) == 1 else "mean f"
        rows["deviations"] = f"{wide} with errors of the model, all else of noise alone"
    return rows
