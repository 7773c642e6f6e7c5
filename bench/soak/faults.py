"""The matrix of faults: what is done to all robots, nodes and links at once, and when it is over.

A fault returns the monotonic time from which on robots have to be found again: when what it spoilt is whole, or the
moment itself of what passes at once. All durations are set by hand.
"""

from __future__ import annotations

import functools
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from math import pi
from typing import NamedTuple

from bench.soak.nodes import MAIN, SEARCH, TRACK, Node
from bench.soak.robots import Manner
from bench.soak.stage import Stage


class SkippedError(Exception):
    """A fault cannot be made on this machine; says why."""


class Fault(NamedTuple):
    """What a fault is called, and what makes it."""

    name: str
    make: Callable[[Stage], float]

    @property
    def ends_processes(self) -> bool:
        """Whether processes of the nodes end, whose memory cannot be watched any longer."""
        return self.make is restart or (isinstance(self.make, functools.partial) and self.make.func is kill)


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


def badly(stage: Stage, seconds: float, bad: Callable[[Stage, Manner], Manner], lasts: bool = False) -> float:
    """Let all robots send in another manner for a while; what ``lasts`` is over at once."""
    manner, moment = bad(stage, stage.manner), time.monotonic()
    stage.set_manner(manner)
    if lasts:
        stage.manner = manner
        return moment
    stage.wait(seconds)
    stage.set_manner(stage.manner)
    return time.monotonic()


def _jumped(stage: Stage, manner: Manner) -> Manner:
    x, y = stage.rng.uniform(-40, 40), stage.rng.uniform(-40, 40)
    return replace(manner, shift=(x, y, stage.rng.uniform(-pi, pi)))


def _stepped(_: Stage, manner: Manner, seconds: float) -> Manner:
    return replace(manner, offset=manner.offset + seconds)


def strange(stage: Stage, deed: str, seconds: float) -> float:
    """Let the stranger do something."""
    stage.stranger.send((deed, seconds))
    stage.wait(120.0, stage.stranger.said)
    stage.stranger.result()
    return time.monotonic()


def link(stage: Stage, mode: str, seconds: float) -> float:
    """Let the link of the robots or of the nodes go bad."""
    name = stage.rng.choice(sorted(stage.links))
    bad = stage.links[name]
    stage.watch.flipping = mode == "corrupt" and name == "nodes"
    bad.send(mode)
    stage.wait(seconds)
    bad.send("open")
    moment = time.monotonic()
    stage.wait(1.0 if stage.watch.flipping else 0.0)
    stage.watch.flipping = False
    return moment


def map_file(stage: Stage) -> float:
    """Replace every node's map by another, unlink it or write half of it, by renaming; then the right one again."""
    way = stage.rng.choice(("replaced", "gone", "half"))
    for node in stage.nodes:
        whole = node.site.map.read_bytes()
        part = node.map.with_suffix(".new")
        other = next((each.site.map.read_bytes() for each in stage.nodes if each is not node), whole[::-1])
        if way == "gone":
            node.map.unlink()
        else:
            part.write_bytes(other if way == "replaced" else whole[: len(whole) // 2])
            part.replace(node.map)
    stage.wait(10.0)
    for node in stage.nodes:
        part = node.map.with_suffix(".new")
        shutil.copy(node.site.map, part)
        part.replace(node.map)
    return time.monotonic()


def hand_over(stage: Stage) -> float:
    """Ask every node to take over half a map, which it has to refuse, and the whole one again."""
    for node in stage.nodes:
        part = node.map.with_suffix(".new")
        whole = node.site.map.read_bytes()
        part.write_bytes(whole[: len(whole) // 2])
        part.replace(node.map)
        node.send(MAIN, signal.SIGHUP)
    stage.wait(5.0)
    for node in stage.nodes:
        part = node.map.with_suffix(".new")
        shutil.copy(node.site.map, part)
        part.replace(node.map)
        node.send(MAIN, signal.SIGHUP)
    return time.monotonic()


def disk_full(stage: Stage) -> float:
    """Fill the disk of the state folders."""
    if stage.disk is None:
        raise SkippedError("no small file system may be mounted here")
    filler = stage.disk / "filler"
    try:
        with filler.open("wb", buffering=0) as out:
            while out.write(b"\0" * 4096):
                pass
    except OSError:
        pass
    stage.wait(15.0)
    filler.unlink()
    return time.monotonic()


def twin(stage: Stage) -> float:
    """Start a second node for the robots of the first."""
    node = stage.nodes[0]
    second: Node = replace(node, log=node.log.with_suffix(".twin.log"), samples={}, crashes=[], started=0)
    second.start()
    stage.wait(15.0)
    if second.running():
        second.end()
    return time.monotonic()


_NO_CLOUDS: Callable[[Stage, Manner], Manner] = lambda _, manner: replace(manner, clouds=False)  # noqa: E731
_P = functools.partial

_MADE: dict[str, Callable[[Stage], float]] = {
    "router killed, back after 3 s": router,
    "tracking engine SIGKILL": _P(kill, part=TRACK),
    "search engine SIGKILL": _P(kill, part=SEARCH),
    "node SIGKILL, started again": _P(kill, part=MAIN),
    "node SIGTERM, started again": restart,
    "tracking engine SIGSTOP 10 s": _P(freeze, part=TRACK),
    "search engine SIGSTOP 10 s": _P(freeze, part=SEARCH),
    "node SIGSTOP 8 s": _P(freeze, part=MAIN, seconds=8.0),
    "no clouds for 10 s": _P(badly, seconds=10.0, bad=_NO_CLOUDS),
    "no odometry for 5 s": _P(badly, seconds=5.0, bad=lambda _, m: replace(m, odometry=False)),
    "odometry jumps": _P(badly, seconds=0.0, bad=_jumped, lasts=True),
    "odometry frozen for 8 s": _P(badly, seconds=8.0, bad=lambda _, m: replace(m, frozen=True)),
    "stamps in ms for 8 s": _P(badly, seconds=8.0, bad=lambda _, m: replace(m, unit_ns=1_000_000)),
    "stamps frozen for 5 s": _P(badly, seconds=5.0, bad=lambda _, m: replace(m, stopped=True)),
    "sensor clock steps 1 h ahead": _P(badly, seconds=0.0, bad=_P(_stepped, seconds=3600.0), lasts=True),
    "sensor clock steps 10 min back": _P(badly, seconds=0.0, bad=_P(_stepped, seconds=-600.0), lasts=True),
    "100 frames a second for 8 s": _P(badly, seconds=8.0, bad=lambda _, m: replace(m, cloud_period=0.01)),
    "stranger: get of **": _P(strange, deed="ask", seconds=0.0),
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
    "map file replaced, gone or half": map_file,
    "SIGHUP for half a map, and for the whole": hand_over,
    "disk of the state full": disk_full,
    "second node for the same robots": twin,
}

FAULTS = {name: Fault(name, make) for name, make in _MADE.items()}
"""By name."""
