"""JSON of all commands: one schema, kept in the documentation, which the documents obey."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import documents
import epigauge as eg
import pytest
from metric_scenes import metric_scene

jsonschema = pytest.importorskip("jsonschema", reason="documents are checked by jsonschema")
pytest.importorskip("typer", reason="the command line needs typer")
pytest.importorskip("rich", reason="the command line needs rich")

from epigauge.cli import app  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

SCHEMA = json.loads((documents.CHECKOUT / "docs" / "schema.json").read_text())
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
COMMANDS = {
    "refine": "refine matches.csv",
    "estimate": "estimate matches.csv",
    "estimate, E": "estimate matches.csv --model E --intrinsics 1000,640,480",
    "estimate, H": "estimate matches.csv --model H",
    "estimate, auto": "estimate matches.csv --model auto",
    "pair": "pair A.jpg B.jpg",
    "pair, auto": "pair A.jpg B.jpg --model auto",
    "pair, H": "pair A.jpg B.jpg --model H",
    "bundle": "bundle tracks.csv",
    "bundle, scene": "bundle scene.npz",
    "bundle, lines": "bundle with_lines.npz --lines lines.csv --refine pose",
    "compare": "compare tracks.csv --methods covariant,free",
    "colmap": "colmap database.db",
    "colmap, raw": "colmap database.db --from-matches",
    "demo": "demo --trials 1 --no-plot",
    "data": "data",
    "info": "info",
    "samples": "samples",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("files")
    documents.provide(path)
    eg.save_scene(path / "scene.npz", *metric_scene("SIMPLE_RADIAL", noise_px=0.3))
    lines = eg.line_scene(n_views=3, n_points=10, n_lines=5, seed=1)
    eg.save_scene(path / "with_lines.npz", lines.tracks, lines.true)
    eg.save_line_tracks(path / "lines.csv", lines.line_tracks)
    return path


def written(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the document that a command writes."""
    monkeypatch.chdir(folder)
    done = CliRunner().invoke(app, [*command.split(), "--json"])
    if "needs the package" in done.output or not (folder / "A.jpg").exists():
        pytest.skip(done.output)
    assert done.exit_code in (0, 1), done.output
    found: dict[str, Any] = json.loads(done.stdout, parse_constant=pytest.fail)
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_documents_obey_the_schema(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = written(COMMANDS[name], folder, monkeypatch)
    assert list(document)[:3] == ["command", "version", "schema"]
    assert document["command"] == name.partition(",")[0]
    assert document["version"] == eg.__version__
    VALIDATOR.validate(document)


@pytest.mark.parametrize("field", ["command", "version", "schema", "F", "flags", "history"])
def test_a_document_without_a_field_is_refused(
    field: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = written(COMMANDS["refine"], folder, monkeypatch)
    broken = {name: value for name, value in document.items() if name != field}
    assert not VALIDATOR.is_valid(broken)


@pytest.mark.parametrize(
    ("field", "value"),
    [("schema", 2), ("F", [[1.0]]), ("flags", "near-affine"), ("success", None), ("sigma", 2.0)],
)
def test_a_document_with_another_form_is_refused(
    field: str, value: object, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = copy.deepcopy(written(COMMANDS["refine"], folder, monkeypatch))
    document[field] = value
    assert not VALIDATOR.is_valid(document)


def test_the_schema_is_one_and_knows_every_command() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    known = {part["if"]["properties"]["command"]["const"] for part in SCHEMA["allOf"]}
    assert {name.partition(",")[0] for name in COMMANDS} == known
