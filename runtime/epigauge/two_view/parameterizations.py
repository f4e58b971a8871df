"""Ways to represent and update a fundamental matrix during the optimisation.

Each offers the same few methods, so that the problems know nothing of the representation: `start`,
`fundamental`, `retract`, and derivatives of F (`derivatives`) and of the second camera (`camera`)
by the update parameters, at no update.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.kernels import Table

__all__ = [
    "PARAMETERIZATIONS",
    "RESTRICTABLE",
    "Block",
    "BlockF",
    "Maps",
    "MapsF",
    "Ortho",
    "OrthonormalF",
    "ParFree",
    "Parameterization",
    "Reduced",
    "Remapped",
    "factorize",
    "frozen_directions",
]

Array = NDArray[np.float64]
Parts = dict[str, tuple[int, ...]]


class Parameterization(Protocol):
    """A representation of F with p update parameters."""

    @property
    def dimension(self) -> int:
        """Return p."""

    def start(self, F: Array) -> Any:
        """Return the representation of the rank-2 matrix nearest to F."""

    def fundamental(self, estimate: Any) -> Array:
        """Return F, of any scale."""

    def derivatives(self, estimate: Any) -> tuple[Array, Array]:
        """Return first (9, p) and second (9, p, p) derivatives of vect(F) at no update."""

    def camera(self, estimate: Any) -> tuple[Array, Array]:
        """Return P' for P = (I | 0), and its derivative (12, p) at no update."""

    def retract(self, estimate: Any, delta: Array) -> Any:
        """Return the estimate moved by p parameters."""


class OrthonormalF(NamedTuple):
    """The orthonormal representation F ~ U diag(1, sigma, 0) V^T of B&S section 3.2.

    Attributes
    ----------
    U, V : ndarray, shape (3, 3)
        Orthonormal matrices; the epipoles are their last columns, e' = u3 and e = v3.
    sigma : ndarray, shape ()
        Ratio of the singular values.
    """

    U: Array
    V: Array
    sigma: Array


def factorize(F: Array) -> OrthonormalF:
    """Return the orthonormal representation of the rank-2 matrix nearest to F.

    Parameters
    ----------
    F : ndarray, shape (3, 3)
        Not zero; of any scale and sign.

    Returns
    -------
    OrthonormalF
        With 0 <= sigma <= 1 (B&S Table 1, step i').
    """
    U, values, Vt = np.linalg.svd(F)
    return OrthonormalF(U, Vt.T, np.asarray(values[1] / values[0]))


class Ortho:
    """Seven parameters: U <- U R(x), V <- V R(y), sigma <- sigma + delta_sigma (B&S eq. 3)."""

    dimension = 7
    #: Parameters that move each part of the epipolar geometry (B&S section 4.4).
    parts: ClassVar[Parts] = {
        "epipole2": (0, 1),
        "epipole1": (3, 4),
        "epipolar_transformation": (2, 5, 6),
    }

    def __init__(self, kernels: Table) -> None:
        self._kernels = kernels

    def start(self, F: Array) -> OrthonormalF:
        """Return the orthonormal representation."""
        return factorize(F)

    def fundamental(self, estimate: OrthonormalF) -> Array:
        """Return F (B&S eq. 2)."""
        return np.asarray(self._kernels.fundamental_from_factors(*estimate))

    def derivatives(self, estimate: OrthonormalF) -> tuple[Array, Array]:
        """Return the derivatives of F."""
        _, first, second = self._kernels.fundamental_derivatives(*estimate)
        return first, second

    def camera(self, estimate: OrthonormalF) -> tuple[Array, Array]:
        """Return P' (B&S eq. 5) and A_perp (B&S eqs. 6, 7)."""
        P2, A_perp = self._kernels.canonical_camera_derivatives(*estimate)
        return P2, A_perp

    def retract(self, estimate: OrthonormalF, delta: Array) -> OrthonormalF:
        """Return the updated factors."""
        return OrthonormalF(*self._kernels.retract_factors(*estimate, delta))


