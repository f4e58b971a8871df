"""The worker's side: partitions by name, built when first asked for, and rebuilt when lost."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from epigauge.distributed.partition import Observations, Partition, Setup
from epigauge.distributed.sums import Node, Terms, combined

__all__ = ["Payload", "Recipe", "Reply", "Source", "forget", "serve"]

Array = NDArray[np.float64]


class Source(Protocol):
    """Where a partition's observations come from."""

    def load(self) -> Observations:
        """Return them."""


@dataclass(frozen=True)
class Recipe:
    """All that a partition is rebuilt from, wherever that is.

    Attributes
    ----------
    setup : Setup or None
        What all partitions have in common; None where only the observations are asked for.
    source : Source or Observations
        Its observations, or where they are.
    kept : ndarray of bool, shape (m,), or None
        Its fixed points.
    state : tuple or None
        Token, cameras and its points of the last state that was accepted.
    trial : tuple or None
        Arguments of the `advance` that led on from there.
    """

    setup: Setup | None
    source: Source | Observations
    kept: NDArray[np.bool_] | None = None
    state: tuple[int, Array, Array] | None = None
    trial: tuple[Any, ...] | None = None

    def made(self) -> Partition | Observations:
        """Return the partition, or its observations alone."""
        source = self.source
        observations = source if isinstance(source, Observations) else source.load()
        if self.setup is None:
            return observations
        return Partition(self.setup, observations, self.kept)

    def restore(self, partition: Partition, token: int) -> None:
        """Bring a partition to a state."""
        assert self.state is not None
        partition.load(*self.state)
        if self.state[0] != token:
            assert self.trial is not None
            assert self.trial[-1] == token
            partition.advance(*self.trial)


@dataclass(frozen=True)
class Payload:
    """What goes to one worker alone: arguments and recipes of its partitions, by their number."""

    own: Mapping[int, tuple[Any, ...]] = field(default_factory=dict)
    recipes: Mapping[int, Recipe] = field(default_factory=dict)


class Reply(NamedTuple):
    """Sums of partitions as far up the tree as they go here, their own results, what is missing."""

    terms: dict[Node, Terms]
    own: dict[int, Any]
    missing: list[int]


#: Partitions by run and number.
_HELD: dict[tuple[str, int], Any] = {}
_LOCK = threading.Lock()

#: What works at a state: its token is the first argument.
_AT_STATE = ("linearize_state", "blocks_of_state", "eliminate", "product", "advance")


def serve(
    run: str,
    count: int,
    numbers: Sequence[int],
    call: str,
    common: tuple[Any, ...],
    payload: Payload,
    threads: int,
) -> Reply:
    """Call a method of some partitions, of `count` in all.

    Parameters
    ----------
    run : str
        Name of the problem.
    count : int
        Number of its partitions.
    numbers : sequence of int
        Which of them.
    call : str
        Name of the method.
    common : tuple
        Its first arguments.
    payload : Payload
        The others, and recipes of partitions that may not be here.
    threads : int
        So many partitions at the same time.
    """

    def one(number: int) -> tuple[Terms, Any] | None:
        recipe = payload.recipes.get(number)
        partition = _partition(run, number, recipe)
        if partition is None:
            return None
        if call in _AT_STATE and common[0] not in partition.states:
            if recipe is None:
                return None
            recipe.restore(partition, common[0])
        found: tuple[Terms, Any] = getattr(partition, call)(*common, *payload.own.get(number, ()))
        return found

    with ThreadPoolExecutor(max(1, min(threads, len(numbers)))) as pool:
        results = dict(zip(numbers, pool.map(one, numbers), strict=True))
    there = {number: result for number, result in results.items() if result is not None}
    terms = {(0, number): result[0] for number, result in there.items() if result[0]}
    own = {number: result[1] for number, result in there.items()}
    return Reply(combined(terms, count), own, [k for k in numbers if k not in there])


def _partition(run: str, number: int, recipe: Recipe | None) -> Any:
    with _LOCK:
        held = _HELD.get((run, number))
    if held is None and recipe is not None:
        held = recipe.made()
        with _LOCK:
            _HELD[run, number] = held
    return held


def forget(runs: Sequence[str]) -> None:
    """Drop the partitions of runs."""
    with _LOCK:
        for key in [key for key in _HELD if key[0] in runs]:
            del _HELD[key]
