"""Errors of epigauge: `ValueError` subclasses that say what was wrong and what is needed.

The parts of a message stay available as attributes, and every error can be pickled, so that it
survives the way back from a worker process.
"""

from __future__ import annotations

import os

__all__ = [
    "ArgumentError",
    "BackendError",
    "EpigaugeError",
    "FileFormatError",
    "MissingPackageError",
]


class EpigaugeError(ValueError):
    """Base class of all errors that epigauge raises on purpose."""


class ArgumentError(EpigaugeError):
    """An argument of a function cannot be used.

    Parameters
    ----------
    argument : str
        Name of the argument, as the caller wrote it.
    was : str
        What it was, as the rest of a sentence: ``"has shape (5, 3)"``.
    needed : str
        What is needed instead, or how to repair it.
    """

    def __init__(self, argument: str, was: str, needed: str) -> None:
        super().__init__(argument, was, needed)
        self.argument = argument
        self.was = was
        self.needed = needed

    def __str__(self) -> str:
        return f"{self.argument} {self.was}; needed: {self.needed}"


class FileFormatError(EpigaugeError):
    """A file cannot be read as what it should be.

    Parameters
    ----------
    file : str or path
        The file.
    reason : str
        What is wrong with it and, where that helps, what is needed.
    line : int, optional
        Number of the line at fault, from 1.
    """

    def __init__(self, file: str | os.PathLike[str], reason: str, line: int | None = None) -> None:
        super().__init__(os.fspath(file), reason, line)
        self.file = os.fspath(file)
        self.reason = reason
        self.line = line

    def __str__(self) -> str:
        where = self.file if self.line is None else f"{self.file}, line {self.line}"
        return f"{where}: {self.reason}"


class BackendError(EpigaugeError):
    """A numerical backend was asked for that is unknown or not usable here.

    Parameters
    ----------
    name : str
        Name of the backend.
    reason : str
        Why it cannot be used, as the rest of a sentence: ``"is not installed"``.
    remedy : str
        What to do about it.
    """

    def __init__(self, name: str, reason: str, remedy: str) -> None:
        super().__init__(name, reason, remedy)
        self.name = name
        self.reason = reason
        self.remedy = remedy

    def __str__(self) -> str:
        return f"backend {self.name!r} {self.reason}; {self.remedy}"


class MissingPackageError(EpigaugeError, ImportError):
    """A function needs an optional package that is not installed.

    Parameters
    ----------
    package : str
        Name of the package.
    extra : str
        The extra of epigauge that brings it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(package, extra)
        self.package = package
        self.extra = extra

    def __str__(self) -> str:
        return f"needs the package {self.package}: pip install 'epigauge[{self.extra}]'"
