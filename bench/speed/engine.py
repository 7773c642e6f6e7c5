"""``Localizer.step`` on a map of 10,000 stations with frames of 65,536 points: times, processor share, memory.

A simulated town, 240 m wide, driven at 1.5 m/s with an Ouster-like lidar of 2,048 columns; 65,536 of its returns are
kept in each frame. The run is fed forwards and backwards until 10,000 frames are one drive. Steps while searching are
those up to the first fix. The processor share counts all threads, in per cent of one core at 10 frames a second. Error
and share of frames with a pose show that no time is saved by wrong or missing poses.

``--throughput``: figures as users ask for them, for three sensors, each on a town of its own. Frames a second and a
core are the inverse of the processor time of all threads of ``Localizer.step`` while tracking. The transport carries
raw clouds between two zenoh sessions of one process, over TCP. The calls of an agent's loop are those of
``Localizer.step`` and, at 10 Hz, of ``AsyncLocalizer.step``: while tracking, and while a search is under way, of a map
that the robot is not on; wall time, and the processor time of the calling thread, which other work does not lengthen.
"""

from __future__ import annotations

import itertools
import threading
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import coview_kernels
from bench.harness.rows import Row, bounded, informs, listed, reached
from bench.harness.worlds import LIDARS, opened
from bench.stream.processes import free_port, open_session
from coview_stream import AsyncLocalizer, BaseMap, Fix, Localizer, State
from coview_stream.messages import encode_cloud, encode_odometry, encode_pose
from coview_stream.messages.types import CloudMessage, OdometryMessage, PoseMessage
from coview_stream.recordings.run import Frame
from coview_stream.sim import SimulationConfig

POINTS = 65_536
_SETTLED = 2_000  # frames before memory is watched
_RATE = 10.0
_ODOMETRY_RATE = 50.0  # Hz, of the robots whose bytes are counted
_MAX_CALL = 10.0  # ms: an agent's step has to be over
_STRIDE = 4  # frames on the wrong map, of which all others are left out: a keyframe, and its search, every 0.4 s


def options(parser: ArgumentParser) -> None:
    """Add the other question."""
    parser.add_argument("--throughput", action="store_true", help="frames and bytes a second, calls of an agent's loop")


def rows(asked: Namespace) -> Iterator[Row]:
    """Feed a new localizer frame by frame, and judge the times."""
    if asked.throughput:
        yield from throughput(*((30, LIDARS[:2]) if asked.quick else (300, LIDARS)))
        return
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


# ---- throughput


