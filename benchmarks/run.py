"""Run the benchmarks one after the other, and write the tables of the documentation.

python benchmarks/run.py [--quick]
python benchmarks/run.py --tables docs/benchmarks    # those of docs/benchmarks.md
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

#: Script, arguments of a quick run. Those of packages that are not installed say so and go on.
SCRIPTS = {
    "evaluations.py": ["--trials", "5"],
    "bias.py": ["--trials", "50"],
    "robust.py": ["--trials", "3"],
    "databases.py": ["--images", "4", "--runs", "1"],
    "two_views.py": ["--quick"],
    "kernels.py": ["--quick"],
    "many_views.py": ["--quick"],
    "metric_views.py": ["--runs", "1"],
    "covariances.py": ["--runs", "1"],
    "sequences.py": ["--quick"],
    "imports.py": ["--runs", "3"],
}

#: Those whose output docs/benchmarks.md shows, and what else it needs of them.
TABLES: dict[str, list[str]] = {
    "two_views.py": [],
    "kernels.py": [],
    "many_views.py": ["--plot", "growth.png"],
    "metric_views.py": [],
    "covariances.py": ["--peers"],
    "sequences.py": [],
    "imports.py": [],
}


def main() -> int:
    """Run them; return 1 when one fails."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small problems, few runs")
    parser.add_argument("--tables", type=Path, metavar="FOLDER", help="write the tables there")
    options = parser.parse_args()
    if options.tables:
        return write(options.tables)
    failed = 0
    for script, arguments in SCRIPTS.items():
        print(f"\n## {script}\n", flush=True)
        done = subprocess.run(command(script, arguments if options.quick else []), check=False)
        failed |= done.returncode != 0
    return int(failed)


def write(folder: Path) -> int:
    """Write what the benchmarks print to files of Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    for script, arguments in TABLES.items():
        done = subprocess.run(
            command(script, arguments), cwd=folder, stdout=subprocess.PIPE, text=True, check=False
        )
        if done.returncode:
            return 1
        (folder / script).with_suffix(".txt").write_text(done.stdout)
    return 0


def command(script: str, arguments: list[str]) -> list[str]:
    """Return how a benchmark is run."""
    return [sys.executable, str(Path(__file__).resolve().with_name(script)), *arguments]


if __name__ == "__main__":
    sys.exit(main())
