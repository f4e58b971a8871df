"""What all results share: text and a table for people, plain data, and files."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from epigauge import verdicts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["SCHEMA", "Result", "SavedResult"]

#: Version of the form of JSON documents: another one is not read alike.
SCHEMA = 1

#: Fields that have their own place in a summary, or none.
_APART = ("flags", "success", "kind", "schema")
#: Arrays of more entries are shown by their shape.
_SMALL = 12


class Result:
    """Base of results: `print`, `summary`, `to_dict`, `save`, and a table in notebooks.

    Every field can be reached by its name; what is shown to people are the ones that matter first.
    All results can be pickled and copied.
    """

    __slots__ = ()

    #: Fields that people see first; all that are neither large nor private if empty.
    _shown: ClassVar[tuple[str, ...]] = ()

    def summary(self) -> str:
        """Return what matters, in lines for people: numbers, flags, and what the flags mean.

        Returns
        -------
        str
            The text that `print` shows.

        Examples
        --------
        >>> import epigauge as eg
        >>> scene = eg.two_view_scene(seed=1)
        >>> print(eg.refine_fundamental(scene.x1, scene.x2).summary().splitlines()[0])
        FundamentalResult: may be used
        """
        rows = self._summary_rows()
        width = max(map(len, rows), default=0)
        lines = [self._heading()]
        for name, text in rows.items():
            first, *others = text.splitlines() or [""]
            lines.append(f"  {name:{width}}  {first}")
            lines += [f"  {'':{width}}  {line}" for line in others]
        lines += [f"  {flag}: {text}" for flag, text in self._explained().items()]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data: dicts, lists, str, int, float, bool and None.

        Returns
        -------
        dict
            Every public field by its name; `kind` is the type of the result, `version` that of
            epigauge, `schema` that of the form. NaN and infinity are None, as JSON has no such
            numbers.

        Examples
        --------
        >>> import json, epigauge as eg
        >>> scene = eg.two_view_scene(seed=1)
        >>> document = eg.refine_fundamental(scene.x1, scene.x2).to_dict()
        >>> document["kind"], len(json.loads(json.dumps(document))["F"])
        ('FundamentalResult', 3)
        """
        from epigauge.io.output import plain

        document: dict[str, Any] = plain(identity(self) | self._contents())
        return document

    def save(self, path: Any, **more: Any) -> None:
        """Write it as NPZ or JSON, which `load_result` reads.

        Parameters
        ----------
        path : str or path
            The file; ``.npz`` or ``.json`` chooses the form.
        **more
            Further fields to write.

        Raises
        ------
        ArgumentError
            If the suffix is neither of these.
        OSError
            If the file cannot be written.

        Examples
        --------
        >>> result.save("pair.npz")  # doctest: +SKIP
        >>> eg.load_result("pair.npz").F  # doctest: +SKIP
        """
        from epigauge.io.output import save_result

        save_result(path, self, **more)

    def plot(self, *data: Any, **options: Any) -> Figure:
        """Draw it.

        Parameters
        ----------
        *data
            What it was computed from: the matches ``x1, x2`` of results of two views, the tracks of
            reconstructions, upgrades and metric covariances; nothing for all others.
        **options
            Of the picture of this kind of result.

        Returns
        -------
        matplotlib.figure.Figure
            The picture; `epigauge.plots.save_figure` writes it.

        Raises
        ------
        ArgumentError
            If there is nothing to draw, or the data does not belong to the result.
        MissingPackageError
            If Matplotlib is not installed.

        Examples
        --------
        >>> import epigauge as eg
        >>> tracks = eg.load_tracks(eg.samples.path("tracks.csv"))
        >>> figure = tracks.plot()  # doctest: +SKIP
        """
        from epigauge.plots import plot_result

        return plot_result(self, *data, **options)

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        """Return the summary as a table, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'><pre style='margin:0'>{html.escape(text)}</pre></td></tr>"
            for name, text in self._summary_rows().items()
        )
        notes = "".join(
            f"<p><strong>{html.escape(flag)}:</strong> {html.escape(text)}</p>"
            for flag, text in self._explained().items()
        )
        heading = html.escape(self._heading())
        return f"<table><caption><strong>{heading}</strong></caption>{rows}</table>{notes}"

    def _contents(self) -> dict[str, Any]:
        """Return all public fields by name."""
        own: Any = self
        fields = [field.name for field in dataclasses.fields(own)]
        return {name: getattr(self, name) for name in fields if not name.startswith("_")}

    def _arrays(self) -> dict[str, Any]:
        """Return the fields of NPZ, where they differ."""
        return self._contents()

    def _summary_rows(self) -> dict[str, str]:
        """Return names and texts of a table for people."""
        contents = self._contents()
        wanted = self._shown or tuple(n for n in contents if n not in _APART)
        rows = {name: _text(contents[name]) for name in wanted if contents.get(name) is not None}
        if _are_words(contents.get("flags")):
            rows["flags"] = ", ".join(contents["flags"]) or "none"
        return rows

    def _heading(self) -> str:
        kind, success = type(self).__name__, getattr(self, "success", None)
        if not isinstance(success, bool | np.bool_):
            return kind
        return f"{kind}: {_verdict(bool(success))}"

    def _explained(self) -> dict[str, str]:
        flags = getattr(self, "flags", ())
        known = _are_words(flags) and all(flag in verdicts.FLAGS for flag in flags)
        return verdicts.explained(flags) if known else {}


class SavedResult(dict[str, Any], Result):
    """What `load_result` reads: a dict of the fields, which are attributes, too.

    Examples
    --------
    >>> found = eg.load_result("pair.json")  # doctest: +SKIP
    >>> found["F"] is found.F, found.success  # doctest: +SKIP
    """

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"the file holds no {name!r}; it has {', '.join(self)}") from None

    def probability_good(self, px: float) -> Any:
        """Return what the result of a robust estimate has under this name."""
        from epigauge.two_view.confidence import probability_below
        from epigauge.two_view.tensors import REFUSED

        error, p_wrong = (np.asarray(getattr(self, key), float) for key in ("error_px", "p_wrong"))
        error = np.where(np.isnan(error), np.inf, error)  # JSON has no infinity
        good = probability_below(px, error, p_wrong)
        found = np.where(np.asarray(self.status) == REFUSED, 0.0, good)
        return found if found.ndim else float(found)

    def __str__(self) -> str:
        return self.summary()

    def _contents(self) -> dict[str, Any]:
        return dict(self)

    def _heading(self) -> str:
        kind, success = self.get("kind", "SavedResult"), self.get("success")
        known = f": {_verdict(success)}" if isinstance(success, bool) else ""
        return f"{kind} from a file{known}"


def identity(result: Any) -> dict[str, Any]:
    """Return what every document says of itself: the type of the result, version and form."""
    if not isinstance(result, Result) or isinstance(result, SavedResult):
        return {}
    import epigauge

    return {"kind": type(result).__name__, "version": epigauge.__version__, "schema": SCHEMA}


def _verdict(success: bool) -> str:
    return "may be used" if success else "not to be used"


def _are_words(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(word, str) for word in value)


def _text(value: Any) -> str:
    """Show a value on one line, or a small matrix on a line a row."""
    if isinstance(value, bool | np.bool_ | str):
        return str(value)
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    if isinstance(value, np.ndarray):
        if 0 < value.size <= _SMALL and value.dtype.kind in "iufb":
            return np.array2string(value, precision=6, suppress_small=False)
        return f"{value.dtype} {value.shape}"
    if isinstance(value, Result):
        return value._heading()
    if isinstance(value, list | tuple):
        if _are_words(value) and len(value) <= _SMALL:
            return ", ".join(value)
        return f"{len(value)} rows"
    if isinstance(value, Mapping):
        return f"{len(value)} entries"
    return str(value).split("\n", 1)[0]
