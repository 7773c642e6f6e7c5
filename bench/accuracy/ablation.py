"""What each choice of the method is worth.

Every variant changes a choice (the last ones several of the paper's at once) and runs on the same simulated worlds: how
often the search names the right place (from one keyframe, from five), then the whole localizer on the same run. What is
done stays in ``--work``.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.accuracy.accuracy import evaluated
from bench.accuracy.paper import Modes, SmallestDistance, add_vote
from bench.harness.files import fingerprint, folder, isolated, remembered
from bench.harness.rows import Row, informs, listed
from bench.harness.worlds import KINDS, LIDARS, map_of, prepare, world_name
from coview_stream import BaseMap
from coview_stream.basemap import file_format
from coview_stream.basemap.stations import describe_storeys
from coview_stream.clouds import read_tum
from coview_stream.config import Channel, ConsensusConfig, DescriptorConfig, KeyframeConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats, Floats32
from coview_stream.geometry.transforms import Points, Pose, inverse, to_local, transform, wrap_angle, yaw_of
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.offline import locate
from coview_stream.localization.registration.clouds import voxelized
from coview_stream.localization.search.consensus import Consensus
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import SimulationConfig

WINDOW = 5  # keyframes that vote together in the coarse measure

_DESCRIBED = ("descriptor.", "station_codes")  # arrays of a map that depend on how stations are described

NEAR, ALIGNED = 3.0, float(np.radians(9.0))  # a place is right within one and a half blocks and shifts


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


class Search:
    """One variant's votes, and how often they name the right place: of the newest keyframe alone, of the last few."""

    def __init__(self, variant: Variant, base_map: BaseMap) -> None:
        self.variant = variant
        self.right = {"keyframes": 0, "top1": 0, "windows": 0, "coarse": 0}
        grid, config = base_map.station_grid, ConsensusConfig()
        self._alone = Consensus(grid, replace(config, window=1))
        self._window: Consensus | SmallestDistance = (
            SmallestDistance(grid.stations, WINDOW)
            if variant.modes.single
            else Consensus(grid, replace(config, window=WINDOW))
        )

    def vote(self, seen: Seen, centre: Floats, volumes: dict[Channel, Floats32]) -> None:
        """Add a keyframe's distances and judge the places."""
        add_vote(self._alone, centre, volumes)
        add_vote(self._window, centre, volumes)
        self.right["keyframes"] += 1
        self.right["top1"] += right(self._alone.hypotheses()[0].T_map_odom, seen)
        if len(self._window) == WINDOW:
            self.right["windows"] += 1
            self.right["coarse"] += right(self._window.hypotheses()[0].T_map_odom, seen)


class Bank:
    """One map's geometry, and its stations described in as many ways as are asked for, each once."""

    def __init__(self, path: Path) -> None:
        arrays, self._parameters, _ = file_format.load(path)
        self._geometry = {name: a for name, a in arrays.items() if not name.startswith(_DESCRIBED)}
        self.built = BaseMap(arrays, self._parameters)
        self._known: dict[tuple[Channel, bool], npt.NDArray[np.float16]] = {}

    def map(self, descriptor: DescriptorConfig, modes: Modes) -> BaseMap:
        """Return the base map as if it had been built with ``descriptor``."""
        points, stations, block = np.array(self.built.points), self.built.stations, self.built.config.block
        for name in descriptor.channels:
            if (name, modes.strict) not in self._known:
                with modes.descriptors():
                    found = describe_storeys(points, stations, block, replace(descriptor, channels=(name,)))
                self._known[name, modes.strict] = found[name]
        described = {f"descriptor.{name}": self._known[name, modes.strict] for name in descriptor.channels}
        config = self._parameters["config"] | {"descriptor": asdict(descriptor)}
        return BaseMap(self._geometry | described, self._parameters | {"config": config})


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


def places(world: Path, bank: Bank) -> dict[str, dict[str, int]]:
    """Count how often each variant names the right place along a world's run."""
    searches = [Search(variant, bank.built) for variant in VARIANTS]
    described = cache(bank.map)
    for seen in keyframes_of(world, bank.built.origin, VARIANTS[0].descriptor):
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
    return {search.variant.name: search.right for search in searches}


def right(T_map_odom: Pose, seen: Seen) -> bool:
    """Whether a hypothesis puts the keyframe at its true place and heading; heights are not compared."""
    found, true = (transform(T, seen.position[None])[0] for T in (T_map_odom, seen.T_map_odom))
    turn = wrap_angle(yaw_of(T_map_odom) - yaw_of(seen.T_map_odom))
    return bool(np.hypot(*(found - true)[:2]) < NEAR and abs(turn) < ALIGNED)


