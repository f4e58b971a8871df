"""Calls of all partitions, wherever they are: who has which, and what to do when one is lost."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

from epigauge.distributed.sums import Node, Terms, whole
from epigauge.distributed.worker import Payload, Recipe, Reply, forget, serve
from epigauge.errors import ArgumentError

__all__ = ["Dispatch", "Run"]

#: Seconds between looks whether all workers are alive, and to wait for one if there is none.
_LOOK, _PATIENCE = 0.5, 60.0

#: Calls at the same time, one a worker.
_CALLS = 64

#: A call fails for good when one partition has been lost so many times.
_ATTEMPTS = 5


class Dispatch:
    """The workers of a client, and which partition each of them has.

    Parameters
    ----------
    client : distributed.Client
        Connected to a scheduler.
    limit : int, optional
        Bytes of observations that a worker holds laid out beside those in use; by default all.

    Raises
    ------
    ArgumentError
        If it is none, is closed, or has no workers.
    """

    def __init__(self, client: Any, limit: int | None = None) -> None:
        self.limit = limit
        if not all(callable(getattr(client, name, None)) for name in ("submit", "scatter")):
            was = f"is of type {type(client).__name__}"
            raise ArgumentError("client", was, "a distributed.Client, as Client() returns")
        if getattr(client, "asynchronous", False):
            raise ArgumentError("client", "is asynchronous", "Client(asynchronous=False)")
        self._client = client
        self.stale: list[str] = []
        self.workers()

    def workers(self) -> dict[str, int]:
        """Return the threads of all workers by address; wait a while for one."""
        needed = "a client of a running scheduler with workers"
        if getattr(self._client, "status", "running") != "running":
            was = f"is not connected to its scheduler (status {self._client.status})"
            raise ArgumentError("client", was, needed)
        try:
            found: dict[str, int] = self._client.nthreads()
            if not found:
                self._client.wait_for_workers(1, timeout=_PATIENCE)
                found = self._client.nthreads()
        except (OSError, TimeoutError) as error:
            was = f"has no scheduler that answers, or no worker ({error!s:.200})"
            raise ArgumentError("client", was, needed) from None
        return dict(sorted(found.items()))

    def submitted(self, address: str, name: str, threads: int, *arguments: Any) -> Any:
        """Return the future of a call of `serve` at a worker."""
        *common, payload = arguments
        client, there = self._client, payload
        if payload.own or payload.recipes:  # large: not by way of the scheduler
            there = client.scatter(payload, workers=[address], direct=True, hash=False)
        return client.submit(
            serve,
            *common,
            there,
            threads,
            workers=[address],
            allow_other_workers=False,
            pure=False,
            key=f"epigauge-{name}-{uuid.uuid4().hex}",
        )

    def result(self, future: Any) -> Reply:
        """Return what a future gives."""
        reply: Reply = self._client.gather(future, direct=True)
        return reply

    def alive(self) -> set[str]:
        """Return the addresses of the workers."""
        return set(self.workers())

    def sweep(self) -> None:
        """Let workers forget problems that nobody uses any more."""
        runs, self.stale = self.stale, []
        if runs:
            with contextlib.suppress(Exception):  # who is not there any more has forgotten
                self._client.run(forget, runs)


class Run:
    """One problem at the workers.

    Parameters
    ----------
    dispatch : Dispatch
        The workers.
    count : int
        Number of partitions.
    recipe : callable
        Returns how a partition, by its number, is made.
    """

    def __init__(self, dispatch: Dispatch, count: int, recipe: Callable[[int], Recipe]) -> None:
        self.name, self.count = uuid.uuid4().hex, count
        self._dispatch, self._recipe = dispatch, recipe
        self._home: dict[int, str] = {}
        self._there: set[int] = set()
        # Kept: a call that was given up may still wait for a connection.
        self._pool = ThreadPoolExecutor(_CALLS)

    def each(
        self,
        call: str,
        common: tuple[Any, ...] = (),
        own: Callable[[int], tuple[Any, ...]] | None = None,
    ) -> tuple[Terms, list[Any]]:
        """Call a method of all partitions.

        Parameters
        ----------
        call : str
            Name of a method of `Partition`.
        common : tuple
            Its first arguments.
        own : callable, optional
            Returns the others for the number of a partition.

        Returns
        -------
        tuple, list
            The sums of what is to be summed, and what each partition returns of its own.
        """
        self._dispatch.sweep()
        terms: dict[Node, Terms] = {}
        results: dict[int, Any] = {}
        lost = dict.fromkeys(range(self.count), 0)
        pending: dict[Future[Reply], _Task] = {}

        def begin(numbers: Iterable[int]) -> None:
            for address, threads, part in self._shares(sorted(numbers)):
                payload = Payload(
                    {} if own is None else {k: own(k) for k in part},
                    {k: self._recipe(k) for k in part if k not in self._there},
                    self._dispatch.limit,
                )
                arguments = self.name, self.count, part, call, common, payload
                task = _Task(self._dispatch, address, part)
                pending[self._pool.submit(task.run, call, threads, *arguments)] = task

        begin(range(self.count))
        try:
            while pending:
                done, _ = wait(pending, timeout=_LOOK, return_when=FIRST_COMPLETED)
                alive = None if done else self._dispatch.alive()
                for future, task in list(pending.items()):
                    if future in done:
                        del pending[future]
                        again = self._taken(future, task, terms, results)
                    elif alive is not None and task.address not in alive:
                        del pending[future]
                        task.cancel()
                        again = task.numbers
                    else:
                        continue
                    for number in again:
                        self._there.discard(number)
                        lost[number] += 1
                        if lost[number] > _ATTEMPTS:
                            was = f"loses worker after worker (partition {number}: {call})"
                            needed = "workers that stay, with enough memory for their part"
                            raise ArgumentError("client", was, needed)
                    if again:
                        begin(again)
        finally:
            for task in pending.values():
                task.cancel()
        total = whole(terms, self.count) if terms else ()
        return total, [results[k] for k in range(self.count)]

    def release(self) -> None:
        """Let the workers forget this problem, the next time that they are called."""
        self._dispatch.stale.append(self.name)

    def _taken(
        self,
        future: Future[Reply],
        task: _Task,
        terms: dict[Node, Terms],
        results: dict[int, Any],
    ) -> list[int]:
        """Take a reply; return the partitions that must be called once more."""
        error = future.exception()
        if error is None:
            reply = future.result()
            terms.update(reply.terms)
            results.update(reply.own)
            self._there.update(reply.own)
            return reply.missing
        if task.address in self._dispatch.alive() and not _is_of_transport(error):
            raise error
        return task.numbers

    def _shares(self, numbers: list[int]) -> list[tuple[str, int, list[int]]]:
        """Return which worker, of how many threads, calls which partitions."""
        workers = self._dispatch.workers()
        addresses, load = list(workers), dict.fromkeys(workers, 0)
        if not self._home:  # neighbours together: their sums are made there
            total = sum(workers.values())
            ends = [sum(list(workers.values())[: k + 1]) for k in range(len(addresses))]
            for number in range(self.count):
                place = (number + 0.5) * total / self.count
                self._home[number] = addresses[sum(end <= place for end in ends)]
        for address in self._home.values():
            if address in load:
                load[address] += 1
        for number in numbers:
            if self._home[number] not in workers:
                spare = min(addresses, key=lambda address: load[address] / workers[address])
                self._home[number] = spare
                self._there.discard(number)
                load[spare] += 1
        homes = sorted({self._home[k] for k in numbers})
        return [
            (home, workers[home], [k for k in numbers if self._home[k] == home]) for home in homes
        ]


class _Task:
    """A call at one worker."""

    def __init__(self, dispatch: Dispatch, address: str, numbers: list[int]) -> None:
        self._dispatch, self.address, self.numbers = dispatch, address, numbers
        self._future: Any = None
        self._cancelled = False

    def run(self, call: str, threads: int, *arguments: Any) -> Reply:
        """Make the call and wait for its reply."""
        self._future = self._dispatch.submitted(self.address, call, threads, *arguments)
        if self._cancelled:
            self.cancel()
        return self._dispatch.result(self._future)

    def cancel(self) -> None:
        """Give the call up: `run` ends."""
        self._cancelled = True
        if self._future is not None:
            with contextlib.suppress(Exception):
                self._future.cancel()


def _is_of_transport(error: BaseException) -> bool:
    """Tell whether a call was lost, not wrong."""
    from concurrent.futures import CancelledError as Given

    from distributed import CancelledError
    from distributed.scheduler import KilledWorker

    return isinstance(error, CancelledError | Given | KilledWorker | OSError | TimeoutError)
