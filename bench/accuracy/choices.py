"""Choices of the method, and how they are measured on one site: the search, the whole localizer.

A choice of the search is judged at every keyframe by exact distances: whether the best place of this keyframe is right,
one of its ten best, the best of five keyframes together. The localizer runs as ``coview-stream locate`` does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from coview_stream import BaseMap
from coview_stream.basemap.stations import StationGrid, describe_storeys, find_stations
from coview_stream.clouds import read_tum
from coview_stream.config import Channel, ConsensusConfig, DescriptorConfig, KeyframeConfig, LocalizerConfig
from coview_stream.descriptors.coview import describe, ground_below
from coview_stream.geometry.arrays import Floats, Floats32, Ints
from coview_stream.geometry.rasters import argsmallest
from coview_stream.geometry.transforms import Points, Pose, inverse, to_local, transform, wrap_angle, yaw_of
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.offline import locate
from coview_stream.localization.registration.clouds import voxelized
from coview_stream.localization.search import acceptance
from coview_stream.localization.search.consensus import Consensus, Hypothesis
from coview_stream.localization.search.keyframes import KeyframeBuffer
from coview_stream.localization.search.retrieval import exact_distances
from coview_stream.localization.state import State
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import driven, evaluate

NEAR, ALIGNED = 3.0, float(np.radians(9.0))  # a place is right within one and a half blocks and shifts
WINDOW, BEST = 5, 10  # keyframes that vote together, best places of one

_DESCRIBED = ("descriptor.", "station_codes")  # arrays of a map that depend on how stations are described
_SAMPLE = 100_000  # distances that a median is taken of


@dataclass(frozen=True)
class Choice:
    """The search with some choices changed.

    Attributes:
        descriptor: of stations and keyframes.
        spacing: metres between stations, and between keyframes: L = sigma_d.
    """

    descriptor: DescriptorConfig = field(default_factory=DescriptorConfig)
    spacing: float = 2.0


@dataclass(frozen=True)
class KeyframeView:
    """A keyframe as the search sees it."""

    scan: Points  # (N, 3) VLS of all keyframes, odometry frame, metres
    position: Floats  # (3,) of the sensor
    T_map_odom: Pose  # (4, 4) the truth, map frame relative to the map's origin
    submap: Points  # (N, 3) points to register


class Site:
    """A map, the first metres of a run, and its true poses; in ``site.coview``, ``run/`` and ``truth.tum``."""

    def __init__(self, folder: Path, metres: float) -> None:
        self.map = BaseMap.load(folder / "site.coview")
        whole, (stamps, truth) = open_run(folder / "run"), read_tum(folder / "truth.tum")
        frames = int(np.searchsorted(driven(truth), metres, "right"))
        self.run, self.truth = whole[:frames], (stamps[:frames], truth[:frames])
        self.points = np.array(self.map.points)
        self.described = lru_cache(maxsize=4)(self._described)
        self.stations = lru_cache(maxsize=None)(self._stations)
        self.keyframes = lru_cache(maxsize=None)(self._keyframes)
        self.volumes = lru_cache(maxsize=8)(self._volumes)

    def _stations(self, block: float) -> Floats32:
        own = block == self.map.config.block
        return np.array(self.map.stations) if own else find_stations(self.points, block)

    def _described(self, block: float, descriptor: DescriptorConfig) -> npt.NDArray[np.float16]:
        """Descriptors (M, R, S) of the stations, of the only channel."""
        return describe_storeys(self.points, self.stations(block), block, descriptor)[descriptor.channels[0]]

    def _keyframes(self, distance: float) -> list[KeyframeView]:
        """Return the keyframes of the run in order, every ``distance`` metres."""
        settings, out = KeyframeConfig(distance=distance), []
        buffer, descriptor = KeyframeBuffer(settings), DescriptorConfig(radius=100.0)
        for frame in self.run:
            T_odom_body = to_local(frame.T_odom_body, self.run.poses[0][:3, 3])  # as the localizer has it
            T_map_body = to_local(self.truth[1][frame.index], self.map.origin)
            keyframe = buffer.add(RawScan(voxelized(frame.points, T_odom_body, settings), T_odom_body), frame.stamp)
            if keyframe is None:
                continue
            whole = buffer.virtual_scan(keyframe.position, descriptor.radius, descriptor.voxel)
            if len(whole) < settings.min_points:
                continue
            submap = buffer.recent(4)  # as the search registers
            out.append(KeyframeView(whole, keyframe.position.copy(), T_map_body @ inverse(T_odom_body), submap))
        return out

    def _volumes(self, choice: Choice) -> list[tuple[Floats, Floats32, float]]:
        """Zero (3,) of each keyframe, its distances (M, S) by a choice of one channel, and their processor seconds."""
        descriptor = choice.descriptor
        # the zero concerns only the keyframe, not the stations
        stations = self.described(choice.spacing, replace(descriptor, ground_zero=True))
        out = []
        for seen in self.keyframes(choice.spacing):
            begin, scan, z = time.process_time(), seen.scan, float(seen.position[2])
            centre = np.array([*seen.position[:2], ground_below(scan, seen.position) if descriptor.ground_zero else z])
            volume = exact_distances(stations, describe(scan, centre, descriptor)[descriptor.channels[0]])
            out.append((centre, volume, time.process_time() - begin))
        return out

    def search(self, choice: Choice) -> dict[str, float]:
        """Count how often a choice names the right place along the run, with the seconds of all distances."""
        channels = choice.descriptor.channels
        singles = [replace(choice, descriptor=replace(choice.descriptor, channels=(name,))) for name in channels]
        by_channel = [self.volumes(one) for one in singles]
        seconds = sum(took for volumes in by_channel for *_, took in volumes)
        grid = StationGrid(self.stations(choice.spacing), choice.spacing)
        one, together = (Consensus(grid, ConsensusConfig(window=n)) for n in (1, WINDOW))
        counts = dict.fromkeys(("keyframes", "top1", "top10", "windows", "coarse"), 0.0)
        for k, seen in enumerate(self.keyframes(choice.spacing)):
            centre = by_channel[0][k][0]
            vote = TableVote.of_distances(centre, [volumes[k][1] for volumes in by_channel])
            for consensus in (one, together):
                consensus.vote(vote)
            best = [right(place.T_map_odom, seen) for place in one.hypotheses()[:BEST]]
            counts["keyframes"] += 1
            counts["top1"] += best[0]
            counts["top10"] += any(best)
            if k + 1 >= WINDOW:
                counts["windows"] += 1
                counts["coarse"] += right(together.hypotheses()[0].T_map_odom, seen)
        return counts | {"seconds": seconds, "stations": float(len(grid))}

    def _map(self, channels: Sequence[Channel]) -> BaseMap:
        """Return the map as if it had been built with other channels."""
        descriptor = replace(self.map.descriptor_config, channels=tuple(channels))
        if descriptor == self.map.descriptor_config:
            return self.map
        singles = {name: replace(descriptor, channels=(name,)) for name in channels}
        arrays = {name: a for name, a in self.map.arrays.items() if not name.startswith(_DESCRIBED)}
        arrays |= {f"descriptor.{n}": self.described(self.map.config.block, d) for n, d in singles.items()}
        config = self.map.parameters["config"] | {"descriptor": asdict(descriptor)}
        return BaseMap(arrays, self.map.parameters | {"config": config})

    def elsewhere(self, choice: LocalizerChoice, folder: Path) -> dict[str, Any]:
        """Localize the run on the map of another site, and count the poses, which are all false."""
        with choice.changed():
            found = locate(BaseMap.load(folder / "site.coview"), self.run, choice.config)
        return {"posed": len(found.posed), "frames": found.frames}

    def located(self, choice: LocalizerChoice) -> dict[str, Any]:
        """Localize the run; figures of ``evaluate``."""
        base_map = self._map(choice.channels or self.map.descriptor_config.channels)
        with choice.changed():
            found = locate(base_map, self.run, choice.config)
        poses = np.array([fix.T_map_body for fix in found.posed]).reshape(-1, 4, 4)
        estimate = np.array([fix.stamp for fix in found.posed]), poses
        errors = evaluate(estimate, self.truth)
        return {
            "success": errors.success, "false_frames": errors.false_frames, "first_fix_m": errors.first_fix_m,
            "posed": errors.posed, "frames": errors.frames, "ms": 1e3 * float(np.median(found.seconds)),
            "e_t": errors.translation.mean if errors.translation else None,
            "e_r": errors.rotation.mean if errors.rotation else None,
        }  # fmt: skip


@dataclass(frozen=True)
class LocalizerChoice:
    """The whole localizer with some choices changed.

    Attributes:
        config: of the localizer.
        changed: makes the change in the code, until it ends.
        channels: of the map's descriptors; none: its own.
    """

    config: LocalizerConfig = field(default_factory=LocalizerConfig)
    changed: Callable[[], AbstractContextManager[Any]] = nullcontext
    channels: tuple[Channel, ...] = ()


def unverified() -> AbstractContextManager[Any]:
    """Accept the first keyframe's best place that registers."""

    def verdict(scored: Any, leader: Hypothesis | None, *_: Any) -> tuple[State, str]:
        return (State.SEARCHING, "no place") if leader is None else (State.TRACKING, "not verified")

    return patch.object(acceptance, "_verdict", verdict)