class BlockF(NamedTuple):
    """F = U12 M V12^T: first two columns of orthonormal U, V, and a 2x2 matrix of unit norm."""

    U: Array
    V: Array
    M: Array


class Block:
    """Seven parameters, regular at sigma = 1: the epipoles by rotations, M in its tangent plane."""

    dimension = 7
    #: Parameters that move each part of the epipolar geometry.
    parts: ClassVar[Parts] = {
        "epipole2": (0, 1),
        "epipole1": (2, 3),
        "epipolar_transformation": (4, 5, 6),
    }

    def __init__(self, kernels: Table) -> None:
        self._kernels = kernels

    def start(self, F: Array) -> BlockF:
        """Return the block representation."""
        U, V, sigma = factorize(F)
        return BlockF(U, V, np.diag([1.0, float(sigma)]) / np.hypot(1.0, sigma))

    def fundamental(self, estimate: BlockF) -> Array:
        """Return F."""
        return np.asarray(self._kernels.block_fundamental(*estimate))

    def derivatives(self, estimate: BlockF) -> tuple[Array, Array]:
        """Return the derivatives of F."""
        _, first, second = self._kernels.block_derivatives(*estimate)
        return first, second

    def camera(self, estimate: BlockF) -> tuple[Array, Array]:
        """Return the canonic P' and its derivative."""
        P2, derivative = self._kernels.block_camera_derivatives(*estimate)
        return P2, derivative

    def retract(self, estimate: BlockF, delta: Array) -> BlockF:
        """Return the updated factors."""
        return BlockF(*self._kernels.block_retract(*estimate, delta))


class MapsF(NamedTuple):
    """Epipoles and epipolar transformation in one of 36 charts.

    Attributes
    ----------
    axes1, axes2 : tuple of int
        Order of the axes of each image: the last axis is that of the epipole's largest entry, the
        first that of the largest entry of the epipolar transformation. These entries are one.
    parameters : ndarray, shape (7,)
        The others, in that order.
    """

    axes1: tuple[int, ...]
    axes2: tuple[int, ...]
    parameters: Array


class Maps:
    """Seven parameters in the best of 36 charts, chosen anew after every update (B&S section 2)."""

    dimension = 7

    def __init__(self, kernels: Table) -> None:
        self._kernels = kernels

    def start(self, F: Array) -> MapsF:
        """Return the chart that freezes the largest entries, and the parameters in it."""
        U, _, V = np.linalg.svd(F)
        e, e_ = V[2], U[:, 2]
        i, j = int(np.argmax(np.abs(e))), int(np.argmax(np.abs(e_)))
        inner = np.delete(np.delete(F, j, axis=0), i, axis=1)
        row, column = np.divmod(int(np.argmax(np.abs(inner))), 2)
        axes1 = _leading(int(np.delete(range(3), i)[column]), i)
        axes2 = _leading(int(np.delete(range(3), j)[row]), j)
        e, e_, F = e[[*axes1]], e_[[*axes2]], F[np.ix_(axes2, axes1)]
        free = (e[:2] / e[2], e_[:2] / e_[2], F[:2, :2].ravel()[1:] / F[0, 0])
        return MapsF(axes1, axes2, np.concatenate(free))

    def fundamental(self, estimate: MapsF) -> Array:
        """Return F."""
        return self._all(estimate)[0]

    def derivatives(self, estimate: MapsF) -> tuple[Array, Array]:
        """Return the derivatives of F."""
        _, first, second, _, _ = self._all(estimate)
        return first, second

    def camera(self, estimate: MapsF) -> tuple[Array, Array]:
        """Return the canonic P' and its derivative."""
        _, _, _, P2, derivative = self._all(estimate)
        return P2, derivative

    def retract(self, estimate: MapsF, delta: Array) -> MapsF:
        """Return the updated matrix in the chart that suits it best."""
        return self.start(self.fundamental(estimate._replace(parameters=estimate[2] + delta)))

    def _all(self, estimate: MapsF) -> tuple[Array, Array, Array, Array, Array]:
        """Return F, dF, d2F, P2, dP2 with their axes put back in the order of the images'."""
        axes1, axes2, parameters = estimate
        F, dF, d2F, P2, dP2 = self._kernels.maps(parameters)
        back1, back2 = np.argsort(axes1), np.argsort(axes2)
        entries = np.ix_(back2, back1)
        # [S' e']_x = det(S') S' [e']_x S'^T: an odd order turns the sign of [e']_x F.
        signs = np.array([*3 * [np.linalg.det(np.eye(3)[back2])], 1.0])
        rows = np.ix_(back2, np.append(back1, 3))
        return (
            F[entries],
            dF.reshape(3, 3, 7)[entries].reshape(9, 7),
            d2F.reshape(3, 3, 7, 7)[entries].reshape(9, 7, 7),
            P2[rows] * signs,
            (dP2.reshape(3, 4, 7)[rows] * signs[:, None]).reshape(12, 7),
        )


