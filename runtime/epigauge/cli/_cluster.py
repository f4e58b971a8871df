"""Processes that the commands adjust by: those of a scheduler, or some of this machine."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import epigauge as eg
from epigauge.errors import ArgumentError, MissingPackageError

__all__ = ["adjuster", "client_of", "local_client", "pool"]

#: Seconds within which a scheduler answers.
_ANSWERS = 10


def adjuster(scheduler: str | None) -> Callable[..., eg.BundleResult]:
    """Return what adjusts: here, or the workers of the Dask scheduler at an address."""
    if scheduler is None:
        return eg.bundle_adjust
    client = client_of(scheduler)

    def adjust(tracks: eg.Tracks, start: Any, **options: Any) -> eg.BundleResult:
        with client:
            return eg.distributed.bundle_adjust(tracks, client, start, **options)

    return adjust


def client_of(scheduler: str) -> Any:
    """Return the client of a scheduler."""
    _check_package()
    from distributed import Client

    try:
        return Client(scheduler, timeout=_ANSWERS, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        was = f"{scheduler!r:.80} does not answer ({error!s:.200})"
        needed = "the address of a running scheduler, such as tcp://host:8786"
        raise ArgumentError("--scheduler", was, needed) from None


@contextmanager
def pool(workers: int, scheduler: str | None) -> Iterator[dict[str, Any]]:
    """Give where pairs are computed, as the library takes it: here, or by a scheduler's workers."""
    if scheduler is None:
        yield {"workers": workers}
        return
    if workers != 1:
        raise ArgumentError("--workers", "is given beside --scheduler", "one of them")
    with client_of(scheduler) as client:
        yield {"executor": client.get_executor()}


@contextmanager
def local_client() -> Iterator[Any]:
    """Give a client of processes of this machine, one for each of its cores."""
    _check_package()
    from distributed import Client, LocalCluster

    options: dict[str, Any] = {"dashboard_address": ":0", "silence_logs": logging.ERROR}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with (
        LocalCluster(n_workers=cores, threads_per_worker=1, **options) as workers,
        Client(workers, set_as_default=False) as client,
    ):
        yield client


def _check_package() -> None:
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise MissingPackageError("distributed", "dask") from None
