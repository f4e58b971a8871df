"""Run the benchmarks one after the other: python benchmarks/run.py [--quick]."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

#: Script, arguments of a quick run. Those of packages that are not installed say so and go on.
SCRIPTS = {
    "evaluations.py": ["--trials", "5"],
    "bias.py": ["--trials", "50"],
    "robust.py": ["--trials", "3"],
    "two_views.py": ["--quick"],
    "kernels.py": ["--quick"],
    "imports.py": ["--runs", "3"],
}


def main() -> int:
    """Run them; return 1 when one fails."""
    quick = "--quick" in sys.argv[1:]
    failed = 0
    for script, arguments in SCRIPTS.items():
        print(f"\n## {script}\n", flush=True)
        path = Path(__file__).with_name(script)
        done = subprocess.run([sys.executable, path, *(arguments if quick else [])], check=False)
        failed |= done.returncode != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