def throughput(count: int, lidars: Sequence[str]) -> Iterator[Row]:
    """Yield the rows of some sensors; ``count`` frames or calls behind each figure."""
    coview_kernels.warm_up()
    worlds = [
        opened(SimulationConfig("town", sensor, seed=4010 + k, size=160.0, length=24.0))
        for k, sensor in enumerate(lidars)
    ]
    for k, (sensor, (base_map, run, _)) in enumerate(zip(lidars, worlds, strict=True)):
        frames, stranger = [run.read(index) for index in range(len(run))], worlds[k - 1][0]
        fix, steps = bare(base_map, frames, count, State.TRACKING)
        _, searches = bare(stranger, frames[::_STRIDE], count // 4, State.SEARCHING)
        figures: dict[str, Any] = {"sensor": sensor, "points": float(np.mean([len(frame.points) for frame in frames]))}
        figures |= {f"bare, tracking, {name}": value for name, value in spread(steps).items()}
        figures |= {f"bare, searching, {name}": value for name, value in spread(searches).items()}
        for doing, site in (("tracking", base_map), ("searching", stranger)):
            calls = agent(site, frames if doing == "tracking" else frames[::_STRIDE], count, doing == "searching")
            figures |= {f"agent, {doing}, {name}": value for name, value in spread(calls).items()}
        figures["rate"] = rate = 1.0 / float(np.mean([cpu for _, cpu in steps]))
        figures["robots"], figures["Mpoints"] = rate / _RATE, rate * figures["points"] / 1e6
        cloud, figures["robot"] = messages(frames[0], fix)
        figures["link"] = loopback(cloud, count) / 1e6
        yield informs(f"engine/{sensor}: frames a second and a core", rate, "Hz", figures)
        for doing in ("tracking", "searching"):
            longest = figures[f"agent, {doing}, max"]
            yield bounded(f"engine/{sensor}: longest call of the agent while {doing}", longest, "ms", _MAX_CALL)


def there_and_back(frames: Sequence[Frame]) -> Iterator[tuple[float, Frame]]:
    """Yield stamps, seconds, and the frames of a drive that never ends."""
    turns = itertools.cycle([*frames, *frames[-2:0:-1]])
    return ((tick / _RATE, frame) for tick, frame in enumerate(turns))


Times = list[tuple[float, float]]
"""Wall and processor seconds of calls."""


def bare(base_map: BaseMap, frames: Sequence[Frame], count: int, state: State) -> tuple[Fix, Times]:
    """Return the last fix and the ``count`` steps of a localizer that began and ended in a state.

    The processor time is that of all threads. Searching, only the steps with a keyframe count.
    """
    localizer, times = Localizer(base_map), []
    localizer.prepare()
    evidence = None
    for stamp, frame in itertools.islice(there_and_back(frames), 100 * count):
        before, wall, cpu = localizer.state, time.perf_counter(), time.process_time()
        fix = localizer.step(frame.points, frame.T_odom_body, stamp)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        searched, evidence = fix.evidence is not evidence, fix.evidence
        tracked = before is fix.state is State.TRACKING
        if tracked if state is State.TRACKING else searched and not fix.state.has_place:
            times.append((wall, cpu))
        if len(times) >= count:
            return fix, times
    raise AssertionError(f"{count} steps while {state} were wanted; there are {len(times)}")


def agent(base_map: BaseMap, frames: Sequence[Frame], count: int, searching: bool) -> Times:
    """Return ``count`` calls of an agent's step at 10 Hz, while it tracks or while a search is under way.

    The processor time is that of the calling thread.
    """
    times: Times = []
    with AsyncLocalizer(base_map) as localizer:
        localizer.prepare()
        for tick, (stamp, frame) in enumerate(there_and_back(frames)):
            due = time.perf_counter() + 1.0 / _RATE
            before, wall, cpu = localizer.searching, time.perf_counter(), time.thread_time()
            fix = localizer.step(frame.points, frame.T_odom_body, stamp)
            wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
            if (before or localizer.searching) if searching else fix.state is State.TRACKING:
                times.append((wall, cpu))
            if len(times) >= count or tick > 10 * count:
                break
            time.sleep(max(0.0, due - time.perf_counter()))
    return times


def spread(times: Times) -> dict[str, float]:
    """Return median, 99th percentile and longest of the wall times, and the longest processor time, ms."""
    wall, cpu = 1e3 * np.array(times or [(np.nan, np.nan)]).T
    return {"p50": float(np.median(wall)), "p99": float(np.percentile(wall, 99)), "max": wall.max(), "cpu": cpu.max()}


def messages(frame: Frame, fix: Fix) -> tuple[bytes, float]:
    """Return the payload of a frame's cloud, and the MB a second of a robot: clouds, odometry and poses."""
    assert fix.T_map_body is not None
    assert fix.covariance is not None
    pose = PoseMessage(0, "r1", "TRACKING", fix.T_map_body, fix.covariance, fix.confidence, "0" * 64,
                       protection=fix.protection, T_map_odom=fix.T_map_odom)  # fmt: skip
    cloud = encode_cloud(CloudMessage(0, frame.points), "xyz").payload
    odometry = encode_odometry(OdometryMessage(0, frame.T_odom_body), "json").payload
    bytes_a_second = _RATE * (len(cloud) + len(encode_pose(pose, "json").payload)) + _ODOMETRY_RATE * len(odometry)
    return cloud, bytes_a_second / 1e6


def loopback(payload: bytes, count: int) -> float:
    """Return the bytes a second that zenoh carries in messages of this size, one after the other."""
    import zenoh

    endpoint, came = f"tcp/127.0.0.1:{free_port()}", threading.Semaphore(0)
    with open_session("peer", listen=[endpoint]) as here, open_session("client", connect=[endpoint]) as there:
        _subscriber = here.declare_subscriber("bench/loopback", lambda sample: came.release())
        publisher = there.declare_publisher("bench/loopback", congestion_control=zenoh.CongestionControl.BLOCK)
        deadline = time.monotonic() + 30.0
        while not came.acquire(timeout=0.05):
            if time.monotonic() > deadline:
                raise TimeoutError("zenoh carries nothing")
            publisher.put(b"")
        time.sleep(0.5)
        while came.acquire(blocking=False):
            pass
        begin = time.perf_counter()
        for _ in range(count):
            publisher.put(payload)
        for _ in range(count):
            came.acquire(timeout=30.0)
        return count * len(payload) / (time.perf_counter() - begin)


def tables(rows: Sequence[Row], asked: Namespace) -> Mapping[str, str]:
    """Return throughput and calls, a line for each sensor."""
    if not asked.throughput:
        return {}
    figures = [row.details for row in rows if row.details]
    calls = [
        {"sensor": f["sensor"], "call": call, "doing": doing}
        | {name: f[f"{side}, {doing}, {name}"] for name in ("p50", "p99", "max", "cpu")}
        for f in figures
        for side, call in (("bare", "Localizer.step"), ("agent", "AsyncLocalizer.step"))
        for doing in ("tracking", "searching")
    ]
    return {
        "": listed(
            (("sensor", "sensor", None), ("points a frame", "points", 0), ("frames/s and core", "rate", 0),
             ("robots at 10 Hz and core", "robots", 1), ("million points/s and core", "Mpoints", 1),
             ("a robot sends and gets, MB/s", "robot", 2), ("zenoh carries, MB/s", "link", 0)), figures),
        "Calls of an agent's loop": listed(
            (("sensor", "sensor", None), ("call", "call", None), ("while", "doing", None), ("p50 ms", "p50", 1),
             ("p99 ms", "p99", 1), ("longest ms", "max", 1), ("longest, processor ms", "cpu", 1)), calls),
    }  # fmt: skip
