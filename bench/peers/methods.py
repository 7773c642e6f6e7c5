"""What a peer has to do, and coview_stream itself.

* As in the product: the search gets the keyframes of the drive one after the other and gives a pose once the
  probability of an error is below the integrity risk (``LocalizerConfig()``); the time is that of all until then.
* One scan: the same search from one submap, which has to stand alone.
* Tracking: registration at the scales that the tracker uses, believed where the scan fits there better than chance;
  that is in the time, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

import coview_kernels
from bench.harness.worlds import Place
from coview_stream import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import Pose, inverse, pose_from, rot_z
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import register
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.tracking.place_evidence import PlaceEvidence

OFF, TURNED = 0.5, float(np.radians(3.0))  # how far from the truth tracking starts, metres and radians


@dataclass(frozen=True)
class Answer:
    """A pose (4, 4) map <- submap, or None, and whether the method itself vouches for it."""

    T_map_submap: Pose | None
    vouched: bool


class Method(Protocol):
    """One way to localize; made for one map, asked many times."""

    def answer(self, place: Place) -> Answer:
        """Say where the submap lies, or that it is not known."""


def started(place: Place) -> Pose:
    """Return ``T_map_submap`` (4, 4) that tracking starts from: the truth, off in a direction of the place's own."""
    rng = np.random.default_rng(int(abs(place.T_map_submap[0, 3]) * 1e3))
    heading, turn = rng.uniform(-np.pi, np.pi), TURNED * rng.choice([-1.0, 1.0])
    off = pose_from(rot_z(turn), [OFF * np.cos(heading), OFF * np.sin(heading), 0.0])
    return np.asarray(place.T_map_submap @ off)


class Keyframes:
    """The search over the keyframes of a drive."""

    def __init__(self, site: BaseMap) -> None:
        coview_kernels.warm_up()
        config = LocalizerConfig()
        self._search = GlobalSearch(site, config, LocalMaps(site, config.registration.source_range))

    def answer(self, place: Place) -> Answer:
        """Search until a keyframe's verdict accepts a place."""
        self._search.clear()
        for query in self._queries(place):
            accepted = self._search.update(query).accepted
            if accepted is not None:
                return Answer(accepted.T_map_odom @ place.T_odom_submap, True)
        return Answer(None, False)

    def _queries(self, place: Place) -> list[SearchRequest]:
        return place.queries


class OneScan(Keyframes):
    """The search from one submap alone: all points of the drive as if they were one scan."""

    def _queries(self, place: Place) -> list[SearchRequest]:
        newest = place.queries[-1]
        return [replace(newest, submap=place.submap + newest.position.astype(np.float32))]


class Tracking:
    """Registration from a pose nearby, believed if the scan speaks for it, as for every registration."""

    def __init__(self, site: BaseMap) -> None:
        coview_kernels.warm_up()
        self._site, self._config = site, LocalizerConfig().registration
        self._maps = LocalMaps(site, self._config.source_range)

    def answer(self, place: Place) -> Answer:
        """Register the submap."""
        start, newest = started(place), place.queries[-1]
        source = prepare_scan(place.submap, np.zeros(3), self._config)
        target = self._maps.around(start[:3, 3])
        if target is None:
            return Answer(None, False)
        found = register(source, start, target, self._config, self._config.track, centre=np.zeros(3))
        if found is None:
            return Answer(None, False)
        T = found.T_map_source
        # the submap's frame takes the place of odometry's
        scan = ObservedScan.of(source, newest.cloud, inverse(place.T_odom_submap) @ newest.T_odom_body)
        return Answer(T, PlaceEvidence(self._site).observe(scan, T).ratio > 0.0)
