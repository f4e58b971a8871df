"""What a verdict says."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Verdict"]


@dataclass(frozen=True)
class Verdict:
    """What is to be known of a reconstruction before it is used.

    Attributes
    ----------
    flags : tuple of str
        Names from `epigauge.verdicts.FLAGS`.
    rank : int
        Of the normal matrix; 11 n + 3 m - 15 where all is determined, n and m being the numbers of
        views and points that count, these with two observations.
    n_behind : int
        Observations of points behind the camera, signs of cameras and points being chosen best.
    condition, weakest : float, str
        See `BundleResult`.
    """

    flags: tuple[str, ...]
    rank: int
    n_behind: int
    condition: float = float("inf")
    weakest: str = ""
