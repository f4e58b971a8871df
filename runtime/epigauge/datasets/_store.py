"""Where the files of data sets lie, and how they get there."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from epigauge.datasets import _convert
from epigauge.datasets._catalogue import Dataset, Source
from epigauge.errors import EpigaugeError, MissingPackageError

#: Where the pinned commits are served.
PUBLIC = "https://raw.githubusercontent.com"
#: Part of the cache's path: a conversion that writes other arrays gets another number.
_LAYOUT = "1"
#: Seconds without an answer that count as no connection, and bytes read at a time.
_TIMEOUT, _CHUNK = 30, 2**16
_LOG = logging.getLogger("epigauge.datasets")


class DatasetError(EpigaugeError):
    """A data set is not on this machine and cannot be fetched.

    Parameters
    ----------
    name : str
        Name of the set.
    reason : str
        Why, as the rest of a sentence: ``"is not offered for download"``.
    """

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(name, reason)
        self.name = name
        self.reason = reason

    def __str__(self) -> str:
        return (
            f"data set {self.name!r} {self.reason}; where its files are at hand, set the "
            "environment variable EPIGAUGE_DATA to the directory that holds them"
        )


def locate(
    entry: Dataset, file: str, sources: Sequence[Source], base_url: str, convert: str
) -> Path:
    """Return a file of a data set, fetching it first where it is not on this machine.

    Parameters
    ----------
    entry : Dataset
        The set, for messages.
    file : str
        Path below the directory of data.
    sources : sequence of Source
        What it is made of.
    base_url : str
        Where to fetch these from.
    convert : str
        The function of `_convert` that makes the file of them.

    Returns
    -------
    Path
        The complete file.
    """
    given = os.environ.get("EPIGAUGE_DATA")
    if given and Path(given, file).is_file():
        return Path(given, file)
    if not sources:
        raise DatasetError(entry.name, f"is not offered for download ({entry.origin})")
    try:
        import pooch
    except ModuleNotFoundError:
        raise MissingPackageError("pooch", "data") from None
    cached = Path(os.environ.get("EPIGAUGE_CACHE") or pooch.os_cache("epigauge"), _LAYOUT, file)
    if cached.is_file():
        return cached
    _LOG.info("fetching data set %s; licence: %s", entry.name, entry.licence)
    with tempfile.TemporaryDirectory(prefix="epigauge-") as folder:
        downloaded = [_download(entry, source, base_url, Path(folder)) for source in sources]
        cached.parent.mkdir(parents=True, exist_ok=True)
        getattr(_convert, convert)(downloaded, cached, entry.image_size)
    return cached


def _download(entry: Dataset, source: Source, base_url: str, folder: Path) -> Path:
    """Download one file and check it."""
    import pooch

    url = source.url(base_url)
    name = Path(source.path).name
    try:
        with _silenced(pooch.get_logger()):
            found: Any = pooch.retrieve(
                url, f"sha256:{source.sha256}", name, folder, downloader=_get
            )
    except OSError as error:  # all that requests raises is one
        raise DatasetError(entry.name, f"could not be fetched from {url}: {error}") from error
    except ValueError as error:
        raise DatasetError(entry.name, f"was refused: {error} ({url})") from error
    return Path(found)


def _get(url: str, file: str, pooch: Any) -> None:
    """Download for pooch, whose own function leaves the connection of a failed request open."""
    import requests

    with requests.get(url, stream=True, timeout=_TIMEOUT) as response, Path(file).open("wb") as out:
        response.raise_for_status()
        for chunk in response.iter_content(_CHUNK):
            out.write(chunk)


@contextmanager
def _silenced(logger: logging.Logger) -> Iterator[None]:
    """Keep pooch from writing to stderr what this module logs itself."""
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
