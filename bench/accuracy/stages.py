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

from bench.accuracy.paper import Modes, SmallestDistance, add_vote
from coview_stream import BaseMap
from coview_stream.basemap import file_format
from coview_stream.basemap.stations import describe_storeys
from coview_stream.clouds import read_tum
from coview_stream.config import Channel, ConsensusConfig, DescriptorConfig, KeyframeConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Points, Pose, inverse, to_local, transform, wrap_angle, yaw_of
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.registration.prepare_scan import voxelized
from coview_stream.localization.search.consensus import Consensus
from coview_stream.localization.search.keyframes import KeyframeBuffer
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
    modes: Modes = field(default_factory=Modes)


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
        self._known: dict[tuple[Channel, bool], npt.NDArray[np.float16]] = {}

    def map(self, descriptor: DescriptorConfig, modes: Modes) -> BaseMap:
        """Return the base map as if it had been built with ``descriptor``."""
        with modes.descriptors():
            described = {
                f"descriptor.{name}": self._described(name, descriptor, modes.strict) for name in descriptor.channels
            }
        config = self._parameters["config"] | {"descriptor": asdict(descriptor)}
        return BaseMap(self._geometry | described, self._parameters | {"config": config})

    def _described(self, name: Channel, descriptor: DescriptorConfig, strict: bool) -> npt.NDArray[np.float16]:
        if (name, strict) not in self._known:
            one, block = replace(descriptor, channels=(name,)), self.built.config.block
            points, stations = np.array(self.built.points), self.built.stations
            self._known[name, strict] = describe_storeys(points, stations, block, one)[name]
        return self._known[name, strict]


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
        grid, config = base_map.station_grid, ConsensusConfig()
        self._alone = Consensus(grid, replace(config, window=1))
        self._window: Consensus | SmallestDistance = (
            SmallestDistance(grid.stations, WINDOW)
            if variant.modes.single
            else Consensus(grid, replace(config, window=WINDOW))
        )

    def vote(self, seen: Seen, centre: Floats, volumes: dict[Channel, Floats32]) -> None:
        add_vote(self._alone, centre, volumes)
        add_vote(self._window, centre, volumes)
        self.places.keyframes += 1
        self.places.top1 += right(self._alone.hypotheses()[0].T_map_odom, seen)
        if len(self._window) == WINDOW:
            self.places.windows += 1
            self.places.coarse += right(self._window.hypotheses()[0].T_map_odom, seen)


def places(world: Path, variants: list[Variant], bank: Bank) -> dict[str, Places]:
    """How often each variant names the right place along a world's run."""
    searches = [_Search(variant, bank.built) for variant in variants]

    @cache
    def described(descriptor: DescriptorConfig, modes: Modes) -> BaseMap:
        return bank.map(descriptor, modes)

    for seen in keyframes_of(world, bank.built.origin, variants[0].descriptor):
        known: dict[tuple[DescriptorConfig, Modes], Floats32] = {}
        for search in searches:
            descriptor, modes = search.variant.descriptor, replace(search.variant.modes, single=False)
            centre = np.array([*seen.position[:2], seen.ground if descriptor.ground_zero else seen.position[2]])
            volumes = {}
            for name in descriptor.channels:
                one = replace(descriptor, channels=(name,))
                if (one, modes) not in known:
                    # the zero is the keyframe's affair: it does not change the stations
                    base_map = described(replace(one, ground_zero=True), modes)
                    with modes.descriptors():
                        query = describe(seen.scan, centre, one)
                    known[one, modes] = modes.distances(base_map, query)[name]
                volumes[name] = known[one, modes]
            search.vote(seen, centre, volumes)
    return {search.variant.name: search.places for search in searches}


def right(T_map_odom: Pose, seen: Seen) -> bool:
    """Whether a hypothesis puts the keyframe at its true place and heading; heights are not compared."""
    found, true = (transform(T, seen.position[None])[0] for T in (T_map_odom, seen.T_map_odom))
    turn = wrap_angle(yaw_of(T_map_odom) - yaw_of(seen.T_map_odom))
    return bool(np.hypot(*(found - true)[:2]) < NEAR and abs(turn) < ALIGNED)
