"""``Localizer.step`` on a map of 10,000 stations with frames of 65,536 points: times, processor share, memory.

A simulated town, 240 m wide, driven at 1.5 m/s with an Ouster-like lidar of 2,048 columns, of whose returns 65,536 are
kept in each frame. The run is fed again and again, forwards and backwards (the robot reverses), so that 10,000 frames
are one drive. ``while searching`` are the frames up to the first fix whose step searched the map; a robot that must
not wait for that calls ``add_frame`` and ``apply_search_result`` (the search in another process, as ``serve`` does).

The processor share is that of all threads, in per cent of one core at 10 frames a second. The error is there so that
nobody wins time by being wrong, the share of frames with a pose so that nobody does by not answering.
"""

from __future__ import annotations

import itertools
import time
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, bounded, informs, reached
from bench.harness.worlds import map_of, prepare, world_name

POINTS = 65_536
STEP_P50, STEP_P99 = 8.0, 40.0  # ms
SHARE = 15.0  # % of one core at 10 Hz
GROWTH = 20.0  # MB from frame 2,000 to frame 10,000
ERROR = 0.12  # metres, root mean square
POSED = 95.0  # % of the frames
_SETTLED = 2_000
_RATE = 10.0


@dataclass
class Drive:
    """What happened on a drive: a number per frame.

    Attributes:
        wall: seconds of each step. cpu: processor seconds, all threads.
        tracking: whether the localizer was tracking before the step, and searched no map.
        error: metres; NaN without a pose.
        memory: resident MB, by frame.
    """

    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    tracking: list[bool] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    memory: dict[int, float] = field(default_factory=dict)


def opened(length: float) -> tuple[Any, Any, Any]:
    """Map, run and true poses (N, 4, 4) of the simulated town, with warm kernels."""
    import coview_kernels
    from coview_stream import BaseMap
    from coview_stream.clouds import read_tum
    from coview_stream.recordings.open_run import open_run
    from coview_stream.sim import SimulationConfig

    config = SimulationConfig("town", "os64-2048", seed=4004, size=240.0, length=length)
    prepare(folder(), config)
    world = folder() / world_name(config)
    coview_kernels.warm_up()
    return BaseMap.load(map_of(folder(), config)), open_run(world / "run"), read_tum(world / "truth.tum")[1]


def frames_of(run: Any, count: int) -> Iterator[tuple[int, int]]:
    """(index of the frame in the run, tick) for ``count`` frames, forwards and backwards."""
    there_and_back = [*range(len(run)), *range(len(run) - 2, 0, -1)]
    return ((index, tick) for tick, index in enumerate(itertools.islice(itertools.cycle(there_and_back), count)))


def drive(base_map: Any, run: Any, truth: np.ndarray, count: int) -> Drive:
    """Feed ``count`` frames to a new localizer."""
    import psutil

    from coview_stream import Localizer

    rng = np.random.default_rng(0)
    frames = [run.read(k) for k in range(len(run))]
    clouds = [f.points[np.sort(rng.choice(len(f.points), min(POINTS, len(f.points)), replace=False))] for f in frames]
    localizer, out, process = Localizer(base_map), Drive(), psutil.Process()
    for index, tick in frames_of(run, count):
        before = localizer.state.has_place
        cpu, wall = time.process_time(), time.perf_counter()
        fix = localizer.step(clouds[index], frames[index].T_odom_body, tick / _RATE)
        out.wall.append(time.perf_counter() - wall)
        out.cpu.append(time.process_time() - cpu)
        out.tracking.append(before)
        T = fix.T_map_body
        out.error.append(np.nan if T is None else float(np.linalg.norm(T[:3, 3] - truth[index, :3, 3])))
        if tick % 500 == 0 or tick == count - 1:
            out.memory[tick] = process.memory_info().rss / 1e6
    return out


def rows(asked: Namespace) -> Iterator[Row]:
    """Drive, and judge the times."""
    base_map, run, truth = opened(12.0 if asked.quick else 36.0)
    count = 600 if asked.quick else 10_000
    done = drive(base_map, run, truth, count)
    name = f"engine/{len(base_map)} stations, {POINTS} points"
    wall, tracking = np.array(done.wall) * 1e3, np.array(done.tracking)
    p50, p99 = np.percentile(wall, [50, 99])
    yield bounded(f"{name}: step p50", p50, "ms", STEP_P50)
    yield bounded(f"{name}: step p99", p99, "ms", STEP_P99)
    yield informs(f"{name}: longest step while tracking", wall[tracking].max(), "ms")
    searched = wall[~tracking & (wall > 5 * np.median(wall))]
    yield informs(f"{name}: step while searching", float(np.median(searched)) if len(searched) else np.nan, "ms")
    share = 100.0 * _RATE * float(np.array(done.cpu)[tracking].mean()) if tracking.any() else np.nan
    yield bounded(f"{name}: processor share while tracking", share, "%", SHARE)
    error = np.array(done.error)
    known = error[np.isfinite(error)]
    yield bounded(f"{name}: error, rms", float(np.sqrt((known**2).mean())) if len(known) else np.nan, "m", ERROR)
    yield reached(f"{name}: frames with a pose", 100.0 * len(known) / count, "%", POSED)
    if not asked.quick:
        settled = min((tick for tick in done.memory if tick >= _SETTLED), default=0)
        growth = max(done.memory[t] for t in done.memory if t >= settled) - done.memory[settled]
        yield bounded(f"engine/memory growth, frames {settled} to {count}", growth, "MB", GROWTH)
