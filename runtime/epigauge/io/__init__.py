"""Point matches and tracks in, results out: CSV, TXT, BAL, NPZ, JSON, PLY, COLMAP.

Files are untrusted. Nothing is unpickled, sizes are checked before anything is allocated, and a
file that cannot be used is refused with a `FileFormatError` that names the file, the line where
there is one, and the reason. What cannot be opened or written at all is an `OSError`.
Files are written under a temporary name and moved into place: a half-written one is never seen.
"""

from __future__ import annotations

from epigauge.io._colmap_pinhole import save_colmap_model
from epigauge.io._common import MAX_MATCHES
from epigauge.io._scene import ColmapSource, SceneSource
from epigauge.io.line_files import load_line_tracks, save_line_tracks
from epigauge.io.matches import Matches, load_matches, save_matches
from epigauge.io.output import plain, save_result, writing
from epigauge.io.ply import save_ply
from epigauge.io.results import load_result
from epigauge.io.scene_files import load_scene, save_scene
from epigauge.io.tracks import (
    TrackFile,
    load_reconstruction,
    load_track_file,
    load_tracks,
    save_reconstruction,
    save_tracks,
)

__all__ = [
    "MAX_MATCHES",
    "ColmapSource",
    "Matches",
    "SceneSource",
    "TrackFile",
    "load_line_tracks",
    "load_matches",
    "load_reconstruction",
    "load_result",
    "load_scene",
    "load_track_file",
    "load_tracks",
    "plain",
    "save_colmap_model",
    "save_line_tracks",
    "save_matches",
    "save_ply",
    "save_reconstruction",
    "save_result",
    "save_scene",
    "save_tracks",
    "writing",
]
