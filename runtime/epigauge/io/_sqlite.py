"""SQLite files from elsewhere: opened without trust, copied without loss, errors made plain."""

from __future__ import annotations

import errno
import functools
import os
import secrets
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from epigauge.errors import EpigaugeError, FileFormatError
from epigauge.io._common import cut

_WAIT_S = 5.0

_UNFINISHED = "holds an interrupted write: open it for writing once, which takes it back"

#: What is the matter with the system rather than with the file, by SQLite's code.
_SYSTEM = {
    sqlite3.SQLITE_BUSY: (errno.EBUSY, "is locked by another program: close it, or try again"),
    sqlite3.SQLITE_LOCKED: (errno.EBUSY, "is locked by another program: close it, or try again"),
    sqlite3.SQLITE_READONLY_ROLLBACK: (errno.EACCES, _UNFINISHED),
    sqlite3.SQLITE_READONLY_RECOVERY: (errno.EACCES, _UNFINISHED),
    sqlite3.SQLITE_READONLY: (errno.EACCES, "cannot be written to"),
    sqlite3.SQLITE_CANTOPEN: (errno.EACCES, "cannot be opened"),
    sqlite3.SQLITE_IOERR: (errno.EIO, "cannot be read or written"),
    sqlite3.SQLITE_FULL: (errno.ENOSPC, "does not fit on the disk"),
}


def connect(path: Path, write: bool, longest: int) -> tuple[sqlite3.Connection, bool]:
    """Open an SQLite file that exists; call it within `sqlite_errors`.

    Parameters
    ----------
    path : Path
        The file.
    write : bool
        Whether it may be changed.
    longest : int
        Most bytes of a value; a longer one is an error.

    Returns
    -------
    connection : sqlite3.Connection
        Without automatic transactions.
    unguarded : bool
        Whether nothing keeps other programs from writing: compare `stamp` before and after.

    Raises
    ------
    FileFormatError
        If it is something else.
    OSError
        If it cannot be opened.
    """
    with path.open("rb") as file:  # a missing file, a directory: said by the operating system
        head = file.read(20)
    if not head.startswith(b"SQLite format 3\0"):
        raise FileFormatError(path, "is no SQLite database" if head else "is empty")
    # A reader of a database with a write-ahead log (WAL) makes files beside it and leaves them
    # there. Where there are none, no program has the database open, and none are needed.
    unguarded = not write and head[18:20] == b"\x02\x02" and not _log(path).exists()
    mode = "rw" if write else "ro&immutable=1" if unguarded else "ro"
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=_WAIT_S, isolation_level=None
    )
    try:
        connection.text_factory = functools.partial(str, encoding="utf-8", errors="replace")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)
        # What SQLite's authors recommend for files from elsewhere
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        connection.execute("PRAGMA synchronous = FULL")
    except BaseException:
        connection.close()
        raise
    return connection, unguarded


def stamp(path: Path) -> tuple[int, int]:
    """Return what changes when another program writes to a file."""
    state = path.stat()
    return state.st_size, state.st_mtime_ns


def copy_beside(source: sqlite3.Connection, path: Path) -> Path:
    """Copy a database to a new file beside it.

    Parameters
    ----------
    source : sqlite3.Connection
        The open database; this connection must not be writing.
    path : Path
        Its file.

    Returns
    -------
    Path
        The file's name with ``.bak`` appended, or ``.bak1``, ``.bak2`` and so on: a file that
        exists is never replaced. It has this name only when it is complete.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with closing(sqlite3.connect(temporary)) as target:
            shutil.copymode(path, temporary)
            source.backup(target)
            target.execute("PRAGMA journal_mode = DELETE")  # one file, complete in itself
        return _named(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def sqlite_errors(path: Path) -> Iterator[None]:
    """Turn whatever SQLite and its Python module raise into `FileFormatError` and `OSError`."""
    try:
        yield
    except (EpigaugeError, OSError):
        raise
    except Exception as error:
        code = getattr(error, "sqlite_errorcode", None) or 0
        # The low byte of an extended code is the code proper.
        known = _SYSTEM.get(code) or _SYSTEM.get(code & 0xFF)
        if known is not None:
            number, reason = known
            raise OSError(number, f"{reason} ({error})", str(path)) from error
        reason = cut(str(error) or type(error).__name__, limit=100)
        raise FileFormatError(path, f"is damaged or no database: {reason}") from error


def _log(path: Path) -> Path:
    """Return the write-ahead log of a database."""
    real = Path(os.path.realpath(path))
    return real.with_name(real.name + "-wal")


def _named(temporary: Path, path: Path) -> Path:
    """Give a complete copy the first name that is free."""
    number = 0
    while True:
        kept = path.with_name(f"{path.name}.bak{number or ''}")
        number += 1
        if kept.exists():
            continue
        try:
            os.link(temporary, kept)  # unlike renaming, never replaces a file
        except FileExistsError:
            continue
        except OSError:  # a file system without links
            temporary.rename(kept)
        return kept
