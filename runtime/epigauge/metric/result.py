"""What is known of a metric scene: the result of `metric_upgrade`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge._results import Result
from epigauge.cameras import MetricReconstruction
from epigauge.errors import ArgumentError
from epigauge.metric.scene import Images
from epigauge.metric.search import Candidate
from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.tracks import MIN_VIEWS, Tracks
from epigauge.uncertainty.covariance import MetricCovariance
from epigauge.verdicts import FLAGS

__all__ = ["MetricUpgrade", "nothing"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MetricUpgrade(Result):
    """A metric scene from tracks alone, and what is known of its cameras.

    Attributes
    ----------
    reconstruction : MetricReconstruction or None
        Cameras and points after metric adjustment; None where nothing was found, then `flags` say
        why.
    focal_px, focal_std_px : float or ndarray, shape (c,)
        Focal length in pixels and its standard deviation, of one camera, or of each of several (the
        mean of fx and fy of models that have both). The deviation is that of `covariance`, wider
        where views contradict one another beyond the noise ("model error"), with what a richer
        model (OPENCV) moves the focal length by beyond the noise, and with 0.05 % of models that
        have one focal length for both axes, which real cameras do not have exactly. It is infinite
        where nothing determines the focal length.
    flags : tuple of str
        From `epigauge.verdicts.FLAGS`.
    success : bool
        Whether the scene may be used: adjusted, and determined.
    message : str
        How it ended.
    rms_px : float
        Of the observations that were not set aside, per coordinate.
    noise_px : float
        Standard deviation of an image coordinate, estimated.
    rejected : ndarray of bool, shape (N,)
        Observations that were set aside as gross errors.
    refined : tuple of str
        Intrinsics that the tracks determine, and that were refined; the others are where they
        began: principal points in the centre, no distortion.
    candidates : tuple of Candidate
        Metric bases that were tried, the one taken first.
    bundle : BundleResult or None
        The last adjustment.
    covariance : MetricCovariance or None
        Of everything, by the noise of independent observations alone: `focal_std_px` is wider.

    Examples
    --------
    >>> import epigauge as eg
    >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
    >>> xy = tracks.xy + 256.0  # from the corner of the images, not their centre
    >>> tracks = eg.Tracks(tracks.view, tracks.point, xy)
    >>> result = eg.metric_upgrade(tracks, image_size=(512, 512))
    >>> result.reconstruction.cameras.model, "weak focal length" in result.flags
    ('SIMPLE_RADIAL', True)
    """

    reconstruction: MetricReconstruction | None = field(repr=False)
    focal_px: float | Array
    focal_std_px: float | Array
    flags: tuple[str, ...]
    success: bool
    message: str
    rms_px: float
    noise_px: float
    rejected: NDArray[np.bool_] = field(repr=False)
    refined: tuple[str, ...]
    candidates: tuple[Candidate, ...] = field(repr=False)
    bundle: BundleResult | None = field(repr=False)
    covariance: MetricCovariance | None = field(repr=False)

    def _contents(self) -> dict[str, Any]:
        """Return what is known; `bundle` would tell the scene twice, and has a form of its own."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in own.items() if name != "bundle"}

    def _arrays(self) -> dict[str, Any]:
        """Return what arrays can hold."""
        left = "candidates", "covariance"
        return {name: value for name, value in self._contents().items() if name not in left}

    def kept(self, tracks: Tracks) -> tuple[Tracks, MetricReconstruction]:
        """Return the observations that were not set aside, and the scene of what they show.

        Parameters
        ----------
        tracks : Tracks
            Those that `metric_upgrade` was given.

        Returns
        -------
        tracks : Tracks
            Points with two good observations or more, renumbered; all views.
        reconstruction : MetricReconstruction
            Cameras, and these points.

        Raises
        ------
        ArgumentError
            Where there is no scene, or nothing is left of some view.

        Examples
        --------
        >>> import epigauge as eg
        >>> seen = eg.line_scene(n_views=6, n_lines=2).tracks
        >>> seen = eg.Tracks(seen.view, seen.point, seen.xy + 500.0)  # from the corner
        >>> upgrade = eg.metric_upgrade(seen, image_size=(1000, 1000))
        >>> tracks, metric = upgrade.kept(seen)
        >>> len(tracks) <= len(seen)
        True
        """
        if self.reconstruction is None:
            raise ArgumentError("result", "has no scene", "tracks that determine one")
        good = ~self.rejected & (tracks.weights > 0.0)
        lengths = np.bincount(tracks.point[good], minlength=tracks.n_points)
        good &= lengths[tracks.point] >= MIN_VIEWS
        part, views, points = tracks.subset(good, min_points=1)
        lost = np.setdiff1d(np.arange(tracks.n_views), views)
        if len(lost):
            was = f"leave no good observation of view {lost[0]}"
            raise ArgumentError("tracks", was, "a scene without that view")
        scene = self.reconstruction
        return part, MetricReconstruction(scene.R, scene.t, scene.X[points], scene.cameras)


def nothing(tracks: Tracks, images: Images, flags: tuple[str, ...]) -> MetricUpgrade:
    """Return that there is no metric scene, and why."""
    count = int(images.group.max()) + 1
    nan, inf = np.full(count, np.nan), np.full(count, np.inf)
    sentences = [f"{name}: {FLAGS[name].sentence}" for name in flags]
    return MetricUpgrade(
        reconstruction=None,
        focal_px=float("nan") if count == 1 else nan,
        focal_std_px=float("inf") if count == 1 else inf,
        flags=flags,
        success=False,
        message="; ".join(["no metric scene was found", *sentences]),
        rms_px=float("nan"),
        noise_px=float("nan"),
        rejected=np.zeros(len(tracks), dtype=np.bool_),
        refined=(),
        candidates=(),
        bundle=None,
        covariance=None,
    )
