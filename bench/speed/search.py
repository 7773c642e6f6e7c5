"""The whole search step on one core, beside the code of an earlier commit, in a town and on a campus.

A robot without a place drives twelve keyframes from each of many starts along a simulated run; no place is ever
accepted, so that the votes of ten keyframes have added up for most steps. Each code builds the map with its own
command, learned features included, and searches it in a process of its own on the same core; they take turns, drive
by drive. A row's time is that of ``GlobalSearch.update``, without the frames between keyframes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import COMMIT, Code, folder, pinned, today
from bench.harness.rows import Row, against, bounded, informs, reached
from bench.harness.worlds import prepare
from coview_stream.errors import InputError
from coview_stream.sim import SimulationConfig

WORLDS = {
    "town": SimulationConfig("town", "vlp16", seed=2211, size=220.0, length=90.0),
    "campus": SimulationConfig("campus", "os64", seed=2212, size=220.0, length=90.0),
}
"""About 10,000 stations each; seeds that nothing was tuned on."""

P50_MS, P95_MS, LEAST_RIVALS, LEAST_RATIO = 60.0, 100.0, 200, 5.0
"""The targets."""

KEYFRAMES = 12  # of a drive; the consensus has a window of ten
DRIVES = 9
_WORKER = Path(__file__).with_name("search_worker.py")


class Searcher:
    """Process that searches a map with the keyframes of a run, drive by drive; close it as a context."""

    def __init__(self, code: Code, site: Path, run: Path, core: int | None = None) -> None:
        """Start it, on a core (by default the last one that this process may use)."""
        self._process = subprocess.Popen(
            code.command(str(_WORKER), str(site), str(run), str(last_core() if core is None else core), str(KEYFRAMES)),
            env=code.environment(), cwd=site.parent, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.steps: list[dict[str, Any]] = []
        self.fixes: list[dict[str, Any]] = []  # the steps that accepted a place
        self.megabytes = 0.0
        self.about = self._answer()
        self.drive()
        self.steps.clear()  # of the first drive, while caches fill
        self.fixes.clear()

    def __enter__(self) -> Searcher:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise InputError(f"a searching process ended with exit code {self._process.wait()}")
        return dict(json.loads(line))

    def drive(self) -> None:
        """Search along another drive."""
        assert self._process.stdin is not None
        print(flush=True, file=self._process.stdin)
        found = self._answer()
        self.steps += found["steps"]
        self.fixes += [found["fix"]] if found["fix"] else []
        self.megabytes = found["megabytes"]

    def percentile(self, share: float, key: str = "ms") -> float:
        """Return a percentile of the steps' milliseconds, of wall time or of the processor's (``cpu_ms``)."""
        return float(np.percentile([step[key] for step in self.steps], share))

    def rivals(self) -> float:
        """Return the median number of scored rivals; NaN where results do not tell."""
        known = [step["rivals"] for step in self.steps if step["rivals"] is not None]
        return float(np.median(known)) if known else np.nan


def last_core() -> int:
    """Return the last core that this process may use."""
    return max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0


def rows(asked: Namespace) -> Iterator[Row]:
    """Time both worlds."""
    try:
        codes = {"ours": today(), "pinned": pinned()}
    except InputError as error:
        print(f"search: no ratio: {error}", file=sys.stderr)
        codes = {"ours": today()}
    for name, config in WORLDS.items():
        world = prepare(folder(), config)
        with ExitStack() as stack:
            sides = {}
            for side, code in codes.items():
                site = code.built([world / "base.laz"], world / f"{side}.coview")
                sides[side] = stack.enter_context(Searcher(code, site, world / "run"))
            for turn in range(3 if asked.quick else DRIVES):
                for side in list(sides)[:: -1 if turn % 2 else 1]:
                    sides[side].drive()
            yield from _judged(name, sides)


def _judged(world: str, sides: dict[str, Searcher]) -> Iterator[Row]:
    ours, other = sides["ours"], sides.get("pinned")
    name = f"search/{world}, {ours.about['stations']} stations"
    details = {side: {"steps": searcher.steps, **searcher.about} for side, searcher in sides.items()}
    for label, share, most in (("p50", 50, P50_MS), ("p95", 95, P95_MS)):
        yield bounded(f"{name}: step {label}", ours.percentile(share), "ms", most)
    if other is not None:
        earlier = f"beside commit {COMMIT[:7]}"
        for label, share, least in (("p50", 50, LEAST_RATIO), ("p95", 95, None)):
            both = [side.percentile(share) for side in (ours, other)]
            yield against(f"{name}: step {label} {earlier}", both[0], both[1], "ms", least)
        both = [side.percentile(50, "cpu_ms") for side in (ours, other)]  # nearly the same on a busy machine
        yield against(f"{name}: step p50 {earlier}, processor time", both[0], both[1], "ms", None)
    yield reached(f"{name}: rivals scored per step, median", ours.rivals(), "", LEAST_RIVALS)
    if ours.fixes:
        median = float(np.median([step["ms"] for step in ours.fixes]))
        yield informs(f"{name}: step that accepts a place, median of {len(ours.fixes)}", median, "ms", {})
    yield informs(f"{name}: memory of the searching process, peak", ours.megabytes, "MB", details)
