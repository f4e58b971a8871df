"""Point matches in, results out: CSV, TXT, NPZ and JSON.

Files are untrusted. Nothing is unpickled, sizes are checked before anything is allocated, and a
file that cannot be used is refused with a `FileFormatError` that names the file, the line where
there is one, and the reason. What cannot be opened or written at all is an `OSError`.
Files are written under a temporary name and moved into place: a half-written one is never seen.
"""

from __future__ import annotations

from epigauge.io._common import MAX_MATCHES
from epigauge.io.matches import Matches, load_matches, save_matches
from epigauge.io.output import plain, save_result, writing

__all__ = [
    "MAX_MATCHES",
    "Matches",
    "load_matches",
    "plain",
    "save_matches",
    "save_result",
    "writing",
]
