"""Damaged files through the command line: each is read, or refused with one line.

    python tests/fuzz.py --inputs 10000

makes that many inputs of good files by mutation, runs them, prints a table, and keeps in
``fuzz-failures`` what was neither. ``--atheris KIND`` lets Atheris choose the inputs by the lines
of Python that they reach, where that package is installed.
"""

from __future__ import annotations

import argparse
import bz2
import faulthandler
import gzip
import importlib.util
import io
import re
import shlex
import sqlite3
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import colmap_databases
import epigauge as eg
import numpy as np
from epigauge.cli import app
from metric_scenes import metric_scene
from typer.testing import CliRunner

Random = np.random.Generator
Mutation = Callable[[bytes, Random], bytes]

#: Seconds that one input may take before the process is ended with a traceback.
LIMIT_S = 60.0
#: Bytes of address space that the process may use beyond what it has when fuzzing begins: the
#: largest arrays that a reader accepts take 320 MB, and NumPy needs several of them.
MEMORY = 4 * 2**30

#: What is put into text.
_WORDS = (
    *(b"nan", b"inf", b"-1", b"0", b"1", b"1e308", b"-1e308", b"1e-308", b"1e20", b"7.5", b"1_0"),
    *(b"99999999999999999999", b"0x10", b"", b",", b"\t", b"\n", b"\r", b"#", b'"', b";", b"\xff"),
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:e[-+]?\d+)?")
#: What is put in the place of eight bytes.
_VALUES = np.array(
    [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, 1e-308, 1e20, 5e-324, 1e9, 2.0**53, 640.0]
)


@dataclass(frozen=True)
class Kind:
    """A good file, the commands that read it, and ways to damage it that only it has."""

    name: str
    good: bytes
    commands: tuple[str, ...]
    inner: tuple[Mutation, ...] = ()
    others: dict[str, bytes] = field(default_factory=dict)

    def damaged(self, random: Random) -> bytes:
        """Return the file with a few random changes, half of them below its outer form."""
        if self.inner and random.integers(2):
            return self.inner[random.integers(len(self.inner))](self.good, random)
        return mutated(self.good, random)


@dataclass(frozen=True)
class Outcome:
    """What a command made of an input; `fault` says what is wrong with that."""

    command: str
    code: int | None
    fault: str
    seconds: float


def mutated(data: bytes, random: Random) -> bytes:
    """Cut, overwrite, insert, move or repeat a few stretches of a file."""
    changed = bytearray(data)
    for _ in range(random.choice([1, 1, 2, 4])):
        at, other = (int(k) for k in random.integers(0, len(changed) + 1, 2))
        size = int(random.integers(0, 40))
        match random.integers(7):
            case 0:
                del changed[at : at + size]
            case 1:
                changed[at : at + size] = random.bytes(size)
            case 2:
                changed[at : at + size] = changed[other : other + size]
            case 3:
                word = _WORDS[random.integers(len(_WORDS))]
                changed[at:at] = word * int(random.choice([1, 1, 1, 500]))
            case 4:
                if random.integers(4) == 0:
                    del changed[at:]
            case 5:
                at -= at % 8
                changed[at : at + 8] = random.choice(_VALUES).tobytes()
            case 6:
                for place in random.integers(0, max(len(changed), 1), 5):
                    changed[place : place + 1] = random.bytes(1)
    return bytes(changed)


def renumbered(data: bytes, random: Random) -> bytes:
    """Replace a few numbers of a text: its form stays good."""
    found = list(_NUMBER.finditer(data))
    changed = bytearray(data)
    for k in sorted(random.integers(0, len(found), random.integers(1, 4)), reverse=True):
        choice = (
            _WORDS[random.integers(10)]
            if random.integers(2)
            else found[(k - 7) % len(found)].group()
        )
        changed[slice(*found[k].span())] = choice
    return bytes(changed)


def relined(data: bytes, random: Random) -> bytes:
    """Leave out, repeat and exchange lines of a text."""
    lines = data.splitlines(keepends=True)
    for _ in range(random.integers(1, 4)):
        a, b = random.integers(0, len(lines), 2)
        match random.integers(3):
            case 0:
                del lines[min(a, b) : min(a, b) + int(random.integers(1, 30))]
            case 1:
                lines.insert(a, lines[b])
            case 2:
                lines[a], lines[b] = lines[b], lines[a]
        lines = lines or [b"\n"]
    return b"".join(lines)


