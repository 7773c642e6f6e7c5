"""Where the time of a search step goes, stage by stage, each beside its floor: the bytes that it has to move at least.

The drives of ``python -m bench search`` on one core, with a clock around each stage. A floor is the bytes that a stage
cannot do without, read or written once, over the memory bandwidth that one thread reaches here when it sums a large
array: arguments and results count whole, tables of the map as far as they are looked at. Arithmetic is free in it, and
so are caches that hold a table from one step to the next; no stage can be faster than its floor on a map that does not
fit them.
"""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from bench.harness.files import folder
from bench.harness.pinned import today
from bench.harness.rows import Row, informs, medians
from bench.harness.tables import number, table
from bench.harness.worlds import prepare
from bench.speed.search import DRIVES, KEYFRAMES, WORLDS, last_core
from bench.speed.search_worker import prepared, requests
from coview_stream.basemap.station_index import StationIndex
from coview_stream.descriptors.network import weights_directory, weights_name
from coview_stream.localization.evidence.observed_scan import ObservedScan, ScanPart
from coview_stream.localization.registration import local_map
from coview_stream.localization.registration import register as registration
from coview_stream.localization.search import global_search, recognizers
from coview_stream.localization.search.consensus import Consensus
from coview_stream.localization.search.learned import feature_vote, matcher
from coview_stream.localization.search.learned.matcher import FeatureMatcher
from coview_stream.localization.search.scoring import PlaceScorer
from coview_stream.report.style import ACCENT, TRUTH, figure

OUT = Path("docs/images/performance_search.png")
STEP = "step"

Moved = Callable[[tuple[Any, ...], Any], float]


class Stage(NamedTuple):
    """Stage of a search step: where its function is looked up, and the bytes that a call moves at least."""

    label: str
    owner: Any
    name: str
    bytes: Moved
    said: str  # the bytes, in words


def size(*values: Any) -> float:
    """Bytes of all arrays in values, in what they hold and in lists of them."""
    total = 0.0
    for value in values:
        if isinstance(value, np.ndarray):
            total += value.nbytes
        elif isinstance(value, dict):
            total += size(*value.values())
        elif isinstance(value, (list, tuple)):
            total += size(*value)
        elif hasattr(value, "__dataclass_fields__"):
            total += size(*(getattr(value, name) for name in value.__dataclass_fields__))
    return total


def bandwidth() -> float:
    """Return the bytes per second at which one thread sums a large array."""
    array = np.ones(64_000_000, dtype=np.float32)  # 256 MB
    return float(array.nbytes / min(medians(array.sum, array.view(np.int8).max, repeat=7)) * 1e3)


def _network(arguments: tuple[Any, ...], result: Any) -> float:
    weights = (weights_directory() / weights_name("ground")).stat().st_size
    return float(weights + size(arguments[1], result.features.local, result.features.sigma))


def _coarse(arguments: tuple[Any, ...], result: Any) -> float:
    images, index = arguments[:2]
    return float(size(images, result) + index.nbytes)


def _windows(arguments: tuple[Any, ...], result: Any) -> float:
    raster, images = arguments[:2]
    looked_at = len(result) * images.nbytes / len(images)  # a window is as large as an image
    return float(min(raster.nbytes, looked_at) + images.nbytes + size(result))


def _field(arguments: tuple[Any, ...], result: Any) -> float:
    """Cells within reach of a scan around each place, each once, but no more than there are."""
    part, field, poses = arguments[:3]
    whole = size(field.occupied, field.ground, field.edge)
    cells = field.occupied[0].size * len(field.tiles)
    reach = 4 * _REACH * _REACH / _CELL**2 * whole / cells
    return float(min(whole, len(poses) * reach) + size(part.points))


def _registered(arguments: tuple[Any, ...], result: Any) -> float:
    target, source = arguments[2], arguments[0]
    return size(target.points, target.normals, source.points)


def _verified(arguments: tuple[Any, ...], result: Any) -> float:
    return size(arguments[0].points, arguments[4].points)


def _nothing(arguments: tuple[Any, ...], result: Any) -> float:
    return 0.0


_REACH, _CELL = 50.0, 0.5  # metres, of a scan and of the field's cells
_CODE = 512  # bytes of a station

STAGES = (
    Stage("points to register", global_search, "prepare_scan", lambda a, r: size(a[0], r), "submap, what is kept"),
    Stage("descriptors", recognizers, "describe", lambda a, r: size(a[0], r), "the local scan, both channels"),
    Stage("co-view: query", StationIndex, "query", _nothing, ""),
    Stage("co-view: screen", StationIndex, "best", lambda a, r: _CODE * len(r), "512 bytes of every station"),
    Stage("co-view: shifts", StationIndex, "all_shifts", lambda a, r: _CODE * len(r) + size(r), "the best stations"),
    Stage("co-view: single scores", StationIndex, "at", lambda a, r: 2 * _CODE * len(r), "1,024 bytes a score"),
    Stage("learned: network", FeatureMatcher, "encode", _network, "weights, points, features"),
    Stage("learned: turns", matcher, "turn_query", lambda a, r: size(a[:2], r.coarse) + r.images.nbytes, "images"),
    Stage("learned: coarse", matcher, "correlate_turned", _coarse, "spectra of the map, scores"),
    Stage("learned: single scores", feature_vote, "window_products", _windows, "cells of the map, images"),
    Stage("learned: rest of the vote", FeatureMatcher, "vote", _nothing, ""),
    Stage("consensus", Consensus, "vote", lambda a, r: 2 * size(a[0]._places.votes), "votes on the kept places"),
    Stage(
        "distinct places", Consensus, "hypotheses", lambda a, r: size(a[0]._places.votes), "votes on the kept places"
    ),
    Stage("observed scan", ObservedScan, "of", _nothing, ""),
    Stage("field: look up", ScanPart, "look_up", _field, "cells around the places, the scan"),
    Stage("evidence", PlaceScorer, "score", lambda a, r: size(a[0]._followed.observed), "observations of the places"),
    Stage("crops of the map", local_map.LocalMaps, "around", _nothing, ""),
    Stage("registration", registration, "register", _registered, "crop and scan, once a place"),
    Stage("verification", registration, "verify", _verified, "crop and scan, once a place"),
    Stage("decision", global_search, "decide", _nothing, ""),
)

