"""The epipolar geometry that raw matches agree on, from samples of seven matches.

Seven matches give one to three F in closed form; F that put some of the seven behind a camera are
dropped. An F is judged by all matches:

    sum log(1 + c^2 / (d^2 + f^2)),

with the distance d to first order, a scale c near the noise of good detectors, and f = c / 10 for
rounding. This is a mixture of all noises, those above c having less and less weight: neither the
noise nor a threshold need be known, and wrong matches that lie near the epipolar lines, as those of
repeated windows do, count little against a sharp agreement. The best F of a batch of samples is
improved by robust fits to the matches around. If most of the matches that agree then lie on one
plane, F through its homography and two matches off it are tried [1]_.

Right matches have neighbours that move alike. Samples are therefore drawn from all matches, and
from the better half, quarter and eighth by this measure or by the caller's score.

The compiled loop is runtime/c/search.c; what is here does the same.

References
----------
.. [1] O. Chum, T. Werner, J. Matas, "Two-view geometry estimation unaffected by a dominant plane",
   CVPR 2005.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge._library import address, library
from epigauge._native import check_sizes
from epigauge.kernels import Table
from epigauge.linear import Levenberg
from epigauge.two_view.criteria import Sampson
from epigauge.two_view.eliminated import EliminatedProblem
from epigauge.two_view.losses import Loss, median
from epigauge.two_view.parameterizations import Ortho

__all__ = ["FLOOR", "SCALES", "Found", "search"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

#: Scale of the distances in conditioned coordinates, whose range is about 7: a seventh of a pixel
#: in an image of 1000. And the part of its square that is rounding.
SCALES, FLOOR = (0.003, 0.02, 0.1), 0.01

#: Samples at most and at least, and how many times more than give one without wrong matches: seven
#: right ones with noise are seldom good enough.
_SAMPLES, _LEAST, _PATIENCE = 20_000, 256, 5.0

#: Among fewer matches than the first, at least the second: what agrees by chance is nearly as good.
_FEW, _LEAST_OF_FEW = 400, 768

#: Threes of matches that a plane is tried from, and twos off it that F is.
_PLANES, _PAIRS = 64, 512

#: A plane with less than this share of the matches that agree leaves F no freedom.
_DOMINANT = 0.2

#: Where no more than this share of the matches that agree are off a plane, by so many standard
#: deviations of the noise, F may be any of the plane. All of these fit its matches alike but for
#: the noise, each across other epipolar lines: judged sharply, the luckiest of them wins over the
#: right one and the few matches off the plane. Those on it then judge as bluntly as so many
#: deviations, and for those off it this part of one is rounding: any two fit exactly.
_DEGENERATE, _OFF, _BLUNT, _LUCK = 0.1, 5.0, 3.0, 0.5

#: Scales off a plane of matches that an epipole is tried from.
_FAR = 9.0

#: Iterations of a robust fit at most, and the widths of the fits in scales.
_STEPS, _WIDTHS = 5, (8.0, 3.0, 1.5)

#: Samples a batch, matches that judge all proposals of a batch, and proposals judged by all.
_BATCH, _JUDGES, _FINALISTS = 64, 192, 6

#: Shares of the matches, best first, that samples are drawn from in turns.
_POOLS = (1.0, 0.5, 0.25, 0.125)


class _Options(ctypes.Structure):
    _fields_ = (
        ("seed", ctypes.c_uint64),
        *((name, ctypes.c_ssize_t) for name in ("samples", "least")),
        *((name, ctypes.c_int) for name in ("planes", "pairs", "steps", "widths")),
        *((name, ctypes.c_double) for name in ("scale", "floor2", "patience")),
        ("width", ctypes.c_double * 4),
        ("dominant", ctypes.c_double),
    )


@cache
def _function() -> Any:
    check_sizes({"eg_search_options": _Options})
    pointer, size = ctypes.c_void_p, ctypes.c_ssize_t
    function = library().eg_search
    function.argtypes, function.restype = [size, *[pointer] * 5], size
    return function


@dataclass(frozen=True)
class Found:
    """What a search has found, in the coordinates of the matches.

    Attributes
    ----------
    F : ndarray, shape (3, 3)
        Zero where no sample gave any.
    score : float
        Its agreement.
    samples : int
        How many sevens were drawn.
    scale : float
        Scale of the distances.
    """

    F: Array
    score: float
    samples: int
    scale: float


def search(
    kernels: Table,
    q1: Array,
    q2: Array,
    order: Rows | None,
    *,
    seed: int = 0,
    scale: float = SCALES[0],
) -> Found:
    """Search for the F that most matches agree on.

    Parameters
    ----------
    kernels : Table
        Backend.
    q1, q2 : ndarray, shape (2, m)
        Conditioned matches, at least seven.
    order : ndarray of int, shape (m,), or None
        Their rows, the most promising first; None if nothing is known.
    seed : int
        Of everything random.
    scale : float
        Distance that is as good as right, in the unit of the matches.

    Returns
    -------
    Found
        The best geometry.
    """
    q, m = np.concatenate([q1, q2]), q1.shape[1]
    if not kernels.compiled:
        return _Search(kernels, q, order, seed, scale).run()
    width = (ctypes.c_double * 4)(*_WIDTHS)
    numbers = (seed, _SAMPLES, _least(q.shape[1]), _PLANES, _PAIRS, _STEPS, len(_WIDTHS))
    options = _Options(*numbers, scale, FLOOR, _PATIENCE, width, _DOMINANT)
    order = None if order is None else np.ascontiguousarray(order, dtype=np.intp)
    F, score = np.zeros((3, 3)), np.zeros(1)
    samples = _function()(
        m, address(q), address(order), ctypes.addressof(options), address(F), address(score)
    )
    if samples < 0:
        raise MemoryError(f"no room for {m} matches")
    return Found(F, float(score[0]), samples, scale)


@dataclass
class _Search:
    """The search in NumPy; method by method what the functions of search.c do."""

    kernels: Table
    q: Array
    order: Rows | None
    seed: int
    scale: float
    drawn: int = 0
    F: Array = field(default_factory=lambda: np.zeros((3, 3)))
    score: float = 0.0
    noise: float = 0.0
    on: NDArray[np.bool_] | None = None

    def run(self) -> Found:
        with np.errstate(all="ignore"):  # samples in special position
            samples = self.seven_points()
            if self.score > 0.0:
                self.plane_and_parallax()
            self.on = None
            score = float(self.judged(self.F[None])[0])
        return Found(self.F, score, samples, self.scale)

    def draw(self, below: Array) -> Rows:
        """Return whole numbers below some: SplitMix64 of a counter."""
        count = np.arange(self.drawn + 1, self.drawn + below.size + 1, dtype=np.uint64)
        self.drawn += below.size
        z = np.uint64(self.seed % 2**64) + count * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        uniform = ((z ^ (z >> np.uint64(31))) >> np.uint64(11)).astype(np.float64) * 2.0**-53
        return (uniform.reshape(below.shape) * below).astype(np.intp)

    def judged(self, F: Array) -> Array:
        """Return the scores of many F by all matches.

        By those on a plane that F is degenerate for, bluntly.
        """
        if self.on is None:
            return self.agreement(F, self.q)
        sharp, blunt = self.q[:, ~self.on], self.q[:, self.on]
        luck = max((_LUCK * self.noise / self.scale) ** 2, FLOOR)
        return self.agreement(F, sharp, self.scale, luck) + self.agreement(
            F, blunt, _BLUNT * self.noise, 1.0
        )

    def agreement(
        self, F: Array, q: Array, scale: float | None = None, floor: float = FLOOR
    ) -> Array:
        """Return the scores of many F, shape (k, 3, 3)."""
        scale2 = (self.scale if scale is None else scale) ** 2
        q1, q2 = q[:2], q[2:]
        factors = [self.kernels.agreement(one, scale2, floor * scale2, q1, q2) for one in F]
        return np.asarray([float(np.sum(np.log(own))) for own in factors])

    def distances(self, F: Array) -> Array:
        """Return squared distances; infinity for matches on the wrong side of an epipole."""
        e2 = self.kernels.epipole(F)
        squared, side = self.kernels.sampson_side(F, e2, self.q[:2], self.q[2:])
        side = side > 0.0
        most = 2 * np.count_nonzero(side) >= len(side)
        return np.where(side == most, squared, np.inf)

    def near(self, F: Array, limit: float) -> Rows:
        return np.flatnonzero(self.distances(F) <= limit**2)

    def improve(self, F: Array) -> None:
        """Fit F to the matches around, wide first and then narrow; keep the best."""
        chart = Ortho(self.kernels)
        for width in self.scale * np.array(_WIDTHS):
            rows = self.near(F, 3.0 * width)
            if len(rows) < 8 or np.linalg.matrix_rank(F) < 2:
                return
            criterion = Sampson(self.kernels, *self.q[:, rows].reshape(2, 2, -1))
            problem = EliminatedProblem(
                criterion, chart, np.ones(len(rows)), Loss("truncated", width), exact=False
            )
            stopping = lm.Stopping(ftol=1e-4, xtol=1e-8, gtol=0.0, max_iter=_STEPS)
            found = lm.minimize(problem, chart.start(F), Levenberg(), lm.Classic(), stopping)
            if not np.isfinite(found.state.cost):
                return
            F = found.state.F
            score = float(self.judged(F[None])[0])
            if score > self.score:
                self.F, self.score = F, score

    def best_of(self, F: Array, finalists: int, highest: float) -> float:
        """Improve the best of a batch, where none before scored as high."""
        if not len(F):
            return highest
        if len(F) > finalists:
            m = self.q.shape[1]
            pool = m if self.order is None else (m + 1) // 2
            judges = np.arange(min(pool, _JUDGES)) * pool // min(pool, _JUDGES)
            judges = judges if self.order is None else self.order[judges]
            first = self.agreement(F, self.q[:, judges])
            F = F[np.argsort(-first, kind="stable")[:finalists]]
        scores = self.judged(F)
        best = int(np.argmax(scores))
        if not scores[best] > highest:
            return highest
        self.improve(F[best])
        return float(scores[best])

    def needed(self) -> float:
        """Return how many samples find the best geometry so far with some confidence."""
        near = len(self.near(self.F, 3.0 * self.scale))
        samples = _PATIENCE * (self.q.shape[1] / max(near, 7.0)) ** 7
        return float(min(max(samples, _least(self.q.shape[1])), _SAMPLES))

    def seven_points(self) -> int:
        m = self.q.shape[1]
        share = np.resize(_POOLS if self.order is not None else 1.0, _BATCH)
        pool = np.maximum(min(14, m), np.trunc(share * m))
        highest, most, done = 0.0, float(_SAMPLES), 0
        while done < most:
            rows = self.draw(np.repeat(pool[:, None], 7, axis=1))
            rows = rows if self.order is None else self.order[rows]
            sample = self.q[:, rows].transpose(0, 2, 1)
            F, votes, discriminant = self.kernels.seven_points(
                *(np.ascontiguousarray(half) for half in (sample[:2], sample[2:]))
            )
            done += _BATCH
            real = np.array([np.ones(_BATCH, np.bool_), discriminant > 0.0, discriminant > 0.0])
            chosen = np.nonzero((real & (np.abs(votes) == 7.0)).T)
            proposals = _normalized(F.transpose(3, 0, 1, 2)[chosen])
            before, highest = highest, self.best_of(proposals, _FINALISTS, highest)
            if highest > before:
                most = self.needed()
        return done

    def plane(self) -> tuple[int, int, Array]:
        """Return how many matches are on one plane, of how many that agree, and its homography."""
        rows = self.near(self.F, 3.0 * self.scale)
        if len(rows) < 7:
            return 0, len(rows), np.eye(3)
        limit = 3.0 * self.scale * 2.0**0.5
        e2 = self.kernels.epipole(self.F)
        e2 /= np.linalg.norm(e2)
        q1, q2 = self.q[:, rows].reshape(2, 2, -1)
        kappa, gain = self.kernels.plane_parallax(self.F, e2, q1, q2)
        three = self.draw(np.full((_PLANES, 3), float(len(rows))))
        xy = q1[:, three] - q1[:, three[:, :1]]
        k = kappa[three] - kappa[three[:, :1]]
        area = xy[0, :, 1] * xy[1, :, 2] - xy[1, :, 1] * xy[0, :, 2]
        v0 = (k[:, 1] * xy[1, :, 2] - k[:, 2] * xy[1, :, 1]) / area
        v1 = (xy[0, :, 1] * k[:, 2] - xy[0, :, 2] * k[:, 1]) / area
        v2 = kappa[three[:, 0]] - v0 * q1[0, three[:, 0]] - v1 * q1[1, three[:, 0]]
        planes = np.stack([v0, v1, v2], axis=1)
        off = gain * (kappa - planes @ np.concatenate([q1, np.ones((1, len(rows)))]))
        counts = np.count_nonzero(np.abs(off) < limit, axis=1)
        counts[~np.isfinite(planes).all(axis=1)] = 0
        best = int(np.argmax(counts))
        v = planes[best] if counts[best] else np.zeros(3)
        # Three matches fix the plane less well than all that are on it
        on = np.abs(off[best]) < limit
        equations = (gain * np.concatenate([q1, np.ones((1, len(rows)))]))[:, on]
        A, b = equations @ equations.T, equations @ (gain * kappa)[on]
        minors = np.cross(np.roll(A, -1, axis=0), np.roll(A, -2, axis=0))
        if (determinant := A[0] @ minors[0]) > 1e-12 * np.prod(np.diag(A)):
            v = minors.T @ b / determinant
        H = np.cross(e2, self.F, axisb=0, axisc=0) + np.outer(e2, v)
        return int(counts[best]), len(rows), H

    def plane_and_parallax(self) -> None:
        """Try F = [e']x H of the plane's homography and two matches off it."""
        count, agree, H = self.plane()
        if count < max(7, _DOMINANT * agree):
            return
        q1, q2 = self.q[:2], self.q[2:]
        squared = self.kernels.homography_squared(H, q1, q2)
        rows = np.flatnonzero(squared > (_FAR * self.scale) ** 2)
        if len(rows) < 2:
            return
        distances = self.distances(self.F)
        near = distances <= (3.0 * self.scale) ** 2
        noise2 = max(1.4826**2 * median(distances[near]), FLOOR * self.scale**2)
        on = squared <= _OFF**2 * noise2
        if np.count_nonzero(~on[near]) <= _DEGENERATE * np.count_nonzero(near):
            self.on, self.noise = on, noise2**0.5
            self.score = float(self.judged(self.F[None])[0])
        one = np.ones((1, len(rows)))
        there = H @ np.concatenate([q1[:, rows], one])
        lines = np.cross(there, np.concatenate([q2[:, rows], one]), axis=0).T
        highest = 0.0
        for _ in range(0, _PAIRS, _BATCH):
            two = lines[self.draw(np.full((_BATCH, 2), float(len(rows))))]
            e2 = np.cross(two[:, 0], two[:, 1])
            F = np.cross(e2[:, :, None], H[None], axis=1)
            # Matches on the plane, as most of the few judges are, say nothing.
            highest = self.best_of(_normalized(F), _BATCH, highest)


def _least(m: int) -> int:
    """Return how many samples are drawn from m matches at least."""
    return _LEAST_OF_FEW if m < _FEW else _LEAST


def _normalized(F: Array) -> Array:
    """Return matrices of unit norm; those that are zero or not finite are left out."""
    norms = np.sqrt(np.sum(F**2, axis=(1, 2)))
    there = (norms > 0.0) & np.isfinite(norms)
    return np.asarray(F[there] / norms[there, None, None])
