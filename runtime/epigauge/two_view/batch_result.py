"""The results of many image pairs, one row a pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from epigauge import lm
from epigauge.two_view._partial import Partial
from epigauge.two_view.tensors import REFUSED

__all__ = ["BATCH_STATUS", "FundamentalBatch"]

Array = NDArray[np.float64]

#: Meaning of `FundamentalBatch.status`.
BATCH_STATUS = lm.STATUS | {REFUSED: "the matches of this pair cannot determine F: see `reasons`"}


@dataclass(frozen=True)
class FundamentalBatch(Partial):
    """Results of many pairs, one row a pair; fields as in `FundamentalResult`.

    Attributes
    ----------
    F : ndarray, shape (n, 3, 3)
        Fundamental matrices; zero where the pair was refused.
    sigma, cost, rms_px, noise_px, condition : ndarray, shape (n,)
        Per pair; zero where it was refused, `condition` infinite.
    covariance : ndarray, shape (n, 9, 9)
        Covariance of vect(F); infinite on the diagonal where it is not determined.
    rank, nfev, njev, nit, status : ndarray of int, shape (n,)
        Per pair; `status` is that of `BATCH_STATUS`, -9 for a refused pair.
    success : ndarray of bool, shape (n,)
        Whether the pair may be used, as `FundamentalResult.success`; computed when asked for.
    distances : ndarray, shape (m,)
        Signed distances of all matches, in the order they were given.
    reasons : dict of int to str
        Why a pair was refused, by its number.
    flags : tuple of tuple of str
        What each pair's matches do not support, as `FundamentalResult.flags`; empty for refused
        pairs. Computed when asked for.

    Examples
    --------
    >>> import epigauge as eg
    >>> matches = eg.load_matches(eg.samples.path("matches.csv"))
    >>> result = eg.refine_fundamental_batch(matches.x1, matches.x2, [0, len(matches)])
    >>> result.F.shape, result.success.tolist(), result.reasons
    ((1, 3, 3), [True], {})
    """

    F: Array
    sigma: Array
    cost: Array
    rms_px: Array
    noise_px: Array
    condition: Array
    covariance: Array
    rank: NDArray[np.intp]
    nfev: NDArray[np.intp]
    njev: NDArray[np.intp]
    nit: NDArray[np.intp]
    status: NDArray[np.intp]
    success: NDArray[np.bool_]
    distances: Array
    reasons: dict[int, str]
    flags: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.F)

    def _arrays(self) -> dict[str, Any]:
        reasons = [self.reasons.get(k, "") for k in range(len(self))]
        flags = ["; ".join(names) for names in self.flags]
        return self._contents() | {"reasons": reasons, "flags": flags}

    def _heading(self) -> str:
        return f"FundamentalBatch: {len(self)} pairs"

    def _summary_rows(self) -> dict[str, str]:
        done, refused = self.status > 0, len(self.reasons)
        rows = {"converged": f"{np.count_nonzero(done)} of {len(self)}", "refused": str(refused)}
        if done.any():
            rows["median rms_px"] = f"{np.median(self.rms_px[done]):.6g}"
            rows["median nfev"] = f"{np.median(self.nfev[done]):g}"
        return rows

    def _explained(self) -> dict[str, str]:
        return {f"pair {k}": reason for k, reason in list(self.reasons.items())[:5]}
