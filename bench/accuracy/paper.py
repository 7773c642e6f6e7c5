"""The first paper's method as printed, from keyframes to a pose: its row in the accuracy tables. Only the bench has it.

X. Duan et al., Remote Sensing 16 (21), 4027, 2024. A keyframe every sigma_d = L metres; its virtual local scan (VLS) is
of the frames since the last one. Descriptors by eqs 1 to 4; stations by the nearest ring keys; distances of these at
all shifts (eqs 5 to 9); the smallest of all keyframes names the place (eqs 10 to 12). VLS points at heights where the
map has none are removed, and point-to-point ICP trimmed to 60 % ends it (eq. 13). Nothing is verified: every run gets a
pose. It is judged at the keyframe that has named it, for the paper has no tracking.

Where the paper leaves room, the reading is in its favour: heights are above the ground on both sides, eq. 12 turns
about the keyframe, columns that are empty on either side cost 1, stations are the product's.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import coview_kernels as kernels
from bench.harness.rows import listed, number
from coview_stream import BaseMap
from coview_stream.basemap.stations import describe_storeys
from coview_stream.config import Channel, DescriptorConfig
from coview_stream.descriptors.coview import describe, on_ground
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    Poses,
    inverse,
    pose_from,
    rot_z,
    rotation_angle,
    to_local,
    transform,
)
from coview_stream.recordings.run import Run
from coview_stream.report.evaluation import MAX_ROTATION, MAX_TRANSLATION

CHANNEL: Channel = "paper"
BLOCK, OVERLAP = 2.0, 0.6
"""Metres of L = sigma_d, and the share of pairs that trimmed ICP keeps; radius, rings and sectors are the defaults."""

WAYS: dict[str, int | None] = {"the paper": 1, "the paper, ten nearest keys": 10, "the paper, all stations": None}
"""Stations that are compared, nearest in ring key; the published program compares all."""

_FRAME_VOXEL, _NEAR = 0.25, 0.5  # metres, as the product's keyframes
_ITERATIONS, _STOP_SHIFT, _STOP_TURN = 100, 1e-4, 1e-5  # metres, radians
_LEVEL = 1.0  # metres of height within which a map point makes a VLS point consistent


@dataclass(frozen=True)
class LocalScan:
    """Virtual local scan of a keyframe, in the odometry frame, metres."""

    points: Points  # (N, 3)
    centre: Floats  # (3,) on the ground
    index: int = 0  # of the keyframe's frame

    @classmethod
    def of(cls, points: Points, position: Floats, voxel: float, index: int = 0) -> LocalScan:
        """Thin the points to one per voxel, and find the ground below the sensor's ``position`` (3,)."""
        thin = kernels.transform_unique(points, np.eye(4), voxel, 0.0)[0]
        return cls(thin, on_ground(thin, position), index)


def local_scans(run: Run, sigma_d: float = BLOCK) -> Iterator[LocalScan]:
    """Yield a VLS every ``sigma_d`` metres of odometry, of the frames since the last; also one of the first frame.

    Coordinates are relative to the first frame's position.
    """
    pending: list[Points] = []
    last = None
    for index in range(len(run)):
        try:
            frame = run.read(index)
        except (CloudError, RunError):  # damaged, as some frames of dirty runs are
            continue
        T = to_local(frame.T_odom_body, run.poses[0][:3, 3])
        pending.append(kernels.transform_unique(frame.points, T, _FRAME_VOXEL, _NEAR)[0])
        if last is None or np.linalg.norm(T[:3, 3] - last) >= sigma_d:
            last = T[:3, 3]
            yield LocalScan.of(np.concatenate(pending), last, DescriptorConfig().voxel, frame.index)
            pending = []


def ring_key(descriptor: Floats32) -> Floats32:
    """Return the rotation-invariant key (..., R): share of occupied (non-zero) sectors of every ring."""
    return np.asarray((descriptor != 0).mean(axis=-1, dtype=np.float32))


def unit_columns(descriptor: Floats32) -> Floats32:
    """Scale the columns of descriptors (..., R, S) to length 1; empty columns stay zero."""
    length = np.linalg.norm(descriptor, axis=-2, keepdims=True)
    return np.asarray(descriptor / np.where(length > 0, length, 1.0), dtype=np.float32)


def distances(stations: Floats32, query: Floats32) -> Floats32:
    """Return eq. 7 (K, S) of stations (K, R, S) and a query (R, S) turned by n sectors, n < S; columns of length 1."""
    sectors = query.shape[-1]
    turned = np.stack([np.roll(query, n, axis=-1).ravel() for n in range(sectors)])
    return np.asarray(1.0 - stations.reshape(len(stations), -1) @ turned.T / sectors, dtype=np.float32)


