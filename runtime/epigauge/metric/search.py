"""The search for a metric scene of a sample of the tracks: projective, bases, adjustment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from epigauge import kernels
from epigauge._options import UpgradeModel
from epigauge.bundle.prior_kinds import IntrinsicPrior
from epigauge.cameras import MetricReconstruction, camera_model
from epigauge.errors import ArgumentError
from epigauge.metric.growth import grown
from epigauge.metric.quadric import Basis, Views, metric_bases
from epigauge.metric.samples import Sample
from epigauge.metric.scene import Images, metric_scene
from epigauge.metric.turning import turned
from epigauge.metric.usual import BEND_KNOWN, CENTRE_KNOWN, GUESSES
from epigauge.multi_view.adjust import BundleResult, bundle_adjust
from epigauge.multi_view.initialize import initialize
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.multi_view.tracks import Tracks
from epigauge.multi_view.uncertainty import covariance
from epigauge.two_view.losses import median

__all__ = ["MODELS", "Candidate", "Fit", "Search", "metric_of"]

Array = NDArray[np.float64]

#: Models that begin as cameras without distortion, which the metric basis is for.
MODELS = get_args(UpgradeModel)

#: Metric bases that are adjusted at most.
_CANDIDATES = 3

#: Metric cameras whose median distance is so many times that of projective ones do not fit.
_MISFIT = 2.0

#: A projective reconstruction is doubted, and sought robustly, where its median distance exceeds
#: this share of width plus height, or where less of it is in front of some metric cameras.
_ROUGH, _AHEAD = 1e-3, 0.9


@dataclass(frozen=True)
class Candidate:
    """A metric basis that was tried.

    Attributes
    ----------
    focal_px : float
        Median focal length of the basis, before any adjustment.
    deviation : float
        Median over the views of their intrinsics' squared deviation from those of usual cameras, in
        usual deviations.
    ahead : float
        Share of the observations in front of the cameras.
    adjusted_focal_px : float
        Median focal length after adjustment of the sample.
    cost : float
        Robust cost of that adjustment, all with one scale, in px^2.
    """

    focal_px: float
    deviation: float
    ahead: float
    adjusted_focal_px: float
    cost: float


@dataclass(frozen=True)
class Fit:
    """A metric scene of the sample.

    Attributes
    ----------
    reconstruction : MetricReconstruction
        After a robust adjustment.
    refined : tuple of str
        Intrinsics that the tracks determine.
    candidates : tuple of Candidate
        All that were tried, this one first.
    typical, projective : float
        Median distance of observations, in pixels, from it and from the projective reconstruction.
    ahead : float
        Share of observations in front of the cameras of the basis.
    """

    reconstruction: MetricReconstruction
    refined: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    typical: float
    projective: float
    ahead: float


def metric_of(bundle: BundleResult) -> MetricReconstruction:
    """Return the reconstruction of an adjustment that began from a metric one."""
    found = bundle.reconstruction
    assert isinstance(found, MetricReconstruction)
    return found


def _better(one: Fit | None, other: Fit | None) -> Fit | None:
    """Return the scene that most observations are nearer to; the first, if there is no other."""
    if one is None or other is None:
        return other if one is None else one
    return other if other.typical < one.typical else one


class Search:
    """A sample of tracks, and what is asked of it.

    Parameters
    ----------
    sample : Sample
        Some of the tracks.
    images : Images
        Sizes and cameras.
    camera : str
        Name of the model.
    workers : int
        Threads.
    backend : str or None
        Where the formulas are computed.
    priors : tuple of IntrinsicPrior
        What is known of the cameras.
    """

    def __init__(
        self,
        sample: Sample,
        images: Images,
        camera: str,
        workers: int,
        backend: str | None,
        priors: tuple[IntrinsicPrior, ...] = (),
    ) -> None:
        self.sample, self.images, self.camera = sample, images, camera
        self.priors = priors
        self.options: Any = {"workers": workers, "backend": backend}
        self.backend: Any = backend
        #: Why there is no scene, where there is none.
        self.flags: tuple[str, ...] = ("undetermined",)

    def run(self, given: Reconstruction | None) -> Fit | None:
        """Return the best metric scene, from a projective reconstruction or without.

        Without, a plain start is tried first, a robust one where that leads nowhere good, and then
        calibrated cameras in turn, from guesses of the focal length. Where cameras in one place are
        near what the views see, those near them are tried, too.
        """
        best: Fit | None = None
        parts = self.sample.tracks, self.images, self.camera, self.priors, self.options
        one_place = turned(*parts)
        for robust in (False, True):
            try:
                projective = self._projective(given, robust)
                hopeless = set(projective.flags) & {"pure rotation", "still camera", "planar scene"}
                if hopeless:
                    self.flags = tuple(f for f in projective.flags if f in hopeless)
                    return None
                best = _better(best, self._metric(projective))
            except (ArgumentError, np.linalg.LinAlgError):
                pass
            if one_place is not None and not robust:
                best = _better(best, self._from(one_place.moving))
                left = None if best is None else self._left(best.reconstruction)
                if left is None or one_place.explains_as_well(left):
                    self.flags = ("pure rotation",)
                    return None
            if given is not None or (best is not None and not self._doubted(best)):
                return best
        return self._grown(best)

    def _grown(self, best: Fit | None) -> Fit | None:
        """Return the best of a doubted scene and those that grow from guessed focal lengths."""
        tracks, unit = self.sample.tracks, self.images.unit
        for share in GUESSES:
            try:
                scene = grown(tracks, self.images, self.camera, share * unit, self.options)
            except (ArgumentError, np.linalg.LinAlgError):
                continue
            fit = None if scene is None else self._from(scene)
            if _better(best, fit) is not best:
                best = fit
                if best is not None and not self._doubted(best):
                    break
        return best

    def _from(self, scene: MetricReconstruction) -> Fit | None:
        """Return a scene of calibrated cameras, adjusted, beside the projective one next to it."""
        tracks, options = self.sample.tracks, self.options
        try:
            adjusted = self._adjusted(scene, self._first())
            projective = bundle_adjust(
                tracks, adjusted.to_projective(), loss="cauchy", ftol=1e-4, **options
            )
            best, refined = self._freed(adjusted)
        except (ArgumentError, np.linalg.LinAlgError):
            return None
        ahead = float(np.mean(adjusted.depths(tracks)[tracks.weights > 0.0] > 0.0))
        cost = self._cost(adjusted, projective.loss_scale_px)
        places = list(camera_model(self.camera).focal)
        share = scene.cameras.of_views[:, places].mean(axis=1) / self.images.unit
        begun = Basis(np.eye(4), float(np.median(share)), float("nan"), cost)
        return Fit(
            best,
            refined,
            (self._candidate(begun, ahead, adjusted, cost),),
            median(np.linalg.norm(self._left(best), axis=1)),
            median(np.linalg.norm(projective.fun, axis=1)),
            ahead,
        )

    def misfit(self, fit: Fit, typical: float) -> bool:
        """Tell whether projective cameras explain the sample much better than metric ones.

        These have `typical`, a median distance of the sample's observations.
        """
        return typical > _MISFIT * fit.projective + 1e-6 * float(self.images.unit.max())

    def _doubted(self, fit: Fit) -> bool:
        rough = fit.typical > _ROUGH * float(self.images.unit.min())
        return rough or fit.ahead < _AHEAD or self.misfit(fit, fit.typical)

    def _projective(self, given: Reconstruction | None, robust: bool) -> BundleResult:
        """Return a projective reconstruction of the sample, robustly adjusted."""
        if given is None:
            # Where cameras do not register, growing calibrated ones is faster than factoring.
            options: Any = {"method": "registration", "robust": robust, "backend": self.backend}
            start = initialize(self.sample.tracks, **options)
        else:
            start = Reconstruction(given.P, given.Q[self.sample.points])
        options = self.options
        return bundle_adjust(self.sample.tracks, start, loss="cauchy", ftol=1e-4, **options)

    def _metric(self, projective: BundleResult) -> Fit | None:
        """Return the best metric scene of a projective one."""
        tracks = self.sample.tracks
        distances = np.linalg.norm(projective.fun, axis=1)
        typical = median(distances)
        kept = tracks.weighted(np.where(distances > 6.0 * typical, 0.0, tracks.weights))
        images, found = self.images, projective.reconstruction
        assert isinstance(found, Reconstruction)
        views = Views(images.cameras_in(found.P), images.group, kernels.table(self.backend))
        tried: list[tuple[float, Candidate, MetricReconstruction]] = []
        for basis in metric_bases(views)[:_CANDIDATES]:
            parts = views, found.Q, basis, kept, images, self.camera
            try:
                scene, ahead = metric_scene(*parts)
                adjusted = self._adjusted(scene, self._first())
            except (ArgumentError, np.linalg.LinAlgError):
                continue
            cost = self._cost(adjusted, projective.loss_scale_px)
            tried.append((cost, self._candidate(basis, ahead, adjusted, cost), adjusted))
        if not tried:
            return None
        tried.sort(key=lambda entry: entry[0])
        best = tried[0][2]
        best, refined = self._freed(best)
        return Fit(
            best,
            refined,
            tuple(entry[1] for entry in tried),
            median(np.linalg.norm(self._left(best), axis=1)),
            typical,
            tried[0][1].ahead,
        )

    def _adjusted(
        self, scene: MetricReconstruction, names: tuple[str, ...]
    ) -> MetricReconstruction:
        """Return the scene after a robust adjustment of poses, points and some intrinsics."""
        found = bundle_adjust(
            self.sample.tracks,
            scene,
            refine=names,
            priors=self._of(names),
            loss="cauchy",
            ftol=1e-4,
            **self.options,
        )
        return metric_of(found)

    def _left(self, scene: MetricReconstruction) -> Array:
        """Return what a scene leaves of the observations of the sample, in pixels."""
        return self.sample.tracks.xy - scene.project(self.sample.tracks)

    def _of(self, names: tuple[str, ...]) -> tuple[IntrinsicPrior, ...] | None:
        """Return what is known of intrinsics that are refined."""
        return tuple(prior for prior in self.priors if prior.name in names) or None

    def _first(self) -> tuple[str, ...]:
        """Return the names of the focal lengths."""
        model = camera_model(self.camera)
        return tuple(model.params[k] for k in model.focal)

    def _freed(self, scene: MetricReconstruction) -> tuple[MetricReconstruction, tuple[str, ...]]:
        """Return the scene with all intrinsics refined that the tracks determine, and their names.

        Where some are not, the principal point is left where it is, and then the distortion.
        """
        model, focal = camera_model(self.camera), self._first()
        bends = tuple(n for n in model.adjusted if n not in (*focal, "cx", "cy"))
        trials = [model.adjusted, (*focal, *bends)] if scene.n_views > 2 else []
        for names in trials:
            try:
                free = self._adjusted(scene, names)
                if self._known(free, names):
                    return free, names
            except (ArgumentError, np.linalg.LinAlgError):
                continue
        return scene, focal

    def _known(self, scene: MetricReconstruction, names: tuple[str, ...]) -> bool:
        """Tell whether the sample determines intrinsics other than focal lengths."""
        tracks = self.sample.tracks
        distances = np.linalg.norm(tracks.xy - scene.project(tracks), axis=1)
        weights = np.where(distances > 6.0 * median(distances), 0.0, tracks.weights)
        options: Any = {"refine": names, "priors": self._of(names), "backend": self.backend}
        known = covariance(tracks.weighted(weights), scene, **options)
        blocks = [np.diag(known.intrinsics(c)) for c in range(len(scene.cameras))]
        std = np.sqrt(np.median(blocks, axis=0))
        unit = float(np.median(self.images.unit))
        for name, deviation in zip(camera_model(self.camera).adjusted, std, strict=True):
            centre, focal = name in ("cx", "cy"), name in self._first()
            if not focal and deviation > (CENTRE_KNOWN * unit if centre else BEND_KNOWN):
                return False
        return True

    def _cost(self, scene: MetricReconstruction, scale_px: float) -> float:
        tracks: Tracks = self.sample.tracks
        squares = np.sum((tracks.xy - scene.project(tracks)) ** 2, axis=1)
        rho = scale_px**2 * np.log1p(squares / scale_px**2)
        model = camera_model(self.camera)
        known = [
            (scene.cameras.params[p.camera, model.params.index(p.name)] - p.value) / p.sigma
            for p in self.priors
        ]
        return 0.5 * float(np.sum(tracks.weights * rho) + scale_px**2 * np.sum(np.square(known)))

    def _candidate(
        self, basis: Basis, ahead: float, scene: MetricReconstruction, cost: float
    ) -> Candidate:
        unit = float(np.median(self.images.unit))
        focal = scene.cameras.params[:, list(camera_model(self.camera).focal)]
        adjusted = float(np.median(focal))
        return Candidate(basis.focal * unit, basis.deviation, ahead, adjusted, cost)
