"""Results of which some fields are computed when they are first asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

__all__ = ["Partial"]


class Partial:
    """Base of a dataclass whose instances may start with some of their fields only."""

    @classmethod
    def partial(cls, known: dict[str, Any], complete: Callable[[], Any]) -> Self:
        """Return a result of which some fields are known and the rest is computed when asked for.

        Parameters
        ----------
        known : dict
            Fields by name.
        complete : callable
            Returns an object with the other fields; those that are known keep their values.

        Returns
        -------
        Partial
            Pickling and copying completes it.
        """
        result = object.__new__(cls)
        result.__dict__.update(known, _complete=complete)
        return result

    def __getattr__(self, name: str) -> Any:
        # Only called for what is not there yet.
        complete = self.__dict__.get("_complete")
        if complete is not None and name in type(self).__dataclass_fields__:  # type: ignore[attr-defined]
            for field, value in complete().__dict__.items():
                self.__dict__.setdefault(field, value)
            self.__dict__.pop("_complete", None)
        try:
            return self.__dict__[name]
        except KeyError:
            kind = type(self).__name__
            raise AttributeError(f"{kind!r} object has no attribute {name!r}") from None

    def __getstate__(self) -> dict[str, Any]:
        fields = type(self).__dataclass_fields__  # type: ignore[attr-defined]
        return {name: getattr(self, name) for name in fields}
