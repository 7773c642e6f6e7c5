"""Runs without odometry: a first pass over the clouds makes it, and they are read again where they are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coview_stream.clouds.bag_clouds import BagClouds
from coview_stream.clouds.bags import open_bag
from coview_stream.clouds.bare import open_bare_run
from coview_stream.clouds.layout import find_bag, find_layout
from coview_stream.clouds.runs import Run, of_bag, single
from coview_stream.clouds.track import Track
from coview_stream.clouds.trajectory import Poses
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry import Pose
from coview_stream.odometry.lidar import LidarOdometry

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
    """Open a run as :func:`~coview_stream.clouds.runs.open_run` does, with odometry made of its clouds.

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
