"""``epigauge estimate``: from a file of raw matches to the fundamental matrix."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from epigauge._options import Backend, FrontEnd
from epigauge.cli._common import Json, choice, given, shown, told
from epigauge.cli._models import Intrinsics, Model, check_model, finish_plane, look_for
from epigauge.cli._targets import ImageSize, Plot, Targets, outputs
from epigauge.cli.refine import FROM_FILE, finish, of_size, warn_of_marks
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io import load_matches
from epigauge.two_view.confidence import error_text


def estimate(
    matches: Annotated[
        Path,
        typer.Argument(
            help="CSV, TXT, NPZ, NPY or HDF5: x1, y1, x2, y2 in pixels.", show_default=False
        ),
    ],
    model: Model = "F",
    intrinsics: Intrinsics = None,
    robust: Annotated[FrontEnd, choice(FrontEnd, "Robust start.")] = "auto",
    threshold_px: Annotated[
        float | None,
        typer.Option(
            help="Largest distance of an inlier; from the noise of the matches when not given."
        ),
    ] = None,
    noise_px: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a coordinate, for the covariance; "
            "estimated from the residuals when not given."
        ),
    ] = None,
    max_iter: Annotated[int, typer.Option(help="Trial steps allowed.")] = 100,
    seed: Annotated[int, typer.Option(help="Of the random samples.")] = 0,
    backend: Annotated[Backend | None, choice(Backend, "See `epigauge info`.")] = None,
    inliers: Annotated[
        bool, typer.Option("--inliers", help="Use only the matches the file marks as inliers.")
    ] = False,
    image_size: ImageSize = None,
    plot: Plot = None,
    output: Annotated[list[Path] | None, outputs("Save the whole result: NPZ or JSON.")] = None,
    json: Json = False,
) -> int:
    """Find the fundamental matrix of a file of raw matches, wrong ones among them.

    Sorts out wrong matches and minimises the reprojection error of the others.
    Writes F with x2^T F x1 = 0 to stdout, three lines of three numbers; with
    --json everything known about it but the derivatives. A saved NPZ is a file
    of matches too, with the inliers marked: `epigauge refine FILE --inliers`.
    With --model E or H it is the essential matrix of normalised points, or H
    with x2 ~ H x1; with --model auto the matrix of the model that the matches
    support, none where they agree by chance.
    """
    targets = Targets(plot, output, json=json)
    options: dict[str, Any] = {
        "robust": robust,
        "threshold_px": "auto" if threshold_px is None else threshold_px,
        "noise_px": noise_px,
        "max_iter": max_iter,
        "seed": seed,
        "backend": backend,
    }
    cameras = check_model(model, intrinsics, targets, options)
    matches = given(matches)
    pair = of_size(load_matches(matches, inliers=inliers), image_size)
    warn_of_marks(pair, "which are judged anew")
    begin = time.perf_counter()
    try:
        found = look_for(model, pair.x1, pair.x2, pair.weights, cameras, options)
    except ArgumentError as error:
        if error.argument in FROM_FILE:
            raise FileFormatError(matches, str(error)) from None
        raise
    seconds = time.perf_counter() - begin
    more: dict[str, Any] = {
        "source": told(matches),
        "matches": len(pair),
        "noise_estimated": noise_px is None,
        "seconds": seconds,
        "x1": pair.x1,
        "x2": pair.x2,
    }
    rows = {"matches": str(len(pair))}
    if found.fit is not None:
        kept = int(np.count_nonzero(found.fit.inlier))
        rows["matches"] += f", {kept} inliers within {found.fit.threshold_px:.3g} px"
    result = found.epipolar
    if result is None:
        return finish_plane(found, shown(matches), rows, more, targets, json)
    rows["error"] = error_text(result.error_px, result.p_wrong)
    return finish(result, pair, result.used, more, rows, targets, json, found)
