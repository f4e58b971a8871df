"""Pages in HTML: their links lead somewhere, their pictures show something, their parts close."""

from __future__ import annotations

import base64
import binascii
import html.parser
import struct
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: Elements that have no end.
_VOID = {
    *("area", "base", "br", "col", "embed", "hr", "img"),
    *("input", "link", "meta", "source", "track", "wbr"),
}


class Page(html.parser.HTMLParser):
    """What is asked about a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.pictures: list[dict[str, str]] = []
        self.names: set[str] = set()
        self.open: list[str] = []
        self.viewport = False
        self.title = ""
        self.wrong: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.names |= {values[key] for key in ("id", "name") if key in values}
        if tag not in _VOID:
            self.open.append(tag)
        if tag == "img":
            self.pictures.append(values)
        self.links += [values[key] for key in ("href", "src") if key in values]
        self.viewport |= values.get("name") == "viewport"

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open[-1] in ("p", "li", "dd", "dt", "td", "th", "tr") != tag:
            if self.open[-1] == tag:
                break
            self.open.pop()
        if self.open and self.open[-1] == tag:
            self.open.pop()
        elif tag != "p":
            self.wrong.append(f"</{tag}> closes nothing")

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["title"]:
            self.title += data


def problems(path: Path) -> list[str]:
    """Return what is wrong with a page."""
    page = Page(path.read_text(encoding="utf-8"))
    found = list(page.wrong)
    if not page.title.strip():
        found.append("has no title")
    if not page.viewport:
        found.append("does not fit a phone (no viewport)")
    for picture in page.pictures:
        if not picture.get("src"):
            # Filled in by the script of the page.
            if "id" not in picture:
                found.append("has a picture without a source")
        elif "alt" not in picture:
            found.append(f"has a picture without alt text: {picture['src'][:40]}")
    for link in page.links:
        why = _broken(link, path, page)
        if why:
            found.append(f"{link[:60]} {why}")
    return found


def _broken(link: str, path: Path, page: Page) -> str | None:
    parts = urlsplit(link)
    if parts.scheme == "data":
        return _empty(link)
    if parts.scheme or link.startswith("//"):
        return None  # not looked up
    if parts.path:
        target = path.parent / unquote(parts.path)
        if not (target.is_file() or (target / "index.html").is_file()):
            return "leads nowhere"
        if parts.fragment and target.suffix == ".html" and target != path:
            there = Page(target.read_text(encoding="utf-8"))
            return None if unquote(parts.fragment) in there.names else "names no part of that page"
        return None
    lost = parts.fragment and unquote(parts.fragment) not in page.names
    return "names no part of the page" if lost else None


def _empty(link: str) -> str | None:
    """Return why an embedded picture shows nothing."""
    kind, _, text = link.partition(",")
    if ";base64" not in kind:
        return None if text else "is empty"
    try:
        content = base64.b64decode(text, validate=True)
    except binascii.Error:
        return "is no base64"
    if content.startswith(b"\x89PNG"):
        width, height = struct.unpack(">II", content[16:24])
        return None if width > 1 and height > 1 else "has no pixels"
    return None if len(content) > 64 else "is empty"
