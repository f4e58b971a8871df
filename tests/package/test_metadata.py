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
NOT_FOR_USERS = {"derive", "dev", "docs", "test"}


def test_lowest_tested_versions_are_the_lowest_declared() -> None:
    extras = PROJECT["optional-dependencies"]
    requirements = {
        *PROJECT["dependencies"],
        *(line for extra in extras.keys() - NOT_FOR_USERS for line in extras[extra]),
    }
    requirements = {line for line in requirements if not line.startswith("epigauge[")}
    declared = dict(line.split(",")[0].split(">=") for line in requirements)
    assert len(declared) == len(requirements)  # two extras with one package agree on its version
    lines = (CHECKOUT / "tests" / "package" / "lowest.txt").read_text().splitlines()
    tested = dict(line.split("==") for line in lines if "==" in line)
    assert tested == declared


def test_version_is_one() -> None:
    cited = re.search(r"^version: (.+)$", (CHECKOUT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited
    assert {metadata.version("epigauge"), epigauge.__version__, cited[1]} == {epigauge.__version__}
    assert "version" in PROJECT["dynamic"]  # read from the package when it is built


@pytest.mark.parametrize("package", ["runtime/epigauge", "generated/epigauge_generated"])
def test_package_says_that_it_is_typed(package: str) -> None:
    assert (CHECKOUT / package / "py.typed").is_file()


def test_conda_recipe_asks_for_what_the_package_asks_for() -> None:
    recipe = (CHECKOUT / "packaging" / "conda" / "recipe.yaml").read_text()
    assert re.search(rf'^  version: "{re.escape(epigauge.__version__)}"$', recipe, re.MULTILINE)
    extras = PROJECT["optional-dependencies"]
    asked = dict(
        line.split(",")[0].split(">=")
        for line in (
            *PROJECT["dependencies"],
            *(line for extra in extras.values() for line in extra),
        )
        if ">=" in line
    )
    renamed = {"matplotlib-base": "matplotlib"}
    stated = dict(re.findall(r"^ +- ([\w-]+) >=([\d.]+)$", recipe, re.MULTILINE))
    stated.pop("cmake")
    build = stated.pop("scikit-build-core")
    assert f"scikit-build-core>={build}" in (CHECKOUT / "pyproject.toml").read_text()
    assert f">={stated.pop('python')}" == PROJECT["requires-python"]
    assert {"numpy", "typer", "rich"} <= stated.keys()
    assert {name: asked[renamed.get(name, name)] for name in stated} == stated


def test_the_index_shows_a_page_without_links_into_the_checkout() -> None:
    page = (CHECKOUT / PROJECT["readme"]).read_text(encoding="utf-8")
    assert not re.search(r"\]\((?!https?://)", page)
    whole = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    fence = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    assert fence.findall(page)
    assert all(code in whole for code in fence.findall(page))  # which is run
    commands = [line.split()[:3] for line in page.splitlines() if line.startswith("$ epigauge")]
    assert commands
    assert all(" ".join(words) in whole for words in commands)


def test_versions_of_python_are_those_that_are_tested() -> None:
    named = re.findall(r"Python :: (3\.\d+)$", "\n".join(PROJECT["classifiers"]), re.MULTILINE)
    matrix = (CHECKOUT / ".github" / "workflows" / "tests.yml").read_text()
    listed = re.search(r"python-version: \|\n((?: +3\.\d+\n)+)", matrix)
    assert listed
    assert sorted(listed[1].split()) == sorted(named)
    for page in ("README.md", PROJECT["readme"], "docs/quickstart.md"):
        said = re.search(
            r"[Tt]ested on (?:Python )?(3\.\d+) to (3\.\d+)", (CHECKOUT / page).read_text()
        )
        assert said
        assert said.groups() == (named[0], named[-1])


def test_addresses_are_open_about_being_placeholders() -> None:
    """Until there are public ones: names in .example are reserved, nobody can own them."""
    for address in PROJECT["urls"].values():
        assert re.match(r"https://([\w.-]+\.)?epigauge\.example(/|$)", address)