class Reference:
    """Virtual reference scans of a map: descriptors, their ring keys in a KD-tree, and the map's points."""

    def __init__(self, base_map: BaseMap, block: float = BLOCK, stations: Floats32 | None = None) -> None:
        """Describe the map's stations, or others, ``block`` metres apart."""
        self.config = DescriptorConfig(channels=(CHANNEL,))
        self.points = np.array(base_map.points)
        chosen = np.array(base_map.stations) if stations is None else stations
        self.stations = chosen.astype(np.float64)
        described = describe_storeys(self.points, chosen, block, self.config)
        descriptors = np.asarray(described[self.config.channels[0]], dtype=np.float32)
        self.keys = cKDTree(ring_key(descriptors))
        self.columns = unit_columns(descriptors)

    def describe(self, scan: LocalScan) -> Floats32:
        """Return the descriptor (R, S) of a VLS."""
        return describe(scan.points, scan.centre, self.config)[self.config.channels[0]]

    def nearest(self, descriptor: Floats32, count: int | None) -> Ints:
        """Return the stations (K,) nearest in ring key; None: all."""
        if count is None:
            return np.arange(len(self.stations))
        return np.atleast_1d(self.keys.query(ring_key(descriptor), k=count)[1]).astype(np.int64)

    def match(self, scan: LocalScan, count: int | None) -> tuple[float, Pose]:
        """Return the smallest distance (eqs 7 to 9) and its ``T_map_odom`` (4, 4) by eq. 12 about the keyframe."""
        descriptor = self.describe(scan)
        stations = self.nearest(descriptor, count)
        found = distances(self.columns[stations], unit_columns(descriptor))
        k, shift = np.unravel_index(int(found.argmin()), found.shape)
        turn = rot_z(2.0 * np.pi * float(shift) / found.shape[1])
        return float(found[k, shift]), pose_from(turn, self.stations[stations[k]]) @ pose_from(np.eye(3), -scan.centre)

    def refine(self, scan: LocalScan, T: Pose) -> Pose:
        """Register the consistent points of a VLS to the map around it from a coarse ``T_map_odom``."""
        radius, middle = self.config.radius, transform(T, scan.centre[None])[0]
        target = self.points[np.hypot(*(self.points[:, :2] - middle[:2]).T) < radius + 5.0]
        near = np.hypot(*(scan.points[:, :2] - scan.centre[:2]).T) < radius
        source = scan.points[near].astype(np.float64)
        if len(target):
            source = source[consistent(transform(T, source), target)]
        return trimmed_icp(source, target.astype(np.float64), T)


def consistent(points: Floats, target: Points) -> Bools:
    """Mask points (N, 3) within a metre of the height of some target point (M, 3) in their square of a block."""
    size = np.array([BLOCK, BLOCK, _LEVEL])
    low = np.floor(target.min(axis=0) / size).astype(np.int64) - 2
    shape = np.floor(target.max(axis=0) / size).astype(np.int64) - low + 3
    taken = np.zeros(shape, dtype=bool)
    taken[tuple((np.floor(target / size).astype(np.int64) - low).T)] = True
    taken[:, :, 1:-1] = taken[:, :, :-2] | taken[:, :, 1:-1] | taken[:, :, 2:]
    index = np.floor(points / size).astype(np.int64) - low
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    return np.asarray(inside & taken[tuple(np.where(inside[:, None], index, 0).T)])


def trimmed_icp(source: Floats, target: Floats, T: Pose, overlap: float = OVERLAP) -> Pose:
    """Return ``T_target_source`` (4, 4) by point-to-point ICP of the nearest ``overlap`` of all pairs (eq. 13).

    Too few points leave it as it was.
    """
    count = int(overlap * len(source))
    if count < 3 or not len(target):
        return T
    tree = cKDTree(target)
    for _ in range(_ITERATIONS):
        moved = transform(T, source)
        apart, nearest = tree.query(moved)
        kept = np.argpartition(apart, count - 1)[:count]
        step = rigid(moved[kept], target[nearest[kept]])
        T = step @ T
        shift = np.linalg.norm(transform(step, moved.mean(axis=0)[None])[0] - moved.mean(axis=0))
        if shift < _STOP_SHIFT and rotation_angle(step) < _STOP_TURN:
            break
    return T


