"""A COLMAP model as a directory of files, text or binary."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from epigauge.errors import ArgumentError, FileFormatError
from epigauge.io._colmap_binary import read_binary, write_binary
from epigauge.io._colmap_parts import FILES, ColmapModel
from epigauge.io._colmap_text import read_text_model, write_text_model
from epigauge.io.output import writing


def read_folder(path: Path) -> ColmapModel:
    """Read a model, binary where there is one."""
    for suffix, read in ((".bin", read_binary), (".txt", read_text_model)):  # as COLMAP chooses
        if (path / f"cameras{suffix}").exists():
            names = [f"{name}{suffix}" for name in ("rigs", "frames")]
            there = [name for name in names if (path / name).exists()]
            if len(there) == 1:
                (lacks,) = set(names) - set(there)
                raise FileFormatError(path, f"holds {there[0]} without {lacks}")
            return read(path)
    raise FileFormatError(path, "is no COLMAP model: it holds neither cameras.bin nor cameras.txt")


def write_folder(path: Path, model: ColmapModel, text: bool, head: Sequence[str] = ()) -> None:
    """Write a model: all of its files or, unless the machine stops between the last steps, none.

    Parameters
    ----------
    path : Path
        Directory; made if absent.
    model : ColmapModel
        With rigs and frames.
    text : bool
        Text, not binary.
    head : sequence of str
        Comments at the top of each text file.

    Raises
    ------
    ArgumentError
        If the directory holds a model of the other form, which COLMAP might read instead.
    OSError
        If it cannot be written.
    """
    suffix, other = (".txt", ".bin") if text else (".bin", ".txt")
    stale = path / f"cameras{other}"
    if stale.exists():
        was = f"is {str(path)!r}, which holds {stale.name} of another model"
        needed = "an empty folder" if head else f"an empty folder, or text={not text}"
        raise ArgumentError("path", was, needed)
    path.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        files = {name: stack.enter_context(writing(path / (name + suffix))) for name in FILES}
        if text:
            write_text_model(files, model, head)
        else:
            write_binary(files, model)
