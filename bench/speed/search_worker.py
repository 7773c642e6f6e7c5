"""Searches in a process of their own, on one core: ``search_worker.py MAP RUN CORE KEYFRAMES``.

For each line on standard input it drives ``KEYFRAMES`` keyframes from another start along the run, as a robot without
a place does, and prints what each search step took, as JSON. No place is ever accepted, so that votes go on adding up;
the same drive is then searched as usual, for what the step that accepts a place takes.
It has to run with the code of earlier commits too: no imports from ``bench``, only names that all of them have.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, NamedTuple

_NEVER = {"risk": sys.float_info.min, "evidence_sum": 1e9}  # what no place meets, now and in earlier commits
_CROPS = 24  # of the map that are kept, as the search engine has it
_STARTS = 7  # a run's starts lie this share of it apart, then between those


class Search(NamedTuple):
    """A search that never accepts, prepared as the search engine does it, and what makes its requests."""

    run: Any
    localizer: Any
    search: Any
    usual: Any  # one that accepts places
    about: dict[str, Any]  # stations, recognizers, and the seconds that the index took


def prepared(site_file: str, run_folder: str) -> Search:
    """Open map and run, and make ready what the first search would."""
    import coview_kernels
    from coview_stream import BaseMap, Localizer, LocalizerConfig
    from coview_stream.config import AcceptanceConfig
    from coview_stream.localization.registration.local_map import LocalMaps
    from coview_stream.localization.search.global_search import GlobalSearch
    from coview_stream.localization.search.recognizers import SearchIndex
    from coview_stream.recordings.open_run import open_run

    rule = AcceptanceConfig()
    for name in _NEVER.keys() & {field.name for field in fields(rule)}:
        object.__setattr__(rule, name, _NEVER[name])  # no user may ask for it
    config = LocalizerConfig(acceptance=rule)
    site, run = BaseMap.load(site_file), open_run(run_folder)
    maps = LocalMaps(site, config.registration.source_range, _CROPS)
    index = SearchIndex.of(site, config)
    coview_kernels.warm_up()
    begin = time.perf_counter()
    index.prepare()
    seconds = time.perf_counter() - begin
    search, usual = (GlobalSearch(site, each, maps, index) for each in (config, LocalizerConfig()))
    about = {"stations": len(site), "recognizers": list(search.names), "prepare_s": seconds}
    return Search(run, Localizer(site, config, maps, index), search, usual, about)


def requests(run: Any, localizer: Any, number: int, count: int) -> Iterator[Any]:
    """Yield ``count`` search requests of the ``number``-th drive; each has a start of its own.

    One that reaches the end of the run goes on at its beginning, as a new search.
    """
    share = (number % _STARTS) / _STARTS + (number // _STARTS % 4) / (4 * _STARTS)
    start, stamp, made = int(share * len(run)), 0.0, 0
    localizer.reset(number + 1)
    for step in range(4 * len(run)):
        at = (start + step) % len(run)
        if step and not at:
            localizer.reset(number + 1)  # odometry does not lead from the end to the beginning
        frame = run.read(at)
        stamp += 0.1
        request = localizer.add_frame(frame.points, frame.T_odom_body, stamp)
        if request is not None:
            made += 1
            yield request
        if made == count:
            return


def timed(search: Any, request: Any) -> dict[str, Any]:
    """Time one search: milliseconds of wall and processor time, and how many rivals it scored, if it says so."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = search.update(request)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    rivals = getattr(result, "rivals", None)
    accepted = getattr(result, "accepted", None) is not None
    return {"ms": 1e3 * wall, "cpu_ms": 1e3 * cpu, "rivals": None if rivals is None else len(rivals), "fix": accepted}


def main(site_file: str, run_folder: str, core: int, count: int) -> None:
    """Prepare, then drive at every line."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})  # before libraries count the cores
    run, localizer, search, usual, about = prepared(site_file, run_folder)
    print(json.dumps(about), flush=True)
    for number, _ in enumerate(sys.stdin):
        steps = [timed(search, request) for request in requests(run, localizer, number, count)]
        until = (timed(usual, request) for request in requests(run, localizer, number, count))
        fix = next((step for step in until if step["fix"]), None)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps({"steps": steps, "fix": fix, "megabytes": peak}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
