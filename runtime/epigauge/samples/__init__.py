"""Small files to try everything with: matches, tracks, photographs. They come with the package.

All of them are computed by the project itself (``tests/make_samples.py``) and have its licence,
BSD-3-Clause: do with them what you like.

>>> import epigauge as eg
>>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
>>> tracks
Tracks(5 views, 100 points, 500 observations)
"""

from __future__ import annotations

import shutil
from pathlib import Path

from epigauge._arguments import as_choice
from epigauge.errors import ArgumentError

__all__ = ["SAMPLES", "copy", "names", "path"]

#: The samples by name, with what they are.
SAMPLES = {
    "matches.csv": "50 matches of a simulated pair, without gross errors",
    "raw_matches.csv": "SIFT matches of A.jpg and B.jpg, wrong ones among them",
    "tracks.csv": "100 simulated points in five views, without gross errors",
    "raw_tracks.csv": "the same tracks, 5 % of the observations 10 to 60 pixels off",
    "A.jpg": "a room, rendered: 640 x 480, f = 560 px",
    "B.jpg": "the same room from 1.4 m farther right",
    **{
        f"room{k}.jpg": f"the room along an arc, {k + 1} of 8: 400 x 300, f = 360 px"
        for k in range(8)
    },
}


def names() -> tuple[str, ...]:
    """Return the names of the samples.

    Returns
    -------
    tuple of str
        Names of files.

    Examples
    --------
    >>> eg.samples.names()[:2]
    ('matches.csv', 'raw_matches.csv')
    """
    return tuple(SAMPLES)


def path(name: str) -> Path:
    """Return where a sample lies.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    Path
        The file: not to be written to.

    Raises
    ------
    ArgumentError
        If there is no such sample.

    Examples
    --------
    >>> matches = eg.load_matches(eg.samples.path("matches.csv"))
    >>> len(matches)
    50
    """
    return Path(__file__).with_name(as_choice("name", name, SAMPLES))


def copy(folder: str | Path) -> list[Path]:
    """Copy all samples to a folder, which is made if absent.

    Parameters
    ----------
    folder : str or path
        Where to. A file there that is the same already is left alone.

    Returns
    -------
    list of Path
        The copies.

    Raises
    ------
    ArgumentError
        If another file has a sample's name; then none is copied.
    OSError
        If the files cannot be written.

    Examples
    --------
    >>> eg.samples.copy("samples")  # doctest: +SKIP
    """
    target = Path(folder)
    pairs = [(path(name), target / name) for name in SAMPLES]
    for source, there in pairs:
        if there.exists() and there.read_bytes() != source.read_bytes():
            raise ArgumentError("folder", f"holds another {there.name}", "an empty folder")
    target.mkdir(parents=True, exist_ok=True)
    for source, there in pairs:
        if not there.exists():
            shutil.copyfile(source, there)
    return [there for _, there in pairs]
