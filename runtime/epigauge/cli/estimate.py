"""``epigauge estimate``: from a file of raw matches to the fundamental matrix."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import epigauge as eg
from epigauge._options import Backend, FrontEnd
from epigauge.cli._common import Json, choice, given
from epigauge.cli._targets import ImageSize, Plot, Targets, outputs
from epigauge.cli.refine import FROM_FILE, finish, of_size, warn_of_marks
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io import load_matches


def estimate(
    matches: Annotated[
        Path, typer.Argument(help="CSV, TXT or NPZ: x1, y1, x2, y2 in pixels.", show_default=False)
    ],
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
    """
    targets = Targets(plot, output, json=json)
    matches = given(matches)
    pair = of_size(load_matches(matches, inliers=inliers), image_size)
    warn_of_marks(pair, "which are judged anew")
    begin = time.perf_counter()
    options: dict[str, Any] = {
        "robust": robust,
        "threshold_px": "auto" if threshold_px is None else threshold_px,
        "noise_px": noise_px,
        "max_iter": max_iter,
        "seed": seed,
        "backend": backend,
    }
    if pair.weights is not None:
        options["weights"] = pair.weights
    try:
        result = eg.estimate_fundamental(pair.x1, pair.x2, **options)
    except ArgumentError as error:
        if error.argument in FROM_FILE:
            raise FileFormatError(matches, str(error)) from None
        raise
    seconds = time.perf_counter() - begin
    kept = int(np.count_nonzero(result.inlier))
    rows = {"matches": f"{len(pair)}, {kept} inliers within {result.threshold_px:.3g} px"}
    more: dict[str, Any] = {
        "source": str(matches),
        "matches": len(pair),
        "noise_estimated": noise_px is None,
    }
    arrays = {"x1": pair.x1, "x2": pair.x2}
    more |= {"seconds": seconds} | arrays
    return finish(result, pair, result.used, more, rows, targets, json)
