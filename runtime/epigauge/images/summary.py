"""What was found of two photographs, in words: for the command line, the picture and the report."""

from __future__ import annotations

import math

import numpy as np

from epigauge import verdicts
from epigauge.images.matching import ImageMatches
from epigauge.two_view.confidence import error_text
from epigauge.two_view.homography_result import HomographyResult
from epigauge.two_view.robust import RobustResult

__all__ = ["epipole_text", "explained", "inside", "match_rows", "summary", "with_deviation"]


def summary(
    result: RobustResult, matches: ImageMatches, seconds: tuple[float, float] | None = None
) -> dict[str, str]:
    """Return what people ask first about a pair: name and value.

    Parameters
    ----------
    result : RobustResult
        What `estimate_fundamental` returned for these matches.
    matches : ImageMatches
        What `match_images` returned.
    seconds : (float, float), optional
        Time that matching and estimation took.

    Returns
    -------
    dict
        Plain text by name, in the order to show it.
    """
    rounds = f", in the last of {result.rounds} rounds" if result.rounds > 1 else ""
    rows = match_rows(matches, result) | {
        "RMS": f"{result.rms_px:.4g} px per coordinate; noise {result.noise_px:.3g} px",
        "sigma": with_deviation(result.sigma, result.sigma_std),
        "error": error_text(result.error_px, result.p_wrong),
        "epipole 1": epipole_text(result, matches, 1),
        "epipole 2": epipole_text(result, matches, 2),
        "evaluations": f"{result.nfev}, with {result.njev} linearisations{rounds}",
    }
    if seconds is not None:
        rows["seconds"] = f"{seconds[0]:.2f} for the matches, {seconds[1]:.2f} for F"
    return rows


def match_rows(
    matches: ImageMatches, result: RobustResult | HomographyResult | None
) -> dict[str, str]:
    """Return how many matches there are and how many agree, of whatever model."""
    rows = {
        "features": f"{matches.n_features1} and {matches.n_features2}, {matches.detector}",
        "matches": f"{len(matches)}",
    }
    if result is not None:
        inliers = int(np.count_nonzero(result.inlier))
        rows["matches"] += f", {inliers} of them inliers within {result.threshold_px:.3g} px"
    return rows


def explained(result: RobustResult) -> dict[str, str]:
    """Return what the matches do not support: each flag of a result with a sentence."""
    found = verdicts.explained(result.flags)
    if result.rank < 7 and result.E is None:
        found["rank"] = f"The matches determine only {result.rank} of the 7 directions of F."
    if result.status <= 0:
        found["not converged"] = _sentence(result.message)
    return found


def inside(result: RobustResult, matches: ImageMatches, image: int) -> bool:
    """Return whether an epipole lies in the picture of image 1 or 2."""
    e = (result.epipole1, result.epipole2)[image - 1]
    width, height = (matches.image_size1, matches.image_size2)[image - 1] or (0, 0)
    x, y, w = (float(value) for value in (e if e[2] >= 0.0 else -e))
    return -0.5 * w <= x <= (width - 0.5) * w and -0.5 * w <= y <= (height - 0.5) * w and w > 0.0


def epipole_text(result: RobustResult, matches: ImageMatches, image: int) -> str:
    """Say where the epipole of image 1 or 2 is, in pixels, and how sure that is."""
    e = (result.epipole1, result.epipole2)[image - 1]
    width, height = (matches.image_size1, matches.image_size2)[image - 1] or (1, 1)
    if abs(e[2]) * 1e4 * max(width, height) <= math.hypot(e[0], e[1]):
        angle = math.degrees(math.atan2(e[1], e[0])) % 180.0
        return f"at infinity, direction {angle:.1f}\N{DEGREE SIGN}"
    deviations = np.sqrt(np.diag(result.epipole_px_covariance(image)))
    x, y = (
        with_deviation(value, deviation)
        for value, deviation in zip(e[:2] / e[2], deviations, strict=True)
    )
    where = "in the picture" if inside(result, matches, image) else "outside the picture"
    return f"({x}, {y}) px, {where}"


def with_deviation(value: float, deviation: float) -> str:
    """Write a value with its standard deviation, to two digits of the latter: 8100 ± 1300."""
    if not math.isfinite(deviation):
        return f"{value:.4g} \N{PLUS-MINUS SIGN} unknown"
    if 0.0 < abs(value) < 1e-3:
        exponent = math.floor(math.log10(abs(value)))
        scale = 10.0**exponent
        return f"({with_deviation(value / scale, deviation / scale)}) 1e{exponent}"
    digits = 1 - math.floor(math.log10(deviation)) if deviation > 0.0 else 6
    shown = min(max(digits, 0), 12)
    value, deviation = round(value, digits), round(deviation, digits)
    return f"{value:.{shown}f} \N{PLUS-MINUS SIGN} {deviation:.{shown}f}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:].rstrip(".") + "."
