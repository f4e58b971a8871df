"""Which matches contradict each other."""

from collections import Counter

import numpy as np
import pytest
from epigauge.two_view.copies import contradicted


@pytest.mark.parametrize("seed", range(40))
def test_points_with_more_than_five_matches_are_those_counted_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = int(rng.integers(0, 60))
    # Few columns and rows: most points share a coordinate with many others, some both.
    x1, x2 = (
        np.column_stack([rng.integers(0, across, m), rng.integers(0, down, m)]).astype(float)
        for across, down in rng.integers(1, 9, (2, 2))
    )
    counts = [Counter(map(tuple, x.tolist())) for x in (x1, x2)]
    several = [
        any(count[tuple(x[k])] > 5 for count, x in zip(counts, (x1, x2), strict=True))
        for k in range(m)
    ]
    assert contradicted(x1, x2).tolist() == several
