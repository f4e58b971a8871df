"""Scenes in folders of parts: written, checked, and adjusted as if they were whole."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
import pytest
from clusters import cluster, metric
from epigauge.distributed.parts import Parts
from epigauge.distributed.questions import keys, values_of
from epigauge.errors import FileFormatError

Scene = tuple[eg.Tracks, Any]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return metric()


@pytest.fixture(scope="module")
def written(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    tracks, start = scene
    return eg.distributed.write_parts(tracks, tmp_path_factory.mktemp("parts"), start)


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """Return a copy that may be damaged."""
    return Path(shutil.copytree(written, tmp_path / "copy"))


def read(folder: Path) -> tuple[Parts, Any]:
    """Read all that a folder has, as an adjustment does."""
    parts = Parts.open(folder)
    start, _ = parts.start()
    for part in parts.parts:
        part.load()
    return parts, start


def rows(tracks: Any) -> set[tuple[float, ...]]:
    table = np.column_stack([tracks.view, tracks.point, tracks.xy, tracks.weights])
    return set(map(tuple, table.tolist()))


# ---------------------------------------------------------------- other forms


@pytest.fixture(params=["parquet", "zarr"])
def other(request: pytest.FixtureRequest, scene: Scene, tmp_path: Path) -> Path:
    """Return a folder of another form than NPZ."""
    pytest.importorskip({"parquet": "pyarrow"}.get(request.param, request.param))
    tracks, start = scene
    spread = np.array([[1.0, 0.3], [0.3, 0.5]])
    oblong = eg.Tracks(tracks.view, tracks.point, tracks.xy, covariance=spread)
    return eg.distributed.write_parts(oblong, tmp_path / "other", start, storage=request.param)


def test_every_form_holds_the_same_bits(scene: Scene, other: Path, tmp_path: Path) -> None:
    tracks, start = scene
    spread = np.array([[1.0, 0.3], [0.3, 0.5]])
    oblong = eg.Tracks(tracks.view, tracks.point, tracks.xy, covariance=spread)
    npz = eg.distributed.write_parts(oblong, tmp_path / "npz", start)
    for own, expected in zip(Parts.open(other).parts, Parts.open(npz).parts, strict=True):
        found, wanted = own.read(), expected.read()
        pairs = [(found.number, wanted.number), (found.X, wanted.X)]
        for name in ("view", "point", "q", "weights", "whitening"):
            pairs.append(tuple(getattr(part.observations, name) for part in (found, wanted)))
        for left, right in pairs:
            assert (left.dtype, left.shape) == (right.dtype, right.shape)
            assert left.tobytes() == right.tobytes()
        assert own.points()[1].tobytes() == wanted.X.tobytes()


def test_damage_of_every_form_is_named(other: Path) -> None:
    first, *_, last = sorted(other.glob("part-*"))
    whole, row = first.read_bytes(), Parts.open(other).parts[0]
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for damaged in (whole[:200], bytes(len(whole)), bytes(flipped), b""):
        first.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=first.name):
            row.read()
    first.unlink()
    with pytest.raises(FileFormatError, match=first.name):
        row.read()
    shutil.copyfile(last, first)
    with pytest.raises(FileFormatError, match=first.name):
        row.read()


def test_a_form_that_is_unknown_is_named(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(eg.ArgumentError, match="storage"):
        eg.distributed.write_parts(scene[0], tmp_path / "x", scene[1], storage="hdf5")
    assert not (tmp_path / "x").exists()


# ---------------------------------------------------------------- what is written


def test_the_parts_hold_the_scene(scene: Scene, written: Path) -> None:
    tracks, start = scene
    parts, found = read(written)
    assert len(parts.parts) == 8
    np.testing.assert_array_equal(found.X, start.X)
    np.testing.assert_array_equal(found.vectors, start.vectors)
    assert found.cameras.model == start.cameras.model
    whole: set[tuple[float, ...]] = set()
    for part in parts.parts:
        own = part.read()
        seen = own.observations
        table = [seen.view, own.number[seen.point], seen.q[0], seen.q[1], seen.weights]
        whole |= set(map(tuple, np.column_stack(table).tolist()))
    assert whole == rows(tracks)
    centroids = np.stack(
        [np.bincount(tracks.view, tracks.xy[:, k]) / np.bincount(tracks.view) for k in (0, 1)], 1
    )
    assert parts.scale == pytest.approx(np.sqrt(np.mean((tracks.xy - centroids[tracks.view]) ** 2)))


def test_chunks_become_parts_one_at_a_time(scene: Scene, tmp_path: Path) -> None:
    tracks, start = scene
    alive: list[int] = []

    def chunks() -> Iterator[eg.distributed.Chunk]:
        for k, part in enumerate(np.array_split(np.arange(tracks.n_points), 3)):
            # What came before is on the disk already.
            alive.append(len(list((tmp_path / "made").glob("part-*.npz"))) - k)
            of = np.isin(tracks.point, part)[::-1]  # in any order
            view, point, xy = (a[::-1][of] for a in (tracks.view, tracks.point, tracks.xy))
            yield eg.distributed.Chunk(start.X[part], view, point - part[0], xy)

    cameras = eg.MetricReconstruction(start.R, start.t, np.zeros((1, 3)), start.cameras)
    names = list("abcdefghijkl")
    found = eg.distributed.write_parts(chunks(), tmp_path / "made", cameras, names=names)
    assert alive == [0, 0, 0]
    parts, again = read(found)
    assert parts.names == tuple(names)
    np.testing.assert_array_equal(again.X, start.X)
    assert sum(part.n_observations for part in parts.parts) == len(tracks)


# ---------------------------------------------------------------- what is refused


def chunk(**other: Any) -> Any:
    """Return two points in two views, with something else."""
    made = {
        "X": np.eye(3)[:2],
        "view": [0, 1, 0, 1],
        "point": [0, 0, 1, 1],
        "xy": np.arange(8.0).reshape(4, 2),
        "weights": None,
    }
    return eg.distributed.Chunk(**(made | other))


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"view": [0, 2, 0, 1]}, "view of chunk 1 is 2 in row 1; needed: 0 to 1"),
        ({"view": [0, 0, 0, 1]}, "view, point of chunk 1 name view 0, point 0 twice"),
        ({"point": [0, 0, 0, 1], "view": [0, 1, 0, 1]}, "twice"),
        ({"view": [0, 1, 1], "point": [0, 0, 1], "xy": np.ones((3, 2))}, "point of chunk 1 1 has"),
        ({"X": np.full((2, 3), np.nan)}, "X of chunk 1"),
        ({"X": np.zeros((2, 2))}, "X of chunk 1"),
        ({"xy": np.full((4, 2), np.inf)}, "xy of chunk 1 is not finite in row 0"),
        ({"xy": np.ones((3, 2))}, "xy of chunk 1 has shape"),
        ({"weights": [1.0, 0.0, 1.0, 1.0]}, "weights of chunk 1 are zero in row 1"),
        ({"view": [0.5, 1, 0, 1]}, "view of chunk 1 is float64"),
        ({"view": [], "point": [], "xy": np.zeros((0, 2))}, "view of chunk 1"),
        ({"X": [["a", "b", "c"]] * 2}, "X of chunk 1 has type"),
        ({"xy": np.full((4, 2), 1j)}, "xy of chunk 1 has type complex128"),
    ],
)
def test_chunks_that_do_not_fit_are_named(
    other: dict[str, Any], message: str, tmp_path: Path
) -> None:
    cameras = eg.Cameras("SIMPLE_PINHOLE", [[800.0, 0.0, 0.0]], [0, 0])
    start = eg.MetricReconstruction([np.eye(3)] * 2, np.eye(3)[:2], np.zeros((1, 3)), cameras)
    with pytest.raises(eg.ArgumentError, match=message):
        eg.distributed.write_parts([chunk(), chunk(**other)], tmp_path, start)
    assert not (tmp_path / "parts.json").exists()


def test_what_cannot_be_written_is_named(scene: Scene, written: Path, tmp_path: Path) -> None:
    tracks, start = scene
    write = eg.distributed.write_parts
    with pytest.raises(eg.ArgumentError, match=r"folder .* holds something"):
        write(tracks, written, start)
    fewer = eg.MetricReconstruction(start.R, start.t, start.X[1:], start.cameras)
    with pytest.raises(eg.ArgumentError, match="90 points, as the tracks"):
        write(tracks, tmp_path, fewer)
    with pytest.raises(eg.ArgumentError, match="weight zero"):
        write(tracks.weighted(1.0 * (np.arange(len(tracks)) > 0)), tmp_path, start)
    with pytest.raises(eg.ArgumentError, match="gives no chunk"):
        write([], tmp_path, start)
    with pytest.raises(eg.ArgumentError, match="is a Reconstruction"):
        write(tracks, tmp_path, start.to_projective())
    for source, told in ((None, "is a NoneType"), ([5], "gives int as chunk 0")):
        with pytest.raises(eg.ArgumentError, match=f"source {told}"):
            write(source, tmp_path / "none", start)
    with pytest.raises(eg.ArgumentError, match="folder is a NoneType"):
        write(tracks, None, start)  # type: ignore[arg-type]
    cameras = eg.Cameras("SIMPLE_PINHOLE", [[800.0, 0.0, 0.0]], [0] * 4)
    four = eg.MetricReconstruction([np.eye(3)] * 4, np.zeros((4, 3)), np.zeros((1, 3)), cameras)
    other = chunk(view=[2, 3, 2, 3])
    with pytest.raises(eg.ArgumentError, match=r"view \[2, 3\] share no point"):
        write([chunk(), other], tmp_path / "parted", four)
    with pytest.raises(eg.ArgumentError, match="view never is 2"):
        write([chunk()], tmp_path / "empty", four)


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def bit_flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def swapped(path: Path) -> None:
    other = path.with_name("part-00004.npz")
    content = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)
    manifest = path.with_name("parts.json")  # as it would be if files were renamed
    told = json.loads(manifest.read_text())
    for row in told["parts"]:
        row["bytes"] = (path.parent / row["file"]).stat().st_size
    manifest.write_text(json.dumps(told))


@pytest.mark.parametrize("damage", [Path.unlink, cut_short, bit_flipped, swapped])
def test_a_damaged_part_is_named(damage: Any, folder: Path) -> None:
    damage(folder / "part-00003.npz")
    with pytest.raises(FileFormatError, match=r"part-0000[34].npz"):
        read(folder)


def test_parts_made_elsewhere_are_checked_as_tracks_are(folder: Path) -> None:
    part = Parts.open(folder).parts[3]
    path, own = Path(part.path), ("view", "point", "xy", "weights")
    with np.load(path) as file:
        given = dict(file)
    own = tuple(name for name in (*own, "whitening") if name in given)

    def written(**rows: Any) -> Any:
        """Return the part with other rows, as the manifest would list it."""
        np.savez(path, **(given | rows))
        count = len(rows["view"]) if "view" in rows else part.n_observations
        return dataclasses.replace(part, n_observations=count)

    def chosen(rows: Any) -> dict[str, Any]:
        return {name: given[name][rows] for name in own}

    expected, every = part.load(), np.arange(part.n_observations)
    # Views in any order within a point, other widths and ends of numbers.
    turned = np.lexsort((-given["view"], given["point"]))
    found = written(**chosen(turned)).load()
    back = np.lexsort((found.view, found.point))
    np.testing.assert_array_equal(found.q[:, back], expected.q)
    found = written(view=given["view"].astype(">i2"), xy=given["xy"].astype(">f8")).load()
    np.testing.assert_array_equal(found.view, expected.view)
    np.testing.assert_array_equal(found.q, expected.q)
    twice = written(**chosen(np.insert(every, 1, 0)))
    with pytest.raises(FileFormatError, match=r"has view \d+, point 0 twice"):
        twice.load()
    once = written(**chosen(every[(given["point"] > 0) | (every == 0)]))
    with pytest.raises(FileFormatError, match="point 0 has fewer than 2 observations"):
        once.load()
    with pytest.raises(FileFormatError, match=r"view has type float64.*needed: whole numbers"):
        written(view=given["view"].astype(float)).load()


def test_a_part_of_another_scene_is_named(folder: Path, scene: Scene, tmp_path: Path) -> None:
    tracks, start = scene
    other = eg.distributed.write_parts(tracks, tmp_path / "other", start)
    for name in ("part-00003.npz", "cameras.npz"):
        before = (folder / name).read_bytes()
        (folder / name).write_bytes((other / name).read_bytes())
        with pytest.raises(FileFormatError, match=f"{name}.* of another scene"):
            read(folder)
        (folder / name).write_bytes(before)
    read(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda told: told.pop("unit"), "is damaged"),
        (lambda told: told.update(form="another"), "is no manifest"),
        (lambda told: told.update(n_observations=7), "n_observations is 7, its parts have"),
        (lambda told: told["parts"].pop(), "n_points is 90, its parts have"),
        (lambda told: told["parts"][0].update(file="../x.npz"), "is not in the folder"),
        (lambda told: told.update(names=["a"]), "1 names of 12 views"),
        (lambda told: told.update(names="a" * 12), "names that are no list"),
        (lambda told: told.update(scale_px=float("nan")), "not positive"),
        (lambda told: told.update(scale_px=1e300), "too large"),
        (lambda told: told.update(n_views=13), "cameras.npz: has 12 views"),
        (lambda told: told.update(n_points=float("inf")), "is damaged: OverflowError"),
        (lambda told: told["parts"][0].pop("bytes"), "is damaged: KeyError"),
        (lambda told: told["parts"][0].update(n_points=10**15), r"10+ points, \d+ observations in"),
        (lambda told: told["parts"][0].update(n_points=0, n_observations=0), "0 points"),
    ],
)
def test_a_changed_manifest_is_named(change: Any, message: str, folder: Path) -> None:
    path = folder / "parts.json"
    told = json.loads(path.read_text())
    change(told)
    path.write_text(json.dumps(told))
    with pytest.raises(FileFormatError, match=message):
        read(folder)


def test_a_folder_of_parts_is_no_scene_to_load(written: Path) -> None:
    with pytest.raises(eg.ArgumentError, match=r"a folder of parts; needed: eg\.distributed"):
        eg.load_scene(written)


def test_a_folder_that_was_not_finished_is_told(folder: Path) -> None:
    (folder / "parts.json").unlink()
    with pytest.raises(FileFormatError, match=r"parts.json.* parts are written, then this"):
        read(folder)


def test_parts_that_share_points_are_named(folder: Path) -> None:
    with np.load(folder / "part-00001.npz") as found:
        arrays = dict(found)
    with np.load(folder / "part-00000.npz") as found:
        arrays["number"][:1] = found["number"][:1]
    np.savez(folder / "part-00001.npz", **arrays)
    path = folder / "parts.json"
    told = json.loads(path.read_text())
    told["parts"][1]["bytes"] = (folder / "part-00001.npz").stat().st_size
    path.write_text(json.dumps(told))
    with pytest.raises(FileFormatError, match=r"part-00001.npz: has points that another part has"):
        read(folder)


# ---------------------------------------------------------------- what the verdict asks


def test_keys_rise_with_their_values() -> None:
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(size=50) * 10.0 ** rng.integers(-300, 300, 50), [0.0]])
    values = np.concatenate([values, [np.inf, -np.inf]])
    order = np.argsort(keys(values))
    np.testing.assert_array_equal(values[order], np.sort(values))
    np.testing.assert_array_equal(values_of(keys(values)), values)
    assert keys(np.array([np.nan]))[0] > keys(values).max()


def test_partitions_answer_as_tracks_do(client: Any, scene: Scene, written: Path) -> None:
    from epigauge import kernels
    from epigauge.distributed.dispatch import Dispatch
    from epigauge.distributed.linearizer import DistributedLinearizer
    from epigauge.distributed.parts_evidence import PartsEvidence
    from epigauge.distributed.pieces import Piece
    from epigauge.multi_view.frame import Frame
    from epigauge.multi_view.parallax import partners
    from epigauge.multi_view.verdicts.evidence import EvidenceOfTracks
    from epigauge.two_view.losses import Loss

    tracks, start = scene
    parts = Parts.open(written)
    _, numbers = parts.start()
    pieces = [Piece(*own) for own in zip(numbers, parts.parts, strict=True)]
    model = eg.cameras.camera_model(start.cameras.model)
    sizes = parts.n_views, parts.n_points, parts.n_observations
    own = DistributedLinearizer(
        *(Dispatch(client), pieces, sizes, model, kernels.table(), Loss(), None, 1.0)
    )
    there = PartsEvidence(own, start, parts.scale)
    here = EvidenceOfTracks(tracks, Frame.of(tracks).scale, *start.seen(tracks))
    assert there.scale == pytest.approx(here.scale, rel=1e-12)
    assert (there.count, there.n_behind, there.open()) == (here.count, here.n_behind, here.open())
    np.testing.assert_array_equal(there.of_views, here.of_views)
    tail, expected = there.tail, here.tail
    assert tail.count == expected.count
    assert tail.largest == pytest.approx(expected.largest, rel=1e-12)
    assert tail.median == pytest.approx(expected.median, rel=1e-12)
    assert tail.sum_of_squares == pytest.approx(expected.sum_of_squares, rel=1e-12)
    assert tail.above(1.0) == expected.above(1.0) > 0
    ranks = [0, 3, 4, len(tracks) - 2, len(tracks) - 1]
    for axis in (0, 1):
        np.testing.assert_array_equal(tail.ranked(axis, ranks), np.sort(tracks.xy[:, axis])[ranks])
    assert there.moved(40.0) == here.moved(40.0)
    assert 0.05 < here.moved(40.0) < 0.95
    for i in (0, 7):
        points, images = there.images(i)
        order = np.argsort(points)
        np.testing.assert_array_equal(points[order], here.images(i)[0])
        np.testing.assert_allclose(images[order], here.images(i)[1], rtol=1e-12)
        found = []
        for evidence in (there, here):
            seen = evidence.around(i)
            found.append(partners(seen, i).tolist())
        assert found[0] == found[1]


# ---------------------------------------------------------------- what is adjusted


def the_same_bits(found: Any, expected: Any) -> None:
    np.testing.assert_array_equal(found.reconstruction.X, expected.reconstruction.X)
    np.testing.assert_array_equal(found.reconstruction.vectors, expected.reconstruction.vectors)
    costs = [[row.cost for row in one.history] for one in (found, expected)]
    assert costs[0] == costs[1]
    assert found.rms_px == pytest.approx(expected.rms_px, rel=1e-12)
    assert (found.flags, found.rank, found.status) == (
        expected.flags,
        expected.rank,
        expected.status,
    )
    assert (found.condition, found.weakest) == (expected.condition, expected.weakest)
    assert found.n_behind == expected.n_behind


def test_parts_give_the_bits_of_arrays(
    client: Any, scene: Scene, written: Path, tmp_path: Path
) -> None:
    tracks, start = scene
    adjust = eg.distributed.bundle_adjust
    options: Any = {"refine": ("f",), "fixed_views": [0, 3], "fixed_points": [1, 2, 40]}
    options |= {"loss": "cauchy"}
    expected = adjust(tracks, client, start, **options)
    output = tmp_path / "adjusted"
    found = adjust(written, client, output=output, memory_limit=0, **options)
    the_same_bits(found, expected)
    assert found.loss_scale_px == expected.loss_scale_px
    assert found.output == str(output)
    _, again = read(output)
    np.testing.assert_array_equal(again.X, found.reconstruction.X)
    np.testing.assert_array_equal(again.vectors, found.reconstruction.vectors)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["covariances", "each camera", "priorless pose"])
def test_all_kinds_of_parts_give_the_bits_of_arrays(kind: str, client: Any, tmp_path: Path) -> None:
    tracks, start = metric(shared=kind != "each camera")
    options: Any = {"refine": "pose"} if kind == "priorless pose" else {}
    if kind == "covariances":
        spread = np.array([[1.0, 0.3], [0.3, 0.5]])
        tracks = eg.Tracks(tracks.view, tracks.point, tracks.xy, covariance=spread)
    folder = eg.distributed.write_parts(tracks, tmp_path / "parts", start)
    found = eg.distributed.bundle_adjust(folder, client, **options)
    the_same_bits(found, eg.distributed.bundle_adjust(tracks, client, start, **options))


@pytest.mark.slow
def test_what_is_wrong_with_a_scene_is_told_of_its_parts(client: Any, tmp_path: Path) -> None:
    tracks, start = metric()
    # A camera that only turned, to first order: all views from one place.
    X = start.X + np.array([0.0, 0.0, 9.0])
    blank = eg.MetricReconstruction(start.R, 0.0 * start.t, X, start.cameras)
    rng = np.random.default_rng(0)
    xy = blank.project(tracks) + rng.normal(0.0, 0.5, (len(tracks), 2))
    moved = eg.MetricReconstruction(
        start.R, rng.normal(0.0, 0.01, start.t.shape), blank.X, start.cameras
    )
    turned = eg.Tracks(tracks.view, tracks.point, xy)
    wild = tracks.xy.copy()
    wild[::40] += rng.uniform(-200.0, 200.0, wild[::40].shape)
    for name, other, begin, flag in (
        ("turned", turned, moved, "pure rotation"),
        ("wild", eg.Tracks(tracks.view, tracks.point, wild), start, "gross errors"),
    ):
        folder = eg.distributed.write_parts(other, tmp_path / name, begin)
        found = eg.distributed.bundle_adjust(folder, client, max_iter=20)
        here = eg.bundle_adjust(other, begin, max_iter=20)
        assert flag in here.flags
        assert found.flags == here.flags
        assert not found.success


def test_what_parts_cannot_be_adjusted_with_is_named(
    client: Any, written: Path, folder: Path, tmp_path: Path
) -> None:
    adjust: Any = eg.distributed.bundle_adjust
    for options, message in (
        ({"robust": True}, "robust is given with a folder of parts"),
        ({"method": "free"}, "method is given with a folder of parts"),
        ({"partitions": 4}, "partitions is given with a folder of parts"),
        ({"memory_limit": -1}, "memory_limit"),
        ({"output": written}, "output .* holds something"),
        ({"loss": "l1"}, "loss"),
        ({"fixed_views": [40]}, "fixed_views"),
    ):
        with pytest.raises(eg.ArgumentError, match=message):
            adjust(written, client, **options)
    with pytest.raises(eg.ArgumentError, match="refine"):
        adjust(written, client, refine="x", output=tmp_path / "unwritten")
    assert not (tmp_path / "unwritten").exists()
    tracks, start = metric()
    with pytest.raises(eg.ArgumentError, match="memory_limit is given with tracks"):
        adjust(tracks, client, start, memory_limit=5)
    with pytest.raises(eg.ArgumentError, match="source is a int"):
        adjust(5, client)
    # What only a worker sees comes back by its name, not as a lost worker.
    bit_flipped(folder / "part-00003.npz")
    with pytest.raises(FileFormatError, match=r"part-00003.npz"):
        adjust(folder, client)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("when", "times"), [("linearize_state", 3), ("advance", 3), ("linearize_state", 6)]
)
def test_a_worker_that_dies_loses_no_part(
    when: str, times: int, written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    import os
    import signal

    from epigauge.distributed import dispatch

    with cluster(2) as workers, distributed.Client(workers) as client:
        expected = eg.distributed.bundle_adjust(written, client, memory_limit=0)
        victim = next(iter(client.run(os.getpid).values()))
        calls: list[str] = []
        killed: list[int] = []
        submitted = dispatch.Dispatch.submitted

        def killing(self: Any, address: str, name: str, *rest: Any) -> Any:
            calls.append(name)
            future = submitted(self, address, name, *rest)
            # In the second step or a later one: both workers are called in each.
            if calls.count(when) >= times and not killed:
                killed.append(victim)
                os.kill(victim, signal.SIGKILL)
            return future

        monkeypatch.setattr(dispatch.Dispatch, "submitted", killing)
        found = eg.distributed.bundle_adjust(written, client, memory_limit=0)
        assert victim not in client.run(os.getpid).values()
    the_same_bits(found, expected)


@pytest.mark.parametrize(
    "option",
    [
        *("--lines=x.csv", "--y-up", "--y-down", "--rigs=drop", "--init=registration"),
        *("--gauge-mode=implicit", "--repeated=drop", "--precision=x.png", "--plot=x.png"),
    ],
)
def test_the_command_line_refuses_what_parts_cannot_have(
    written: Path, run: Any, option: str
) -> None:
    code, out, err = run("bundle", written, option)
    assert (code, out) == (2, "")
    assert f"{option.partition('=')[0]} is given with a folder of parts" in err


@pytest.mark.slow
def test_the_command_line_adjusts_parts(
    client: Any, scene: Scene, written: Path, tmp_path: Path, run: Any
) -> None:
    tracks, start = scene
    address = client.scheduler.address
    output = tmp_path / "adjusted"
    code, out, _ = run("bundle", written, "--json", "--scheduler", address, "-o", output)
    assert code == 0
    told = json.loads(out)
    here = eg.bundle_adjust(tracks, start)
    assert told["cost"] == pytest.approx(here.cost, rel=1e-12)
    assert (tuple(told["flags"]), told["rank"]) == (here.flags, here.rank)
    assert len(Parts.open(output).parts) == 8
    more = "--memory-limit", "0", "--fix-view", "2", "--refine", "f"
    code, out, err = run("bundle", written, "--scheduler", address, *more)
    assert code == 0
    assert len(out.splitlines()) == 12
    assert "8: 12 views, 90 points" in err
    code, _, err = run("bundle", written, "--robust", "--scheduler", address)
    assert code == 2
    assert "--robust is given with a folder of parts" in err
    code, _, err = run("bundle", written, "--fix-view", "x", "--scheduler", address)
    assert code == 2
    assert "--fix-view" in err
