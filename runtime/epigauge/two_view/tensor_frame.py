"""Conditioned coordinates of many pairs at once, and the 8-point estimates there."""

from __future__ import annotations

from typing import Any

from epigauge import arrays
from epigauge.two_view.conditioning import OFFSET, RMS

__all__ = ["Frame", "eight_point"]

Tensor = Any


class Frame:
    """Conditioned coordinates of each pair, as `epigauge.two_view.conditioning`."""

    def __init__(self, xp: Any, origin1: Tensor, origin2: Tensor, scale: Tensor) -> None:
        self.xp, self.origin1, self.origin2, self.scale = xp, origin1, origin2, scale

    @staticmethod
    def of(xp: Any, x1: Tensor, x2: Tensor, weights: Tensor) -> Frame:
        """Return centroids and one scale of the matches that count."""
        counts = xp.astype(weights > 0.0, x1.dtype)[..., None]
        number = xp.sum(counts, axis=1)
        origin1, origin2 = (xp.sum(counts * x, axis=1) / number for x in (x1, x2))
        squares = sum(
            xp.sum(counts * (x - origin[:, None, :]) ** 2, axis=(1, 2)) / (2.0 * number[:, 0])
            for x, origin in ((x1, origin1), (x2, origin2))
        )
        return Frame(xp, origin1, origin2, xp.sqrt(0.5 * squares) / RMS)

    def forward(self, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        """Return both point sets conditioned, shape (2, n, m)."""
        scale = self.scale[:, None, None]
        q1, q2 = (x1 - self.origin1[:, None, :]) / scale, (x2 - self.origin2[:, None, :]) / scale
        return self.xp.permute_dims(q1, (2, 0, 1)), self.xp.permute_dims(q2, (2, 0, 1))

    def displaced(self, F: Tensor) -> tuple[Frame, Tensor]:
        """Return the frame with the second origin off the centroid, and F there."""
        xp = self.xp
        normal = F[:, :2, 2]
        length = xp.sqrt(xp.sum(normal**2, axis=-1))[:, None]
        known = length > 0.0
        axis = xp.asarray([1.0, 0.0], dtype=F.dtype, device=arrays.device(F))
        direction = xp.where(known, normal / xp.where(known, length, 1.0), axis)
        first = xp.abs(direction[:, :1]) >= xp.abs(direction[:, 1:])
        leading = xp.where(first, direction[:, :1], direction[:, 1:])
        shift = OFFSET * direction * _signs(xp, leading)
        moved = Frame(xp, self.origin1, self.origin2 - self.scale[:, None] * shift, self.scale)
        # q2_old = q2_new - shift: F_new = T^T F with T the map from new to old coordinates.
        last = F[:, 2, :] - xp.sum(shift[:, :, None] * F[:, :2, :], axis=1)
        F = xp.stack([F[:, 0, :], F[:, 1, :], last], axis=1)
        return moved, _unit(xp, F)

    def from_pixels(self, F: Tensor) -> Tensor:
        """Return the conditioned F of unit norm."""
        return self._mapped(F, self.scale, (self.origin1, self.origin2))

    def to_pixels(self, F: Tensor) -> Tensor:
        """Return F for pixels, of unit norm."""
        back = -self.origin1 / self.scale[:, None], -self.origin2 / self.scale[:, None]
        return self._mapped(F, 1.0 / self.scale, back)

    def _mapped(self, F: Tensor, scale: Tensor, origins: tuple[Tensor, Tensor]) -> Tensor:
        """Return T2^T F T1 of unit norm, T = [[scale I, origin], [0, 1]]."""
        xp = self.xp
        for origin in origins:  # the columns by the first origin, then the rows by the second
            last = F[:, :, 2] + xp.sum(F[:, :, :2] * origin[:, None, :], axis=-1)
            F = xp.concat([F[:, :, :2] * scale[:, None, None], last[..., None]], axis=-1)
            F = xp.permute_dims(F, (0, 2, 1))
        return _unit(xp, F)


def eight_point(xp: Any, q1: Tensor, q2: Tensor, weights: Tensor) -> Tensor:
    """Return normalised 8-point estimates (n, 3, 3) in the coordinates of q1 and q2."""
    counts = xp.astype(weights > 0.0, q1.dtype)
    number = xp.sum(counts, axis=-1)
    scales, rows = [], []
    for q in (q1, q2):  # centred; one scale an image
        scale = xp.sqrt(xp.sum(counts * q**2, axis=(0, 2)) / (2.0 * number))
        scales.append(scale)
        rows.append(
            [q[0, ...] / scale[:, None], q[1, ...] / scale[:, None], xp.ones_like(q[0, ...])]
        )
    products = xp.stack([counts * b * a for b in rows[1] for a in rows[0]], axis=-1)
    f = xp.linalg.eigh(xp.matrix_transpose(products) @ products)[1][:, :, 0]
    f = f * _signs(xp, _first_large(xp, f))[:, None]
    U, values, Vt = xp.linalg.svd(xp.reshape(f, (-1, 3, 3)))
    F = (U[:, :, :2] * values[:, None, :2]) @ Vt[:, :2, :]
    one = xp.ones_like(scales[0])
    left = xp.stack([one / scales[1], one / scales[1], one], axis=-1)
    right = xp.stack([one / scales[0], one / scales[0], one], axis=-1)
    return _unit(xp, left[:, :, None] * F * right[:, None, :])


def _first_large(xp: Any, f: Tensor) -> Tensor:
    """Return of each row the first entry above half of the largest: its sign is made positive."""
    found = f[:, 8]
    large = xp.abs(f) > 0.5 * xp.max(xp.abs(f), axis=-1)[:, None]
    for k in range(7, -1, -1):
        found = xp.where(large[:, k], f[:, k], found)
    return found


def _signs(xp: Any, values: Tensor) -> Tensor:
    """Return -1 or 1, which is that of zero."""
    one = xp.ones_like(values)
    return xp.where(values < 0.0, -one, one)


def _unit(xp: Any, F: Tensor) -> Tensor:
    return F / xp.sqrt(xp.sum(F**2, axis=(1, 2)))[:, None, None]
