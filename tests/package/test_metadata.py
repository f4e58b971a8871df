"""Statements about versions that stand in more than one place."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import epigauge
import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]


def test_lowest_tested_versions_are_the_lowest_declared() -> None:
    extras = PROJECT["optional-dependencies"]
    requirements = [
        *PROJECT["dependencies"],
        *(line for extra in ("plot", "cli", "casadi") for line in extras[extra]),
    ]
    declared = dict(line.split(",")[0].split(">=") for line in requirements)
    lines = (CHECKOUT / "tests" / "package" / "lowest.txt").read_text().splitlines()
    tested = dict(line.split("==") for line in lines if "==" in line)
    assert tested == declared


def test_version_is_one() -> None:
    cited = re.search(r"^version: (.+)$", (CHECKOUT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited
    versions = {metadata.version("epigauge"), epigauge.__version__, PROJECT["version"], cited[1]}
    assert len(versions) == 1


@pytest.mark.parametrize("package", ["runtime/epigauge", "generated/epigauge_generated"])
def test_package_says_that_it_is_typed(package: str) -> None:
    assert (CHECKOUT / package / "py.typed").is_file()
