"""Random bases and the defect of a step: what Bartoli 2003 does not measure."""

from __future__ import annotations

import numpy as np

from epigauge.multi_view.adjust import BundleResult
from epigauge.multi_view.gauge import equivalent
from epigauge.multi_view.reconstruction import Reconstruction
from epigauge.reproduce.gauge_runs import (
    LABELS,
    STEPS,
    GaugeStudy,
    moved,
    random_transformation,
    step_defect,
)
from epigauge.reproduce.report import Claim, Section, Table

__all__ = ["bases", "defects"]

CONDITIONS = (1.0, 10.0, 100.0, 1000.0)
_BASES = 20


def bases(study: GaugeStudy) -> Section:
    """Count iterations in random projective bases."""
    tracks, start = study.start(0.2, 0)
    here = {method: study.run(0.2, 0, method) for method in LABELS}
    rows = []
    invariant = {}
    for method, label in study.track(list(LABELS.items()), "random bases"):
        own = here[method].reconstruction
        cells: list[str | float] = [label, float(here[method].nit)]
        alike = True
        for condition in CONDITIONS:
            random = np.random.default_rng(study.seed)
            counts, same = [], 0
            for _ in range(_BASES):
                there = random_transformation(random, condition, tracks.n_views, tracks.n_points)
                result = study.adjust(tracks, moved(start, there), method)
                counts.append(result.nit)
                found = result.reconstruction
                assert isinstance(own, Reconstruction)
                assert isinstance(found, Reconstruction)
                same += equivalent(found, own, 1e-6)
                alike &= _same_course(result, here[method])
            cells.append(f"{min(counts)} to {max(counts)} ({same}/{_BASES})")
        invariant[method] = alike
        rows.append((*cells, "yes" if alike else "no"))
    indifferent = [LABELS[method] for method, alike in invariant.items() if alike]
    return Section(
        "The same start in random projective bases",
        [
            f"One scene, d = 0.2; {_BASES} bases of each condition number, with random scales of "
            "cameras and points. Smallest and largest number of iterations, and in how many bases "
            "the result is the same geometry. Same course: the same iterations and costs (1e-8) in "
            "all bases. HARTLEY, BARTOLI, FAUGERAS and MCLAUCHLAN move to a gauge of their own "
            "first, so that the caller's basis cannot matter; what they do there still depends on "
            "that gauge (footnote 1 of the paper). COVARIANT does not need one.",
            Table(
                "bases",
                "Iterations by condition number of T.",
                ("method", "own basis", *[f"{c:g}" for c in CONDITIONS], "same course"),
                rows,
                ("", ".0f", ""),
            ),
        ],
        [
            Claim(
                "Proposition 2",
                "the iteration of Table 1 is gauge invariant",
                invariant["gauge_invariant"],
                f"methods with the same course in all bases: {', '.join(indifferent)}",
            )
        ],
    )


def _same_course(a: BundleResult, b: BundleResult) -> bool:
    """Tell whether two runs took the same iterations."""
    if a.nit != b.nit:
        return False
    costs = [(x.cost, y.cost) for x, y in zip(a.history, b.history, strict=True)]
    return all(abs(x - y) <= 1e-8 * y for x, y in costs)


def defects(study: GaugeStudy) -> Section:
    """How far one step is from being gauge invariant."""
    tracks, start = study.start(0.2, 0)
    kinds = {
        "scales only": 0.0,
        "orthonormal T, unit scales": -1.0,
        **{f"condition {c:g}": c for c in CONDITIONS},
    }
    rows, worst = [], {}
    for item in study.track(STEPS, "defects"):
        cells = []
        for kind, condition in kinds.items():
            random = np.random.default_rng(study.seed)
            found = []
            for _ in range(_BASES):
                there = random_transformation(
                    random, max(condition, 1.0), tracks.n_views, tracks.n_points
                )
                if condition == 0.0:
                    there.T[...] = np.eye(4)
                if condition == -1.0:
                    there.camera_scales[:] = there.point_scales[:] = 1.0
                found.append(step_defect(tracks, start, item, there))
            cells.append(float(max(found)))
            worst[item.label, kind] = cells[-1]
        rows.append((item.label, *cells))
    table1 = worst["Table 1, norm of R^T R", "condition 10"]
    ours = max(value for (label, _), value in worst.items() if label == STEPS[-1].label)
    return Section(
        "Invariance defect of one step",
        [
            "Largest |delta' - T~ delta| / |delta'| over random T~ (B03 eq. 7), with the same "
            "lambda in both bases. The proofs are on the page on gauges.",
            Table("defects", "Largest defect.", ("damping", *kinds), rows, ("", ".0e")),
        ],
        [
            Claim(
                "Proposition 2",
                "the damping of Table 1 satisfies eq. (8)",
                table1 < 1e-6,
                f"defect {table1:.1e} in bases of condition 10; lambda I "
                f"{worst['lambda I', 'condition 10']:.1e}",
            ),
            Claim(
                "footnote 2",
                "lambda I is invariant under orthonormal changes of basis",
                worst["lambda I", "orthonormal T, unit scales"] < 1e-9,
                f"defect {worst['lambda I', 'orthonormal T, unit scales']:.1e}",
            ),
            Claim(
                "not in the paper",
                "covariant damping is invariant under every T~",
                ours < 1e-9,
                f"largest defect {ours:.1e}, condition 1000 and random scales included",
            ),
        ],
    )