def rigid(points: Floats, targets: Floats) -> Pose:
    """Return the least-squares pose (4, 4) that moves points (N, 3) onto targets (N, 3)."""
    a, b = points.mean(axis=0), targets.mean(axis=0)
    U, _, Vt = np.linalg.svd((targets - b).T @ (points - a))
    R = U * [1.0, 1.0, np.linalg.det(U @ Vt)] @ Vt  # no reflection
    return pose_from(R, b - R @ a)


Answers = dict[str, dict[str, Any]]  # by way


def located(
    base_map: BaseMap, run: Run, truth: Poses, spacing: float = BLOCK, stations: Floats32 | None = None
) -> Answers:
    """Localize a run in all ways, and judge the results by the true poses (F, 4, 4) map <- body of all frames.

    L = sigma_d is ``spacing``, metres; for another than the map's give the ``stations`` (M, 3).

    Returns by way: whether it succeeded (5 degrees and 3 m), errors after and metres before refinement, and times.
    """
    reference, scans, out = Reference(base_map, spacing, stations), list(local_scans(run, spacing)), Answers()
    for way, count in WAYS.items():
        begin = time.perf_counter()
        matches = [reference.match(scan, count) for scan in scans]
        searched = time.perf_counter() - begin
        best = min(range(len(scans)), key=lambda k: matches[k][0])
        coarse = matches[best][1]
        fine = reference.refine(scans[best], coarse)
        T_odom_body = to_local(run.poses[scans[best].index], run.poses[0][:3, 3])
        true = to_local(truth[scans[best].index], base_map.origin)
        e_t, e_r = errors(fine @ T_odom_body, true)
        out[way] = {
            "success": bool(e_t < MAX_TRANSLATION and e_r < np.degrees(MAX_ROTATION)), "e_t": e_t, "e_r": e_r,
            "coarse_m": errors(coarse @ T_odom_body, true)[0], "distance": matches[best][0],
            "keyframe_ms": 1e3 * searched / len(scans), "seconds": time.perf_counter() - begin,
        }  # fmt: skip
    return out


def errors(T: Pose, truth: Pose) -> tuple[float, float]:
    """Return metres and degrees between two poses (eqs 15 and 16)."""
    return float(np.linalg.norm(T[:3, 3] - truth[:3, 3])), float(np.degrees(rotation_angle(T @ inverse(truth))))


COLUMNS = tuple((head, head, None) for head in ("method", "right", "false", "e_t m", "e_r deg", "keyframe ms", "run s"))
AUTHORS = dict(zip(
    (head for head, *_ in COLUMNS),
    ("the authors' figures: other data, Cortex-A55", "28 of 30", "2 of 30", "0.10 to 0.30", "0.05 to 0.66", "52", "-"),
    strict=True,
))  # fmt: skip
"""Published: 30 runs, mean errors of three scenes, the search of 9,527 stations."""


def in_words(answers: Answers) -> dict[str, str]:
    """Return by way ``0.31 m, 0.2 deg``, or ``false``."""
    return {
        way: f"{answer['e_t']:.2f} m, {answer['e_r']:.1f} deg" if answer["success"] else "false"
        for way, answer in answers.items()
    }


def compared(ours: Sequence[Mapping[str, Any]], outside: Sequence[Mapping[str, Any]] = ()) -> str:
    """Table of ours beside the paper's ways and the authors' figures.

    Args:
        ours: of each run: ``success``, ``false_frames``, mean errors ``e_t`` and ``e_r`` if it succeeded, ``locate_s``,
            and the ``paper``'s answers.
        outside: runs on the map of another place besides, without the last: there each pose is false.
    """
    answers = [run["paper"] for run in ours]

    def row(name: str, runs: Sequence[Mapping[str, Any]], false: int, ms: float, seconds: str) -> dict[str, str]:
        right = [run for run in runs if run["success"]]
        means = (float(np.mean([run[key] for run in right])) if right else np.nan for key in ("e_t", "e_r"))
        median = float(np.median([run[seconds] for run in runs]))
        shares = f"{len(right)} of {len(runs)}", f"{false} of {len(runs) + len(outside)}"
        cells = name, *shares, *(number(mean, 3) for mean in means), number(ms, 0), number(median, 1)
        return dict(zip((head for head, *_ in COLUMNS), cells, strict=True))

    rows = [row("coview_stream", ours, sum(run["false_frames"] > 0 for run in (*ours, *outside)), np.nan, "locate_s")]
    for way in WAYS:
        runs = [answer[way] for answer in answers]
        wrong = sum(not run["success"] for run in runs) + len(outside)
        rows.append(row(way, runs, wrong, float(np.median([run["keyframe_ms"] for run in runs])), "seconds"))
    return listed(COLUMNS, [*rows, AUTHORS])
