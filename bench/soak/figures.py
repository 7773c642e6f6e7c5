"""Figures of a soak: what was held, survived and lost, with targets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bench.harness.rows import Row, judged
from bench.soak.nodes import Node, slope
from bench.soak.watch import Robot, percentiles

if TYPE_CHECKING:
    from bench.soak.soak import Event

WARM = 600.0  # seconds of a process that its slopes leave out
MAX_GROWTH = 1.0  # MB per hour
MAX_LEAK = 1.0  # descriptors per hour
MIN_HOURS = 0.25  # below which a slope says nothing


def _three(values: list[float] | None) -> str:
    return "-" if values is None else " / ".join(f"{each:.0f}" for each in values)


def held(robots: Sequence[Robot], hours: float, faults: list[tuple[float, float]]) -> list[Row]:
    """Return rows of load, false poses and latency; ``faults`` are periods without calm."""
    out = []
    seconds = 3600 * hours
    for robot in robots:
        name, site = f"{robot.name} ({robot.site.name})", robot.site.name
        rates = f"{robot.frames} / {robot.poses}; {robot.frames / seconds:.1f} / {robot.poses / seconds:.1f} Hz"
        details = {"frames": robot.frames, "poses": robot.poses, "odometries": robot.odometries, "site": site}
        details |= {"states": dict(robot.states), "worst": robot.worst, "false": robot.false[:100]}
        details |= {"counters": robot.status.get("counters"), "unreadable": robot.unreadable}
        out.append(Row(f"soak/{name}: frames in / poses out", text=rates, details=details))
        wrong = len(robot.false) + robot.unreadable
        said = f"{wrong} of {robot.poses}"
        out.append(judged(f"soak/{name}: false or unreadable poses", said, "0", wrong == 0, wrong))
        if robot.garbled:
            out.append(Row(f"soak/{name}: false or unreadable while the nodes' link flips bits", robot.garbled))
        out.append(Row(f"soak/{name}: worst pose, m / degrees", text=f"{robot.worst[0]:.2f} / {robot.worst[1]:.2f}"))
        for label, without in (("all", []), ("15 s after recovery and later", faults)):
            found = percentiles(robot.latencies, without)
            out.append(Row(f"soak/{name}: cloud to pose p50 / p95 / p99, ms, {label}", text=_three(found)))
    return out


def survived(events: Sequence[Event]) -> list[Row]:
    """Return rows of faults, and of those that robots did not come back from."""
    made = [event for event in events if not event.skipped]
    times = [each for event in made for each in event.recoveries.values() if each is not None]
    stuck, unfed = (sum(len(getattr(event, what)) for event in made) for what in ("stuck", "unfed"))
    said = f"{len(made)} of {len({event.fault for event in made})} kinds"
    out = [Row("soak/faults", text=said)]
    if times:
        out.append(Row("soak/back after, median / worst s", text=f"{np.median(times):.1f} / {max(times):.1f}"))
    out.append(
        judged("soak/stuck for 60 s while frames came", f"{stuck} of {len(times) + stuck}", "0", stuck == 0, stuck)
    )
    out.append(Row("soak/robots of the bench that did not reach the router again", float(unfed)))
    skipped = sorted({f"{event.fault} ({event.skipped})" for event in events if event.skipped})
    if skipped:
        out.append(Row("soak/skipped", text="; ".join(skipped)))
    return out


def processes(nodes: Sequence[Node], hours: float, ended: Sequence[float]) -> list[Row]:
    """Return rows of crashes and of the slopes of memory and descriptors of all nodes' processes."""
    crashes = [f"{node.site.name}: {each}" for node in nodes for each in node.crashes]
    out = [
        judged("soak/ended by themselves, or not when asked", "; ".join(crashes) or "0", "0", not crashes, len(crashes))
    ]
    said = sum(node.tracebacks() for node in nodes)
    out.append(judged("soak/tracebacks in logs", str(said), "0", said == 0, said))
    zombies = sum(node.zombies() for node in nodes)
    out.append(Row("soak/zombies now", float(zombies)))
    for what, most, unit in (("megabytes", MAX_GROWTH, "MB/h"), ("descriptors", MAX_LEAK, "per h")):
        for node in nodes:
            parts = sorted({part for part, _ in node.samples})
            slopes = {
                part: slope([rows for (own, _), rows in node.samples.items() if own == part], what, WARM)
                for part in parts
            }
            known = [each for each in slopes.values() if each is not None]
            total = sum(known) if known else math.nan
            text = "; ".join(f"{part} {'-' if each is None else f'{each:+.2f}'}" for part, each in slopes.items())
            long = hours >= MIN_HOURS and bool(known)
            name = f"soak/{node.site.name}: {what} of its processes, slope after 10 min"
            target = f"< {most:g} {unit}" if long else ""
            shown = f"{total:+.2f} {unit} ({text})" if known else "-"
            details = {
                f"{part} {pid}": [
                    (round(each.at - rows[0].at), round(each.megabytes, 2), each.descriptors) for each in rows[::6]
                ]
                for (part, pid), rows in node.samples.items()
            }
            row = judged(name, shown, target, total < most if long else None, total)
            out.append(replace(row, details=details) if what == "megabytes" else row)
    for node in nodes:
        last: dict[str, float] = {}
        for (part, _), rows in node.samples.items():
            last[part] = rows[-1].megabytes
        out.append(Row(f"soak/{node.site.name}: memory of its own at the end, MB", sum(last.values()), details=last))
    if ended:
        out.append(Row("soak/end after SIGTERM, worst s", max(ended)))
    return out
