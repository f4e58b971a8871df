"""What a fault is, the list of planted ones, and where it is looked for in the sources."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Fault:
    """A change of one place in one file.

    Attributes
    ----------
    name, what : str
        Short name, and a sentence.
    file : str
        Path in the checkout.
    begin, end : int
        The characters replaced.
    new : str
        By what.
    """

    name: str
    what: str
    file: str
    begin: int
    end: int
    new: str

    def planted(self, text: str) -> str:
        """Return the file's text with the fault."""
        return text[: self.begin] + self.new + text[self.end :]

    def lines(self, text: str) -> tuple[str, str]:
        """Return the lines it stands in as they are and as they become, without indentation."""
        first = text.rfind("\n", 0, self.begin) + 1
        last = text.find("\n", self.end)
        new = text[first : self.begin] + self.new + text[self.end : last]
        return text[first:last].strip(), new.strip()


@cache
def areas() -> list[dict[str, Any]]:
    """Return the areas of areas.toml."""
    found: list[dict[str, Any]] = tomllib.loads((HERE / "areas.toml").read_text())["area"]
    return found


def area(file: str) -> dict[str, Any]:
    """Return the area that a source belongs to."""
    for entry in areas():
        if any(fnmatch(file, pattern) for pattern in entry["files"]):
            return entry
    raise ValueError(f"no area of areas.toml holds {file}")


def planted_faults(root: Path) -> Iterator[Fault | str]:
    """Yield the faults of planted.toml; a sentence for one that does not apply any more."""
    for entry in tomllib.loads((HERE / "planted.toml").read_text())["fault"]:
        found = _places(root, entry["file"], entry["old"])
        if len(found) != 1:
            reason = "stands at several places" if found else "no longer applies"
            yield f"{entry['name']}: {reason}: {entry['what']} ({entry['file']})"
            continue
        (file, begin, end, indent) = found[0]
        new = _indented(entry["new"], indent)
        yield Fault(entry["name"], entry["what"], file, begin, end, new)


def _places(root: Path, file: str, old: str) -> list[tuple[str, int, int, str]]:
    """Return where a text stands: in its file, else in any other of the same language."""
    lines = [re.escape(line.strip()) for line in old.strip("\n").split("\n")]
    pattern = re.compile(r"\s*\n\s*".join(lines))
    top, suffix = file.split("/")[0], Path(file).suffix
    others = sorted(p.relative_to(root).as_posix() for p in (root / top).rglob(f"*{suffix}"))
    for names in ([file], [name for name in others if name != file]):
        found = []
        for name in names:
            if (root / name).is_file():
                text = (root / name).read_text()
                for match in pattern.finditer(text):
                    line = text[text.rfind("\n", 0, match.start()) + 1 : match.start()]
                    found.append((name, match.start(), match.end(), re.match(r"\s*", line)[0]))
        if found:
            return found
    return []


def _indented(new: str, indent: str) -> str:
    """Return a replacement with the indentation of the place it comes to."""
    lines = new.strip("\n").split("\n")
    own = len(lines[0]) - len(lines[0].lstrip())
    moved = [lines[0].strip(), *(indent + line[own:] for line in lines[1:])]
    return "\n".join(line.rstrip() for line in moved)
