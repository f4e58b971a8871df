"""The back ends that can be used here; a test that asks for a table runs once for each."""

from __future__ import annotations

import pytest
from epigauge import kernels


@pytest.fixture(params=kernels.NAMES)
def table(request: pytest.FixtureRequest) -> kernels.Table:
    """Return the kernels of one back end; skip where it is missing, with the reason."""
    reason = kernels.available()[request.param]
    if reason:
        pytest.skip(f"back end {request.param} {reason}")
    return kernels.table(request.param)
