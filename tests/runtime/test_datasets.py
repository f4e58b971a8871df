"""Data sets by name: found, fetched from a local server, converted as the measured ones were."""

from __future__ import annotations

import bz2
import hashlib
import http.server
import json
import logging
import pickle
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import epigauge as eg
import numpy as np
import pytest
from epigauge.datasets import _convert, _store
from epigauge.datasets._catalogue import Dataset, Source, catalogue
from epigauge.errors import ArgumentError, EpigaugeError, MissingPackageError

#: What of a set's files lies where in the directory of measured data.
ORIGINALS = {
    **{
        name: (f"{name}/original.mat",)
        for name in ("corridor", "house", "library", "merton_1", "dinosaur", "dinosaur_trimmed")
    },
    "Sthlm_trimmed": ("Sthlm_trimmed/original.mat",),
    "hotel_course": ("hotel_course/original.mat",),
    "sba_7": ("sba_demo/7pts.txt", "sba_demo/7cams.txt", "sba_demo/calib.txt"),
    "sba_9": ("sba_demo/9pts.txt", "sba_demo/9cams.txt", "sba_demo/calib.txt"),
    "bal_49": ("bal/problem-49-7776-pre.txt.bz2",),
}
POINTS = b"# X Y Z nframes frame x y\n" + b"".join(
    b"%d %d 5 2  0 %d 20 1 %d 25\n" % (k, k % 3, 10 + k, 15 + k) for k in range(8)
)
CAMERAS = b"1 0 0 0 0 0 0\n2 0 0 0 1 0 0\n"
CALIBRATION = b"100 0 50\n0 100 40\n0 0 1\n"


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files, and the first half only of those whose name begins with ``half``."""

    def log_message(self, *_):
        pass

    def do_GET(self):
        file = Path(self.translate_path(self.path))
        if not file.name.startswith("half"):
            return super().do_GET()
        content = file.read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[: len(content) // 2])
        return None


@pytest.fixture
def served(tmp_path):
    """Return a directory and the address at which its files are served."""
    root = tmp_path / "served"
    root.mkdir()
    handler = partial(Quiet, directory=str(root))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield root, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Return an empty cache; no directory of data is known."""
    pytest.importorskip("pooch")
    monkeypatch.delenv("EPIGAUGE_DATA", raising=False)
    monkeypatch.setenv("EPIGAUGE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "temporary").mkdir()
    return tmp_path / "cache"


def files_below(*folders):
    return [file for folder in folders for file in folder.rglob("*") if file.is_file()]


@pytest.fixture
def toy(served, monkeypatch):
    """Publish a small set named ``toy`` and return its entry."""
    root, _ = served
    sources = []
    for name, content in (("p.txt", POINTS), ("c.txt", CAMERAS), ("calib.txt", CALIBRATION)):
        source = Source("owner/repo", "abc", name, hashlib.sha256(content).hexdigest())
        file = root / source.url("").lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        sources.append(source)
    entry = Dataset(
        *("toy", "tracks", "a toy", "this test", "public domain", "toy/tracks.npz"),
        tuple(sources),
        convert="sba_demo",
    )
    publish(monkeypatch, entry)
    return entry


def publish(monkeypatch, entry):
    both = MappingProxyType(catalogue() | {entry.name: entry})
    monkeypatch.setattr("epigauge.datasets.catalogue", lambda: both)


def test_fetches_converts_and_keeps(toy, served, cache, caplog, capfd):
    root, url = served
    with caplog.at_level(logging.INFO, "epigauge.datasets"):
        tracks = eg.datasets.load("toy", base_url=url)
    assert (tracks.n_views, tracks.n_points, len(tracks)) == (2, 8, 16)
    np.testing.assert_array_equal(tracks.xy[:2], [[10, 20], [15, 25]])
    assert "public domain" in caplog.text
    assert capfd.readouterr() == ("", "")
    arrays = eg.datasets.arrays("toy", base_url=url)
    np.testing.assert_allclose(arrays["P"][1], [[100, 0, 50, 100], [0, 100, 40, 0], [0, 0, 1, 0]])
    assert files_below(cache) == [eg.datasets.path("toy", base_url=url)]
    for file in files_below(root):
        file.unlink()
    assert len(eg.datasets.load("toy", base_url=url)) == 16  # from the cache


def test_directory_of_data_comes_before_the_cache(toy, served, cache, tmp_path, monkeypatch):
    monkeypatch.setenv("EPIGAUGE_DATA", str(tmp_path / "data"))
    assert cache in eg.datasets.path("toy", base_url=served[1]).parents  # it is not there
    scene = eg.multi_view_scene()
    (tmp_path / "data" / "toy").mkdir(parents=True)
    eg.save_tracks(tmp_path / "data" / "toy" / "tracks.npz", scene.tracks)
    assert len(eg.datasets.load("toy")) == len(scene.tracks)


def test_wrong_hash_is_refused_and_leaves_nothing(toy, served, cache, tmp_path):
    (served[0] / "owner/repo/abc/calib.txt").write_bytes(CALIBRATION + b"\n")
    with pytest.raises(eg.datasets.DatasetError, match=r"'toy' was refused: SHA256 .* match"):
        eg.datasets.load("toy", base_url=served[1])
    assert not files_below(cache, tmp_path / "temporary")


def test_download_cut_short_leaves_nothing(toy, served, cache, tmp_path, monkeypatch):
    content = b"x" * 100_000
    source = Source("owner/repo", "abc", "half.txt", hashlib.sha256(content).hexdigest())
    (served[0] / "owner/repo/abc/half.txt").write_bytes(content)
    publish(monkeypatch, replace(toy, sources=(*toy.sources[1:], source)))
    with pytest.raises(eg.datasets.DatasetError, match=r"could not be fetched from http.*half"):
        eg.datasets.load("toy", base_url=served[1])
    assert not files_below(cache, tmp_path / "temporary")


def test_interrupted_conversion_leaves_nothing(toy, served, cache, tmp_path, monkeypatch):
    def interrupted(file, arrays):
        file.write(b"PK")
        raise KeyboardInterrupt

    monkeypatch.setattr(_convert, "write_npz", interrupted)
    with pytest.raises(KeyboardInterrupt):
        eg.datasets.load("toy", base_url=served[1])
    assert not files_below(cache, tmp_path / "temporary")


@pytest.mark.parametrize("what", ["server is gone", "file is gone"])
def test_no_network_names_the_address_and_the_remedy(what, toy, served, cache):
    url = "http://127.0.0.1:9" if what == "server is gone" else f"{served[1]}/elsewhere"
    with pytest.raises(eg.datasets.DatasetError, match="EPIGAUGE_DATA") as caught:
        eg.datasets.load("toy", base_url=url)
    assert f"{url}/owner/repo/abc/p.txt" in str(caught.value)
    assert isinstance(caught.value, EpigaugeError)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # noqa: S301


def test_missing_package_names_the_extra(toy, cache, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(MissingPackageError, match=r"epigauge\[data\]"):
        eg.datasets.load("toy")


@pytest.mark.parametrize(
    ("name", "close"), [("coridor", "'corridor'"), ("BAL49", "'bal_49'"), ("zzz", None), (7, None)]
)
def test_unknown_name_lists_names_and_close_ones(name, close):
    with pytest.raises(ArgumentError) as caught:
        eg.datasets.load(name)
    message = str(caught.value)
    assert ("did you mean" in message) == (close is not None)
    assert close is None or f"did you mean {close}" in message
    assert all(known in message for known in eg.datasets.names())


def test_bad_arguments_are_named(monkeypatch):
    with pytest.raises(ArgumentError, match="kind"):
        eg.datasets.names("images")
    with pytest.raises(ArgumentError, match="views"):
        eg.datasets.load("kusvod2_box", views=[0, 1])


def test_set_that_is_not_offered_says_where_it_comes_from(cache):
    with pytest.raises(eg.datasets.DatasetError, match=r"not offered.*KITTI.*EPIGAUGE_DATA"):
        eg.datasets.load("kitti_forward_1_5")


def test_catalogue_is_complete():
    assert len(eg.datasets.names()) == len(eg.datasets.names("tracks")) + 24
    for name in eg.datasets.names():
        entry = eg.datasets.describe(name)
        assert entry.title
        assert entry.licence
        assert entry.origin
        assert callable(getattr(_convert, entry.convert))
        for source in (*entry.sources, *entry.images.values()):
            assert len(source.sha256) == 64
            assert source.repository.count("/") == 1
            assert source.url(_store.PUBLIC).startswith("https://")
    assert {name for name in eg.datasets.names() if eg.datasets.describe(name).downloadable} == {
        *ORIGINALS,
        "bal_16",
    }


def test_every_measured_set_loads(data_dir, monkeypatch):
    monkeypatch.setenv("EPIGAUGE_DATA", str(data_dir))
    for name in eg.datasets.names():
        entry = eg.datasets.describe(name)
        assert (data_dir / entry.file).is_file()
        if entry.kind == "matches":
            assert len(eg.datasets.load(name, clean=True)) < len(eg.datasets.load(name))
        assert all(file.is_file() for file in eg.datasets.images(name))
    assert len(eg.datasets.load("hotel_klt", clean=True, views=range(0, 51, 5))) == 5646
    assert set(eg.datasets.arrays("bal_49")) == {"view", "point", "xy", "P", "Q"}


@pytest.mark.parametrize("name", [*ORIGINALS, pytest.param("bal_16", marks=pytest.mark.slow)])
def test_download_gives_the_arrays_of_the_measured_sets(name, data_dir, served, cache, monkeypatch):
    """The sums in the catalogue are those of the original files, and so are the arrays."""
    pytest.importorskip("scipy")
    root, url = served
    entry = eg.datasets.describe(name)
    for source, original in zip(entry.sources, ORIGINALS.get(name, ("",)), strict=True):
        file = root / source.url("").lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        if name == "bal_16":  # only its compressed form is here
            file.write_bytes(bz2.decompress((data_dir / entry.file).read_bytes()))
        else:
            file.symlink_to(data_dir / original)
    fetched = eg.datasets.arrays(name, base_url=url)
    monkeypatch.setenv("EPIGAUGE_DATA", str(data_dir))
    measured = eg.datasets.arrays(name)
    assert set(measured) - set(fetched) == set(entry.left_out)
    assert set(fetched) <= set(measured)
    for key, values in fetched.items():
        assert values.dtype == measured[key].dtype
        # The cameras of sba are products, whose last bit depends on how they are summed up.
        rtol = 1e-14 if key in ("P", "R") else 0.0
        np.testing.assert_allclose(values, measured[key], rtol=rtol, atol=rtol)


def test_origins_are_those_that_the_measured_sets_name(data_dir):
    for entry in map(eg.datasets.describe, eg.datasets.names()):
        if entry.name == "bal_16":  # measured here from Debian's copy of the same release
            continue
        readme = (data_dir / entry.file).with_name("README.md").read_text(encoding="utf-8")
        for source in (*entry.sources, *entry.images.values()):
            pinned = f"https://github.com/{source.repository} (commit {source.commit[:7]})"
            assert pinned in readme, entry.name


def test_images_are_fetched_as_they_are(data_dir, served, cache):
    root, url = served
    for file, source in eg.datasets.describe("templeSR_1_2").images.items():
        published = root / source.url("").lstrip("/")
        published.parent.mkdir(parents=True, exist_ok=True)
        published.symlink_to(data_dir / file)
    first, second = eg.datasets.images("templeSR_1_2", base_url=url)
    assert first.name == "templeSR0001.png"
    assert second.read_bytes() == (data_dir / "pairs/images/templeSR0002.png").read_bytes()
    assert eg.datasets.images("corridor") == ()


def test_command_lists_and_fetches(toy, served, cache, monkeypatch):
    pytest.importorskip("typer")
    pytest.importorskip("rich")
    from epigauge.cli import app
    from typer.testing import CliRunner

    listed = CliRunner().invoke(app, ["data", "--json"])
    assert listed.exit_code == 0
    known = {entry["name"]: entry for entry in json.loads(listed.stdout)["datasets"]}
    assert set(known) == set(eg.datasets.names())
    assert known["toy"]["licence"] == "public domain"

    file = eg.datasets.path("toy", base_url=served[1])
    found = CliRunner().invoke(app, ["data", "toy"])
    assert found.exit_code == 0
    assert found.stdout.strip() == str(file)
    assert "public domain" in found.stderr
    refused = CliRunner().invoke(app, ["data", "toi"])
    assert refused.exit_code == 2
    assert "did you mean 'toy'" in refused.stderr
