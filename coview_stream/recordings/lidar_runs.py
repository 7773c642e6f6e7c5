"""Runs without odometry: a first pass over the clouds makes it, and they are read again where they are used."""

# FOLDED coview_stream/recordings/lidar_runs.py: """Runs whose odometry is missing, or not wanted: frames and stamps, and no poses worth the name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.transforms import Pose, Poses
from coview_stream.odometry.lidar_odometry import LidarOdometry
from coview_stream.recordings.bags import BagClouds, open_bag
from coview_stream.recordings.layouts import find_bag, find_layout, read_stamps
from coview_stream.recordings.odometry_track import Track
from coview_stream.recordings.run import Run, of_bag, single

Progress = Callable[[int, int], None]
"""Called with (frames done, frames)."""

_FEW_WALLS = 15  # patches: with fewer the slope of the ground decides


@dataclass(frozen=True)
class Followed:
    """Which frames have a pose, the poses (K, 4, 4) odometry <- body, and remarks for people."""

    kept: list[int]
    poses: Poses
    notes: tuple[str, ...]


def open_lidar_run(
    path: Path,
    lidar: LidarOdometry | None = None,
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    progress: Progress | None = None,
) -> Run:
    """Open a run as :func:`~coview_stream.recordings.open_run.open_run` does, with odometry made of its clouds.

    Frames in files are taken for deskewed, as ever; their stamps are those of ``times.txt``, of an
    ``odometry.tum`` that lies there, or else 0.1 s apart. Frames that odometry cannot place are left out, and notes say
    why.

    Raises:
        RunError: no frames, or none that odometry could place. DependencyError: kiss-icp is missing.
    """
    if odometry_topic is not None:
        raise RunError(f"{path}: --odometry kiss-icp and --odometry-topic {odometry_topic}; give one of them")
    bag = find_bag(path)
    if bag is None and cloud_topic is not None and path.exists():
        raise RunError(f"{path}: is no ROS recording and has no topics; leave --cloud-topic out")
    if bag is not None:
        return _of_bag(bag, lidar, cloud_topic, progress)
    layout = find_layout(path)
    if len(layout.frames) == 1:
        return single(layout)
    lidar = lidar or LidarOdometry()
    run = open_bare_run(path)

    def place(index: int) -> Pose:
        frame = run.read(index)
        return lidar.step(frame.points, None, frame.stamp)

    followed = follow(path, lidar, len(run), place, progress)
    files = tuple(run.frames_paths[index] for index in followed.kept)
    return Run(path, files, run.stamps[followed.kept], followed.poses, notes=(*run.notes, *followed.notes))


def _of_bag(bag: Path, lidar: LidarOdometry | None, topic: str | None, progress: Progress | None) -> Run:
    odometry = lidar or LidarOdometry()
    notes: list[str] = []

    def track(clouds: BagClouds) -> Track:
        def place(index: int) -> Pose:
            message = clouds.message(index)
            return odometry.step(message.points, message.times, message.stamp_ns * 1e-9)

        followed = follow(bag, odometry, len(clouds.stamps), place, progress)
        notes.extend(followed.notes)
        return Track(clouds.stamps[followed.kept], followed.poses)

    opened = open_bag(bag, None, topic, None, track)
    run = of_bag(bag, opened)
    return Run(bag, run.frames_paths, run.stamps, run.poses, run.source, (*notes, *run.notes))


def follow(
    path: Path,
    lidar: LidarOdometry,
    count: int,
    place: Callable[[int], Pose],
    progress: Progress | None = None,
) -> Followed:
    """Place ``count`` frames one after the other, whatever of them can be.

    Raises:
        RunError: not one could be; the message ends with the first one's.
    """
    kept, poses, failed = [], [], []
    for index in range(count):
        try:
            poses.append(place(index))
            kept.append(index)
        except (CloudError, RunError) as error:
            failed.append(str(error))
        if progress is not None:
            progress(index + 1, count)
    if not kept:
        raise RunError(f"{path}: lidar odometry could place not one of {count} frames; first: {failed[0]}")
    notes = []
    if lidar.ground is not None:
        ground = lidar.ground
        lean = np.degrees(np.arccos(np.clip(ground.up[2], -1.0, 1.0)))
        sure = ground.walls >= _FEW_WALLS
        slope = "" if sure else "; it is off by the slope, if there is one: --gravity says better"
        notes.append(
            f"{path}: down is taken from the ground, {ground.height:.1f} m below the sensor, and {ground.walls} "
            f"patches of wall: the sensor leans {lean:.1f} deg{slope}"
        )
    if failed:
        notes.append(
            f"{path}: lidar odometry could not place {len(failed)} of {count} frames; first: {failed[0]}"
        )
    if lidar.restarts:
        notes.append(
            f"{path}: lidar odometry began anew {lidar.restarts} times; what was driven there is missing"
        )
    return Followed(kept, np.array(poses), tuple(notes))


_PERIOD = 0.1  # seconds between frames that nobody has dated


def open_bare_run(path: Path, cloud_topic: str | None = None) -> Run:
    """Open a run as :func:`~coview_stream.recordings.open_run.open_run` does, but for its odometry: all poses are the identity.

    Stamps of frames in files are those of ``times.txt``, of an ``odometry.tum`` that lies there, or else 0.1 s apart.
    Clouds of recordings are not deskewed.

    Raises:
        RunError: no frames, or stamps that do not fit.
    """
    if (bag := find_bag(path)) is not None:
        from coview_stream.recordings.bags import open_bag  # as in open_run: bags build on the live decoders

        return of_bag(bag, open_bag(bag, None, cloud_topic, None, lambda clouds: _nowhere(clouds.stamps)))
    layout = find_layout(path)
    told = read_stamps(layout)
    notes = () if told is not None else (f"{path}: no times.txt; frames are taken for {_PERIOD:g} s apart",)
    stamps = _PERIOD * np.arange(len(layout.frames), dtype=np.float64) if told is None else told
    return Run(path, layout.frames, stamps, _identities(len(stamps)), notes=notes)


def _nowhere(stamps: np.ndarray) -> Track:
    return Track(stamps, _identities(len(stamps)))


def _identities(count: int) -> Poses:
    return np.tile(np.eye(4), (count, 1, 1))
