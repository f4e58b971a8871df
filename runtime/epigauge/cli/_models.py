"""Which model of two views a command looks for, and what it writes of one that is not F or E."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer
from numpy.typing import NDArray
from rich.markup import escape

import epigauge as eg
from epigauge import verdicts
from epigauge._arguments import as_choice
from epigauge._options import TwoViewModel
from epigauge.cli._common import DONE, NOT_CONVERGED, choice, console, facts, shown, write_json
from epigauge.cli._targets import Targets
from epigauge.errors import ArgumentError
from epigauge.io import plain, save_result
from epigauge.two_view.model import flat_evidence

Array = NDArray[np.float64]

Model = Annotated[
    TwoViewModel,
    choice(
        TwoViewModel,
        "What to find: the fundamental matrix, the essential matrix, a homography, or which model "
        "the matches support.",
    ),
]
Intrinsics = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FX,FY,CX,CY",
        help="Calibration in pixels, for E and auto; or F,CX,CY. Twice where the cameras differ.",
        show_default=False,
    ),
]

#: Options of the commands as they are when nobody gives them, and which some models do not have.
_DEFAULTS = {"robust": "auto", "threshold_px": "auto", "noise_px": None, "max_iter": 100}
_WITHOUT = {"H": ("robust",), "auto": tuple(_DEFAULTS)}

#: Bounds of the median error whose probability JSON tells.
_BOUNDS_PX = (0.5, 1.0, 2.0, 5.0)

_NEEDED = "FX,FY,CX,CY or F,CX,CY in pixels"


@dataclass(frozen=True)
class Found:
    """What was found, of whatever model.

    Attributes
    ----------
    model : str
        Its name.
    fit : RobustResult, HomographyResult or None
        The result; none where there is no model.
    success : bool
        Whether it may be used.
    flags : tuple of str
        Of the model.
    message : str
        How it ended.
    more : dict
        What the result does not say itself.
    """

    model: str
    fit: eg.RobustResult | eg.HomographyResult | None
    success: bool
    flags: tuple[str, ...]
    message: str
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def epipolar(self) -> eg.RobustResult | None:
        """The result where the model is F or E."""
        return self.fit if isinstance(self.fit, eg.RobustResult) else None


def calibration(texts: Sequence[str] | None) -> tuple[Array, Array] | None:
    """Return the calibration matrices of both cameras."""
    if not texts:
        return None
    if len(texts) > 2:
        raise ArgumentError("--intrinsics", f"is given {len(texts)} times", "once or twice")
    matrices = [_matrix(text) for text in texts]
    return matrices[0], matrices[-1]


def _matrix(text: str) -> Array:
    try:
        values = [float(value) for value in text.split(",")]
    except ValueError:
        raise ArgumentError("--intrinsics", f"is {text!r}", _NEEDED) from None
    if len(values) not in (3, 4) or not np.isfinite(values).all() or min(values[:-2]) <= 0.0:
        raise ArgumentError("--intrinsics", f"is {text!r}", _NEEDED)
    fx, fy, cx, cy = values if len(values) == 4 else (values[0], *values)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def check_model(
    model: str, intrinsics: Sequence[str] | None, targets: Targets, options: dict[str, Any]
) -> tuple[Array, Array] | None:
    """Check a model and what it needs, before anything is computed; return the calibrations."""
    as_choice("--model", model, get_args(TwoViewModel))
    cameras = calibration(intrinsics)
    if model == "E" and cameras is None:
        raise ArgumentError("--model", "is E without a calibration", "--intrinsics FX,FY,CX,CY")
    if model == "H" and targets.plots:
        raise ArgumentError("--plot", "is given with --model H", "--model F or E: it shows F")
    if model in ("F", "H") and cameras is not None:
        raise ArgumentError("--intrinsics", f"is given with --model {model}", "--model E or auto")
    for name in _WITHOUT.get(model, ()):
        if options[name] != _DEFAULTS[name]:
            option = "--" + name.replace("_", "-")
            needed = "--model F or E" if name == "robust" else "--model F, E or H"
            raise ArgumentError(option, f"is given with --model {model}", needed)
    return cameras


def look_for(
    model: str,
    x1: Array,
    x2: Array,
    weights: Array | None,
    cameras: tuple[Array, Array] | None,
    options: dict[str, Any],
) -> Found:
    """Find a model of two views, with the options of `estimate_fundamental`."""
    if model == "auto":
        if weights is not None:
            raise ArgumentError("weights", "are given with --model auto", "--model F, E or H")
        chosen = {name: options[name] for name in ("seed", "backend")}
        told = eg.estimate_two_view(x1, x2, *(cameras or (None, None)), **chosen)
        more: dict[str, Any] = {"evidence": told.evidence}
        if told.model == "rotation" and told.R is not None:
            more["R"] = told.R
        return Found(told.model, told.fit, told.success, told.flags, told.message, more)
    if weights is not None:
        options = options | {"weights": weights}
    fit: eg.RobustResult | eg.HomographyResult
    if model == "H":
        options = {name: value for name, value in options.items() if name != "robust"}
        fit = eg.estimate_homography(x1, x2, **options)
    elif cameras is not None:
        fit = eg.estimate_essential(x1, x2, *cameras, **options)
    else:
        fit = eg.estimate_fundamental(x1, x2, **options)
    return Found(model, fit, fit.success, fit.flags, fit.message)


def for_json(found: Found | None) -> dict[str, Any]:
    """Return what JSON on stdout says beyond the result."""
    if found is None:
        return {}
    more = {"model": found.model} | found.more
    if found.epipolar is not None:
        good = found.epipolar.probability_good
        more["probability_good"] = {f"{px:g}": good(px) for px in _BOUNDS_PX}
    return more


def for_file(found: Found | None, path: Path) -> dict[str, Any]:
    """Return what a file says beyond the result: NPZ has the evidence one number a name."""
    if found is None:
        return {}
    more = {"model": found.model} | found.more
    if path.suffix.lower() == ".npz" and "evidence" in more:
        more |= flat_evidence(more.pop("evidence"))
    return more


def finish_plane(
    found: Found,
    title: str,
    rows: dict[str, str],
    more: dict[str, Any],
    targets: Targets,
    json: bool,
) -> int:
    """Save and tell a homography, or that there is none; return the exit code.

    Parameters
    ----------
    found : Found
        What was found.
    title : str
        Of the table for people.
    rows : dict of str to str
        Its first lines.
    more : dict
        What else to save and to write as JSON.
    targets : Targets
        What to write; pictures show epipolar geometry, and are left out.
    json : bool
        Whether to write JSON to stdout.
    """
    fit = found.fit
    own = {"flags": found.flags, "success": found.success, "message": found.message}
    if isinstance(fit, eg.HomographyResult):
        std_H = np.sqrt(np.diag(fit.covariance)).reshape(3, 3)
        more = more | {"std_H": std_H}
        rows = rows | {
            "rms_px": f"{fit.rms_px:.6g} per coordinate",
            "noise_px": f"{fit.noise_px:.6g}",
            "evaluations": f"{fit.nfev}, with {fit.njev} linearisations",
        }
    targets.save(lambda path: save_result(path, fit or {}, **more, **own, **for_file(found, path)))
    out = console()
    for path in targets.plots:
        text = f"no {shown(path)}: it would show epipolar geometry, the model is {found.model}"
        out.print(text, soft_wrap=True)
    if json:
        document = {} if fit is None else plain(fit)
        write_json(document | more | for_json(found) | own)
    else:
        out.print(facts(escape(title), {"model": found.model} | rows | {"status": found.message}))
        for flag, sentence in verdicts.explained(found.flags).items():
            out.print(f"[bold red]{escape(flag)}:[/] {escape(sentence)}", soft_wrap=True)
        for row in () if fit is None or targets.on_stdout else fit.H:
            typer.echo(" ".join(f"{value: 24.17g}" for value in row))
    return DONE if found.success else NOT_CONVERGED
