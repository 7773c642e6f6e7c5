"""The search alone, before any registration: which place each variant of the method would name.

A run's keyframes are made once, and stations are described once per channel, so that a dozen variants cost little more
than one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from coview_stream import BaseMap
from coview_stream.basemap import file_format
from coview_stream.basemap.stations import describe_storeys
from coview_stream.clouds import read_tum
from coview_stream.config import Channel, ConsensusConfig, DescriptorConfig, KeyframeConfig, RetrievalConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Points, Pose, inverse, to_local, transform, wrap_angle, yaw_of
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.registration.prepare_scan import voxelized
from coview_stream.localization.search.consensus import Consensus
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.localization.search.retrieval import Retrieval
from coview_stream.localization.search.smallest_distance import SmallestDistance
from coview_stream.localization.search.votes import TableVote
from coview_stream.recordings.open_run import open_run

WINDOW = 5  # keyframes that vote together in the coarse measure

_DESCRIBED = ("descriptor.", "station_codes")  # arrays of a map that depend on how stations are described

NEAR, ALIGNED = 3.0, float(np.radians(9.0))
"""A place is right within this, metres and radians: one and a half blocks, one and a half shifts."""


@dataclass(frozen=True)
class Variant:
    """The method with one or more of its choices made otherwise."""

    name: str
    descriptor: DescriptorConfig = field(default_factory=DescriptorConfig)
    retrieval: RetrievalConfig = field(default_factory=RetrievalConfig)
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)


@dataclass(frozen=True)
class Seen:
    """A keyframe as the search sees it."""

    scan: Points  # (N, 3) virtual local scan, odometry frame, metres
    position: Floats  # (3,) of the sensor
    ground: float  # height below it
    T_map_odom: Pose  # (4, 4) the truth, map frame relative to the map's origin


@dataclass
class Places:
    """Right places: of keyframes alone, and of windows of :data:`WINDOW` keyframes."""

    keyframes: int = 0
    top1: int = 0
    windows: int = 0
    coarse: int = 0


class Bank:
    """One map's geometry, and its stations described in as many ways as are asked for, each once."""

    def __init__(self, path: Path) -> None:
        arrays, self._parameters, _ = file_format.load(path)
        self._geometry = {name: a for name, a in arrays.items() if not name.startswith(_DESCRIBED)}
        self.built = BaseMap(arrays, self._parameters)
        self._known: dict[Channel, npt.NDArray[np.float16]] = {}

    def map(self, descriptor: DescriptorConfig) -> BaseMap:
        """Return the base map as if it had been built with ``descriptor``."""
        described = {f"descriptor.{name}": self._described(name, descriptor) for name in descriptor.channels}
        config = self._parameters["config"] | {"descriptor": asdict(descriptor)}
        return BaseMap(self._geometry | described, self._parameters | {"config": config})

    def _described(self, name: Channel, descriptor: DescriptorConfig) -> npt.NDArray[np.float16]:
        if name not in self._known:
            one, block = replace(descriptor, channels=(name,)), self.built.config.block
            points, stations = np.array(self.built.points), self.built.stations
            self._known[name] = describe_storeys(points, stations, block, one)[name]
        return self._known[name]


def keyframes_of(world: Path, origin: Floats, descriptor: DescriptorConfig) -> Iterator[Seen]:
    """Keyframes of a world's run in order; ``origin`` (3,) is the map's."""
    run, (_, truth) = open_run(world / "run"), read_tum(world / "truth.tum")
    settings = KeyframeConfig()
    buffer = KeyframeBuffer(settings)
    for frame in run:
        T_odom_body = to_local(frame.T_odom_body, run.poses[0][:3, 3])  # near its own origin, as the localizer has it
        T_map_body = to_local(truth[frame.index], origin)
        keyframe = buffer.add(RawScan(voxelized(frame.points, T_odom_body, settings), T_odom_body), frame.stamp)
        if keyframe is None:
            continue
        scan = buffer.virtual_scan(keyframe.position, descriptor.radius, descriptor.voxel)
        if len(scan) >= settings.min_points:
            ground = ground_below(scan, keyframe.position)
            yield Seen(scan, keyframe.position.copy(), ground, T_map_body @ inverse(T_odom_body))


class _Search:
    """One variant's votes: of the newest keyframe alone, and of the last few together."""

    def __init__(self, variant: Variant, base_map: BaseMap) -> None:
        self.variant, self.places = variant, Places()
        grid, window = base_map.station_grid, replace(variant.consensus, window=WINDOW)
        self._alone = Consensus(grid, replace(variant.consensus, window=1))
        self._window: Consensus | SmallestDistance = (
            SmallestDistance(grid.stations, window) if window.mode == "single" else Consensus(grid, window)
        )

    def vote(self, seen: Seen, centre: Floats, volumes: dict[Channel, Floats32]) -> None:
        vote = TableVote.of_distances(centre, volumes.values())
        self._alone.vote(vote)
        if isinstance(self._window, SmallestDistance):
            self._window.vote(centre, volumes.values())
        else:
            self._window.vote(vote)
        self.places.keyframes += 1
        self.places.top1 += right(self._alone.hypotheses()[0].T_map_odom, seen)
        if len(self._window) == WINDOW:
            self.places.windows += 1
            self.places.coarse += right(self._window.hypotheses()[0].T_map_odom, seen)


def places(world: Path, variants: list[Variant], bank: Bank) -> dict[str, Places]:
    """How often each variant names the right place along a world's run."""
    searches = [_Search(variant, bank.built) for variant in variants]

    @cache
    def retrieval(descriptor: DescriptorConfig, config: RetrievalConfig) -> Retrieval:
        return Retrieval(bank.map(descriptor), config)

    for seen in keyframes_of(world, bank.built.origin, variants[0].descriptor):
        known: dict[tuple[DescriptorConfig, RetrievalConfig], Floats32] = {}
        for search in searches:
            descriptor, config = search.variant.descriptor, search.variant.retrieval
            centre = np.array([*seen.position[:2], seen.ground if descriptor.ground_zero else seen.position[2]])
            volumes = {}
            for name in descriptor.channels:
                one = replace(descriptor, channels=(name,))
                if (one, config) not in known:
                    # the zero is the keyframe's affair: it does not change the stations
                    stations = retrieval(replace(one, ground_zero=True), config)
                    known[one, config] = stations.distances(describe(seen.scan, centre, one))[name]
                volumes[name] = known[one, config]
            search.vote(seen, centre, volumes)
    return {search.variant.name: search.places for search in searches}


def right(T_map_odom: Pose, seen: Seen) -> bool:
    """Whether a hypothesis puts the keyframe at its true place and heading; heights are not compared."""
    found, true = (transform(T, seen.position[None])[0] for T in (T_map_odom, seen.T_map_odom))
    turn = wrap_angle(yaw_of(T_map_odom) - yaw_of(seen.T_map_odom))
    return bool(np.hypot(*(found - true)[:2]) < NEAR and abs(turn) < ALIGNED)