def _leading(first: int, last: int) -> tuple[int, ...]:
    """Return the order of three axes that begins and ends with the given ones."""
    return first, 3 - first - last, last


class ParFree:
    """The twelve entries of P' with P = (I | 0): five more than needed (B&S section 5)."""

    dimension = 12

    def __init__(self, kernels: Table) -> None:
        self._kernels = kernels

    def start(self, F: Array) -> Array:
        """Return the canonic P' of F."""
        return np.asarray(self._kernels.canonical_camera(*factorize(F)))

    def fundamental(self, estimate: Array) -> Array:
        """Return [p4]_x H for P' = (H | p4)."""
        return np.cross(estimate[:, 3], estimate[:, :3], axisb=0, axisc=0)

    def camera(self, estimate: Array) -> tuple[Array, Array]:
        """Return P' itself."""
        return estimate, np.eye(12)

    def retract(self, estimate: Array, delta: Array) -> Array:
        """Return the sum."""
        return estimate + delta.reshape(3, 4)


class Reduced:
    """A parameterisation restricted to some directions of its update.

    Parameters
    ----------
    inner : Parameterization
        Whose parameters are restricted.
    basis : ndarray, shape (p, k)
        Columns are the k directions left; a row of zeros freezes a parameter exactly.
    """

    def __init__(self, inner: Ortho | Block, basis: Array) -> None:
        self.inner, self.basis = inner, basis
        self.dimension = basis.shape[1]

    def recombined(self, mixing: Array) -> Reduced:
        """Return the same restriction with other parameters: `mixing` (k, k) times the new ones."""
        return Reduced(self.inner, self.basis @ mixing)

    def start(self, F: Array) -> Any:
        """Return the inner representation."""
        return self.inner.start(F)

    def fundamental(self, estimate: Any) -> Array:
        """Return F."""
        return self.inner.fundamental(estimate)

    def derivatives(self, estimate: Any) -> tuple[Array, Array]:
        """Return derivatives by the directions left."""
        first, second = self.inner.derivatives(estimate)
        return first @ self.basis, self.basis.T @ second @ self.basis

    def camera(self, estimate: Any) -> tuple[Array, Array]:
        """Return P' and its derivative by the directions left."""
        P2, derivative = self.inner.camera(estimate)
        return P2, derivative @ self.basis

    def retract(self, estimate: Any, delta: Array) -> Any:
        """Return the estimate moved along the directions left."""
        return self.inner.retract(estimate, self.basis @ delta)


