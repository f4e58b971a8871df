"""The vocabulary of verdicts: what can be the matter with a result, what it means, what to do.

Every solver and every command takes its flags from here, so that one word means one thing. A flag
that *spoils* a kind of result says that the numbers must not be used: the result's `success` is
False then, and a command ends with exit code 1. Any other flag says: with care.

>>> from epigauge.verdicts import FLAGS, explained, usable
>>> FLAGS["still camera"].sentence
'every point stays where it was: the camera did not move, or both images are one'
>>> usable(["nearly planar"], "F"), usable(["planar scene"], "F"), usable(["planar scene"], "E")
(True, False, True)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

__all__ = ["FLAGS", "Flag", "Kind", "explained", "ordered", "usable"]

#: Kinds of result: a fundamental matrix, an essential one, a homography, many views.
Kind = Literal["F", "E", "H", "views"]


@dataclass(frozen=True)
class Flag:
    """One thing that can be the matter with a result.

    Attributes
    ----------
    sentence : str
        What was found.
    remedy : str
        What to do about it.
    spoils : tuple of str
        Kinds of result that must not be used then: "F", "E", "H", "views".

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.verdicts.FLAGS["still camera"].spoils
    ('F', 'E', 'views')
    """

    sentence: str
    remedy: str
    spoils: tuple[Kind, ...] = ()


#: Every flag, in the order that results list them.
FLAGS = {
    "no common geometry": Flag(
        "the matches agree no better than wrong ones do by chance: nothing says that both images "
        "show one rigid scene",
        "use photographs that overlap, or matches that are stricter (a smaller ratio)",
        ("F", "E", "H", "views"),
    ),
    "still camera": Flag(
        "every point stays where it was: the camera did not move, or both images are one",
        "take images from different places",
        ("F", "E", "views"),
    ),
    "planar scene": Flag(
        "one plane explains what was matched within the noise, or a camera that only turned: the "
        "points do not determine the cameras (of two uncalibrated views, F)",
        "match points off the plane too; of two views, use the homography, or with K known "
        "essential=True, which leaves at most two motions",
        ("F", "views"),
    ),
    "nearly planar": Flag(
        "one homography explains nearly all matches, and the few others fix F: off the plane it "
        "may be wrong by many pixels",
        "match more points off the plane, and check F there before it is used",
    ),
    "several planes": Flag(
        "half as many matches as agree with the homography agree on another one, or some of those "
        "that agree do so far better with another: it is one of several planes, or between them",
        "estimate F, whose scene may be in depth; or leave out the matches that agree and estimate "
        "the next plane, or take a smaller threshold_px",
    ),
    "pure rotation": Flag(
        "the homography that explains all matches could be that of a camera that only turned; a "
        "plane cannot be excluded",
        "take images from different places",
        ("F", "E", "views"),
    ),
    "two motions": Flag(
        "the points lie in one plane, and two motions of the calibrated cameras explain them "
        "alike, with all points in front",
        "match points off the plane, add a third image, or compare both motions (starts=20, "
        "result.minima)",
        ("E",),
    ),
    "pure translation": Flag(
        "the camera moved without turning: every focal length explains the tracks",
        "take images from other directions as well, or give the focal length",
        ("views",),
    ),
    "one rotation axis": Flag(
        "all views are turned about one axis: the intrinsics follow from square pixels and a "
        "shared camera alone, and not at all if the axis is the line of sight",
        "trust the standard deviations, or tilt the camera in some images",
    ),
    "one viewing point": Flag(
        "all views look at one point, which stays in its place in the image: the intrinsics are "
        "determined less well than by any other motion",
        "trust the standard deviations, or look past the point in some images",
    ),
    "critical motion": Flag(
        "the views turn about one axis or look at one point, and a focal length hangs on the "
        "distortion by more than a twentieth, which no standard deviation covers: the shape of the "
        "scene with it",
        "take images with the camera tilted and looking past the object, or give the focal length",
        ("views",),
    ),
    "outside the images": Flag(
        "more than 15 % of the observations lie outside of their images: wrong sizes, or another "
        "origin than the centre of the top left pixel; principal points were sought near the "
        "centres of the images",
        "give width and height in the pixels of the tracks, and add the place of the origin, as of "
        "the centre of the image, to the coordinates",
    ),
    "weak focal length": Flag(
        "the standard deviation of a focal length exceeds a twentieth of it",
        "add views that are turned against the others, or give the focal length",
    ),
    "model error": Flag(
        "the views contradict one another in the focal length by more than noise explains: its "
        "standard deviation was widened to cover that",
        "try another camera model, look for wrong matches, or calibrate the camera",
    ),
    "unlike cameras": Flag(
        "cameras with square pixels and the intrinsics they are said to share do not explain the "
        "tracks nearly as well as projective cameras do",
        "look for wrong matches, give each view its own camera (shared=False), or another model",
        ("views",),
    ),
    "undetermined": Flag(
        "some parameters can change without changing any residual",
        "add matches or views that fix them, or hold them fixed",
        ("F", "E", "H", "views"),
    ),
    "not tied": Flag(
        "the views or points fall into parts that share nothing that counts: each part has a frame "
        "and a scale of its own",
        "add points that both parts see, or reconstruct the parts one by one",
        ("views",),
    ),
    "two-view tracks": Flag(
        "no point is seen by more than two views, and the pairs do not fix all cameras: in a "
        "chain, a star or a ring, scales (of uncalibrated cameras more) are open",
        "match points over three views or more, or more pairs of views",
        ("views",),
    ),
    "open intrinsics": Flag(
        "a focal length, principal point or distortion is open, or uncertain by more than a tenth "
        "of the focal length: a flat, distant or narrow scene, views that all look one way, or a "
        "camera of its own for every view",
        "hold those intrinsics (refine=...), give an IntrinsicPrior, or turn the camera",
    ),
    "flat scene": Flag(
        "all points lie in one plane within the noise, and intrinsics are refined: they lean on "
        "how the views are slanted alone",
        "match points off the plane, or hold the intrinsics",
    ),
    "collinear centres": Flag(
        "all centres of the cameras are on one line: known positions leave the turn about it open, "
        "and intrinsics are weak",
        "take images beside the line, or know a point or a rotation",
    ),
    "points at infinity": Flag(
        "the noise leaves the depth of many points open: they may as well be infinitely far",
        "use their directions, not their places; or take images farther apart",
    ),
    "open lines": Flag(
        "the views leave some lines open: a line in one plane with all centres that see it "
        "(epipolar plane), or one very far away",
        "leave such lines out, or take images from beside that plane",
    ),
    "wrong segments": Flag(
        "some segments are more than twelve standard deviations away from the images of their "
        "lines: matched to wrong lines",
        "leave them out (`line_fun` tells which), or use a robust loss",
    ),
    "gross errors": Flag(
        "a few matches carry most of the error: wrong ones among them, which least squares bends "
        "the result to",
        "find the right matches with estimate_fundamental (`epigauge estimate`), or mark them "
        "(`--inliers`); in tracks, set the wrong ones aside with robust=True (`epigauge bundle "
        "--robust`)",
        ("F", "E", "H", "views"),
    ),
    "poor fit": Flag(
        "most observations are far from the images of their points, by more than a tenth of the "
        "spread of the image coordinates; or some are by a fiftieth, with points behind their "
        "cameras; or most points are behind them, as in a reflected scene: a wrong minimum, or "
        "wrong matches",
        "begin elsewhere, or look for wrong matches",
        ("views",),
    ),
    "strayed views": Flag(
        "most observations of a view are gross errors, set aside or given up by a robust loss: its "
        "camera is wrong, or its matches are",
        "find such cameras anew with robust=True (`epigauge bundle --robust`); views that its "
        "message names still leave out, match anew, or begin elsewhere",
        ("views",),
    ),
    "outliers": Flag(
        "more residuals are beyond four standard deviations than noise explains: gross errors are "
        "left, which pull at the result",
        "set them aside with robust=True (`epigauge bundle --robust`), or use a robust loss",
    ),
    "behind the cameras": Flag(
        "some points lie behind a camera",
        "look for wrong matches, and try more starts",
    ),
    "not oriented": Flag(
        "some points are in front of one camera only (oriented epipolar constraint): a wrong "
        "minimum or wrong matches",
        "look for wrong matches, and try more starts",
    ),
    "ambiguous": Flag(
        "several minima lie within the noise of one another",
        "compare them (result.minima), or add matches that tell them apart",
    ),
    "weak geometry": Flag(
        "the standard deviation of the result exceeds a tenth of its size, or the noise hides the "
        "relief of the scene: first-order covariances are not to be relied on",
        "use more matches, spread over both images and in depth, or a longer baseline",
    ),
    "near-affine": Flag(
        "an affine model explains the matches within the noise: perspective does not show, and "
        "several minima are possible",
        "use several starts (starts=20), or images with more perspective; of many views, an affine "
        "reconstruction says as much",
    ),
    "few matches": Flag(
        "so few more matches than parameters that the noise cannot be estimated to 25 %",
        "use more matches, or give noise_px where it is known",
    ),
    "not pixels": Flag(
        "the coordinates spread over less than 2: not pixels?",
        "give coordinates in pixels; lengths and thresholds are in the unit of the coordinates",
    ),
    "wrong calibration": Flag(
        "a fundamental matrix explains the matches much better than an essential one: the "
        "calibration does not fit, or the lenses are distorted, and the motion is off by more than "
        "its standard deviations say",
        "check K1 and K2 (focal length, principal point, scale of the images), undistort the "
        "points, or estimate F",
        ("E",),
    ),
    "distorted cameras": Flag(
        "lens distortion bends the points by more than their noise, which no F can follow",
        "undistort the points first",
        ("F",),
    ),
}


def ordered(names: Iterable[str]) -> tuple[str, ...]:
    """Return names of flags, each once, in the order of `FLAGS`.

    Parameters
    ----------
    names : iterable of str
        Flags that were raised.

    Returns
    -------
    tuple of str
        The same in order.

    Raises
    ------
    KeyError
        On a name that is not in the vocabulary.

    Examples
    --------
    >>> ordered({"near-affine", "planar scene"})
    ('planar scene', 'near-affine')
    """
    raised = set(names)
    if unknown := raised - FLAGS.keys():
        raise KeyError(f"no such flag: {', '.join(sorted(unknown))}")
    return tuple(name for name in FLAGS if name in raised)


def usable(names: Iterable[str], kind: Kind) -> bool:
    """Tell whether a result with these flags may be used.

    Parameters
    ----------
    names : iterable of str
        Flags that were raised.
    kind : {"F", "E", "H", "views"}
        What the result is.

    Returns
    -------
    bool
        False where a flag spoils results of this kind.

    Examples
    --------
    >>> usable(["near-affine"], "F")
    True
    """
    return not any(kind in FLAGS[name].spoils for name in names)


def explained(names: Iterable[str]) -> dict[str, str]:
    """Return each flag with a text for people: what was found, and what to do.

    Parameters
    ----------
    names : iterable of str
        Flags that were raised.

    Returns
    -------
    dict of str to str
        Two sentences a flag.

    Examples
    --------
    >>> list(explained(["near-affine"]))
    ['near-affine']
    """
    return {
        name: f"{_capital(FLAGS[name].sentence)}. {_capital(FLAGS[name].remedy)}." for name in names
    }


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
