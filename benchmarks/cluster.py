"""Bundle adjustment by processes of a Dask cluster on this machine, beside that in one process.

    python benchmarks/cluster.py [--observations 200000] [--steps 4] [--rounds 3]
    python benchmarks/cluster.py --ceiling [--observations 200000]
    python benchmarks/cluster.py --parts [--observations 10000000 --views 5000] [--memory-limit MB]

A street: views along a curve, each point seen by eight neighbours, cameras of the model `bal` with
parameters of their own. First, without `--parts`: the milliseconds of a step in this process (one
thread), by one worker and by two, best of several rounds in turns. The first step is left out: in
it the workers take the start. Beside it what a step takes of processor time in this process; how
long the busiest worker computes in it, and how long it waits for others, transport and this
process; and by how much cost and points differ, the latter after a similarity, and of a few
observations also in their standard deviations. With `--ceiling`: what two processes can be at most
on this machine. A process adjusts half of the views on its own, and beside another one that does
the same: they share memory and caches, and no work.
With `--parts`: observations are generated part by part, written to a folder and adjusted from there
by two workers; the time of a step, and the most memory that all processes together have held, are
told beside the time of a step of the same kind in one process, from a tenth of the observations.
"""

from __future__ import annotations

import _one_thread  # noqa: F401  # isort: skip

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import epigauge as eg
import numpy as np
from _measure import described, machine, markdown
from distributed import Client, LocalCluster, get_task_stream
from lines import aligned

#: Views that see a point, and observations of a part.
_SEEN, _PART = 8, 250_000

#: Observations up to which standard deviations are computed.
_SURE = 1_000_000

FOCAL, NOISE_PX = 900.0, 0.5


def cameras(views: int, seed: int = 0) -> eg.MetricReconstruction:
    """Return cameras along a curve that look to its side, without points."""
    rng = np.random.default_rng(seed)
    along = np.arange(views) * 0.5
    heading = 0.4 * np.sin(along / 40.0)
    R = np.zeros((views, 3, 3))
    R[:, 0, 0], R[:, 0, 2], R[:, 1, 1] = np.cos(heading), -np.sin(heading), 1.0
    R[:, 2, 0], R[:, 2, 2] = np.sin(heading), np.cos(heading)
    # BAL's cameras look along -z, y up.
    R = np.diag([1.0, -1.0, -1.0]) @ R
    centres = np.stack([along, 0.3 * np.sin(along / 3.0), 3.0 * np.sin(along / 25.0)], axis=1)
    t = -np.einsum("nij,nj->ni", R, centres)
    params = np.column_stack([np.full(views, FOCAL), rng.normal(0.0, 0.01, (views, 2))])
    return eg.MetricReconstruction(
        R, t, np.zeros((1, 3)), eg.Cameras("bal", params, np.arange(views))
    )


