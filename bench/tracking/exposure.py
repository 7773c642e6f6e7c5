"""Exposure: false poses per kilometre and per hour of tracking, over all drives of four benchmarks.

Drives are those of ``tracking``, ``conditions`` (real runs), ``protection`` and ``surveys``. Results that ``--work``
has of this code are read, the others are made. A false pose counts once from its first frame on until a right one or
none; rates have their upper Poisson bound, 95 %.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from typing import Any

from bench.__main__ import BENCHMARKS, parser_of
from bench.accuracy.conditions import CONDITIONS, SETS
from bench.accuracy.scores import exposed, rate
from bench.harness.rows import Row, table
from bench.tracking.protection import WORLDS

PARTS = {
    "tracking": "simulated, plain and with events", "conditions": "real runs", "protection": "simulated, 400 m",
    "surveys": "real surveys of few points, simulated robots",
}  # fmt: skip


def options(parser: ArgumentParser) -> None:
    """Add which drives."""
    parser.add_argument("--worlds", type=int, default=WORLDS, help=f"of each family of protection ({WORLDS})")
    parser.add_argument("--sets", nargs="+", default=list(SETS), metavar="NAME", help="of conditions (all)")
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), metavar="NAME", help="(all)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per benchmark, and one of all."""
    words = {"conditions": ["--sets", *asked.sets, "--conditions", *asked.conditions]}
    words |= {"protection": ["--worlds", str(asked.worlds)]}
    every = list[dict[str, Any]]()
    for name, about in PARTS.items():
        of = parser_of(name).parse_args([*words.get(name, ()), *["--quick"] * asked.quick])
        found = (row.details for row in BENCHMARKS[name].load().rows(of))
        drives = [details for details in found if "tracked_m" in details]
        every += drives
        yield _row(f"{name}, {about}", drives)
    yield _row("all", every)


def _row(name: str, drives: Sequence[dict[str, Any]]) -> Row:
    row = exposed("exposure", name, sum(drive["false_times"] for drive in drives), drives)
    row.details.update(drives=len(drives), name=name)
    return row


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Lay out drives, kilometres and hours, and the rates."""
    lines = []
    for row in rows:
        km, hours, events = (row.details[key] for key in ("km", "hours", "events"))
        rates = rate(events, km), rate(events, hours)
        lines.append(
            [row.details["name"], str(row.details["drives"]), f"{km:.2f}", f"{hours:.2f}", str(events), *rates]
        )
    return {"": table(("drives", "number", "km tracked", "hours", "false poses, times", "per km", "per hour"), lines)}
