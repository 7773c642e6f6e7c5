"""The vote of a keyframe by learned features on a map of 0.1 km2, as the search runs it, beside the dense comparison.

The search encodes what is around the robot, compares coarse cells of the map with it at some headings, in the few
dimensions that hold nearly all of the features, and then single places, fine and at every heading, where one was named.
The dense comparison is what that replaced: all 32 dimensions on cells of 2 m at 36 headings all over the map, by FFT in
blocks with spectra kept (``correlate``). The map's features do not come into its time any more than into ours. Both
have the same features of a keyframe and add up their votes in the same way; kept is what both name of what the dense
one names rightly (within 3 m and 9 degrees).
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import coview_kernels
from bench.accuracy.stages import Seen, right
from bench.harness.files import folder
from bench.harness.pinned import today
from bench.harness.rows import Row, against, bounded, informs, reached
from bench.harness.worlds import prepare
from coview_stream import BaseMap, Localizer, LocalizerConfig
from coview_stream.clouds import read_tum
from coview_stream.config import ConsensusConfig
from coview_stream.descriptors.coview import on_ground
from coview_stream.descriptors.network import LOCAL_CELL
from coview_stream.geometry.arrays import Floats32
from coview_stream.geometry.transforms import inverse, to_local
from coview_stream.localization.search.consensus import Consensus, yaw_of_shift
from coview_stream.localization.search.learned.correlation import correlate, downsample
from coview_stream.localization.search.learned.feature_index import FeatureIndex
from coview_stream.localization.search.learned.matcher import FeatureMatcher, QueryFeatures
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.search.votes import TableVote
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

WORLDS = {
    "town": SimulationConfig("town", "vlp16", seed=2221, size=320.0, length=90.0),
    "campus": SimulationConfig("campus", "os64", seed=2222, size=320.0, length=90.0),
}
"""0.1 km2 each; seeds that nothing was tuned on."""

MOST_MS, LEAST_KEPT = 40.0, 99.9
"""The targets: of the whole vote, with one thread, and per cent of right places."""


class Dense:
    """Baseline: all dimensions at all cells and headings."""

    def __init__(self, matcher: FeatureMatcher) -> None:
        whole, corner = matcher.features.coarse(matcher.config.cell)
        surveyed = (whole != 0).any(axis=0)
        self._matcher, margin = matcher, round(32.0 / matcher.config.cell)
        self._index = FeatureIndex(whole, corner, matcher.config.cell, surveyed=surveyed, margin=margin)
        at = np.floor((matcher.stations[:, :2] - corner) / matcher.config.cell).astype(np.int64)
        self._inside = np.asarray(((at >= 0) & (at < whole.shape[:0:-1])).all(axis=1))
        self._column, self._row = np.where(self._inside[:, None], at, 0).T

    def __call__(self, query: QueryFeatures) -> TableVote:
        """Return the vote of one keyframe."""
        config = self._matcher.config
        local, weight = downsample(query.features.local, query.weight, round(config.cell / LOCAL_CELL))
        found = correlate(local, weight, self._index, yaw_of_shift(np.arange(config.yaws), config.yaws))
        scores: Floats32 = found.transpose(1, 2, 0)[self._row, self._column]
        scores[~self._inside] = -np.inf
        known = np.isfinite(scores)
        distance = np.float32(1.0 + np.median(scores[known])) - scores
        distance[~known] = 1.0  # no evidence
        return TableVote.of_distances(query.centre, [distance])


def rows(asked: Namespace) -> Iterator[Row]:
    """Both worlds."""
    coview_kernels.warm_up()
    for name in list(WORLDS)[: 1 if asked.quick else None]:
        yield from _world(name, WORLDS[name])


def _world(name: str, config: SimulationConfig) -> Iterator[Row]:
    world = prepare(folder(), config)
    site = BaseMap.load(today().built([world / "base.laz"], world / "ours.coview"))
    matcher = SearchIndex.of(site, LocalizerConfig(reloc="learned")).learned
    if matcher is None:
        raise RuntimeError("the map has no learned features")
    begin = time.perf_counter()
    matcher.prepare()
    prepared = time.perf_counter() - begin
    dense, settings = Dense(matcher), replace(ConsensusConfig(), peaks=matcher.config.peaks)
    votes = {side: Consensus(site.station_grid, settings) for side in ("ours", "dense")}
    times: dict[str, list[float]] = defaultdict(list)
    found: dict[str, list[tuple[bool, bool]]] = defaultdict(list)
    for request, seen in _keyframes(world, site):
        clock = [time.perf_counter()]

        def lap(stage: str, clock: list[float] = clock) -> None:
            clock.append(time.perf_counter())
            times[stage].append(1e3 * (clock[-1] - clock[-2]))

        query = matcher.encode(request.surroundings, on_ground(request.surroundings, request.position))
        lap("encode")
        vote = matcher.vote(query)
        lap("compare")
        _voted(votes["ours"], vote, seen, found["ours"])
        lap("places")
        other = dense(query)
        lap("dense")
        _voted(votes["dense"], other, seen, found["dense"])
    yield from _judged(
        f"learned_match/{name}, {site.learned.tile_area / 1e6 if site.learned else 0:.2g} km2", times, found
    )
    yield informs(f"learned_match/{name}: making what the search keeps", prepared, "s")


def _keyframes(world: Any, site: BaseMap) -> Iterator[tuple[SearchRequest, Seen]]:
    """Yield the requests of a drive that never finds its place, and the truth of each."""
    run, (_, truth) = open_run(world / "run"), read_tum(world / "truth.tum")
    localizer = Localizer(site)
    for frame in run:
        request = localizer.add_frame(frame.points, frame.T_odom_body, frame.stamp)
        if request is not None and len(request.surroundings) >= localizer.config.keyframe.min_points:
            T = to_local(truth[frame.index], site.origin) @ inverse(request.T_odom_body)
            yield request, Seen(request.scan, request.position, 0.0, T)


def _voted(consensus: Consensus, vote: Any, seen: Seen, found: list[tuple[bool, bool]]) -> None:
    """Add a vote, and whether a right place is named, and named first."""
    consensus.vote(vote)
    named = [right(each.T_map_odom, seen) for each in consensus.hypotheses()]
    found.append((any(named), bool(named) and named[0]))


def _judged(name: str, times: dict[str, list[float]], found: dict[str, list[tuple[bool, bool]]]) -> Iterator[Row]:
    taken = {stage: np.array(values[1:]) for stage, values in times.items()}  # the first keyframe warms up
    whole = taken["encode"] + taken["compare"] + taken["places"]
    yield bounded(f"{name}: whole vote, p50", float(np.median(whole)), "ms", MOST_MS)
    yield informs(f"{name}: whole vote, p95", float(np.percentile(whole, 95)), "ms")
    yield informs(f"{name}: network", float(np.median(taken["encode"])), "ms")
    both = [float(np.median(taken[side])) for side in ("compare", "dense")]
    yield against(f"{name}: comparison beside the dense one", both[0], both[1], "ms", None)
    yield informs(f"{name}: places that keyframes agree on", float(np.median(taken["places"])), "ms")
    ours, dense = np.array(found["ours"]), np.array(found["dense"])
    good = dense[:, 0]
    kept = 100.0 * float(ours[good, 0].mean()) if good.any() else np.nan
    yield reached(f"{name}: right places kept, of {int(good.sum())}", kept, "%", LEAST_KEPT)
    yield Row(
        f"{name}: right place first, beside the dense one", 100 * ours[:, 1].mean(), 100 * dense[:, 1].mean(), "%"
    )
