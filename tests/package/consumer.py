"""A program of a user, for type checkers: what they know about the installed package.

`tox -e types` checks it with mypy --strict against the wheel, tests/package/test_installed.py
runs it.
"""

from typing import assert_type

import epigauge as eg
import numpy as np
from epigauge.errors import MissingPackageError
from numpy.typing import NDArray


def refined(x1: NDArray[np.float64], x2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F, or stop the program."""
    try:
        result = eg.refine_fundamental(x1, x2, noise_px=None, loss="huber")
    except eg.ArgumentError as error:
        raise SystemExit(f"{assert_type(error.argument, str)}: {error}") from None
    assert_type(result, eg.FundamentalResult)
    assert_type(result.sigma, float)
    assert_type(result.success, bool)
    assert_type(result.covariance, NDArray[np.float64])
    return result.F


def adjusted(tracks: eg.Tracks) -> eg.Reconstruction:
    """Return cameras and points."""
    start = eg.initialize(tracks)
    result = eg.bundle_adjust(tracks, start, gauge=eg.gauge.reference_camera())
    assert_type(result.rms_px, float)
    found = result.reconstruction  # of the type of the start, which the type checker cannot know
    assert isinstance(found, eg.Reconstruction)
    return found


def main() -> None:
    """Use two views, many views and what lies beside them."""
    scene = eg.two_view_scene(seed=1)
    F = refined(scene.x1, scene.x2)
    distances, first, second = eg.reprojection_distances(F, scene.x1, scene.x2)
    assert_type(distances, NDArray[np.float64])
    assert first.shape == second.shape == scene.x1.shape
    # Lists and integers are taken, too.
    assert eg.fundamental_8point(scene.x1.tolist(), np.round(scene.x2).astype(int)).shape == (3, 3)
    adjusted(eg.multi_view_scene(n_points=20).tracks)
    assert_type(eg.backend(), str)
    assert_type(eg.datasets.names(), tuple[str, ...])
    assert issubclass(MissingPackageError, eg.EpigaugeError)
    # A name that there is not, and an option of the wrong type, are errors to a checker.
    assert not hasattr(eg, "refine")
    if not scene:
        eg.refine(scene)  # type: ignore[attr-defined]
        eg.refine_fundamental(scene.x1, scene.x2, max_iter="many")  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
