"""What all tests share: the real data, the command line, and that Ctrl-C can be tested.

Here stands, too, which of them need not run in every environment of the matrix.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
from clusters import cluster

#: The image pairs of the data directory's folder ``pairs``.
PAIRS = (
    "adelaide_barrsmith",
    "adelaide_bonhall",
    "adelaide_elderhalla",
    "adelaide_johnssona",
    "adelaide_ladysymon",
    "adelaide_library",
    "adelaide_nese",
    "adelaide_physics",
    "adelaide_unionhouse",
    "entry_p10_2_3",
    "fountain_p11_0_4",
    "fountain_p11_4_5",
    "kitti_forward_1_5",
    "kusvod2_booksh",
    "kusvod2_box",
    "kusvod2_castle",
    "kusvod2_corr",
    "kusvod2_head",
    "kusvod2_kampa",
    "kusvod2_rotunda",
    "kusvod2_zoom",
    "motorcycle_rectified",
    "templeSR_1_2",
    "templeSR_9_10",
)

#: Tests of files, commands, pages and pictures. Their numbers come from functions that have tests
#: of their own, so another back end or another way of installing changes nothing here.
#: test_cli.py is not among them: it runs everywhere.
SURFACE = (
    *("package/test_distribution.py", "package/test_documents.py", "package/test_metadata.py"),
    *("package/test_newcomer.py", "runtime/test_benchmarks.py", "runtime/test_cli_*.py"),
    *("runtime/test_colmap*.py", "runtime/test_datasets.py"),
    *("runtime/test_database_executors.py", "runtime/test_display.py", "runtime/test_fuzz.py"),
    *("runtime/test_images.py", "runtime/test_interop.py", "runtime/test_io*.py"),
    *("runtime/test_line_files.py", "runtime/test_match_files.py", "runtime/test_pages_*.py"),
    *("runtime/test_pair_pictures.py", "runtime/test_plots.py", "runtime/test_precision_plot.py"),
    *("runtime/test_reproduce*.py", "runtime/test_samples.py", "runtime/test_scene_files.py"),
    "runtime/test_viewer.py",
)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `SURFACE` names, before ``-m`` chooses."""
    for item in items:
        if any(fnmatch(item.path.as_posix(), f"*/{name}") for name in SURFACE):
            item.add_marker("surface")


def pytest_configure() -> None:
    """Take Ctrl-C as usual where the shell has started the tests so that they ignore it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return $EPIGAUGE_DATA, or ``../shared/data`` beside the checkout; skip where neither is."""
    checkout = Path(__file__).resolve().parents[1]
    directory = Path(os.environ.get("EPIGAUGE_DATA", checkout.parent / "shared" / "data"))
    if not (directory / "pairs").is_dir():
        pytest.skip("no measured data: set EPIGAUGE_DATA to the directory that holds pairs/")
    return directory


@pytest.fixture(scope="session")
def client() -> Iterator[Any]:
    """Give the client of two processes, the same for all tests; skip without Dask."""
    distributed = pytest.importorskip("distributed")
    with cluster(2) as two, distributed.Client(two, set_as_default=False) as found:
        yield found


@pytest.fixture(params=PAIRS)
def pair(request: pytest.FixtureRequest, data_dir: Path) -> Path:
    """NPZ file of one measured image pair; a test that asks for it runs once a pair."""
    return data_dir / "pairs" / f"{request.param}.npz"


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run the command line in this process: (exit code, stdout, stderr)."""
    pytest.importorskip("typer", reason="the command line needs typer")
    pytest.importorskip("rich", reason="the command line needs rich")
    from epigauge.__main__ import main

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["epigauge", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        code = caught.value.code
        return (0 if code is None else code, *capsys.readouterr())

    return run
