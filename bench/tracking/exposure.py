"""Exposure: false poses per kilometre and per hour of tracking, over all drives of four benchmarks.

Drives are those of ``tracking``, ``conditions`` (real runs), ``protection`` and ``surveys``. Results that ``--work``
has of this code are read, the others are made. A false pose counts once from its first frame on until a right one or
none. Drives along one way (a recorded run under other conditions, a world with other events) are no independent
kilometres: the upper Poisson bounds, 95 %, count each way once, with its longest tracking and its most false poses.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from typing import Any

from bench.__main__ import parser_of
from bench.accuracy import conditions
from bench.accuracy.scores import rate
from bench.harness.rows import Row, judged, table
from bench.tracking import protection, surveys, tracking

PARTS = {
    "tracking": (tracking, "simulated, plain and with events"), "conditions": (conditions, "real runs"),
    "protection": (protection, "simulated, 400 m"),
    "surveys": (surveys, "real surveys of few points, simulated robots, false from 3 m"),
}  # fmt: skip


def options(parser: ArgumentParser) -> None:
    """Add which drives."""
    every = list(conditions.SETS), list(conditions.CONDITIONS)
    parser.add_argument("--worlds", type=int, default=protection.WORLDS, help="of each family of protection (30)")
    parser.add_argument("--sets", nargs="+", default=every[0], metavar="NAME", help="of conditions (all)")
    parser.add_argument("--conditions", nargs="+", default=every[1], metavar="NAME", help="(all)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per benchmark, and one of all."""
    words = {"conditions": ["--sets", *asked.sets, "--conditions", *asked.conditions]}
    words |= {"protection": ["--worlds", str(asked.worlds)]}
    every = list[dict[str, Any]]()
    for name, (module, about) in PARTS.items():
        of = parser_of(name).parse_args([*words.get(name, ()), *["--quick"] * asked.quick])
        found = (row.details | {"way": row.details.get("way", row.details.get("set"))} for row in module.rows(of))
        drives = [details for details in found if "tracked_m" in details]
        every += drives
        yield counted(f"{name}, {about}", drives)
    yield counted("all, false from 1 m, on surveys from 3 m", every)


def counted(name: str, drives: Sequence[dict[str, Any]]) -> Row:
    """Return the row of some drives: kilometres, hours and false poses of all, and of each way once."""
    ways = [[drive for drive in drives if drive["way"] == way] for way in dict.fromkeys(d["way"] for d in drives)]
    figures: dict[str, Any] = {"name": name, "drives": len(drives), "ways": len(ways)}
    for key, part, unit in (("km", "tracked_m", 1e3), ("hours", "tracked_s", 3.6e3), ("events", "false_times", 1)):
        figures[key] = sum(drive[part] for drive in drives) / unit
        figures[f"{key}_once"] = sum(max(drive[part] for drive in way) for way in ways) / unit
    text = f"{figures['events']:.0f} in {figures['km']:.2f} km and {figures['hours']:.2f} h of tracking"
    row = judged(f"exposure/{name}, times", text, "", None, figures["events"])
    row.details.update(figures)
    return row


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Lay out drives, kilometres and hours, and the rates of each way once."""
    lines = []
    for row in rows:
        of = row.details
        once = int(of["events_once"])
        cells = f"{of['drives']}, {of['ways']}", f"{of['km']:.2f}, {of['km_once']:.2f}", f"{of['hours']:.2f}"
        rates = rate(once, of["km_once"]), rate(once, of["hours_once"])
        lines.append([of["name"], *cells, f"{of['events']:.0f}, {once}", *rates])
    head = "drives", "number, ways", "km tracked, of ways", "hours", "false poses, times, of ways", "per km", "per hour"
    return {"": table(head, lines)}
