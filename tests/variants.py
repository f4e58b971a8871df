"""Run tests with each variant of the C library that this machine can use: python tests/variants.py.

Arguments are passed on to pytest; by default the tests that compare the compiled code with NumPy.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from epigauge import _library, kernels

TESTS = Path(__file__).parent
DEFAULT = (
    *("generated/test_backends.py", "generated/test_foot_points.py", "generated/test_table.py"),
    *(
        "runtime/test_two_view_native.py",
        "runtime/test_batch.py",
        "runtime/test_native_linearizer.py",
    ),
    *("runtime/test_bundle_native.py", "generated/test_joint.py", "runtime/test_two_view_fused.py"),
)


def main() -> int:
    """Return 1 when a run fails."""
    if (reason := kernels.available()["c"]) is not None:
        print(f"nothing to compare: the C library {reason}")
        return os.environ.get("EPIGAUGE_REQUIRE_C") == "1"
    arguments = sys.argv[1:] or [str(TESTS / name) for name in DEFAULT]
    failed = 0
    for name in _library.usable():
        print(f"\n## {name}\n", flush=True)
        environment = os.environ | {_library.CHOICE: name}
        command = [sys.executable, "-m", "pytest", "-n", "auto", "-m", "not slow", *arguments]
        failed |= subprocess.run(command, env=environment, check=False).returncode != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
