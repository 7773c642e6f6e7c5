"""Runs whose odometry is made of their clouds, and runs without odometry.

Lidar odometry takes a first pass over the clouds; they are read again where they are used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.transforms import Pose, Poses
from coview_stream.odometry.lidar_odometry import LidarOdometry
from coview_stream.recordings.bags import BagClouds, Track, open_bag
from coview_stream.recordings.layouts import find_bag, find_layout, read_stamps
from coview_stream.recordings.run import Run, single_frame_run

Progress = Callable[[int, int], None]
"""Called with (frames done, frames)."""

_PERIOD = 0.1  # seconds, set by hand: between frames that have no stamps
_MIN_WALLS = 15  # patches, set by hand: with fewer the slope of the ground decides


@dataclass(frozen=True)
class Placed:
    """Result of lidar odometry over a run.

    Attributes:
        kept: indices of the frames that have a pose.
        poses: (K, 4, 4) theirs, odometry <- body, metres.
        notes: remarks for people, a line each.
    """

    kept: list[int]
    poses: Poses
    notes: tuple[str, ...]


def open_lidar_run(
    path: Path,
    lidar: LidarOdometry | None = None,
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    progress: Progress | None = None,
    mount: Mount | None = None,
) -> Run:
    """Open a run as :func:`~coview_stream.recordings.open_run.open_run` does, with odometry made of its clouds.

    Frames in files count as deskewed; their stamps are those of ``times.txt``, of an ``odometry.tum`` beside them, or
    else 0.1 s apart. Frames that odometry cannot place are left out, and notes say why.

    Raises:
        RunError: no frames, or none that odometry could place. DependencyError: kiss-icp is missing.
    """
    if odometry_topic is not None:
        raise RunError(f"{path}: --odometry kiss-icp and --odometry-topic {odometry_topic}; give one of them")
    bag = find_bag(path)
    if bag is None and cloud_topic is not None and path.exists():
        raise RunError(f"{path}: is no ROS recording and has no topics; leave --cloud-topic out")
    if bag is not None:
        return _of_bag(bag, lidar, cloud_topic, progress, mount)
    layout = find_layout(path)
    if len(layout.frames) == 1:
        return single_frame_run(layout, mount)
    lidar = lidar or LidarOdometry()
    run = open_bare_run(path, mount=mount)

    def place(index: int) -> Pose:
        frame = run.read(index)
        return lidar.step(frame.points, None, frame.stamp)

    placed = _place_all(path, lidar, len(run), place, progress)
    files = tuple(run.frames_paths[index] for index in placed.kept)
    return Run(path, files, run.stamps[placed.kept], placed.poses, notes=(*run.notes, *placed.notes), mount=mount)


def _of_bag(
    bag: Path, lidar: LidarOdometry | None, topic: str | None, progress: Progress | None, mount: Mount | None
) -> Run:
    odometry = lidar or LidarOdometry()
    notes: list[str] = []

    def track(clouds: BagClouds) -> Track:
        def place(index: int) -> Pose:
            message = clouds.message(index)
            return odometry.step(message.points, message.times, message.stamp_ns * 1e-9)

        placed = _place_all(bag, odometry, len(clouds.stamps), place, progress)
        notes.extend(placed.notes)
        return Track(clouds.stamps[placed.kept], placed.poses)

    run = open_bag(bag, None, topic, None, track, mount)
    return replace(run, notes=(*notes, *run.notes))


def _place_all(
    path: Path, lidar: LidarOdometry, count: int, place: Callable[[int], Pose], progress: Progress | None = None
) -> Placed:
    """Place ``count`` frames one after the other, and leave out those that cannot be placed.

    Raises:
        RunError: none can be placed; the message ends with the first one's.
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
        reliable = ground.walls >= _MIN_WALLS
        slope = "" if reliable else "; it is off by the slope, if there is one: --gravity says better"
        notes.append(
            f"{path}: down is taken from the ground, {ground.height:.1f} m below the sensor, and {ground.walls} "
            f"patches of wall: the sensor leans {lean:.1f} deg{slope}"
        )
    if failed:
        notes.append(f"{path}: lidar odometry could not place {len(failed)} of {count} frames; first: {failed[0]}")
    if lidar.restarts:
        notes.append(f"{path}: lidar odometry began anew {lidar.restarts} times; what was driven there is missing")
    return Placed(kept, np.array(poses), tuple(notes))


def open_bare_run(path: Path, cloud_topic: str | None = None, mount: Mount | None = None) -> Run:
    """Open a run as :func:`~coview_stream.recordings.open_run.open_run` does, but with the identity for all poses.

    Stamps of frames in files are those of ``times.txt``, of an ``odometry.tum`` beside them, or else 0.1 s apart.
    Clouds of recordings are not deskewed.

    Raises:
        RunError: no frames, or stamps that do not fit.
    """
    if (bag := find_bag(path)) is not None:
        return open_bag(bag, None, cloud_topic, None, _identity_track, mount)
    layout = find_layout(path)
    stamps = read_stamps(layout)
    notes: tuple[str, ...] = ()
    if stamps is None:
        stamps = _PERIOD * np.arange(len(layout.frames), dtype=np.float64)
        notes = (f"{path}: no times.txt; frames are taken for {_PERIOD:g} s apart",)
    return Run(path, layout.frames, stamps, _identities(len(stamps)), notes=notes, mount=mount)


def _identity_track(clouds: BagClouds) -> Track:
    return Track(clouds.stamps, _identities(len(clouds.stamps)))


def _identities(count: int) -> Poses:
    return np.tile(np.eye(4), (count, 1, 1))
