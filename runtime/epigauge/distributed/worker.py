"""The worker's side: partitions by name, built when first asked for, and rebuilt when lost."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from epigauge.distributed import memory
from epigauge.distributed.observations import Observations, Setup, Source
from epigauge.distributed.partition import Partition
from epigauge.distributed.sums import Node, Terms, combined

__all__ = ["Payload", "Recipe", "Reply", "forget", "serve"]

Array = NDArray[np.float64]


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
        Token, cameras and its points of a state that was accepted.
    trials : tuple
        Arguments of each `advance` that led on from there, one after the other.
    """

    setup: Setup | None
    source: Source | Observations
    kept: NDArray[np.bool_] | None = None
    state: tuple[int, Array, Array] | None = None
    trials: tuple[tuple[Any, ...], ...] = ()

    def made(self) -> Partition | Observations:
        """Return the partition, or its observations alone."""
        source = self.source
        if self.setup is not None:
            return Partition(self.setup, source, self.kept)
        return source if isinstance(source, Observations) else source.load()

    def restore(self, partition: Partition, token: int) -> None:
        """Bring a partition to a state."""
        assert self.state is not None
        partition.load(*self.state)
        for trial in self.trials:
            if token in partition.states:
                return
            partition.advance(*trial)
        assert token in partition.states


@dataclass(frozen=True)
class Payload:
    """What goes to one worker alone.

    Attributes
    ----------
    own, recipes : mapping
        Arguments and recipes of its partitions, by their number.
    limit : int or None
        Bytes of observations that it holds laid out beside those in use; None for all.
    """

    own: Mapping[int, tuple[Any, ...]] = field(default_factory=dict)
    recipes: Mapping[int, Recipe] = field(default_factory=dict)
    limit: int | None = None


class Reply(NamedTuple):
    """Sums of partitions as far up the tree as they go here, their own results, what is missing."""

    terms: dict[Node, Terms]
    own: dict[int, Any]
    missing: list[int]


#: Partitions by run and number.
_HELD: dict[tuple[str, int], Any] = {}
_LOCK = threading.Lock()

#: What works at a state: its token is the first argument.
_AT_STATE = (
    *("linearize_state", "points_of_state", "blocks_of_state", "eliminate", "product", "advance"),
)


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
        does = partition
        if isinstance(partition, Partition) and call not in (*_AT_STATE, "load"):
            does = partition.evaluation
        found: tuple[Terms, Any] = getattr(does, call)(*common, *payload.own.get(number, ()))
        if payload.limit is not None and _held(run) > payload.limit:
            partition.drop()
        return found

    # Those whose observations are here go first: the others take their place no sooner.
    order = sorted(numbers, key=lambda number: not _laid_out(run, number))
    with ThreadPoolExecutor(max(1, min(threads, len(order)))) as pool:
        results = dict(zip(order, pool.map(one, order), strict=True))
    there = {number: result for number, result in results.items() if result is not None}
    terms = {(0, number): result[0] for number, result in there.items() if result[0]}
    own = {number: result[1] for number, result in there.items()}
    return Reply(combined(terms, count), own, [k for k in numbers if k not in there])


def _partition(run: str, number: int, recipe: Recipe | None) -> Any:
    with _LOCK:
        held = _HELD.get((run, number))
    if held is None and recipe is not None:
        memory.keep()
        held = recipe.made()
        with _LOCK:
            _HELD[run, number] = held
    return held


def _laid_out(run: str, number: int) -> bool:
    with _LOCK:
        held = _HELD.get((run, number))
    return isinstance(held, Partition) and held.laid_out


def _held(run: str) -> int:
    """Return the bytes of observations that are laid out here."""
    with _LOCK:
        held = [one for key, one in _HELD.items() if key[0] == run]
    return sum(one.nbytes for one in held if isinstance(one, Partition))


def forget(runs: Sequence[str]) -> None:
    """Drop the partitions of runs, and with the last of all the memory that they took."""
    with _LOCK:
        for key in [key for key in _HELD if key[0] in runs]:
            del _HELD[key]
        if not _HELD:
            memory.give_back()
