"""``Localizer.step`` on a map of 10,000 stations with frames of 65,536 points: times, processor share, memory.

A simulated town, 240 m wide, driven at 1.5 m/s with an Ouster-like lidar of 2,048 columns; 65,536 of its returns are
kept in each frame. The run is fed forwards and backwards until 10,000 frames are one drive. Steps while searching are
those up to the first fix. The processor share counts all threads, in per cent of one core at 10 frames a second. Error
and share of frames with a pose show that no time is saved by wrong or missing poses.
"""

from __future__ import annotations

import itertools
import time
from argparse import Namespace
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

import coview_kernels
from bench.harness.rows import Row, bounded, informs, reached
from bench.harness.worlds import opened
from coview_stream import Localizer
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.sim import SimulationConfig

POINTS = 65_536
_SETTLED = 2_000  # frames before memory is watched
_RATE = 10.0


class Drive(NamedTuple):
    """One drive, frame by frame."""

    wall: Floats  # seconds of the step
    cpu: Floats  # processor seconds of all threads
    tracking: Bools  # whether the robot had a place before it, so no map was searched
    error: Floats  # metres; NaN without a pose
    memory: dict[int, float]  # resident MB, every 500 frames


def town(length: float) -> tuple[Any, Any, Floats]:
    """Map, run and true poses (N, 4, 4) of the simulated town, with warm kernels."""
    coview_kernels.warm_up()
    base_map, run, truth = opened(SimulationConfig("town", "os64-2048", seed=4004, size=240.0, length=length))
    return base_map, run, truth[1]


def drive(base_map: Any, run: Any, truth: Floats, count: int) -> Drive:
    """Feed ``count`` frames to a new localizer."""
    import psutil  # of the extra bench

    rng = np.random.default_rng(0)
    frames = [run.read(k) for k in range(len(run))]
    clouds = [f.points[np.sort(rng.choice(len(f.points), min(POINTS, len(f.points)), replace=False))] for f in frames]
    localizer, process = Localizer(base_map), psutil.Process()
    steps, memory = [], {}
    there_and_back = itertools.cycle([*range(len(frames)), *range(len(frames) - 2, 0, -1)])
    for tick, index in enumerate(itertools.islice(there_and_back, count)):
        tracked = localizer.state.has_place
        cpu, wall = time.process_time(), time.perf_counter()
        T = localizer.step(clouds[index], frames[index].T_odom_body, tick / _RATE).T_map_body
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        steps.append((wall, cpu, tracked, np.nan if T is None else np.linalg.norm(T[:3, 3] - truth[index, :3, 3])))
        if tick % 500 == 0 or tick == count - 1:
            memory[tick] = process.memory_info().rss / 1e6
    walls, cpus, tracking, error = np.array(steps, dtype=np.float64).T
    return Drive(walls, cpus, tracking.astype(bool), error, memory)


def rows(asked: Namespace) -> Iterator[Row]:
    """Drive, and judge the times."""
    base_map, run, truth = town(12.0 if asked.quick else 36.0)
    count = 600 if asked.quick else 10_000
    done = drive(base_map, run, truth, count)
    name = f"engine/{len(base_map)} stations, {POINTS} points"
    wall, tracking = done.wall * 1e3, done.tracking
    p50, p99 = np.percentile(wall, [50, 99])
    yield bounded(f"{name}: step p50", p50, "ms", 8.0)
    yield bounded(f"{name}: step p99", p99, "ms", 25.0)
    yield informs(f"{name}: longest step while tracking", wall[tracking].max(), "ms")
    searched = wall[~tracking & (wall > 5 * np.median(wall))]
    yield informs(f"{name}: step while searching", float(np.median(searched)) if len(searched) else np.nan, "ms")
    share = 100.0 * _RATE * float(done.cpu[tracking].mean()) if tracking.any() else np.nan
    yield bounded(f"{name}: processor share while tracking", share, "%", 15.0)
    known = done.error[np.isfinite(done.error)]
    yield bounded(f"{name}: error, rms", float(np.sqrt((known**2).mean())) if len(known) else np.nan, "m", 0.12)
    yield reached(f"{name}: frames with a pose", 100.0 * len(known) / count, "%", 95.0)
    if not asked.quick:
        settled = min((tick for tick in done.memory if tick >= _SETTLED), default=0)
        growth = max(done.memory[t] for t in done.memory if t >= settled) - done.memory[settled]
        yield bounded(f"engine/memory growth, frames {settled} to {count}", growth, "MB", 20.0)