def chunks(true: eg.MetricReconstruction, observations: int) -> Iterator[eg.distributed.Chunk]:
    """Give noisy observations of points beside the views, a part at a time, and a start."""
    count, views = max(observations // _SEEN, 1), true.n_views
    parts = max(8, -(-observations // _PART))
    edges = np.linspace(0, count, parts + 1).astype(int)
    for k, (begin, end) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        rng = np.random.default_rng([1, k])
        place = np.sort(rng.uniform(begin, end, end - begin)) / count * (views - _SEEN + 1)
        first = place.astype(np.intp)
        middle = true.centres[first + _SEEN // 2]
        offset = rng.uniform([-2.0, -3.0, 4.0], [2.0, 3.0, 16.0], (end - begin, 3))
        X = middle + np.einsum("nji,nj->ni", true.R[first + _SEEN // 2], offset * [1.0, 1.0, -1.0])
        point = np.repeat(np.arange(end - begin), _SEEN)
        view = (first[:, None] + np.arange(_SEEN)).ravel()
        scene = eg.MetricReconstruction(true.R, true.t, X, true.cameras)
        xy = scene.project(_Seen(view, point, views, len(X))) + rng.normal(
            0.0, NOISE_PX, (len(view), 2)
        )
        yield eg.distributed.Chunk(X + rng.normal(0.0, 0.02, X.shape), view, point, xy)


class _Seen:
    """As much of tracks as a projection asks for."""

    def __init__(self, view: Any, point: Any, n_views: int, n_points: int) -> None:
        self.view, self.point, self.n_views, self.n_points = view, point, n_views, n_points

    def __len__(self) -> int:
        return len(self.view)


def off(true: eg.MetricReconstruction) -> eg.MetricReconstruction:
    """Return cameras that an adjustment can begin at."""
    rng = np.random.default_rng(2)
    t = true.t + rng.normal(0.0, 0.005, true.t.shape)
    params = true.cameras.params + np.array([3.0, 0.0, 0.0]) * rng.normal(size=(true.n_views, 1))
    own = eg.Cameras("bal", params, true.cameras.camera_of_view)
    return eg.MetricReconstruction(true.R, t, true.X, own)


def whole(observations: int, views: int) -> tuple[eg.Tracks, eg.MetricReconstruction]:
    """Return tracks and start of all chunks together."""
    true = cameras(views)
    parts, begin, starts = [], 0, []
    for chunk in chunks(true, observations):
        parts.append((chunk.view, np.asarray(chunk.point) + begin, chunk.xy))
        starts.append(chunk.X)
        begin += len(np.asarray(chunk.X))
    view, point, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    start = off(true)
    X = np.concatenate(starts)
    return eg.Tracks(view, point, xy), eg.MetricReconstruction(start.R, start.t, X, start.cameras)


def a_step(result: Any) -> float:
    """Return the seconds of a step after the first, in which points and start go to the workers."""
    _, *rows = result.history
    return float(rows[-1].seconds - rows[0].seconds) / (len(rows) - 1)


def computing(stream: Any, steps: int) -> float:
    """Return the seconds of a step that the busiest worker computes, of a stream of tasks."""
    spans: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for task in stream.data:
        for name in ("epigauge-linearize_state", "epigauge-advance"):
            if task["key"].startswith(name):
                found = [part for part in task["startstops"] if part["action"] == "compute"]
                own = spans.setdefault((task["worker"], name), [])
                own += [(part["start"], part["stop"]) for part in found]
    busy: dict[str, float] = {}
    for (worker, _), own in spans.items():
        last = sorted(own)[1 - steps :]
        if name == "epigauge-linearize_state":  # what comes after the last step is none of its
            last = sorted(own)[-steps:-1]
        busy[worker] = busy.get(worker, 0.0) + sum(stop - start for start, stop in last)
    return max(busy.values()) / (steps - 1)


def peak_memory(pids: list[int]) -> int:
    """Return the bytes that processes have held at most, each at its own time."""
    total = 0
    for pid in pids:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        total += 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return total


def cluster(workers: int) -> LocalCluster:
    """Return so many processes of one thread."""
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address=":0",
        silence_logs=50,
        memory_limit=0,
    )


def speeds(observations: int, views: int, steps: int, rounds: int) -> None:
    """Time steps here, by one worker and by two."""
    tracks, start = whole(observations, views)
    options: Any = {"max_iter": steps, "ftol": 0.0}
    found: dict[str, list[tuple[float, float, float]]] = {}
    results: dict[str, Any] = {}
    with cluster(1) as one, cluster(2) as two, Client(one) as single, Client(two) as double:
        for _ in range(rounds):
            begin = time.process_time()
            results["in process"] = eg.bundle_adjust(tracks, start, **options)
            spent = (time.process_time() - begin) / steps
            found.setdefault("in process", []).append((a_step(results["in process"]), spent, 0.0))
            for name, client in (("1 worker", single), ("2 workers", double)):
                begin = time.process_time()
                with get_task_stream(client) as stream:
                    results[name] = eg.distributed.bundle_adjust(tracks, client, start, **options)
                spent = (time.process_time() - begin) / steps
                row = a_step(results[name]), spent, computing(stream, steps)
                found.setdefault(name, []).append(row)
    best = {name: min(rows) for name, rows in found.items()}
    expected = results["in process"]
    sigma = None
    if len(tracks) <= _SURE:
        sigma = eg.covariance(tracks, expected.reconstruction, noise_px=NOISE_PX).std.points
    table = []
    for name, (step, here, worker) in best.items():
        other = results[name]
        away = aligned(other.reconstruction, expected.reconstruction).X - expected.reconstruction.X
        table.append(
            [
                name,
                f"{1e3 * step:.0f}",
                f"{best['in process'][0] / step:.2f}",
                f"{1e3 * here:.0f}",
                f"{1e3 * worker:.0f}" if worker else "",
                f"{1e3 * (step - worker):.0f}" if worker else "",
                f"{abs(other.cost / expected.cost - 1.0):.1e}",
                f"{np.abs(away).max():.1e}",
                "" if sigma is None else f"{np.max(np.abs(away) / sigma):.1e}",
            ]
        )
    print(f"{len(tracks)} observations, {tracks.n_views} views, {tracks.n_points} points\n")
    head = ["", "ms a step", "speed", "processor here", "busiest worker", "rest"]
    head += ["cost off", "points off", "of sigma"]
    print(markdown(head, table))
    ratio = best["1 worker"][0] / best["2 workers"][0]
    overhead = best["1 worker"][0] / best["in process"][0] - 1.0
    print(f"\ntwo workers against one: {ratio:.2f}; overhead of one worker: {100 * overhead:.0f} %")


_HERE: list[Any] = []


def prepare(observations: int, views: int) -> None:
    """Keep tracks and start in this process."""
    _HERE[:] = whole(observations, views)


def own_step(steps: int) -> float:
    """Return the seconds of a step of what this process keeps."""
    return a_step(eg.bundle_adjust(*_HERE, max_iter=steps, ftol=0.0))


def ceiling(observations: int, views: int, steps: int, rounds: int) -> None:
    """Time steps of half of the views in a process, alone and beside another one."""
    context = get_context("spawn")
    pools = [ProcessPoolExecutor(1, mp_context=context) for _ in range(2)]
    alone, both = [], []
    with pools[0], pools[1]:
        wait([pool.submit(prepare, observations // 2, views // 2) for pool in pools])
        for _ in range(rounds):
            alone.append(pools[0].submit(own_step, steps).result())
            side = [pool.submit(own_step, steps) for pool in pools]
            both.append(max(future.result() for future in side))
    print(
        f"half of {observations} observations: {1e3 * min(alone):.0f} ms a step in a process alone,"
    )
    print(f"{1e3 * min(both):.0f} beside another one that has the other half: two processes that")
    print(f"share no work are at most {2.0 * min(alone) / min(both):.2f} times as fast as one here")


def parts(observations: int, views: int, steps: int, limit: int | None) -> None:
    """Adjust a folder of parts by two workers, and measure the memory."""
    true = cameras(views)
    options: Any = {"max_iter": steps, "ftol": 0.0}
    with tempfile.TemporaryDirectory() as folder, cluster(2) as two, Client(two) as client:
        begin = time.perf_counter()
        path = Path(folder) / "parts"
        eg.distributed.write_parts(chunks(true, observations), path, off(true))
        written = time.perf_counter() - begin
        begin = time.perf_counter()
        result = eg.distributed.bundle_adjust(path, client, memory_limit=limit, **options)
        took = time.perf_counter() - begin
        held = [peak_memory([pid]) for pid in (os.getpid(), *client.run(os.getpid).values())]
    step, told = a_step(result), ", ".join(f"{size / 2**30:.2f}" for size in held)
    print(f"{result.n_observations} observations, {views} views, {len(result.reconstruction.X)}")
    print(f"points in parts, written in {written:.0f} s; adjusted in {took:.0f} s with the verdict")
    print(f"{1e3 * step:.0f} ms a step by two workers; cost {result.cost:.8g}, {result.flags}")
    print(f"peak memory {sum(held) / 2**30:.2f} GiB: client and workers {told}")
    few, fewer = max(observations // 10, 1000), max(views // 10, 2 * _SEEN)
    here = a_step(eg.bundle_adjust(*whole(few, fewer), **options))
    print(f"in one process {1e3 * here:.0f} ms a step for a tenth of the observations")


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--observations", type=int, default=200_000)
    parser.add_argument("--views", type=int, help="by default one for 2,000 observations")
    parser.add_argument("--steps", type=int, default=4, help="at least two")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--ceiling", action="store_true", help="two processes side by side")
    parser.add_argument("--parts", action="store_true", help="a folder, by two workers")
    parser.add_argument("--memory-limit", type=int, metavar="MB", help="of each worker")
    options = parser.parse_args()
    if options.steps < 2:
        parser.error("--steps is less than two: the first one is left out")
    views = options.views or max(options.observations // 2000, 2 * _SEEN)
    print(f"\n{described(machine(('distributed',)))}\n")
    if options.parts:
        limit = None if options.memory_limit is None else 1_000_000 * options.memory_limit
        parts(options.observations, views, options.steps, limit)
    else:
        does = ceiling if options.ceiling else speeds
        does(options.observations, views, options.steps, options.rounds)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
