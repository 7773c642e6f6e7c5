"""Localized runs: a recorded run with the results of ``locate``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config.mount import Mount
from coview_stream.errors import CloudError, InputError, warn
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.geometry.transforms import Points, Pose, Poses, inverse, pose_from, transform
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.odometry_history import OdometryHistory
from coview_stream.localization.frame import OdometryCorrection
from coview_stream.localization.smoothing import PoseKind
from coview_stream.recordings.run import Run

_SAME_STAMP = 5e-4  # seconds; trajectories have microseconds, and frames are at least milliseconds apart
_MAX_RESULT = 1 << 28  # bytes of a result.json


@dataclass(frozen=True)
class RunPair:
    """A recorded run and the results of ``locate`` for it."""

    run: Path  # path of the run
    out: Path  # output directory of locate, or a trajectory (TUM, map <- body)

    @property
    def trajectory(self) -> Path:
        """The trajectory's file."""
        return self.out / "trajectory.tum" if self.out.is_dir() else self.out

    @property
    def result(self) -> Path:
        """The ``result.json`` next to the trajectory, which may be absent."""
        return self.trajectory.with_name("result.json")


def parse_pair(text: str) -> RunPair:
    """Parse ``RUN:OUT``; InputError unless exactly one split of the text at a colon gives two existing paths."""
    ways = [k for k, letter in enumerate(text) if letter == ":" and 0 < k < len(text) - 1]
    if not ways:
        raise InputError(f"{text}: write RUN:OUT, the run and the results of `coview-stream locate RUN -o OUT`")
    pairs = [RunPair(Path(text[:k]), Path(text[k + 1 :])) for k in ways]
    there = [pair for pair in pairs if pair.run.exists() and pair.out.exists()]
    if len(there) > 1:
        raise InputError(f"{text}: can be parted in {len(there)} ways, and each names files; rename one of them")
    if not there:
        pair = next((pair for pair in pairs if pair.run.exists()), pairs[0])
        absent = pair.out if pair.run.exists() else pair.run
        raise InputError(f"{text}: there is no {absent}; write RUN:OUT, the run and the results of `locate`")
    return there[0]


@dataclass(frozen=True)
class PosedFrame:
    """One frame of a run on the map."""

    stamp: float  # seconds
    points: Points  # (N, 3) float32 in the body frame, levelled, metres
    T_map_body: Pose  # (4, 4), relative to the map's origin
    eye: Floats  # (3,) of the lidar in the body frame, levelled


class LocalizedRun:
    """Run with poses on the map; frames are read on demand. Poses bridged by odometry alone are left out.

    Attributes:
        pair: paths of the run and of its results.
        stamps: (K,) stamps of the frames with a pose, seconds.
        poses: (K, 4, 4) map <- body, in the coordinates of the map's sources.
        without_pose: number of frames without a pose.
        damaged: indices of frames that could not be read so far.
    """

    def __init__(
        self, pair: RunPair, base_map: BaseMap, open_it: Callable[[Path, Mount | None], Run], cloud_delay: float = 0.0
    ) -> None:
        """Read the results, then open the run with ``open_it`` (its path, the mount of ``locate``).

        ``cloud_delay``, the seconds by which clouds are stamped later than odometry, is for results that lack it.

        Raises:
            InputError: the results are of another map, no frame has a pose, or files cannot be read.
        """
        self.pair = pair
        if not pair.trajectory.is_file():
            raise InputError(f"{pair.out}: holds no trajectory.tum; name the results of `coview-stream locate`")
        stamps, poses = read_tum(pair.trajectory)
        result = _read_result(pair.result)
        _check_map(pair, result, base_map)
        measured = ~_bridged(stamps, result)
        stamps, poses = stamps[measured], poses[measured]
        calibration = _part(result, "calibration")
        names = ("roll_deg", "pitch_deg", "odometry_turn_deg_per_m", "heading_deg")
        roll, pitch, turn, heading = np.radians([_number(calibration, name) for name in names]).tolist()
        lever = _number(calibration, "lever_x_m"), _number(calibration, "lever_y_m")
        scale, delay = (
            _number(calibration, "odometry_scale", 1.0) - 1.0,
            _number(calibration, "clouds_late_s", cloud_delay),
        )
        self._calibration = Calibration(
            roll, pitch, scale, turn, heading=heading, lever_x=lever[0], lever_y=lever[1], delay=delay
        )
        mount = _part(result, "mount")
        self._run = open_it(pair.run, _mount(mount) if mount else None)
        self._origin = base_map.origin
        self.damaged: set[int] = set()
        self._index, at = _matched(self._run.stamps, stamps)
        self.stamps, self.poses = self._run.stamps[self._index], poses[at]
        self.without_pose = len(self._run) - len(self._index)
        if not len(self._index):
            why = f"none at a stamp of {pair.run}" if len(stamps) else "none at all: the run was not localized"
            raise InputError(f"{pair.trajectory}: holds poses: {why}; leave it out, or name the right run")

    def __len__(self) -> int:
        """Return the number of frames with a pose."""
        return len(self._index)

    @property
    def odometry(self) -> Poses:
        """Odometry (K, 4, 4) of these frames, metres, with the last correction of scale and heading by ``locate``."""
        correction = OdometryCorrection()
        corrected = np.array([correction.correct(T, self._calibration) for T in self._run.poses])
        return np.asarray(corrected[self._index])

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks of the run's reader, one line each."""
        return self._run.notes

    def frames(self, wanted: Callable[[int], bool] | None = None) -> Iterator[PosedFrame | None]:
        """Yield the frames with a pose, in order; None for damaged frames and frames that ``wanted`` refuses."""
        lever = np.zeros(3) if self._run.mount is None else self._run.mount.T_body_sensor[:3, 3]
        history = OdometryHistory.of(self._run.stamps, self._run.poses)
        since = history.since_clouds(self.stamps, self._calibration.delay, self._calibration.scale)
        for k, index in enumerate(self._index):
            if wanted is not None and not wanted(k):
                yield None
                continue
            try:
                frame = self._run.read(int(index), self._calibration.sweep)
            except CloudError:
                self.damaged.add(int(index))
                yield None
                continue
            finite = frame.points[np.isfinite(frame.points).all(axis=1)]
            points = self._calibration.level(finite)
            # a single scan may lie far from the zero of its file, and the pose is in the file's coordinates
            T = self.poses[k] @ inverse(since[k]) @ pose_from(np.eye(3), frame.origin)
            T[:3, 3] -= self._origin
            eye = transform(self._calibration.T_body_cloud, lever[None])[0]
            yield PosedFrame(float(self.stamps[k]), points, T, eye)


