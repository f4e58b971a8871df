"""What a fault is, the list of planted ones, and where it is looked for in the sources."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

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
    tests : list of str
        Tests of the area, the likeliest to notice it first.
    """

    name: str
    what: str
    file: str
    begin: int
    end: int
    new: str
    tests: list[str]

    def planted(self, text: str) -> str:
        """Return the file's text with the fault."""
        return text[: self.begin] + self.new + text[self.end :]


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
        yield Fault(
            entry["name"],
            entry["what"],
            file,
            begin,
            end,
            new,
            files_tests(root, file, entry.get("tests", ())),
        )


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


def files_tests(root: Path, file: str, first: Sequence[str]) -> list[str]:
    """Return the tests of a file's area that there are, after some that come first."""
    named = list(first)
    areas = tomllib.loads((HERE / "areas.toml").read_text())["area"]
    for area in areas:
        if any(fnmatch(file, pattern) for pattern in area["files"]):
            named += [test for test in area["tests"] if test not in named]
            break
    else:
        raise ValueError(f"no area of areas.toml holds {file}")
    return [test for test in named if (root / test.split("::")[0]).is_file()]