def rearchived(data: bytes, random: Random) -> bytes:
    """Change one array of an NPZ file, with sums that fit."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = sorted(members)[random.integers(len(members))]
    match random.integers(4):
        case 0:
            members[name] = mutated(members[name], random)
        case 1:  # only numbers
            array = bytearray(members[name])
            for at in random.integers(16, max(len(array) // 8, 17), random.integers(1, 4)):
                array[8 * at : 8 * at + 8] = random.choice(_VALUES).tobytes()
            members[name] = bytes(array)
        case 2:
            del members[name]
        case 3:  # another type, shape or order
            with np.load(io.BytesIO(data)) as arrays:
                array = np.asarray(arrays[name.removesuffix(".npy")])
            forms = (
                lambda a: a.astype(
                    random.choice(["f2", "f4", "i1", "u8", "c16", "?", "S3", ">f8"])
                ),
                np.transpose,
                np.ravel,
                lambda a: a[..., :0],
                lambda a: a[:1],
                lambda a: np.stack([a, a]),
            )
            stream = io.BytesIO()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.save(stream, forms[random.integers(len(forms))](array))
            members[name] = stream.getvalue()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", random.choice([zipfile.ZIP_STORED, 8])) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return stream.getvalue()


def inside(
    unpack: Callable[[bytes], bytes], pack: Callable[[bytes], bytes], mutation: Mutation
) -> Mutation:
    """Return a mutation of what is inside a compressed file."""
    return lambda data, random: pack(mutation(unpack(data), random))


def recelled(data: bytes, random: Random) -> bytes:
    """Replace a few values of a database: its pages stay good."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "d.db"
        path.write_bytes(data)
        connection = sqlite3.connect(path)
        for _ in range(random.integers(1, 4)):
            table = random.choice(["images", "keypoints", "two_view_geometries"])
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
            column = columns[random.integers(len(columns))]
            (rowid,) = connection.execute(
                f"SELECT rowid FROM {table} ORDER BY random() LIMIT 1"
            ).fetchone() or (1,)
            (old,) = connection.execute(
                f"SELECT {column} FROM {table} WHERE rowid = ?", (rowid,)
            ).fetchone() or (None,)
            new = mutated(old, random) if isinstance(old, bytes) and old else None
            others = [None, -1, 0, 2, 10**6, 2**62, 1.5, "text", b"\0" * 8]
            value = new if new and random.integers(3) else others[random.integers(len(others))]
            try:
                statement = f"UPDATE {table} SET {column} = ? WHERE rowid = ?"
                connection.execute(statement, (value, rowid))
            except sqlite3.Error:  # a constraint of COLMAP's schema
                continue
        connection.commit()
        connection.close()
        return path.read_bytes()


def kinds() -> dict[str, Kind]:
    """Return every kind of file that a command reads, by its name."""
    text = (renumbered, relined)
    # Near enough for 20 matches to show parallax: a flagged result would end with 1.
    pair = eg.two_view_scene(3.0, n_points=20, noise_px=0.5, seed=1)
    many = eg.multi_view_scene(n_views=4, n_points=15, visible=0.8, noise_px=0.5, seed=2)
    weights = np.linspace(0.5, 1.0, 20)
    matches = eg.Matches(pair.x1, pair.x2, weights, (640, 480), (640, 480))
    with tempfile.TemporaryDirectory() as folder:

        def saved(name: str, save: Callable[[Path], object]) -> bytes:
            path = Path(folder) / name
            save(path)
            return path.read_bytes()

        def of_matches(path: Path) -> None:
            eg.save_matches(path, matches)

        def of_tracks(path: Path) -> None:
            eg.save_tracks(path, many.tracks, many.true if path.suffix == ".npz" else None)

        def of_bal(path: Path) -> None:
            eg.save_scene(path, *metric_scene("bal", 2, n_points=15, n_cameras=4, noise_px=0.5))

        tracks = saved("t.csv", of_tracks)
        found = [
            Kind("m.csv", saved("m.csv", of_matches), ("refine FILE", "refine FILE --json"), text),
            Kind("m.txt", saved("m.txt", of_matches), ("refine FILE",), text),
            Kind("m.npz", saved("m.npz", of_matches), ("refine FILE",), (rearchived,)),
            Kind("t.csv", tracks, ("bundle FILE", "bundle FILE --clean"), text),
            Kind(
                "t.npz",
                saved("t.npz", of_tracks),
                ("bundle FILE", "bundle FILE --start FILE", "bundle FILE --json"),
                (rearchived,),
            ),
            Kind(
                "b.txt",
                saved("b.txt", of_bal),
                ("bundle FILE --start FILE", "bundle FILE --refine pose"),
                text,
            ),
            *scenes(Path(folder)),
            *strangers(Path(folder), matches, many.tracks),
            *(
                Kind(
                    f"b.txt.{name}",
                    saved(f"b.txt.{name}", of_bal),
                    ("bundle FILE",),
                    tuple(inside(form.decompress, form.compress, m) for m in (*text, mutated)),
                )
                for name, form in (("gz", gzip), ("bz2", bz2))
            ),
            Kind(
                "r.npz",
                saved("r.npz", lambda path: eg.save_reconstruction(path, many.true)),
                ("bundle t.csv --start FILE",),
                (rearchived,),
                {"t.csv": tracks},
            ),
            Kind(
                "d.db",
                saved("d.db", lambda path: colmap_databases.Project(3, 12).write(path)),
                ("colmap FILE", "colmap FILE --json", "colmap FILE --write --no-backup"),
                (recelled,),
            ),
        ]
    return {kind.name: kind for kind in found}


