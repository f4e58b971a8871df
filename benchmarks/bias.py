"""Measure what Kanatani's bias correction does to the bias.

    python benchmarks/bias.py [--trials 1000]

For each scene the mean deviation from the true F over the trials, without and with the correction,
in units of its own covariance: 7 on average where there is no bias.
"""

from __future__ import annotations

import argparse

import epigauge as eg
import numpy as np
from epigauge.two_view.conditioning import condition
from epigauge.two_view.covariance import tangent_basis

SCENES = (
    {"distance": 6.0, "noise_px": 3.0},
    {"distance": 4.0, "noise_px": 6.0, "n_points": 100},
    {"distance": 5.0, "noise_px": 3.0, "motion": "forward"},
)


def biases(trials: int, noise_px: float, **options: object) -> list[float]:
    """Return the two mean deviations of a scene."""
    scene = eg.two_view_scene(seed=3, noise_px=noise_px, **options)
    frame = condition(scene.x1_true, scene.x2_true)
    F = frame.from_pixels(scene.F_true)
    basis, random = tangent_basis(F), np.random.default_rng(0)
    found = np.zeros((2, trials, 7))
    for k in range(trials):
        x1, x2 = (
            x + noise_px * random.normal(size=x.shape) for x in (scene.x1_true, scene.x2_true)
        )
        for i in (0, 1):
            G = frame.from_pixels(
                eg.refine_fundamental(
                    x1, x2, scene.F_true, noise_px=noise_px, bias_correction=bool(i)
                ).F
            )
            found[i, k] = basis.T @ (G * np.sign(np.sum(G * F))).ravel()
    information = np.linalg.inv(np.cov(found[0].T))
    means = found.mean(axis=1)
    return [float(trials * mean @ information @ mean) for mean in means]


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    trials = parser.parse_args().trials
    print("| scene | bias | corrected |\n|---|---|---|")
    for scene in SCENES:
        plain, corrected = biases(trials, **scene)
        name = ", ".join(f"{key} {value}" for key, value in scene.items())
        print(f"| {name} | {plain:.1f} | {corrected:.1f} |", flush=True)


if __name__ == "__main__":
    main()