def uncalibrated() -> AbstractContextManager[Any]:
    """Believe sensor and odometry as they are."""
    exact = Calibration(sigma_tilt=np.radians(0.15), sigma_scale=0.003, sigma_turn=np.radians(0.005))

    def apply(estimator: CalibrationEstimator) -> None:
        estimator.calibration = exact

    return patch.object(CalibrationEstimator, "_apply", apply)


class TableVote:
    """Vote of z-scores (M, S), lower is better, at every station and shift; the best ``count`` are candidates."""

    def __init__(self, centre: Floats, scores: Floats32, count: int = 4000) -> None:
        self.centre, self.scores, self.count = centre, scores, count

    @classmethod
    def of_distances(cls, centre: Floats, volumes: Sequence[Floats32]) -> TableVote:
        """Average the standardised distances (M, S) of the channels, whose raw distances are not comparable."""
        scores = [robust_zscore(volume) for volume in volumes]
        return cls(centre, sum(scores[1:], start=scores[0]) * np.float32(1.0 / len(scores)))

    @property
    def sectors(self) -> int:
        """Number of shifts S."""
        return int(self.scores.shape[1])

    def candidates(self) -> tuple[Ints, Ints]:
        """Return stations and shifts (K,) of the best scores."""
        station, shift = np.divmod(argsmallest(self.scores.ravel(), self.count), self.sectors)
        return station, shift

    def at(self, stations: Ints, shifts: Ints) -> Floats32:
        """Look up z-scores (K,); 0 for station -1."""
        return np.where(stations < 0, np.float32(0.0), self.scores[stations, shifts])

    def at_all(self, requests: Sequence[tuple[TableVote, Ints, Ints]]) -> list[Floats32]:
        """Return the result of :meth:`at` for each request."""
        return [vote.at(stations, shifts) for vote, stations, shifts in requests]


def robust_zscore(volume: Floats32) -> Floats32:
    """Return the robust standard deviations (M, S) by which each distance exceeds the median; negative is better."""
    every = max(1, volume.size // _SAMPLE)
    sample = volume[::every].ravel()
    median = np.median(sample)
    deviation = np.float32(1.4826 * np.median(np.abs(sample - median)) + 1e-6)
    return np.asarray((volume - median) * np.float32(1.0 / deviation), dtype=np.float32)


def right(T_map_odom: Pose, seen: KeyframeView) -> bool:
    """Return whether a hypothesis puts the keyframe at its true place and heading, regardless of height."""
    found, true = (transform(T, seen.position[None])[0] for T in (T_map_odom, seen.T_map_odom))
    turn = wrap_angle(yaw_of(T_map_odom) - yaw_of(seen.T_map_odom))
    return bool(np.hypot(*(found - true)[:2]) < NEAR and abs(turn) < ALIGNED)