def scenes(folder: Path) -> Iterator[Kind]:
    """Yield the files of COLMAP folders, each damaged while the others are good, and NPZ."""
    scene = metric_scene("SIMPLE_RADIAL", 5, n_points=12, noise_px=0.5)
    command = ("bundle FOLDER --refine pose",)
    for form, text in (("bin", False), ("txt", True)):
        eg.save_scene(folder / form, *scene, text=text)
        good = {path.name: path.read_bytes() for path in (folder / form).iterdir()}
        for name, data in good.items():
            others = {other: content for other, content in good.items() if other != name}
            inner = (renumbered, relined) if text else ()
            yield Kind(name, data, command, inner, others)
    eg.save_scene(folder / "s.npz", *scene)
    whole = (folder / "s.npz").read_bytes()
    yield Kind("s.npz", whole, ("bundle FILE --refine pose",), (rearchived,))


def strangers(folder: Path, matches: eg.Matches, tracks: eg.Tracks) -> Iterator[Kind]:
    """Yield files as other programs write them."""
    x1, x2 = matches.x1.astype(np.float32), matches.x2.astype(np.float32)
    rows, nowhere = np.arange(len(x1)), np.full(3, -1)
    features = {"keypoints0": x1, "keypoints1": np.vstack([x2, x2[:3] + 5.0])}
    tables: dict[str, dict[str, np.ndarray]] = {
        "loftr.npz": {"mkpts0": x1, "mkpts1": x2, "mconf": np.ones(len(x1))},
        "lightglue.npz": features | {"matches": np.column_stack([rows, rows])},
        "superglue.npz": features
        | {"keypoints0": np.vstack([x1, x1[:3] - 5.0]), "matches0": np.append(rows, nowhere)},
        "opencv.npz": {"pts1": x1[:, None], "pts2": x2[:, None], "mask": np.full(len(x1), 255)},
    }
    for name, arrays in tables.items():
        np.savez(folder / name, **arrays)
        yield Kind(name, (folder / name).read_bytes(), ("refine FILE",), (rearchived,))
    np.save(folder / "m.npy", np.hstack([x1, x2]))
    yield Kind("m.npy", (folder / "m.npy").read_bytes(), ("refine FILE",))
    if importlib.util.find_spec("h5py"):
        import h5py

        with h5py.File(folder / "hloc.h5", "w") as file:
            for name, x in (("keypoints0", x1), ("keypoints1", x2)):
                file.create_dataset(f"a.jpg/b.jpg/{name}", data=x)
        yield Kind("hloc.h5", (folder / "hloc.h5").read_bytes(), ("refine FILE",))

    size = np.array([640, 480])
    xy = (tracks.xy + 0.5 - size / 2) / size.max()
    lines = ["OPENSFM_TRACKS_VERSION_v2"] + [
        f"{view}.jpg\t{point}\t{k}\t{x!r}\t{y!r}\t0.004\t10\t20\t30\t-1\t-1"
        for k, (view, point, (x, y)) in enumerate(
            zip(tracks.view, tracks.point, xy.tolist(), strict=True)
        )
    ]
    exif = {f"exif/{i}.jpg.exif": b'{"width": 640, "height": 480}' for i in range(tracks.n_views)}
    text = (renumbered, relined)
    good = "\n".join(lines).encode()
    yield Kind("opensfm.csv", good, ("bundle FILE",), text, exif)
    first = "exif/0.jpg.exif"
    others = {name: content for name, content in exif.items() if name != first}
    yield Kind(first, exif[first], ("bundle opensfm.csv",), text, others | {"opensfm.csv": good})
    scene = metric_scene("bal", 5, n_points=12, noise_px=0.5)
    eg.save_scene(folder / "s.out", *scene)
    good = (folder / "s.out").read_bytes()
    yield Kind("s.out", good, ("bundle FILE --refine pose",), text)


