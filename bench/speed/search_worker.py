"""Searches in a process of their own, on one core: ``search_worker.py MAP RUN CORE KEYFRAMES``.

For each line on standard input it drives ``KEYFRAMES`` keyframes from another start along the run, as a robot without
a place does, and prints what each search step took, as JSON. No place is ever accepted, so that votes go on adding up.
It has to run with the code of earlier commits too: no imports from ``bench``, only names that all of them have.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

MAP, RUN, CORE, KEYFRAMES = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {CORE})  # before libraries count the cores

import resource  # noqa: E402

import coview_kernels  # noqa: E402
from coview_stream import BaseMap, Localizer, LocalizerConfig  # noqa: E402
from coview_stream.config import AcceptanceConfig  # noqa: E402
from coview_stream.localization.registration.local_map import LocalMaps  # noqa: E402
from coview_stream.localization.search.global_search import GlobalSearch  # noqa: E402
from coview_stream.localization.search.recognizers import SearchIndex  # noqa: E402
from coview_stream.recordings.open_run import open_run  # noqa: E402

_ENDLESS = 1e9  # evidence that a place would need
_CROPS = 24  # of the map that are kept, as the search engine has it
_STARTS = 7  # a run's starts lie this share of it apart, then between those


def main() -> None:
    """Prepare as the search engine does, then drive at every line."""
    config = LocalizerConfig(acceptance=AcceptanceConfig(evidence_sum=_ENDLESS))
    site, run = BaseMap.load(MAP), open_run(RUN)
    maps = LocalMaps(site, config.registration.source_range, _CROPS)
    index = SearchIndex.of(site, config)
    coview_kernels.warm_up()
    begin = time.perf_counter()
    index.prepare()
    prepared = time.perf_counter() - begin
    localizer = Localizer(site, config, maps, index)  # makes the requests, and never has a place
    search = GlobalSearch(site, config, maps, index)
    ready = {"stations": len(site), "recognizers": list(search.names), "prepare_s": prepared}
    print(json.dumps(ready), flush=True)
    for number, _ in enumerate(sys.stdin):
        share = (number % _STARTS) / _STARTS + (number // _STARTS % 4) / (4 * _STARTS)
        steps = drive(run, localizer, search, int(share * len(run)), number)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps({"steps": steps, "megabytes": peak}), flush=True)


def drive(run: Any, localizer: Any, search: Any, start: int, epoch: int) -> list[dict[str, Any]]:
    """Time the searches of one drive; one that reaches the end of the run goes on at its beginning, elsewhere."""
    localizer.reset(epoch + 1)
    steps: list[dict[str, Any]] = []
    stamp = 0.0
    for count in range(4 * len(run)):
        at = (start + count) % len(run)
        if count and not at:
            localizer.reset(epoch + 1)  # odometry does not lead from the end to the beginning
        frame = run.read(at)
        stamp += 0.1
        request = localizer.add_frame(frame.points, frame.T_odom_body, stamp)
        if request is None:
            continue
        cpu, wall = time.process_time(), time.perf_counter()
        result = search.update(request)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        rivals = getattr(result, "rivals", None)
        steps.append({"ms": 1e3 * wall, "cpu_ms": 1e3 * cpu, "rivals": None if rivals is None else len(rivals)})
        if len(steps) == KEYFRAMES:
            break
    return steps


if __name__ == "__main__":
    main()