def _matched(frames: Floats, stamps: Floats) -> tuple[Any, Any]:
    """Return the indices of frames and poses with equal stamps."""
    if not len(stamps):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    after = np.clip(np.searchsorted(stamps, frames), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    nearest = np.where(np.abs(stamps[before] - frames) <= np.abs(stamps[after] - frames), before, after)
    same = np.abs(stamps[nearest] - frames) <= _SAME_STAMP
    return np.flatnonzero(same), nearest[same]


def _bridged(stamps: Floats, result: dict[str, Any]) -> Bools:
    """Mask the poses (N,) in stretches that ``locate --smooth`` bridged."""
    stretches, bridged = result.get("smoothed"), np.zeros(len(stamps), dtype=bool)
    for stretch in stretches if isinstance(stretches, list) else ():
        if isinstance(stretch, dict) and stretch.get("kind") == PoseKind.BRIDGED:
            first, last = (_number(stretch, name, math.nan) for name in ("first_stamp", "last_stamp"))
            bridged |= (stamps > first - _SAME_STAMP) & (stamps < last + _SAME_STAMP)
    return bridged


def _read_result(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        if path.stat().st_size > _MAX_RESULT:
            raise ValueError("too large")
        result = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as a result of `locate` ({error}); run it again") from error
    if not isinstance(result, dict):
        raise InputError(f"{path}: is not a result of `locate`; run it again")
    return result


def _check_map(pair: RunPair, result: dict[str, Any], base_map: BaseMap) -> None:
    sha = result.get("map_sha256")
    if not isinstance(sha, str) or not sha:
        warn(f"{pair.out}: does not say which map it was localized on; taken for the one given")
    elif base_map.sha256 and sha != base_map.sha256:
        raise InputError(
            f"{pair.result}: localized on another map ({sha[:8]}, not {base_map.sha256[:8]}); "
            f"run `coview-stream locate` with this one"
        )


def _part(result: dict[str, Any], name: str) -> dict[str, Any]:
    value = result.get(name)
    return value if isinstance(value, dict) else {}


def _mount(values: dict[str, Any]) -> Mount:
    """Read :meth:`Mount.to_json`, also in the form of earlier versions: radians, names without units."""
    angles, metres = ("roll", "pitch", "yaw"), ("x", "y", "z")
    roll, pitch, yaw = (math.radians(_number(values, f"{name}_deg")) or _number(values, name) for name in angles)
    x, y, z = (_number(values, f"{name}_m") or _number(values, name) for name in metres)
    return Mount(roll, pitch, yaw, x, y, z)


def _number(values: dict[str, Any], name: str, otherwise: float = 0.0) -> float:
    value = values.get(name, otherwise)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else otherwise
