"""Milliseconds of each stage of a tracking step and of a search step.

The drive of ``python -m bench engine`` and those of ``python -m bench search``, with a clock around each stage; time
in an inner stage does not count for the outer one. The clocks cost some microseconds each.
"""

from __future__ import annotations

import importlib
from argparse import Namespace
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from time import perf_counter
from typing import Any
from unittest.mock import patch

import numpy as np

from bench.harness.files import folder, today
from bench.harness.rows import Row, informs
from bench.harness.worlds import prepare
from bench.speed import engine
from bench.speed.search import DRIVES, KEYFRAMES, WORLDS
from bench.speed.search_worker import prepared, requests

_SETTLED = 300  # frames before a tracked step counts
_LOCALIZATION = "coview_stream.localization"

TRACKING = (
    ("step, the rest of it", "localizer:Localizer.step"),
    ("check of the cloud", "frame:validate_cloud"),
    ("match to map, the rest of it", "tracking.tracker:Tracker.match_to_map"),
    ("crop of the map", "registration.local_map:LocalMaps.around"),
    ("points to register", "tracking.tracker:prepare_scan"),
    ("registration", "tracking.map_matching:register"),
    ("observed scan", "evidence.observation:ObservedScan.of"),
)
SEARCH = (
    ("step, the rest of it", "search.global_search:GlobalSearch.update"),
    ("points to register", "search.global_search:prepare_scan"),
    ("descriptors", "search.recognizers:describe"),
    ("learned: network", "search.learned.matcher:FeatureMatcher.encode"),
    ("learned: vote", "search.learned.matcher:FeatureMatcher.vote"),
    ("consensus", "search.consensus:Consensus.vote"),
    ("distinct places", "search.consensus:Consensus.hypotheses"),
    ("field: look up", "evidence.observation:ScanPart.look_up"),
    ("evidence", "search.scoring:PlaceScorer.score"),
    ("crop of the map", "registration.local_map:LocalMaps.around"),
    ("registration", "search.refinement:register"),
    ("decision", "search.global_search:decide"),
)
"""Label, and where the function is looked up, below the package of localization."""

Record = dict[str, float]  # milliseconds by stage of one step


def looked_up(where: str) -> tuple[Any, str]:
    """Return the module or class of a stage's function, and its name there."""
    module, _, names = where.partition(":")
    owner: Any = importlib.import_module(f"{_LOCALIZATION}.{module}")
    *outer, name = names.split(".")
    for part in outer:
        owner = getattr(owner, part)
    return owner, name


class Recorder:
    """Milliseconds of the stages of each step."""

    def __init__(self) -> None:
        self.step: Record = defaultdict(float)
        self._inner = [0.0]  # of the stages below each running one

    @contextmanager
    def around(self, stages: Sequence[tuple[str, str]]) -> Iterator[None]:
        """Record the stages until the block ends."""
        with ExitStack() as stack:
            for label, where in stages:
                owner, name = looked_up(where)
                timed: Any = self._recorded(label, getattr(owner, name))
                if isinstance(vars(owner)[name], classmethod):
                    timed = staticmethod(timed)
                stack.enter_context(patch.object(owner, name, timed))
            yield

    def _recorded(self, label: str, run: Callable[..., Any]) -> Callable[..., Any]:
        def recorded(*arguments: Any, **options: Any) -> Any:
            self._inner.append(0.0)
            begin = perf_counter()
            result = run(*arguments, **options)
            spent = 1e3 * (perf_counter() - begin)
            self.step[label] += spent - self._inner.pop()
            self._inner[-1] += spent
            return result

        return recorded


def tracked(count: int) -> list[Record]:
    """Stages of the steps of a tracked drive."""
    base_map, run, truth = engine.town(36.0)
    recorder, steps = Recorder(), list[Record]()
    with recorder.around(TRACKING):
        step = engine.Localizer.step

        def noted(*arguments: Any) -> Any:
            recorder.step = defaultdict(float)
            steps.append(recorder.step)
            return step(*arguments)

        with patch.object(engine.Localizer, "step", noted):
            engine.drive(base_map, run, truth, count)
    return steps[_SETTLED:]


def searched(drives: int) -> list[Record]:
    """Stages of the search steps in the town."""
    world = prepare(folder(), WORLDS["town"])
    site = today().built([world / "base.laz"], world / "ours.coview")
    run, localizer, search, *_ = prepared(str(site), str(world / "run"))
    recorder, steps = Recorder(), list[Record]()
    with recorder.around(SEARCH):
        for turn in range(drives + 1):
            for request in requests(run, localizer, turn, KEYFRAMES):
                recorder.step = defaultdict(float)
                search.update(request)
                if turn:  # caches fill during the first
                    steps.append(recorder.step)
    return steps


def rows(asked: Namespace) -> Iterator[Row]:
    """Medians and 95th percentiles of the stages."""
    steps = tracked(600 if asked.quick else 1500)
    matched = [step for step in steps if "registration" in step]
    kinds = {f"tracking, {len(matched)} of {len(steps)} frames that register": (TRACKING, matched)}
    kinds["search"] = SEARCH, searched(2 if asked.quick else DRIVES)
    for title, (stages, records) in kinds.items():
        for label, _ in stages:
            values = np.array([step.get(label, 0.0) for step in records])
            if values.any():
                p50, p95 = np.percentile(values, [50, 95])
                yield informs(f"stages/{title}: {label}, median", p50, "ms", {"p95": p95})
