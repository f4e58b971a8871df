"""What the readers and writers share: limits, suffixes and short descriptions for messages."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from epigauge.errors import ArgumentError

PathLike = str | os.PathLike[str]

#: Most matches or observations read from one file. Larger files are refused before their content
#: is allocated.
MAX_MATCHES = 10_000_000


def check_suffix(path: PathLike, *allowed: str) -> str:
    """Check the suffix that chooses the form of a file."""
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        raise ArgumentError(
            "path", f"is {os.fspath(path)!r}", f"a name ending in {listed(allowed)}"
        )
    return suffix


def listed(names: Sequence[str]) -> str:
    """List a few names."""
    return ", ".join([*map(cut, names[:8]), *(["..."] if len(names) > 8 else [])]) or "nothing"


def cut(value: object, limit: int = 40) -> str:
    """Show something from a file on one line of readable length, free of control characters."""
    text = "".join(c if c.isprintable() else "?" for c in str(value)[: limit + 1])
    return text if len(text) <= limit else text[: limit - 3] + "..."