def run(kind: Kind, data: bytes, command: str, folder: Path) -> Outcome:
    """Run a command on an input and judge what it does."""
    folder /= re.sub(r"\W", "-", kind.name)
    folder.mkdir(exist_ok=True)
    for name, content in {kind.name: data, **kind.others}.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    arguments = command.replace("FILE", kind.name).split()
    arguments = [str(folder / a) if (folder / a).is_file() else a for a in arguments]
    arguments = [str(folder) if a == "FOLDER" else a for a in arguments]
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy's would be noise on stderr
        result = CliRunner().invoke(app, arguments)
    seconds = time.perf_counter() - begin
    return Outcome(
        command, result.exit_code, "\n".join(_faults(result, data, folder, kind)), seconds
    )


def _faults(result: object, data: bytes, folder: Path, kind: Kind) -> Iterator[str]:
    """Yield what is wrong with the outcome of a command."""
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        yield "".join(traceback.format_exception(result.exception))
        return
    if result.exit_code not in (0, 1, 2):
        yield f"exit code {result.exit_code}"
    if "Traceback" in result.stderr:
        yield result.stderr
    # A database of which no pair can be used is told pair by pair, as data.
    if result.exit_code == 2 and result.stdout and kind.name != "d.db":
        yield "refused, but there is data on stdout"
    if result.exit_code == 2 and not (result.stderr + result.stdout).strip():
        yield "refused without a reason"
    if result.exit_code == 0 and re.search(r"\b(nan|NaN|Infinity)\b", result.stdout):
        yield "NaN on stdout"
    files = {path for path in folder.rglob("*") if path.is_file()}
    left = files - {folder / name for name in (kind.name, *kind.others)}
    if left:
        yield f"left behind: {sorted(path.name for path in left)}"


def fuzz(
    inputs: int,
    seed: int,
    names: list[str],
    folder: Path,
    each: Callable[[Kind, bytes, Outcome], object],
) -> None:
    """Run `inputs` damaged files, the kinds in turn, and hand each outcome over."""
    known = kinds()
    chosen = [known[name] for name in names or known]
    random = np.random.default_rng(seed)
    for k in range(inputs):
        kind = chosen[k % len(chosen)]
        data = kind.damaged(random)
        command = kind.commands[random.integers(len(kind.commands))]
        each(kind, data, run(kind, data, command, folder))


def main() -> int:
    """Run from the command line; return 1 if there were failures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--failures", type=Path, default=Path("fuzz-failures"))
    parser.add_argument("--atheris", metavar="KIND")
    parser.add_argument("kinds", nargs="*", help="such as m.csv; default: all")
    options = parser.parse_args()
    _limit_memory()
    with tempfile.TemporaryDirectory() as folder:
        if options.atheris:
            return _with_atheris(kinds()[options.atheris], Path(folder))
        codes: Counter[tuple[str, object]] = Counter()
        slowest: dict[str, float] = {}
        begin = time.perf_counter()

        def each(kind: Kind, data: bytes, outcome: Outcome) -> None:
            faulthandler.dump_traceback_later(LIMIT_S, exit=True)
            codes[kind.name, "fault" if outcome.fault else outcome.code] += 1
            slowest[kind.name] = max(slowest.get(kind.name, 0.0), outcome.seconds)
            if outcome.fault:
                options.failures.mkdir(exist_ok=True)
                stem = f"{sum(codes.values()):06d}-{kind.name.replace('/', '-')}"
                (options.failures / stem).write_bytes(data)
                why = f"{shlex.join(['epigauge', outcome.command])}\n{outcome.fault}\n"
                (options.failures / f"{stem}.log").write_text(why)

        fuzz(options.inputs, options.seed, options.kinds, Path(folder), each)
    columns = (0, 1, 2, "fault")
    print(f"{'':12}{'read':>8}{'no conv.':>10}{'refused':>9}{'faults':>8}{'slowest':>10}")
    for name, seconds in slowest.items():
        read, stopped, refused, faults = (codes[name, column] for column in columns)
        print(f"{name:12}{read:8}{stopped:10}{refused:9}{faults:8}{seconds:8.2f} s")
    faults = sum(count for (_, code), count in codes.items() if code == "fault")
    print(f"{options.inputs} inputs in {time.perf_counter() - begin:.0f} s, {faults} failures")
    return int(faults > 0)


def _limit_memory() -> None:
    """Make what asks for too much memory fail with MemoryError, where the system can."""
    try:
        import resource
    except ImportError:
        return
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _with_atheris(kind: Kind, folder: Path) -> int:
    """Let Atheris choose the inputs; it ends the process itself."""
    import atheris

    def one(data: bytes) -> None:
        outcome = run(kind, data, kind.commands[0], folder)
        if outcome.fault:
            raise AssertionError(outcome.fault)

    corpus = folder / "corpus"
    corpus.mkdir()
    (corpus / "good").write_bytes(kind.good)
    atheris.instrument_all()
    atheris.Setup([sys.argv[0], str(corpus)], one)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
