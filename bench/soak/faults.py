"""The matrix of faults: each acts on all robots, nodes and links at once.

A fault returns the monotonic time from which on robots have to be found again: when the damage is undone, or the
moment itself of a fault without duration.
"""

from __future__ import annotations

import functools
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from math import pi

from bench.soak.stage import MAIN, SEARCH, TRACK, Stage


def router(stage: Stage) -> float:
    """Kill the router; it returns three seconds later."""
    stage.router.kill()
    stage.wait(3.0)
    stage.start_router()
    return time.monotonic()


def kill(stage: Stage, part: str) -> float:
    """SIGKILL a process of every node; a main process is started again at once, as a supervisor would."""
    moment = time.monotonic()
    for node in stage.nodes:
        if part == MAIN:
            node.end(signal.SIGKILL)
            node.start()
        else:
            node.send(part, signal.SIGKILL)
    return moment if part != MAIN else time.monotonic()


def freeze(stage: Stage, part: str, seconds: float = 10.0) -> float:
    """SIGSTOP a process of every node for a while."""
    frozen = [node.send(part, signal.SIGSTOP) for node in stage.nodes]
    stage.wait(seconds)
    for process in frozen:
        if process is not None and process.is_running():
            process.send_signal(signal.SIGCONT)
    return time.monotonic()


def restart(stage: Stage) -> float:
    """SIGTERM every node and start it again."""
    for node in stage.nodes:
        seconds = node.end()
        if seconds > 2.0:
            node.crashes.append(f"ended {seconds:.1f} s after SIGTERM")
        node.start()
    return time.monotonic()


def badly(stage: Stage, seconds: float, **changes: object) -> float:
    """Let all robots send in another manner for a while, or for good if that is 0 seconds."""
    manner, moment = replace(stage.manner, **changes), time.monotonic()  # type: ignore[arg-type]
    stage.set_manner(manner)
    if not seconds:
        stage.manner = manner
        return moment
    stage.wait(seconds)
    stage.set_manner(stage.manner)
    return time.monotonic()


def jump(stage: Stage) -> float:
    """Let odometry go on in another frame."""
    x, y = stage.rng.uniform(-40, 40), stage.rng.uniform(-40, 40)
    return badly(stage, 0.0, shift=(x, y, stage.rng.uniform(-pi, pi)))


def clock(stage: Stage, seconds: float) -> float:
    """Let the sensor clocks step."""
    return badly(stage, 0.0, offset=stage.manner.offset + seconds)


def strange(stage: Stage, deed: str, seconds: float) -> float:
    """Let the stranger do something."""
    stage.stranger.send((deed, seconds))
    stage.wait(120.0, stage.stranger.answered)
    stage.stranger.result()
    return time.monotonic()


def link(stage: Stage, mode: str, seconds: float) -> float:
    """Let the link of the robots or of the nodes go bad."""
    name = stage.rng.choice(sorted(stage.links))
    stage.watch.flipping = mode == "corrupt" and name == "nodes"
    stage.links[name].send(mode)
    stage.wait(seconds)
    stage.links[name].send("open")
    moment = time.monotonic()
    stage.wait(1.0 if stage.watch.flipping else 0.0)
    stage.watch.flipping = False
    return moment


def map_file(stage: Stage, hangup: bool) -> float:
    """Write half of every node's map, or unlink it, then the right one again; ``hangup`` asks nodes to take them."""
    gone = not hangup and stage.rng.random() < 0.5
    for whole in (False, True):
        for node in stage.nodes:
            part = node.map.with_suffix(".new")
            if whole:
                shutil.copy(node.site.map, part)
            else:
                content = node.site.map.read_bytes()
                part.write_bytes(content[: len(content) // 2])
            part.replace(node.map)
            if gone and not whole:
                node.map.unlink()
            if hangup:
                node.send(MAIN, signal.SIGHUP)
        stage.wait(0.0 if whole else 8.0)
    return time.monotonic()


_P = functools.partial

FAULTS: dict[str, Callable[[Stage], float]] = {
    "router killed, back after 3 s": router,
    "tracking engine SIGKILL": _P(kill, part=TRACK),
    "search engine SIGKILL": _P(kill, part=SEARCH),
    "node SIGKILL, started again": _P(kill, part=MAIN),
    "node SIGTERM, started again": restart,
    "tracking engine SIGSTOP 10 s": _P(freeze, part=TRACK),
    "search engine SIGSTOP 10 s": _P(freeze, part=SEARCH),
    "node SIGSTOP 8 s": _P(freeze, part=MAIN, seconds=8.0),
    "no clouds for 10 s": _P(badly, seconds=10.0, clouds=False),
    "no odometry for 5 s": _P(badly, seconds=5.0, odometry=False),
    "odometry jumps": jump,
    "odometry frozen for 8 s": _P(badly, seconds=8.0, frozen=True),
    "stamps in ms for 8 s": _P(badly, seconds=8.0, unit_ns=1_000_000),
    "stamps frozen for 5 s": _P(badly, seconds=5.0, stopped=True),
    "sensor clock steps 1 h ahead": _P(clock, seconds=3600.0),
    "sensor clock steps 10 min back": _P(clock, seconds=-600.0),
    "100 frames a second for 8 s": _P(badly, seconds=8.0, cloud_period=0.01),
    "stranger: get of **": _P(strange, deed="ask", seconds=2.0),
    "stranger: puts on poses, statuses, rpc": _P(strange, deed="spoof", seconds=8.0),
    "stranger: deletes keys": _P(strange, deed="delete", seconds=5.0),
    "stranger: holds tokens, answers queries": _P(strange, deed="claim", seconds=8.0),
    "stranger: flood of rubbish": _P(strange, deed="flood", seconds=10.0),
    "link cut for 5 s": _P(link, mode="cut", seconds=5.0),
    "link cut every 2 s, 10 s": _P(link, mode="flapping", seconds=10.0),
    "link half-open for 12 s": _P(link, mode="silent", seconds=12.0),
    "link of 200 ms, 10 s": _P(link, mode="slow", seconds=10.0),
    "link of 1 Mbit/s, 10 s": _P(link, mode="thin", seconds=10.0),
    "link that loses 20 %, 10 s": _P(link, mode="lossy", seconds=10.0),
    "link that flips bits, 10 s": _P(link, mode="corrupt", seconds=10.0),
    "map file gone or half": _P(map_file, hangup=False),
    "SIGHUP for half a map, and for the whole": _P(map_file, hangup=True),
}

ENDS_PROCESSES = [name for name in FAULTS if "SIGKILL" in name or "SIGTERM" in name]
"""Faults that end processes of nodes, whose memory cannot be watched any longer."""
