"""README and documentation: all their code runs, prints what they show, and nothing is missing."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path

import documents
import epigauge as eg
import pytest
from _pytest.mark import ParameterSet
from epigauge.datasets import DatasetError, _store
from epigauge.errors import MissingPackageError

OPTIONAL = (
    *("cv2", "casadi", "matplotlib", "poselib", "pycolmap", "rich", "scipy", "sympy", "torch"),
    "typer",
)
#: Public modules beside the package itself, by the name that users write.
MODULES = {
    "epigauge.gauge": eg.gauge,
    **{
        f"epigauge.{name}": importlib.import_module(f"epigauge.{name}")
        for name in (
            *(
                "arrays",
                "casadi",
                "colmap",
                "datasets",
                "distributed",
                "errors",
                "images",
                "interop",
                "io",
                "kernels",
            ),
            *("plots", "reports", "samples", "verdicts"),
        )
    },
}
#: Of these, python and console are run, and text is compared with what is printed.
KINDS = {"python", "console", "text", "bibtex", "diff"}


def parameters() -> list[ParameterSet]:
    """Return the pages; all but the README take seconds."""
    return [
        pytest.param(
            page,
            id=page.relative_to(documents.CHECKOUT).as_posix(),
            marks=[] if page.name == "README.md" else pytest.mark.slow,
        )
        for page in documents.pages()
    ]


@pytest.mark.parametrize("page", parameters())
def test_code_of_the_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(entry: eg.datasets.Dataset, *_: object) -> Path:
        raise DatasetError(entry.name, "is not on this machine")

    monkeypatch.setattr(_store, "_download", offline)
    monkeypatch.setenv("EPIGAUGE_CACHE", str(tmp_path / "cache"))
    if "EPIGAUGE_DATA" not in os.environ:
        data = documents.CHECKOUT.parent / "shared" / "data"
        monkeypatch.setenv("EPIGAUGE_DATA", str(data))
    folder = tmp_path / "work"
    folder.mkdir()
    try:
        documents.run(page, folder)
    except (DatasetError, MissingPackageError) as error:
        pytest.skip(str(error))
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in OPTIONAL:
            raise
        pytest.skip(f"needs the package {error.name}")
    for name in documents.pictures(page):
        assert (folder / name).is_file(), f"no code of the page makes {name}"
        assert (documents.PICTURES / name).is_file(), f"python tests/documents.py {page}"


@pytest.mark.parametrize(
    ("shown", "agrees"),
    [
        ("rms 0.123 px in 5", True),
        ("rms 0.12 px ... 5", True),
        ("rms 0.13 px in 5", True),  # a unit of the last digit shown
        ("rms ~0.15 px in 5", True),
        ("rms 0.15 px in 5", False),
        ("rms 0.123 px in 6", False),
        ("rms 0.123 mm in 5", False),
    ],
)
def test_shown_output_is_compared(shown: str, agrees: bool) -> None:
    printed = "rms 0.1234567 px   in 5\n"
    if agrees:
        documents.compare(printed, shown, "here")
    else:
        with pytest.raises(AssertionError, match="here prints"):
            documents.compare(printed, shown, "here")


@pytest.mark.parametrize("page", documents.pages(), ids=lambda page: page.name)
def test_every_block_is_of_a_kind_that_is_known(page: Path) -> None:
    kinds = re.findall(r"^ *```+ *([^`\n]+)$", page.read_text(), re.MULTILINE)
    assert {kind for kind in kinds if not kind.startswith("{")} <= KINDS
    assert not re.search(r"^```\{code", page.read_text(), re.MULTILINE)  # it would not be run


def test_pictures_load_on_a_phone() -> None:
    large = {
        path.name: path.stat().st_size
        for path in documents.PICTURES.iterdir()
        if path.stat().st_size > documents.LARGEST
    }
    assert large == {}


def test_links_of_the_readme_lead_to_files() -> None:
    """Those of the other pages are checked when the documentation is built."""
    targets = re.findall(r"\]\(([^)\s#]+)", (documents.CHECKOUT / "README.md").read_text())
    missing = [t for t in targets if "://" not in t and not (documents.CHECKOUT / t).exists()]
    assert targets
    assert missing == []


@pytest.mark.parametrize("name", ["epigauge", *MODULES])
def test_every_public_name_is_in_the_reference(name: str) -> None:
    pages = (documents.CHECKOUT / "docs" / "api").glob("*.rst")
    text = "\n".join(page.read_text() for page in pages)
    documented = set(re.findall(r"^\.\. (?:auto\w+|py:data):: ([\w.]+)", text, re.MULTILINE))
    module = MODULES.get(name, eg)
    # What the package itself offers, too, is documented there.
    public = {f"epigauge.{n}" if n in eg.__all__ else f"{name}.{n}" for n in module.__all__}
    assert not public - documented - set(MODULES)


def test_the_changelog_says_nothing_twice() -> None:
    text = (documents.CHECKOUT / "CHANGELOG.md").read_text(encoding="utf-8")
    lines = [line.strip(" -") for line in text.splitlines() if len(line) > 20]
    assert [line for line in lines if lines.count(line) > 1] == []
    entries = [" ".join(entry.split()) for entry in re.split(r"^- ", text, flags=re.MULTILINE)]
    broken = [e for e in entries if e.count("(") != e.count(")") or e.count("`") % 2]
    assert broken == []


def test_the_first_page_repeats_the_numbers_of_the_results() -> None:
    """Medians and shares below 1 px of the sets of photographs, and their range in the text."""
    index, results = (
        (documents.CHECKOUT / "docs" / name).read_text(encoding="utf-8")
        for name in ("index.md", "results.md")
    )
    row = re.compile(r"^\| (\w+-P\d+) \| \d+ \| (.*) \|$", re.MULTILINE)
    cell = re.compile(r"([\d.]+): [\d.]+, ([\d.]+), [\d.]+")
    measured = {
        name: [(float(median), 100.0 * float(share)) for median, share in cell.findall(cells)]
        for name, cells in row.findall(results)
        if cell.search(cells)
    }
    said = dict(row.findall(index))
    assert len(said) == 3
    assert said.keys() == measured.keys()
    for name, cells in said.items():
        numbers = [float(number) for number in re.findall(r"[\d.]+", cells)]
        assert numbers[::2] == [median for median, _ in measured[name]]
        # Both are rounded.
        assert numbers[1::2] == pytest.approx([share for _, share in measured[name]], abs=0.56)
    text = " ".join(index.split())
    ours, magsac = ([cells[k][0] for cells in measured.values()] for k in (0, 2))
    assert f"the lowest, {min(ours):.2f} to {max(ours):.2f} px" in text
    assert f"`USAC_MAGSAC` has {min(magsac):.2f} to {max(magsac):.2f};" in text