Record = dict[str, tuple[float, float, int]]  # seconds, bytes and calls of each stage of one step


class Recorder:
    """Stages of a step as they are called; the time of one does not count for that in which it is called."""

    def __init__(self) -> None:
        self.step: Record = {}
        self._inner = [0.0]  # seconds of the stages below each that runs

    @contextmanager
    def around(self, stages: Sequence[Stage]) -> Iterator[None]:
        """Record the stages until the block ends."""
        with ExitStack() as stack:
            for stage in stages:
                stack.enter_context(patch.object(stage.owner, stage.name, self._recorded(stage)))
            yield

    def _recorded(self, stage: Stage) -> Callable[..., Any]:
        run = getattr(stage.owner, stage.name)

        def recorded(*arguments: Any, **options: Any) -> Any:
            self._inner.append(0.0)
            begin = perf_counter()
            result = run(*arguments, **options)
            seconds = perf_counter() - begin
            below = self._inner.pop()
            self._inner[-1] += seconds
            own = seconds if stage.label == STEP else seconds - below
            before = self.step.get(stage.label, (0.0, 0.0, 0))
            moved = stage.bytes((*arguments, *options.values()), result)
            self.step[stage.label] = before[0] + own, before[1] + moved, before[2] + 1
            return result

        return recorded


def measured(world: Path, site: Path, drives: int) -> list[Record]:
    """Stages of all steps of some drives."""
    run, localizer, search, _ = prepared(str(site), str(world / "run"))
    recorder, steps = Recorder(), []
    whole = Stage(STEP, global_search.GlobalSearch, "update", lambda a, r: 0.0, "")
    with recorder.around([*STAGES, whole]):
        for turn in range(drives + 1):
            for request in requests(run, localizer, turn, KEYFRAMES):
                recorder.step = {}
                search.update(request)
                if turn:  # caches fill during the first
                    steps.append(recorder.step)
    return steps


def options(parser: ArgumentParser) -> None:
    """Add where the picture goes."""
    parser.add_argument("--out", type=Path, default=OUT, help=f"the picture ({OUT})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Medians of the stages in the town, and the picture."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {last_core()})
    world = prepare(folder(), WORLDS["town"])
    site = today().built([world / "base.laz"], world / "ours.coview")
    speed = bandwidth()
    yield informs("search_stages/memory bandwidth, one thread", speed / 1e9, "GB/s")
    steps = measured(world, site, 2 if asked.quick else DRIVES)
    shown = []
    for label, said in [(STEP, ""), *((stage.label, stage.said) for stage in STAGES)]:
        found = np.array([step.get(label, (0.0, 0.0, 0)) for step in steps])
        if not found[:, 2].any():
            continue
        p50, p95 = np.percentile(1e3 * found[:, 0], [50, 95])
        moved = float(np.median(found[:, 1]))
        details = {
            "stage": label, "p95": p95, "bytes": moved, "said": said, "calls": float(np.median(found[:, 2])),
            "floor": 1e3 * moved / speed,
        }  # fmt: skip
        shown.append(informs(f"search_stages/{label}", p50, "ms", details))
        yield shown[-1]
    draw(shown, asked.out)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per stage."""
    head = ("stage", "calls", "ms, median", "ms, 95 %", "MB", "floor, ms", "times the floor", "what is counted")
    shown = []
    for row in (row for row in rows if row.details):
        about, floor = row.details, row.details["floor"]
        ratio = row.ours / floor if floor else float("nan")
        shown.append([
            about["stage"], number(about["calls"], 0), number(row.ours, 2), number(about["p95"], 2),
            number(about["bytes"] / 1e6 if floor else None, 2), number(floor or None, 3), number(ratio, 0),
            about["said"],
        ])  # fmt: skip
    return {"": table(head, shown)}


def draw(shown: Sequence[Row], path: Path) -> None:
    """Draw the stages as bars, their floors as marks, over a logarithmic axis."""
    stages = [row for row in shown if row.details["stage"] != STEP][::-1]
    path.parent.mkdir(parents=True, exist_ok=True)
    with figure(path, figsize=(7.2, 4.6)) as (drawing, axes):
        axes.barh([row.details["stage"] for row in stages], [row.ours for row in stages], color=ACCENT, height=0.6)
        for k, row in enumerate(stages):
            axes.text(row.ours * 1.08, k, f"{row.ours:.{1 if row.ours < 10 else 0}f} ms", va="center", fontsize=8)
        marks = [(row.details["floor"], k) for k, row in enumerate(stages) if row.details["floor"]]
        axes.plot(
            *zip(*marks, strict=True), "|", color=TRUTH, markersize=16, markeredgewidth=2, label="its bytes from memory"
        )
        axes.set(xscale="log", xlabel="milliseconds", title="Where the time of a search step goes")
        axes.set_xlim(1e-3, 3 * max(row.ours for row in stages))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.legend(fontsize=9, loc="lower right")
        drawing.supxlabel(
            "python -m bench search_stages    1 thread", fontsize=8, color="#666666", family="DejaVu Sans Mono"
        )