SEEDS = tuple(range(2101, 2109))
"""Held out: not for tuning, as those of ``python -m bench accuracy``."""

_LENGTH = 24.0  # metres driven in each world
_COC = partial(DescriptorConfig, channels=("coview",))

VARIANTS = (
    Variant("default: both channels, exhaustive, consensus"),
    Variant("Scan Context alone", DescriptorConfig(channels=("scan_context",))),
    Variant("co-view context alone", _COC()),
    Variant("co-view alone, strict (eq. 2 only)", _COC(), Modes(strict=True)),
    Variant("ring key retrieval, 200 candidates", modes=Modes(ring_key=True)),
    Variant("co-view alone, strict, ring key", _COC(), Modes(ring_key=True, strict=True)),
    Variant("single minimum, no consensus", modes=Modes(single=True)),
    Variant("keyframe's zero at the sensor", DescriptorConfig(ground_zero=False)),
    Variant("co-view alone, zero at the sensor", _COC(ground_zero=False)),
    Variant("all three: co-view, ring key, single", _COC(), Modes(ring_key=True, single=True)),
    Variant("all three: strict, ring key, single", _COC(), Modes(ring_key=True, single=True, strict=True)),
)
"""The last one is the paper's own method."""

Measured = dict[str, dict[str, Any]]  # variant name -> its measures in one world

COLUMNS = (
    ("variant", "variant", None), ("top-1", "top1", 2), (f"coarse ({WINDOW} kf)", "coarse", 2), ("SLR", "slr", None),
    ("false frames", "false", None), ("e_t m", "e_t", 3), ("e_r deg", "e_r", 3), ("first fix m", "first_m", 1),
)  # fmt: skip


def world_of(seed: int) -> SimulationConfig:
    """Return the world of a seed: kinds and lidars in turn, odd ones changed since the map was made."""
    size = (240.0, 270.0, 300.0)[seed // 2 % 3]
    changed = 0.25 if seed % 2 else 0.0
    return SimulationConfig(KINDS[seed % 4], LIDARS[seed % 3], seed, size, _LENGTH, changed=changed)


def ablate(below: Path, config: SimulationConfig) -> Measured:
    """Measure all variants in one world: the search alone, then the whole localizer on the world's run."""
    world, bank = below / world_name(config), Bank(map_of(below, config))
    search, out = places(world, bank), Measured()
    for variant in VARIANTS:
        with variant.modes.localizer():
            located = locate(bank.map(variant.descriptor, variant.modes), open_run(world / "run"))
        out[variant.name] = search[variant.name] | evaluated(located, world)
    return out


def total(name: str, got: Sequence[dict[str, Any]]) -> Row:
    """Row of a variant over all its worlds; a run without a fix counts as an endless first fix."""

    def count(key: str) -> int:
        return sum(each[key] for each in got)

    def error(key: str) -> float:
        return float(np.mean([each[key]["mean"] for each in got if each[key]] or [np.nan]))

    top1 = count("top1") / count("keyframes") if count("keyframes") else np.nan
    coarse = count("coarse") / count("windows") if count("windows") else np.nan
    first = float(np.median([np.inf if each["first_fix_m"] is None else each["first_fix_m"] for each in got]))
    details = {
        "variant": name, "top1": top1, "coarse": coarse, "slr": f"{count('success')} of {len(got)}",
        "false": f"{count('false_frames')} of {count('posed')}", "e_t": error("translation"), "e_r": error("rotation"),
        "first_m": first, "keyframes": count("keyframes"),
    }  # fmt: skip
    return informs(f"ablation/{name}: top-1", 100 * top1, "%", details)


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, help=f"({SEEDS[0]} to {SEEDS[-1]})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Yield a row per variant."""
    measured = {}
    for seed in dict.fromkeys(asked.seeds[:1] if asked.quick else asked.seeds):
        config = world_of(seed)
        isolated(prepare, folder(), config)
        spec = {"world": config.to_dict(), "code": fingerprint(), "bench": fingerprint("bench/accuracy")}
        file = folder() / "results" / f"ablation-{world_name(config)}.json"
        measured[seed] = remembered(file, spec, partial(isolated, ablate, folder(), config))
    for name in (variant.name for variant in VARIANTS):
        row = total(name, [world[name] for world in measured.values()])
        row.details["seeds"] = list(measured)
        yield row


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """One line per variant; above it, the seeds."""
    seeds, votes = rows[0].details["seeds"], rows[0].details["keyframes"]
    text = listed(COLUMNS, [row.details for row in rows])
    return {"": f"Worlds of the seeds {', '.join(map(str, seeds))}; {votes} keyframes vote.\n\n{text}"}
