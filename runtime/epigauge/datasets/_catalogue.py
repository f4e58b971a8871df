"""The catalogue of data sets: what they are, where they come from, and what may be done with them.

It is written in ``catalogue.toml``, whose groups share an origin and a licence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

_FILES = {"tracks": "{}/tracks.npz", "matches": "pairs/{}.npz"}


@dataclass(frozen=True)
class Source:
    """A published file.

    Parameters
    ----------
    repository : str
        ``owner/name`` on GitHub.
    commit : str
        The commit that is pinned.
    path : str
        Path of the file in it.
    sha256 : str
        Of its bytes.

    Examples
    --------
    >>> import epigauge as eg
    >>> eg.datasets.Source("owner/name", "0" * 40, "data/a.npz", "0" * 64).path
    'data/a.npz'
    """

    repository: str
    commit: str
    path: str
    sha256: str = field(repr=False)

    def url(self, base_url: str) -> str:
        """Return the address of the file below that of a server.

        Parameters
        ----------
        base_url : str
            The address of the server.

        Returns
        -------
        str
            Where the file is.

        Examples
        --------
        >>> import epigauge as eg
        >>> source = eg.datasets.Source("owner/name", "c0ffee", "data/a.npz", "0" * 64)
        >>> source.url("https://example.org/")
        'https://example.org/owner/name/c0ffee/data/a.npz'
        """
        return f"{base_url.rstrip('/')}/{self.repository}/{self.commit}/{self.path}"


@dataclass(frozen=True)
class Dataset:
    """A data set of the catalogue.

    Parameters
    ----------
    name : str
        What `load` calls it.
    kind : {"tracks", "matches"}
        Points in many views, or in two.
    title : str
        What it is.
    origin : str
        Who made it, and what was done to it.
    licence : str
        Under which terms it may be used, as far as its publishers say.
    file : str
        Its path below the directory that ``EPIGAUGE_DATA`` names.
    sources : tuple of Source
        The published files it is converted from; none where it is not offered for download.
    images : mapping of str to Source
        Image files that come with it, by their path below the same directory.
    left_out : tuple of str
        Arrays that were added from elsewhere, which a downloaded set lacks.
    image_size : (int, int) or None
        (width, height) of the images, in pixels, where a download would not tell.
    convert : str
        How the sources become the file: a function of the module ``_convert``.

    Examples
    --------
    >>> import epigauge as eg
    >>> entry = eg.datasets.describe("house")
    >>> entry.kind, entry.downloadable
    ('tracks', True)
    """

    name: str
    kind: str
    title: str
    origin: str
    licence: str
    file: str
    sources: tuple[Source, ...] = ()
    images: Mapping[str, Source] = field(default_factory=lambda: MappingProxyType({}))
    left_out: tuple[str, ...] = ()
    image_size: tuple[int, int] | None = None
    convert: str = field(default="unchanged", repr=False)

    @property
    def downloadable(self) -> bool:
        """Whether `load` can fetch it."""
        return bool(self.sources)


@cache
def catalogue() -> Mapping[str, Dataset]:
    """Return all data sets by name, in the order of the file."""
    import tomllib  # not needed by most who import epigauge

    text = files(__package__).joinpath("catalogue.toml").read_text(encoding="utf-8")
    groups = tomllib.loads(text).values()
    return MappingProxyType({entry.name: entry for group in groups for entry in _entries(group)})


def _entries(group: dict[str, Any]) -> Iterator[Dataset]:
    for name, own in group["sets"].items():
        known = {key: value for key, value in group.items() if key != "sets"} | own
        pinned = (known.pop("repository", ""), known.pop("commit", ""))
        size = known.pop("image_size", None)
        yield Dataset(
            name=name,
            file=known.pop("file", _FILES[known["kind"]].format(name)),
            sources=tuple(Source(*pinned, *item) for item in known.pop("files", {}).items()),
            images=MappingProxyType(
                {file: Source(*pinned, *item) for file, item in known.pop("images", {}).items()}
            ),
            left_out=tuple(known.pop("left_out", ())),
            image_size=None if size is None else (size[0], size[1]),
            **known,
        )
