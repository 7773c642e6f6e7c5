"""Runs with odometry computed in a first pass over their clouds, and runs without odometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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

_PERIOD = 0.1  # seconds between frames without stamps
_MIN_WALLS = 15  # patches; with fewer the slope of the ground decides the vertical


def open_lidar_run(
    path: Path,
    lidar: LidarOdometry | None = None,
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    progress: Progress | None = None,
    mount: Mount | None = None,
) -> Run:
    """Open a run like :func:`~coview_stream.recordings.open_run.open_run`, with odometry computed from its clouds.

    Frames in files count as deskewed; their stamps come from ``times.txt``, ``odometry.tum`` or MulRan's names, else
    they are 0.1 s apart. Frames that odometry cannot place are left out and counted in the notes.

    Raises:
        RunError: no frames, or odometry could place none. DependencyError: kiss-icp is missing.
    """
    if odometry_topic is not None:
        raise RunError(f"{path}: --odometry kiss-icp and --odometry-topic {odometry_topic}; give one of them")
    bag = find_bag(path)
    if bag is None and cloud_topic is not None and path.exists():
        raise RunError(f"{path}: is not a ROS recording and has no topics; leave --cloud-topic out")
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

    placed, poses, notes = _place_all(path, lidar, len(run), place, progress)
    files = tuple(run.frames_paths[index] for index in placed)
    return Run(path, files, run.stamps[placed], poses, notes=(*run.notes, *notes), mount=mount)


def _of_bag(
    bag: Path, lidar: LidarOdometry | None, topic: str | None, progress: Progress | None, mount: Mount | None
) -> Run:
    odometry = lidar or LidarOdometry()
    notes: list[str] = []

    def track(clouds: BagClouds) -> Track:
        def place(index: int) -> Pose:
            message = clouds.message(index)
            return odometry.step(message.points, message.times, message.stamp_ns * 1e-9)

        placed, poses, remarks = _place_all(bag, odometry, len(clouds.stamps), place, progress)
        notes.extend(remarks)
        return Track(clouds.stamps[placed], poses)

    run = open_bag(bag, None, topic, None, track, mount)
    return replace(run, notes=(*notes, *run.notes))


def _place_all(
    path: Path, lidar: LidarOdometry, count: int, place: Callable[[int], Pose], progress: Progress | None = None
) -> tuple[list[int], Poses, list[str]]:
    """Place ``count`` frames; return their indices, poses (K, 4, 4) odometry <- body, and notes. RunError for none."""
    placed, poses, failed = [], [], []
    for index in range(count):
        try:
            poses.append(place(index))
            placed.append(index)
        except (CloudError, RunError) as error:
            failed.append(str(error))
        if progress is not None:
            progress(index + 1, count)
    if not placed:
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
        notes.append(f"{path}: lidar odometry began anew {lidar.restarts} times; poses of those stretches are missing")
    return placed, np.array(poses), notes


def open_bare_run(path: Path, cloud_topic: str | None = None, mount: Mount | None = None) -> Run:
    """Open a run like :func:`~coview_stream.recordings.open_run.open_run`, but with the identity for every pose.

    Stamps of frames in files come from ``times.txt``, ``odometry.tum`` or MulRan's names, else they are 0.1 s apart.
    Clouds of recordings are not deskewed.

    Raises:
        RunError: no frames, or stamps that do not match.
    """
    if (bag := find_bag(path)) is not None:
        return open_bag(bag, None, cloud_topic, None, lambda clouds: Track(clouds.stamps, clouds.poses), mount)
    layout = find_layout(path)
    stamps = read_stamps(layout)
    notes: tuple[str, ...] = ()
    if stamps is None:
        stamps = _PERIOD * np.arange(len(layout.frames), dtype=np.float64)
        notes = (f"{path}: no times.txt; frames are taken for {_PERIOD:g} s apart",)
    identities = np.tile(np.eye(4), (len(stamps), 1, 1))
    return Run(path, layout.frames, stamps, identities, notes=notes, mount=mount)
