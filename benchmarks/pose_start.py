"""Projective starts: camera by camera (`initialize`) against the global bilinear pOSE.

    python benchmarks/pose_start.py TRACKS.npz... [--raw]

pOSE (Hong and Zach, CVPR 2018) mixes the projective equations P12 X - (p3 X) m with the affine ones
P12 X - m, which is bilinear: random cameras converge when the points are eliminated. Both starts
are then adjusted projectively; a line a set says how many of five random starts arrive where the
start camera by camera does, and the processor time of each. Without --raw, gross errors (those
that `metric_upgrade` sets aside) are left out beforehand; of each set the longest tracks.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import epigauge as eg
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POINTS, _STARTS, _ROUNDS = 1000, 5, 200
#: Share of the affine equations.
_ETA = 0.05


class Pose:
    """The problem, with images (n, m, 2) of which `sees` (n, m) are known."""

    def __init__(self, xy: Array, sees: NDArray[np.bool_]) -> None:
        self.xy, self.sees = xy, sees
        n, m = sees.shape
        # Each observation gives four equations B P X = c: two projective, two affine.
        self.B = np.zeros((n, m, 4, 3))
        a, b = np.sqrt(1.0 - _ETA), np.sqrt(_ETA)
        self.B[:, :, [0, 1], [0, 1]], self.B[:, :, [2, 3], [0, 1]] = a, b
        self.B[:, :, :2, 2] = -a * xy
        self.B *= sees[:, :, None, None]
        self.c = np.zeros((n, m, 4))
        self.c[:, :, 2:] = b * xy * sees[:, :, None]

    def points(self, P: Array) -> tuple[Array, Array, Array, Array]:
        """Return the best points, derivatives by them, their inverses, and residuals."""
        A = self.B @ P[:, None]
        J, right = A[..., :3], self.c - A[..., 3]
        V = np.einsum("nmik,nmil->mkl", J, J, optimize=True)
        inverse = np.linalg.inv(V + 1e-12 * np.eye(3))
        X = np.einsum("mkl,nmil,nmi->mk", inverse, J, right, optimize=True)
        return X, J, inverse, np.einsum("nmik,mk->nmi", J, X, optimize=True) - right

    def solve(self, P: Array) -> tuple[Array, Array]:
        """Return cameras and points after at most so many steps of variable projection."""
        (n, m), damping = self.sees.shape, 1e-3
        X, J, inverse, r = self.points(P)
        for _ in range(_ROUNDS):
            h = np.concatenate([X, np.ones((m, 1))], axis=1)
            by = np.einsum("nmia,mb->nmiab", self.B, h).reshape(n, m, 4, 12)
            W = np.einsum("nmik,nmip->mknp", J, by, optimize=True).reshape(m, 3, 12 * n)
            S = -np.tensordot(inverse @ W, W, axes=([0, 1], [0, 1]))
            U = np.einsum("nmip,nmiq->npq", by, by, optimize=True)
            for i in range(n):
                S[12 * i : 12 * i + 12, 12 * i : 12 * i + 12] += U[i]
            g = np.einsum("nmip,nmi->np", by, r, optimize=True).ravel()
            cost = np.sum(r**2)
            while damping < 1e10:
                step = np.linalg.solve(S + damping * np.eye(12 * n), -g)
                trial = P + step.reshape(n, 3, 4)
                found = self.points(trial)
                if np.sum(found[3] ** 2) < cost:
                    break
                damping *= 10.0
            else:
                break
            P, (X, J, inverse, r), damping = trial, found, 0.1 * damping
            if np.sum(r**2) > (1.0 - 1e-7) * cost:
                break
        return P, X


def longest(tracks: eg.Tracks) -> eg.Tracks:
    """Return the longest tracks that count, views without points left out."""
    good = tracks.weights > 0.0
    lengths = np.bincount(tracks.point[good], minlength=tracks.n_points)
    chosen = np.argsort(-lengths, kind="stable")[:_POINTS]
    keep = good & np.isin(tracks.point, chosen)
    return eg.Tracks.pruned(tracks.view[keep], tracks.point[keep], tracks.xy[keep])[0]


def adjusted(tracks: eg.Tracks, start: object, raw: bool) -> float:
    """Return the RMS after projective adjustment, with gross errors the median distance."""
    if not raw:
        return eg.bundle_adjust(tracks, start).rms_px
    found = eg.bundle_adjust(tracks, start, loss="cauchy")
    return float(np.median(np.linalg.norm(found.fun, axis=1)))


def main(path: Path, raw: bool) -> None:
    """Print a line."""
    with np.load(path) as z:
        tracks, size = eg.Tracks(z["view"], z["point"], z["xy"]), z["image_size"]
    if not raw:
        rejected = eg.metric_upgrade(tracks, image_size=size).rejected
        tracks = tracks.weighted(np.where(rejected, 0.0, 1.0))
    tracks = longest(tracks)
    begin = time.process_time()
    ours = adjusted(tracks, eg.initialize(tracks, seed=0), raw)
    seconds = time.process_time() - begin
    n, m, unit = tracks.n_views, tracks.n_points, float(np.max(size)) / 2.0
    xy, sees = np.zeros((n, m, 2)), np.zeros((n, m), dtype=bool)
    xy[tracks.view, tracks.point] = (tracks.xy - np.asarray(size) / 2.0) / unit
    sees[tracks.view, tracks.point] = True
    problem, ends = Pose(xy, sees), []
    T = np.array([[unit, 0.0, size[0] / 2.0], [0.0, unit, size[1] / 2.0], [0.0, 0.0, 1.0]])
    begin = time.process_time()
    for seed in range(_STARTS):
        P, X = problem.solve(np.random.default_rng(seed).normal(size=(n, 3, 4)))
        start = eg.Reconstruction(T @ P, np.column_stack([X, np.ones(m)]))
        try:
            ends.append(adjusted(tracks, start, raw))
        except eg.ArgumentError:
            ends.append(np.inf)
    spent = (time.process_time() - begin) / _STARTS
    same = sum(end < 1.01 * ours for end in ends)
    print(
        f"{path.parent.name:28} {n:3} views {m:5} points; camera by camera {ours:8.4f} px "
        f"{seconds:6.2f} s; pOSE best {min(ends):8.4f}, {same} of {_STARTS} as good, {spent:.2f} s",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("tracks", type=Path, nargs="+")
    parser.add_argument("--raw", action="store_true")
    given = parser.parse_args()
    for file in given.tracks:
        main(file, given.raw)
