"""What ``epigauge bundle`` does with a folder of parts, which no process has to hold whole."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import typer
from rich.markup import escape

import epigauge as eg
from epigauge.cli._cluster import client_of, local_client
from epigauge.cli._common import (
    DONE,
    INTERRUPTED,
    NOT_CONVERGED,
    console,
    facts,
    shown,
    write_json,
)
from epigauge.cli._live import watching
from epigauge.distributed.parts import Parts
from epigauge.errors import ArgumentError
from epigauge.io import plain

__all__ = ["adjust_folder", "refuse"]

_MEGABYTE = 1_000_000


def refuse(options: Mapping[str, Any]) -> None:
    """Refuse what needs all observations at one place, where it is given."""
    for name, value in options.items():
        if value:
            option = f"--{name.replace('_', '-')}"
            was = "is given with a folder of parts"
            raise ArgumentError(option, was, "none; or tracks, or a scene")


def adjust_folder(
    folder: Path,
    scheduler: str | None,
    memory_limit: int | None,
    refine: str | None,
    fixed: Sequence[str],
    outputs: Sequence[Path],
    json: bool,
    **options: Any,
) -> int:
    """Adjust the parts of a folder and write what is asked for; return the exit code."""
    parts = Parts.open(folder)
    if len(outputs) > 1:
        raise ArgumentError("--output", "is given more than once", "one new folder")
    chosen: Any = refine or "all"
    if chosen not in ("all", "pose"):
        chosen = [name.strip() for name in chosen.split(",")]
    options |= {"refine": chosen, "fixed_views": [_view(name, parts) for name in fixed]}
    if memory_limit is not None:
        options["memory_limit"] = memory_limit * _MEGABYTE
    if outputs:
        options["output"] = outputs[0]
    out, begin = console(), time.perf_counter()
    given = None if scheduler is None else client_of(scheduler)
    with (
        local_client() if given is None else nullcontext(given) as client,
        watching(out, parts.n_observations, "adjustment", not json) as watch,
    ):
        watch.begin()
        result = eg.distributed.bundle_adjust(folder, client, callback=watch, **options)
    if given is not None:
        given.close()
    seconds = time.perf_counter() - begin
    found = result.reconstruction
    if json:
        document: dict[str, Any] = plain(result)
        scene = document.pop("reconstruction")
        document |= scene.pop("cameras") | scene
        more = {"source": str(folder), "names": plain(parts.names), "seconds": seconds}
        write_json(document | more | {"n_views": parts.n_views, "n_points": parts.n_points})
    else:
        for row in found.vectors:
            typer.echo(" ".join(f"{value:.17g}" for value in row))
        status = "interrupted" if watch.interrupted else escape(result.message)
        rows = {
            "parts": f"{len(parts.parts)}: {parts.n_views} views, {parts.n_points} points, "
            f"{parts.n_observations} observations",
            "cameras": f"{len(found.cameras)} of the model {found.cameras.model}, refined: "
            f"{chosen if isinstance(chosen, str) else 'pose, ' + ', '.join(chosen)}",
            "rms_px": f"{result.rms_px:.6g} per coordinate",
            "cost": f"{result.cost:.8g} px^2",
            "evaluations": f"{result.nfev}, with {result.njev} linearisations",
            "status": status,
            "flags": escape(", ".join(result.flags)) or "none",
            "seconds": f"{seconds:.2f}",
        }
        if result.weakest:
            rows["weakest"] = escape(result.weakest)
        out.print(facts(escape(shown(folder)), rows))
    if watch.interrupted:
        out.print(f"[bold red]interrupted[/] after {result.nfev} evaluations: this is the best")
        return INTERRUPTED
    return DONE if result.success else NOT_CONVERGED


def _view(name: str, parts: Parts) -> int:
    if name in (parts.names or ()):
        return (parts.names or ()).index(name)
    if name.isascii() and name.isdigit() and int(name) < parts.n_views:
        return int(name)
    needed = f"a number from 0 to {parts.n_views - 1}, or the name of a view"
    raise ArgumentError("--fix-view", f"is {name!r:.60}", needed)