class Remapped:
    """A restricted parameterisation of F in other coordinates than those that are computed in.

    Freezing a part of F, or sigma = 1, means something in given coordinates only: the caller's
    pixels, or those of calibrated cameras.

    Parameters
    ----------
    inner : Parameterization
        Of F in its own coordinates.
    to1, to2 : ndarray, shape (3, 3)
        Homogeneous maps of the images from its coordinates to those computed in.
    anchor : ndarray, shape (3, 3), optional
        The only F to start from, in its own coordinates: parts of it stay exactly as they are.
    """

    def __init__(
        self, inner: Parameterization, to1: Array, to2: Array, anchor: Array | None = None
    ) -> None:
        self.inner, self._anchor = inner, anchor
        self._to1, self._to2 = to1, to2
        self._from1 = np.linalg.inv(to1)
        one, two = self._from1.T, np.linalg.inv(to2).T
        self.entries = (two[:, None, :, None] * one[None, :, None, :]).reshape(9, 9)  # Kronecker's
        self.dimension = inner.dimension

    def start(self, F: Array) -> Any:
        """Return the inner representation, of the anchor if there is one."""
        if self._anchor is not None:
            return self.inner.start(self._anchor)
        return self.inner.start(self._to2.T @ F @ self._to1)

    def balanced(self, F: Array) -> Remapped:
        """Return the same with parameters that move F at right angles and equally far.

        Equally far in the coordinates computed in, at a start value: pixels, where an epipole moves
        by 1e-6 or by 1, would otherwise give the damping a meaningless scale.
        """
        estimate = self.start(F)
        f = self.fundamental(estimate).ravel()
        derivative = self.derivatives(estimate)[0]
        derivative -= np.outer(f, f @ derivative) / (f @ f)
        sizes = np.maximum(np.linalg.norm(derivative, axis=0), np.finfo(float).tiny)
        # The unit matrix below keeps the triangle regular where directions coincide
        stacked = np.vstack([derivative / sizes, 1e-6 * np.eye(self.dimension)])
        triangle = np.linalg.qr(stacked)[1] * sizes / np.linalg.norm(f)
        assert isinstance(self.inner, Reduced)
        inner = self.inner.recombined(np.linalg.inv(triangle))
        return Remapped(inner, self._to1, self._to2, self._anchor)

    def fundamental(self, estimate: Any) -> Array:
        """Return F in the coordinates computed in."""
        return (self.entries @ self.inner.fundamental(estimate).ravel()).reshape(3, 3)

    def derivatives(self, estimate: Any) -> tuple[Array, Array]:
        """Return derivatives of F in the coordinates computed in."""
        first, second = self.inner.derivatives(estimate)
        return self.entries @ first, np.tensordot(self.entries, second, axes=1)

    def camera(self, estimate: Any) -> tuple[Array, Array]:
        """Return P' for P = (I | 0) in the coordinates computed in."""
        P2, derivative = self.inner.camera(estimate)
        back = np.eye(4)
        back[:3, :3] = self._from1
        return self._to2 @ P2 @ back, np.kron(self._to2, back.T) @ derivative

    def retract(self, estimate: Any, delta: Array) -> Any:
        """Return the estimate moved by the inner update."""
        return self.inner.retract(estimate, delta)


def frozen_directions(parts: Parts, fix: tuple[str, ...]) -> Array:
    """Return the basis for `Reduced` that freezes parts of the epipolar geometry.

    Parameters
    ----------
    parts : dict
        Parameters of each part, as `Ortho.parts`.
    fix : tuple of str
        Parts to freeze.

    Returns
    -------
    ndarray, shape (7, k)
        Unit vectors of the parameters left.
    """
    frozen = {index for part in fix for index in parts[part]}
    return np.eye(7)[:, [k for k in range(7) if k not in frozen]]


#: Those whose parameters keep the parts of the epipolar geometry separate.
RESTRICTABLE: dict[str, type[Ortho] | type[Block]] = {"ortho": Ortho, "block": Block}

#: The minimal parameterisations by name: of F alone, for any structure.
PARAMETERIZATIONS: dict[str, type[Ortho] | type[Block] | type[Maps]] = {
    "ortho": Ortho,
    "block": Block,
    "maps": Maps,
}
