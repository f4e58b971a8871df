"""``epigauge pair``: from two photographs to their epipolar geometry, with a picture of it."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.markup import escape

from epigauge._options import Backend, Detector, FrontEnd
from epigauge.cli._common import (
    DONE,
    NOT_CONVERGED,
    Json,
    choice,
    console,
    facts,
    named,
    shown,
    warn,
    write_json,
)
from epigauge.cli._models import (
    Intrinsics,
    Model,
    check_model,
    finish_plane,
    for_file,
    for_json,
    look_for,
)
from epigauge.cli._targets import Plot, Targets, outputs
from epigauge.cli.refine import epipoles, standard_deviations
from epigauge.errors import ArgumentError
from epigauge.images import ImageMatches, load_image, match_images
from epigauge.images.loading import Image
from epigauge.images.summary import match_rows, summary
from epigauge.io import plain, save_result
from epigauge.two_view.robust import RobustResult

_AT_LEAST = 8


def pair(
    image1: Annotated[
        Path, typer.Argument(help="First photograph: JPEG, PNG, TIFF ...", show_default=False)
    ],
    image2: Annotated[Path, typer.Argument(help="Second photograph.", show_default=False)],
    detector: Annotated[Detector, choice(Detector, "Features.")] = "sift",
    ratio: Annotated[
        float, typer.Option(help="Largest ratio of the nearest to the second nearest descriptor.")
    ] = 0.8,
    max_size: Annotated[
        int,
        typer.Option(
            help="Longest side in pixels of the image that features are sought in; a larger one "
            "is made smaller for that. Results are in pixels of the full image."
        ),
    ] = 2000,
    max_features: Annotated[int, typer.Option(help="Strongest features kept.")] = 8000,
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
    plot: Plot = None,
    output: Annotated[list[Path] | None, outputs("Save the whole result: NPZ or JSON.")] = None,
    json: Json = False,
) -> int:
    """Find the fundamental matrix of two photographs.

    Finds features, matches them, sorts out wrong matches and minimises the
    reprojection error of the others. Pixels are those of the upright image,
    turned as its EXIF orientation says; (0, 0) is the centre of the top left
    one. Writes F with x2^T F x1 = 0 to stdout, three lines of three numbers;
    with --json everything known about it but the derivatives. A saved NPZ is
    a file of matches too: `epigauge refine result.npz --inliers`. With --model
    E or H it is the essential matrix of normalised points, or H with x2 ~ H x1;
    with --model auto the matrix of the model that the matches support, none
    where they agree by chance.
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
    os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")  # of damaged files our own errors tell
    out = console()
    begin = time.perf_counter()
    with out.status("matching"):
        photos = load_image(image1), load_image(image2)  # once, for a picture too
        matches = _matched(
            photos,
            (image1, image2),
            detector=detector,
            ratio=ratio,
            max_size=max_size,
            max_features=max_features,
        )
    middle = time.perf_counter()
    names = f"{shown(image1)}, {shown(image2)}"
    _check(matches, names)
    try:
        found = look_for(model, matches.x1, matches.x2, None, cameras, options)
    except ArgumentError as error:
        if error.argument in ("x1", "x2", "x1, x2"):
            was = f"have {len(matches)} matches, which {error.was}"
            raise ArgumentError(names, was, error.needed) from None
        raise
    seconds = middle - begin, time.perf_counter() - middle

    more: dict[str, Any] = {
        "source": [str(image1), str(image2)],
        "image_size1": matches.image_size1,
        "image_size2": matches.image_size2,
        "detector": detector,
        "features": [matches.n_features1, matches.n_features2],
        "x1": matches.x1,
        "x2": matches.x2,
        "noise_estimated": noise_px is None,
        "seconds": seconds,
    }
    title = f"{named(image1)} - {named(image2)}"
    result = found.epipolar
    if result is None:
        rows = match_rows(matches, found.fit)
        return finish_plane(found, title, rows, more, targets, json)
    std_F, std_sigma = standard_deviations(result.F, result.covariance)
    more |= {"std_F": std_F, "std_sigma": std_sigma, "epipoles": epipoles(result.F)}
    targets.save(lambda path: save_result(path, result, **more, **for_file(found, path)))
    targets.draw(lambda path: _draw(path, result, matches, photos, seconds))
    if json:
        everything = plain(result)
        del everything["jac"]
        write_json(everything | more | for_json(found))
    else:
        rows = summary(result, matches, seconds) | {"status": result.message}
        out.print(facts(escape(title), {name: escape(value) for name, value in rows.items()}))
        warn(out, result)
        if not targets.on_stdout:
            for row in result.F if result.E is None else result.E:
                typer.echo(" ".join(f"{value: 24.17g}" for value in row))
    return DONE if result.success else NOT_CONVERGED


def _matched(photos: tuple[Image, Image], paths: tuple[Path, Path], **options: Any) -> ImageMatches:
    """Match photographs that have been read; results and errors name their files."""
    try:
        matches = match_images(*photos, **options)
    except ArgumentError as error:
        files = dict(zip(("image1", "image2"), map(shown, paths), strict=True))
        name = files.get(error.argument, error.argument)
        raise ArgumentError(name, error.was, error.needed) from None
    return replace(matches, name=" - ".join(path.stem for path in paths))


def _check(matches: ImageMatches, names: str) -> None:
    """Refuse images that show the same picture, or have too little in common."""
    if len(matches) >= _AT_LEAST and np.array_equal(matches.x1, matches.x2):
        raise ArgumentError(names, "show the same picture", "two photographs from different places")
    if len(matches) < _AT_LEAST:
        counts = f"{matches.n_features1} and {matches.n_features2} features"
        raise ArgumentError(
            names,
            f"have {counts} but only {len(matches)} matches",
            f"at least {_AT_LEAST}: photographs that overlap and are not blank or blurred, or "
            "another --detector",
        )


def _draw(
    path: Path,
    result: RobustResult,
    matches: ImageMatches,
    images: tuple[Image, Image],
    seconds: tuple[float, float],
) -> None:
    """Write the picture or the report."""
    if path.suffix.lower() == ".html":
        from epigauge.reports import save_pair_report

        save_pair_report(path, result, matches, images, seconds=seconds)
    else:
        from epigauge.plots import save_figure
        from epigauge.plots.pair import plot_pair

        save_figure(plot_pair(result, matches, images, seconds=seconds), path)
