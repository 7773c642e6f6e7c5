"""What the plots of the performance page show: milliseconds over candidates, points and robots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.harness.places import base_map, places, world
from bench.harness.rows import medians
from bench.speed.engine import folder, frames_of

PERIOD_MS = 100.0
"""Between the frames of a robot, at 10 Hz."""

BEST = 20
"""Stations that matching has to name."""

SCENE = "town"

_SEARCH_FRAMES = 400  # at most, until a robot is tracked
_ROUNDS = 61


@dataclass
class Curves:
    """Milliseconds by name, at each ``x``; ``limit`` is a line that says how much is allowed."""

    title: str
    axis: str
    x: Sequence[int]
    milliseconds: dict[str, list[float]] = field(default_factory=dict)
    limit: tuple[float, str] | None = None


def candidates(quick: bool = False) -> Curves:
    """One keyframe with 1,000 to 100,000 stations at all 60 shifts; the best 20 are asked for.

    Stations are those of the town's map; beyond their number, halves of two of them, turned. The query is a keyframe
    of its run. Index, spectra and transposed descriptors are made beforehand.
    """
    import coview_kernels as kernels

    sizes = [1_000, 3_000] if quick else [1_000, 3_000, 10_000, 30_000, 100_000]
    out = Curves("Matching one query at all shifts", "stations", sizes)
    stations, query = _stations(max(sizes))
    found = []
    for size in sizes:
        some = stations[:size]
        index, spectra = kernels.MatchIndex(some), kernels.column_spectra(some)
        columns = np.ascontiguousarray(kernels.unit_columns(some).reshape(size, -1).T)
        turned = np.stack([np.roll(kernels.unit_columns(query), n, axis=1) for n in range(query.shape[1])])
        turned = turned.reshape(len(turned), -1) / query.shape[1]
        found.append(
            medians(
                partial(index.top_k, query, BEST),
                partial(_best_of_spectra, query, spectra),
                partial(_best_of_product, turned, columns),
            )
        )
    names = ("coview_stream, pruned", "spectra, BLAS", "one product of turned queries, BLAS")
    out.milliseconds = dict(zip(names, map(list, zip(*found, strict=True)), strict=True))
    return out


def points(quick: bool = False) -> Curves:
    """Frames of 4,096 to 131,072 points: transform, range filter, voxels, polar bins (:mod:`bench.intake`)."""
    from bench.speed.intake import _BINS as BINS
    from bench.speed.intake import _LIMITS as LIMITS
    from bench.speed.intake import best_numpy, frame, pose
    from coview_kernels import FrameIntake

    sizes = [4_096, 16_384] if quick else [4_096, 8_192, 16_384, 32_768, 65_536, 131_072]
    out = Curves("Taking in a frame", "points of the frame", sizes)
    both, T, order = np.concatenate([frame(0), frame(1)]), pose(), np.random.default_rng(0)
    found = []
    for size in sizes:
        part = both[np.sort(order.choice(len(both), size, replace=False))]
        take = FrameIntake(*LIMITS, BINS)
        found.append(medians(partial(take, part, T), partial(best_numpy, part, T)))
    ours, numpy = zip(*found, strict=True)
    out.milliseconds = {"coview_stream": list(ours), "NumPy, one sort": list(numpy)}
    return out


def robots(quick: bool = False) -> Curves:
    """One round of frames, one of each robot in turn, of robots that share a map and its crops in one process."""
    counts = (1, 2) if quick else (1, 2, 4, 8, 16)
    out = Curves("Tracking several robots on one map", "robots in one process", counts)
    out.limit = (PERIOD_MS, "period of 10 Hz")
    fleet = _fleet(world(folder(), SCENE), max(counts))
    median, worst = [], []
    for count in counts:
        rounds = np.array([_round(fleet[:count]) for _ in range(11 if quick else _ROUNDS)])
        median.append(float(np.median(rounds)))
        worst.append(float(np.percentile(rounds, 95)))
    out.milliseconds = {"a round of frames, median": median, "95th percentile": worst}
    return out


def _stations(count: int) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.float32]]:
    """Descriptors (count, R, S) and a query (R, S)."""
    from coview_stream.place.descriptor import describe, ground_below

    world(folder(), SCENE)
    site, rng = base_map(folder(), SCENE), np.random.default_rng(0)
    channel = site.descriptor_config.channels[0]
    known = np.array(site.descriptors(channel))[rng.permutation(len(site))]
    newest = places(folder(), SCENE, 1)[0].queries[-1]
    centre = newest.position.copy()
    centre[2] = ground_below(newest.scan, newest.position)
    query = describe(newest.scan, centre, site.descriptor_config)[channel]
    parts, half = [known[:count]], known.shape[2] // 2
    while sum(map(len, parts)) < count:
        turns = rng.integers(0, known.shape[2], len(known))
        sectors = (np.arange(half) + turns[:, None]) % known.shape[2]
        made = known[rng.permutation(len(known))]
        other = known[rng.permutation(len(known))]
        np.put_along_axis(made, sectors[:, None], np.take_along_axis(other, sectors[:, None], axis=2), axis=2)
        parts.append(made)
    return np.concatenate(parts)[:count], query


def _best_of_spectra(
    query: npt.NDArray[np.float32], spectra: npt.NDArray[np.complex64]
) -> npt.NDArray[np.intp]:
    import coview_kernels as kernels

    distance = kernels.all_shift_distance(query, spectra, query.shape[1]).min(axis=1)
    return np.argpartition(distance, BEST)[:BEST]


def _best_of_product(
    turned: npt.NDArray[np.float32], columns: npt.NDArray[np.float32]
) -> npt.NDArray[np.intp]:
    score = (turned @ columns).max(axis=0)
    return np.argpartition(-score, BEST)[:BEST]


class _Robot:
    """A tracked robot, which drives a run to and fro."""

    def __init__(self, localizer: Any, frames: list[Any], start: int) -> None:
        self._localizer = localizer
        self._frames = frames
        self._order = [index for index, _ in frames_of(frames, 2 * len(frames) - 2)]
        self._tick = start

    def step(self) -> bool:
        """Take in the next frame; tell whether the robot is tracked."""
        index = self._order[self._tick % len(self._order)]
        self._tick += 1
        frame = self._frames[index]
        fix = self._localizer.step(frame.points, frame.T_odom_body, self._tick * PERIOD_MS / 1e3)
        return fix.T_map_body is not None


def _fleet(there: Path, count: int) -> list[_Robot]:
    """Robots that have found their places along one run, far from each other."""
    from coview_stream import Localizer, LocalizerConfig
    from coview_stream.clouds import open_run
    from coview_stream.pose.registration import LocalMaps

    site, run = base_map(folder(), SCENE), open_run(there / "run")
    frames = [run.read(index) for index in range(len(run))]
    config = LocalizerConfig()
    crops = LocalMaps(site, config.registration.source_range)
    fleet = [_Robot(Localizer(site, config, crops), frames, k * len(frames) // count) for k in range(count)]
    for robot in fleet:
        if not any(robot.step() for _ in range(_SEARCH_FRAMES)):
            raise RuntimeError("a robot has not found its place; the plot would show searches")
    return fleet


def _round(fleet: list[_Robot]) -> float:
    return medians(lambda: [robot.step() for robot in fleet], repeat=1, warm_up=0)[0]
