"""Results of which some fields are computed when they are first asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, Self

from epigauge._results import Result

__all__ = ["Partial"]


class Partial(Result):
    """Base of a dataclass whose instances may start with some of their fields only."""

    @classmethod
    def partial(
        cls, known: dict[str, Any], complete: Callable[[], Any], **cheaper: Callable[[], Any]
    ) -> Self:
        """Return a result of which some fields are known and the rest is computed when asked for.

        Parameters
        ----------
        known : dict
            Fields by name.
        complete : callable
            Returns an object with the other fields; those that are known keep their values. It may
            be partial itself.
        **cheaper : callable
            The same for single fields that need not all the rest.

        Returns
        -------
        Partial
            Pickling and copying completes it.
        """
        result = object.__new__(cls)
        result.__dict__.update(known, _complete=complete, _cheaper=cheaper)
        return result

    def __getattr__(self, name: str) -> Any:
        # Only called for what is not there yet.
        known = self.__dict__
        if name in type(self).__dataclass_fields__:  # type: ignore[attr-defined]
            cheaper = known.get("_cheaper", {}).get(name)
            if cheaper is not None:
                self._add(cheaper())
            while name not in known and "_complete" in known:
                # What completes it may be partial itself, and bring its own `_complete`.
                more = known["_complete"]()
                del known["_complete"]
                self._add(more)
        try:
            return self.__dict__[name]
        except KeyError:
            kind = type(self).__name__
            raise AttributeError(f"{kind!r} object has no attribute {name!r}") from None

    def _add(self, more: Any) -> None:
        for field, value in more.__dict__.items():
            self.__dict__.setdefault(field, value)

    def __getstate__(self) -> dict[str, Any]:
        own: Any = self
        return {field.name: getattr(self, field.name) for field in fields(own)}
