"""Work of one process: the runs on the map of one site, each noted as soon as it ends."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.harness.files import fingerprint, remembered, thread_settings
from bench.integrity.plan import Run, Site
from coview_stream import BaseMap

if TYPE_CHECKING:
    from bench.integrity.run import Robot


Result = dict[str, Any]


def append(file: Path, result: Result) -> None:
    """Add a line; others may do so at the same time."""
    file.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(result, allow_nan=False) + "\n"
    with file.open("a") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        stream.write(line)
        stream.flush()


def read(files: Iterable[Path], code: str) -> dict[str, Result]:
    """Return the newest result of each key that the code with this fingerprint made.

    A line that a killed process has left half-written is passed over.
    """
    found: dict[str, Result] = {}
    for file in files:
        for line in file.read_text().splitlines() if file.is_file() else ():
            try:
                result = json.loads(line)
            except ValueError:
                continue
            if code == result["code"]:
                found[result["key"]] = result
    return found


SITE_CODE = ("coview_stream/sim", "coview_stream/basemap", "coview_stream/clouds", "coview_stream/descriptors")
"""What makes a map, besides this benchmark."""


@dataclass(frozen=True)
class Task:
    """How runs are made and where they are noted.

    Attributes:
        results: file of the results.
        code: fingerprint that they are noted with.
        risk: integrity risk; None for the product's own.
        maps: folder in which maps are kept; None: they are deleted after use.
    """

    results: Path
    code: str
    risk: float | None = None
    maps: Path | None = None

    def key(self, run: Run) -> str:
        """Name of a run's result."""
        return run.key if self.risk is None else f"{run.key}@{self.risk:g}"


def everywhere(sites: Sequence[Site], task: Task, jobs: int) -> Iterator[Result]:
    """Yield results as they come, of ``jobs`` processes with one thread each; results are noted by then."""
    os.environ.update(thread_settings(1))  # what is started from now on inherits it
    with ProcessPoolExecutor(max(1, min(jobs, len(sites))), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(on_site, site, task) for site in sites]
        try:
            for done in as_completed(waiting):
                yield from done.result()
        finally:
            pool.shutdown(cancel_futures=True)


def on_site(site: Site, task: Task) -> list[Result]:
    """Make all runs on one map; what cannot be made is noted as ``failed``, and tried again another time."""
    from bench.integrity.run import Robot

    begin, out = time.process_time(), list[Result]()
    robot, reason = None, ""
    try:
        robot = Robot.on(map_of(site[0], task.maps), task.risk)
    except Exception as error:  # whatever it is, the other sites go on
        reason = f"{type(error).__name__}: {error}"
    share = round((time.process_time() - begin) / len(site), 2)
    for run in site:
        begin = time.process_time()
        result: Result = {"outcome": "failed", "reason": reason}
        try:
            if robot is not None:
                result = _one(run, robot)
        except Exception as error:  # likewise
            result["reason"] = f"{type(error).__name__}: {error}"
        result = {"key": task.key(run), "code": task.code, "class": run.of_class, **asdict(run), **result}
        result |= {"asked_risk": task.risk, "site_s": share, "cost_s": round(time.process_time() - begin, 2)}
        append(task.results, result)
        out.append(result)
    return out


def _one(run: Run, robot: Robot) -> Result:
    from bench.integrity.run import drive_of, first_fix

    drive = drive_of(run)
    return {"outcome": "no way", "reason": "no such street"} if drive is None else first_fix(robot, drive)


def map_of(run: Run, kept: Path | None = None) -> BaseMap:
    """Return the map that a run is made on, built now unless it is ``kept`` in a folder."""
    from bench.integrity.kinds import built, draw, size_of, surveyed

    def build() -> BaseMap:
        return built(surveyed(draw(run.kind, run.seed, size_of(run.kind), 0.0), run.seed))  # changes come later

    if kept is None:
        return build()
    file = kept / f"{run.kind}-{run.seed}.coview"
    spec = {"site": [run.kind, run.seed], "code": fingerprint(*SITE_CODE, "bench/integrity")}
    remembered(file.with_suffix(".json"), spec, lambda: build().save(file))
    return BaseMap.load(file)
