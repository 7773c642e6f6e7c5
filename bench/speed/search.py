"""The whole search step on one core, in a town and on a campus.

A robot without a place drives twelve keyframes from each of many starts along a simulated run. No place is ever
accepted: most steps have the votes of ten keyframes. The map is built by the command, learned features included. Times
are those of ``GlobalSearch.update``, without the frames between keyframes.
"""

from __future__ import annotations

import os
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import coview_kernels
from bench.harness.files import built, folder, isolated, peak_megabytes
from bench.harness.rows import Row, bounded, informs, reached
from bench.harness.worlds import prepare
from coview_stream import BaseMap, Localizer, LocalizerConfig
from coview_stream.config import AcceptanceConfig
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import SearchRequest
from coview_stream.recordings.open_run import open_run
from coview_stream.recordings.run import Run
from coview_stream.sim import SimulationConfig

WORLDS = {
    "town": SimulationConfig("town", "vlp16", seed=2211, size=220.0, length=90.0),
    "campus": SimulationConfig("campus", "os64", seed=2212, size=220.0, length=90.0),
}
"""About 10,000 stations each; seeds that nothing was tuned on."""

P50_MS, P95_MS, LEAST_RIVALS = 60.0, 100.0, 200  # the targets
KEYFRAMES, DRIVES = 12, 9  # of a drive, where the consensus has a window of ten; of a world
_STARTS = 7  # a run's starts lie this share of it apart, then between those


def bind_to_one_core() -> None:
    """Bind this process to the last core that it may use, where the system can; call it before a kernel starts."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def requests(run: Run, localizer: Localizer, number: int) -> Iterator[SearchRequest]:
    """Yield the search requests of the ``number``-th drive; one that ends with the run begins anew at its start."""
    share = (number % _STARTS) / _STARTS + (number // _STARTS % 4) / (4 * _STARTS)
    start, made = int(share * len(run)), 0
    localizer.reset(number + 1)
    for step in range(4 * len(run)):
        at = (start + step) % len(run)
        if step and not at:
            localizer.reset(number + 1)  # odometry does not lead from the end to the beginning
        frame = run.read(at)
        request = localizer.add_frame(frame.points, frame.T_odom_body, 0.1 * step)
        if request is not None:
            made += 1
            yield request
        if made == KEYFRAMES:
            return


def searched(site: Path, run_folder: Path, drives: int) -> dict[str, Any]:
    """Search along some drives: milliseconds and rivals of the steps, and memory."""
    bind_to_one_core()
    rule = AcceptanceConfig()
    object.__setattr__(rule, "risk", sys.float_info.min)  # no place meets it, and no user may ask for it
    config, base_map, run = LocalizerConfig(acceptance=rule), BaseMap.load(site), open_run(run_folder)
    maps = LocalMaps(base_map, config.registration.source_range)
    index = SearchIndex.of(base_map, config)
    coview_kernels.warm_up()
    index.prepare()
    search, localizer = GlobalSearch(base_map, config, maps, index), Localizer(base_map, config, maps, index)
    times, rivals = list[float](), list[int]()
    for number in range(drives + 1):
        for request in requests(run, localizer, number):
            begin = time.perf_counter()
            result = search.update(request)
            if number:  # caches fill during the first drive
                times.append(1e3 * (time.perf_counter() - begin))
                rivals.append(result.rivals)
    return {"stations": len(base_map), "ms": times, "rivals": rivals, "megabytes": peak_megabytes()}


def rows(asked: Namespace) -> Iterator[Row]:
    """Time both worlds."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as our commands set it; more would share the one core
    for world, config in list(WORLDS.items())[: 1 if asked.quick else None]:
        below = prepare(folder(), config)
        site = built(below / "base.laz", below / "searched.coview")
        done = isolated(searched, site, below / "run", 1 if asked.quick else DRIVES)
        name = f"search/{world}, {done['stations']} stations"
        for share, most in ((50, P50_MS), (95, P95_MS)):
            yield bounded(f"{name}: step p{share}", float(np.percentile(done["ms"], share)), "ms", most)
        yield reached(f"{name}: rivals scored per step, median", float(np.median(done["rivals"])), "", LEAST_RIVALS)
        yield informs(f"{name}: memory of the searching process, peak", done["megabytes"], "MB", done)
