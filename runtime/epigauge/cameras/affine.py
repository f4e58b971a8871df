"""Scenes of affine cameras: parallel sight, as of objects far away for their size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from epigauge._arguments import as_real
from epigauge.cameras.checks import counted, finite_rows, frozen
from epigauge.errors import ArgumentError
from epigauge.multi_view.reconstruction import Reconstruction, ReconstructionBase
from epigauge.multi_view.tracks import Tracks

__all__ = ["AffineReconstruction"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AffineReconstruction(ReconstructionBase):
    """Affine cameras and points: shape up to an affine change of space.

    Parameters
    ----------
    P : array_like, shape (n, 2, 4) or (n, 3, 4)
        Cameras, to pixels: ``q = P[:2] (X, 1)``. A third row is (0, 0, 0, 1).
    X : array_like, shape (m, 3)
        Points.

    Raises
    ------
    ArgumentError
        On other shapes, numbers that are not finite, and another third row.

    Examples
    --------
    >>> import numpy as np, epigauge as eg
    >>> eg.AffineReconstruction(np.ones((3, 2, 4)), np.zeros((5, 3)))
    AffineReconstruction(3 views, 5 points)
    """

    P: Array
    X: Array

    def __post_init__(self) -> None:
        given = as_real("P", self.P, "(n, 2, 4) or (n, 3, 4)")
        if given.ndim == 3 and given.shape[1:] == (3, 4):
            other = np.flatnonzero((given[:, 2] != np.array([0.0, 0.0, 0.0, 1.0])).any(axis=1))
            if len(other):
                was = f"has the third row {given[other[0], 2].tolist()} in camera {other[0]}"
                needed = "0 0 0 1: divide P by its last entry, or eg.Reconstruction(P, Q)"
                raise ArgumentError("P", was, needed)
            given = given[:, :2]
        P = finite_rows("P", given, (2, 4), "two rows a view")
        X = finite_rows("X", self.X, (3,), "one point a row")
        for name, array, what in (("P", P, "camera"), ("X", X, "point")):
            if not len(array):
                raise ArgumentError(name, "has no row", f"at least one {what}")
        last = np.broadcast_to(np.array([0.0, 0.0, 0.0, 1.0]), (len(P), 1, 4))
        object.__setattr__(self, "P", frozen(np.concatenate([P, last], axis=1)))
        object.__setattr__(self, "X", frozen(X))

    @property
    def n_views(self) -> int:
        """Number of views."""
        return len(self.P)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self.X)

    @property
    def vectors(self) -> Array:
        """What the kernels of the model take for each view, (n, 12)."""
        return self.P.reshape(-1, 12)

    def project(self, tracks: Tracks) -> Array:
        """Return the predicted pixels of all observations.

        Parameters
        ----------
        tracks : Tracks
            Which point is seen in which view.

        Returns
        -------
        ndarray, shape (N, 2)
            In the tracks' order.

        Raises
        ------
        ArgumentError
            If the tracks are of other numbers of views or points.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
        >>> view, point = np.divmod(np.arange(80), 20)
        >>> affine.project(eg.Tracks(view, point, np.zeros((80, 2)))).shape
        (80, 2)
        """
        self.check_fits(tracks)
        P = self.P[tracks.view, :2]
        return np.asarray(np.einsum("nij,nj->ni", P[:, :, :3], self.X[tracks.point]) + P[:, :, 3])

    def to_projective(self) -> Reconstruction:
        """Return the scene as projective cameras and points, which project to the same pixels.

        Returns
        -------
        Reconstruction
            A start for perspective: its cameras have their centres at infinity.

        Examples
        --------
        >>> import epigauge as eg, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> affine = eg.AffineReconstruction(rng.normal(size=(4, 2, 4)), rng.normal(size=(20, 3)))
        >>> affine.to_projective().P.shape
        (4, 3, 4)
        """
        return Reconstruction(self.P, np.column_stack([self.X, np.ones(len(self.X))]))

    def _heading(self) -> str:
        return repr(self)

    def _summary_rows(self) -> dict[str, str]:
        return {"cameras": "affine, known up to an affine change of space"}

    def __reduce__(self) -> tuple[type, tuple[Array, Array]]:
        """Pickle the arguments: arrays from a pickle could be written to."""
        return type(self), (self.P, self.X)

    def __repr__(self) -> str:
        views, points = counted(self.n_views, "view"), counted(self.n_points, "point")
        return f"AffineReconstruction({views}, {points})"
