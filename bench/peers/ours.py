"""coview_stream itself.

* As in the product: the search gets the keyframes of the drive one after the other and gives a pose once three of
  them have confirmed it (``LocalizerConfig()``); the time is that of all keyframes until then.
* One scan: the same search with ``stationary=True``, from one submap, which has to stand alone.
* Tracking: registration at the scales that the tracker uses, then its verification, which is in the time, too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.harness.places import Place
from bench.peers.method import Answer
from bench.peers.start import started
from coview_stream import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.fix import Cause
from coview_stream.geometry import inverse, transform
from coview_stream.pose.judgement import Habit
from coview_stream.pose.registration import LocalMaps, register
from coview_stream.pose.source import local_source
from coview_stream.pose.verification import verify
from coview_stream.query import Query
from coview_stream.search import GlobalSearch


class Keyframes:
    """The search over the keyframes of a drive."""

    def __init__(self, site: BaseMap, stationary: bool = False) -> None:
        import coview_kernels

        coview_kernels.warm_up()
        config = LocalizerConfig(stationary=stationary)
        self._search = GlobalSearch(site, config, LocalMaps(site, config.registration.source_range))

    def answer(self, place: Place) -> Answer:
        """Search until a keyframe's verdict accepts a place."""
        return self._search_all(place.queries, place)

    def _search_all(self, queries: list[Query], place: Place) -> Answer:
        self._search.clear()
        score = 0.0
        for query in queries:
            verdict = self._search.update(query)
            score = verdict.evidence.score
            if verdict.accepted is not None:
                return Answer(verdict.accepted.T_map_odom @ place.T_odom_submap, True, score)
        return Answer(None, False, score)


class OneScan(Keyframes):
    """The search from one submap alone."""

    def __init__(self, site: BaseMap) -> None:
        super().__init__(site, stationary=True)

    def answer(self, place: Place) -> Answer:
        """Search with all points of the drive as if they were one scan."""
        newest = place.queries[-1]
        submap = place.submap + newest.position.astype(np.float32)
        return self._search_all([replace(newest, submap=submap)], place)


class Tracking:
    """Registration from a pose nearby, believed if it passes the check that every registration must pass."""

    def __init__(self, site: BaseMap) -> None:
        import coview_kernels

        coview_kernels.warm_up()
        self._site = site
        self._config = LocalizerConfig().registration
        self._maps = LocalMaps(site, self._config.source_range)

    def answer(self, place: Place) -> Answer:
        """Register the submap."""
        start = started(place)
        source = local_source(place.submap, np.zeros(3), self._config)
        target = self._maps.around(transform(start, np.zeros((1, 3)))[0])
        if target is None:
            return Answer(None, False)
        found = register(source, start, target, self._config, self._config.track, centre=np.zeros(3))
        if found is None:
            return Answer(None, False)
        T, newest = found.T_map_source, place.queries[-1]
        surveyed = self._site.surveyed(transform(T, source.points)[:, :2])
        T_map_body = T @ inverse(place.T_odom_submap) @ newest.T_odom_body
        evidence = verify(source, T, newest.seen, T_map_body, target, surveyed)
        cause, _ = Habit().judge(evidence, LocalizerConfig().acceptance)
        return Answer(T, cause is Cause.VERIFIED, evidence.score)
