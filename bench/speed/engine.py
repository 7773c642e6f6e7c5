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

import numpy as np

import coview_kernels
from bench.harness.rows import Row, bounded, informs, reached
from bench.harness.worlds import opened
from coview_stream import Localizer
from coview_stream.sim import SimulationConfig

POINTS = 65_536
_SETTLED = 2_000  # frames before memory is watched
_RATE = 10.0


def rows(asked: Namespace) -> Iterator[Row]:
    """Feed a new localizer frame by frame, and judge the times."""
    import psutil  # of the extra bench

    coview_kernels.warm_up()
    count, length = (600, 12.0) if asked.quick else (10_000, 36.0)
    base_map, run, (_, truth) = opened(SimulationConfig("town", "os64-2048", seed=4004, size=240.0, length=length))
    rng, frames = np.random.default_rng(0), [run.read(k) for k in range(len(run))]
    clouds = [f.points[np.sort(rng.choice(len(f.points), min(POINTS, len(f.points)), replace=False))] for f in frames]
    localizer, process = Localizer(base_map), psutil.Process()
    steps, memory = [], {}
    there_and_back = itertools.cycle([*range(len(frames)), *range(len(frames) - 2, 0, -1)])
    for tick, index in enumerate(itertools.islice(there_and_back, count)):
        tracked = localizer.state.has_place  # no map is searched then
        cpu, wall = time.process_time(), time.perf_counter()
        T = localizer.step(clouds[index], frames[index].T_odom_body, tick / _RATE).T_map_body
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        steps.append((wall, cpu, tracked, np.nan if T is None else np.linalg.norm(T[:3, 3] - truth[index, :3, 3])))
        if tick % 500 == 0 or tick == count - 1:
            memory[tick] = process.memory_info().rss / 1e6
    wall, cpu, tracked, error = np.array(steps, dtype=np.float64).T
    wall, tracking = wall * 1e3, tracked.astype(bool)
    name = f"engine/{len(base_map)} stations, {POINTS} points"
    p50, p99 = np.percentile(wall, [50, 99])
    yield bounded(f"{name}: step p50", p50, "ms", 8.0)
    yield bounded(f"{name}: step p99", p99, "ms", 25.0)
    yield informs(f"{name}: longest step while tracking", max(wall[tracking], default=np.nan), "ms")
    searched = wall[~tracking & (wall > 5 * np.median(wall))]
    yield informs(f"{name}: step while searching", float(np.median(searched)) if len(searched) else np.nan, "ms")
    share = 100.0 * _RATE * float(cpu[tracking].mean()) if tracking.any() else np.nan
    yield bounded(f"{name}: processor share while tracking", share, "%", 15.0)
    known = error[np.isfinite(error)]
    yield bounded(f"{name}: error, rms", float(np.sqrt((known**2).mean())) if len(known) else np.nan, "m", 0.12)
    yield reached(f"{name}: frames with a pose", 100.0 * len(known) / count, "%", 95.0)
    if not asked.quick:
        growth = max(memory[tick] for tick in memory if tick >= _SETTLED) - memory[_SETTLED]
        yield bounded(f"engine/memory growth, frames {_SETTLED} to {count}", growth, "MB", 20.0)
