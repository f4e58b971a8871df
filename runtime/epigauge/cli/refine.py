"""``epigauge refine``: from a file of matches to the fundamental matrix."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table

import epigauge as eg
from epigauge._options import Backend, Criterion, Hessian, Parameterization, Structure
from epigauge.cli._common import (
    DONE,
    NOT_CONVERGED,
    Json,
    choice,
    console,
    facts,
    given,
    shown,
    told,
    warn,
    write_json,
)
from epigauge.cli._models import Found, for_file, for_json
from epigauge.cli._targets import ImageSize, Plot, Targets, outputs, save_drawing
from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io import Matches, load_matches, plain, save_result

Array = NDArray[np.float64]

#: Arguments of the solvers that come from the file.
FROM_FILE = ("x1", "x2", "x1, x2", "weights")


def refine(
    matches: Annotated[
        Path,
        typer.Argument(
            help="CSV, TXT, NPZ, NPY or HDF5: x1, y1, x2, y2 in pixels.", show_default=False
        ),
    ],
    parameterization: Annotated[
        Parameterization, choice(Parameterization, "How F is represented.")
    ] = "ortho",
    criterion: Annotated[Criterion, choice(Criterion, "What is minimised.")] = "reprojection",
    structure: Annotated[
        Structure, choice(Structure, "What becomes of the points.")
    ] = "eliminated",
    hessian: Annotated[Hessian, choice(Hessian, "Of the cost over F.")] = "exact",
    noise_px: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of a coordinate, for the covariance; "
            "estimated from the residuals when not given."
        ),
    ] = None,
    max_iter: Annotated[int, typer.Option(help="Trial steps allowed.")] = 100,
    backend: Annotated[Backend | None, choice(Backend, "See `epigauge info`.")] = None,
    inliers: Annotated[
        bool, typer.Option("--inliers", help="Use only the matches the file marks as inliers.")
    ] = False,
    image_size: ImageSize = None,
    plot: Plot = None,
    output: Annotated[list[Path] | None, outputs("Save the whole result: NPZ or JSON.")] = None,
    json: Json = False,
) -> int:
    """Refine the fundamental matrix of a file of matches.

    Starts from the 8-point estimate and minimises the reprojection error.
    Writes F with x2^T F x1 = 0 to stdout, three lines of three numbers; with
    --json everything known about it but the derivatives.
    """
    targets = Targets(plot, output, json=json)
    matches = given(matches)
    pair = of_size(load_matches(matches, inliers=inliers), image_size)
    if not inliers:
        warn_of_marks(pair, "which is ignored: --inliers uses only them")
    begin = time.perf_counter()
    try:
        result = eg.refine_fundamental(
            pair.x1,
            pair.x2,
            parameterization=parameterization,
            criterion=criterion,
            structure=structure,
            hessian=hessian,
            noise_px=noise_px,
            weights=pair.weights,
            max_iter=max_iter,
            backend=backend,
        )
    except ArgumentError as error:
        if error.argument in FROM_FILE:
            raise FileFormatError(matches, str(error)) from None
        raise
    seconds = time.perf_counter() - begin
    rows = {"matches": str(len(pair))}
    more = {"source": told(matches), "matches": len(pair), "noise_estimated": noise_px is None}
    used = np.arange(len(pair))
    return finish(result, pair, used, more | {"seconds": seconds}, rows, targets, json)


def finish(
    result: eg.FundamentalResult,
    pair: Matches,
    used: NDArray[np.intp],
    more: dict[str, Any],
    rows: dict[str, str],
    targets: Targets,
    json: bool,
    found: Found | None = None,
) -> int:
    """Save, draw and tell what came out of the matches of a file; return the exit code.

    Parameters
    ----------
    result : FundamentalResult
        What came out.
    pair : Matches
        The file's matches.
    used : ndarray of int
        Those that the result is for.
    more : dict
        What else to save and to write as JSON.
    rows : dict of str to str
        First lines of the table for people.
    targets : Targets
        What to write.
    json : bool
        Whether to write JSON to stdout.
    found : Found, optional
        The model that was looked for, and more about it.
    """
    std_F, std_sigma = standard_deviations(result.F, result.covariance)
    more = more | {"std_F": std_F, "std_sigma": std_sigma, "epipoles": epipoles(result.F)}
    targets.save(lambda path: save_result(path, result, **more, **for_file(found, path)))
    targets.draw(lambda path: _draw(path, result, pair, used, str(more["source"])))
    if json:
        everything = plain(result)
        del everything["jac"]
        write_json(everything | more | for_json(found))
    else:
        _report(result, more, rows)
        if not targets.on_stdout:
            for row in result.F if result.E is None else result.E:
                typer.echo(" ".join(f"{value: 24.17g}" for value in row))
    return DONE if result.success else NOT_CONVERGED


def of_size(pair: Matches, image_size: tuple[int, int] | None) -> Matches:
    """Return matches that know the size of their images, where it was given."""
    if image_size is None:
        return pair
    if min(image_size) < 1:
        was = f"is {image_size[0]} {image_size[1]}"
        raise ArgumentError("--image-size", was, "a width and a height above 0")
    return replace(pair, image_size1=image_size, image_size2=image_size)


def warn_of_marks(pair: Matches, then: str) -> None:
    """Tell people that a file marks inliers, and what happens to the marks."""
    if pair.marked is not None and pair.marked < len(pair):
        text = f"the file marks {pair.marked} of {len(pair)} matches as inliers, {then}"
        console().print(text, soft_wrap=True)


def standard_deviations(F: Array, covariance: Array) -> tuple[Array, float]:
    """Return the standard deviations of the entries of F and of its ratio sigma.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Fundamental matrix.
    covariance : ndarray, shape (9, 9)
        Covariance of vect(F), row-wise.

    Returns
    -------
    std_F : ndarray, shape (3, 3)
        Square roots of the diagonal.
    std_sigma : float
        To first order, from d sigma = (u2^T dF v2 - sigma u1^T dF v1) / s1; infinite where the
        covariance is.
    """
    U, s, Vt = np.linalg.svd(F)
    by_F = (np.outer(U[:, 1], Vt[1]) - s[1] / s[0] * np.outer(U[:, 0], Vt[0])).ravel() / s[0]
    std_F = np.sqrt(np.diag(covariance)).reshape(3, 3)
    if not np.isfinite(covariance).all():
        return std_F, float("inf")
    return std_F, float(np.sqrt(max(by_F @ covariance @ by_F, 0.0)))


def epipoles(F: Array) -> list[list[float]]:
    """Return the epipoles in image 1 and 2, in pixels; not finite where they lie at infinity."""
    U, _, Vt = np.linalg.svd(F)
    with np.errstate(divide="ignore", invalid="ignore"):
        return [(e[:2] / e[2]).tolist() for e in (Vt[2], U[:, 2])]


def _draw(
    path: Path, result: eg.FundamentalResult, pair: Matches, used: NDArray[np.intp], title: str
) -> None:
    """Write the picture."""
    from epigauge.plots import plot_refinement

    sizes = (pair.image_size1, pair.image_size2)
    figure = plot_refinement(result, pair.x1[used], pair.x2[used], image_sizes=sizes)
    save_drawing(path, figure, title, result)


def _report(result: eg.FundamentalResult, more: dict[str, Any], rows: dict[str, str]) -> None:
    """Tell people on stderr what came out."""
    origin = "estimated from the residuals" if more["noise_estimated"] else "given"
    e1, e2 = (_place(e) for e in more["epipoles"])
    rows = rows | {
        "rms_px": f"{result.rms_px:.6g} per coordinate",
        "noise_px": f"{result.noise_px:.6g}, {origin}",
        "sigma": f"{result.sigma:.8g}, standard deviation {more['std_sigma']:.2g}",
        "epipoles": f"{e1} in image 1, {e2} in image 2",
        "evaluations": f"{result.nfev}, with {result.njev} linearisations",
        "status": escape(result.message),
        "seconds": f"{more['seconds']:.4f}",
    }
    out = console()
    out.print(facts(escape(shown(Path(more["source"]))), rows))
    deviations = Table(title="standard deviation of F", show_header=False, title_justify="left")
    for row in more["std_F"]:
        deviations.add_row(*(f"{value:.2e}" for value in row))
    out.print(deviations)
    warn(out, result)


def _place(e: list[float]) -> str:
    return f"({e[0]:.6g}, {e[1]:.6g})" if np.isfinite(e).all() else "at infinity"
