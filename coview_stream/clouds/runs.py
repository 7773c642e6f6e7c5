"""Runs: a robot's frames with their odometry, read one frame at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.cloud import Cloud
from coview_stream.clouds.layout import Layout, find_bag, find_layout, read_odometry
from coview_stream.clouds.readers import read_cloud
from coview_stream.clouds.trajectory import Poses, Stamps
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry import Points, Pose

if TYPE_CHECKING:  # they build on this
    from coview_stream.clouds.bags import Opened
    from coview_stream.odometry.lidar import LidarOdometry
    from coview_stream.odometry.runs import Progress

KISS_ICP = "kiss-icp"
"""In place of an odometry file: make the odometry out of the clouds."""


@dataclass(frozen=True)
class Frame:
    """One scan of a run.

    Attributes:
        index: position in the run, from 0.
        stamp: seconds.
        points: (N, 3) float32 in the body frame (x forward, z up), metres, relative to ``origin``.
        T_odom_body: (4, 4), odometry <- body.
        origin: (3,) float64 metres. Zeros, except for a single terrestrial scan in map-like coordinates.
        path: the file it came from.
        dropped: rows of the file that were not usable.
    """

    index: int
    stamp: float
    points: Points
    T_odom_body: Pose
    origin: npt.NDArray[np.float64]
    path: Path
    dropped: int = 0


class CloudSource(Protocol):
    """Where the clouds of a run come from, if not from one file each."""

    def read(self, index: int) -> Cloud:
        """Frame ``index`` in the body frame at its stamp, metres; CloudError if it cannot be had."""
        ...


@dataclass(frozen=True)
class Run:
    """A validated run. Iterating reads lazily: one frame is in memory at a time.

    Attributes:
        path: the directory, the single cloud file, or the recording.
        frames_paths: (N) files in order; of a recording its path, N times.
        stamps: (N,) seconds, strictly increasing.
        poses: (N, 4, 4), odometry <- body, metres.
        source: reads the clouds of a recording; None if each is a file.
        notes: what was left out or taken for granted when the run was opened, a line each.
    """

    path: Path
    frames_paths: tuple[Path, ...]
    stamps: Stamps
    poses: Poses
    source: CloudSource | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.frames_paths)

    def __iter__(self) -> Iterator[Frame]:
        """Yield every frame in order; raises like ``read`` (use ``read`` to skip a damaged frame)."""
        return (self.read(index) for index in range(len(self)))

    def read(self, index: int) -> Frame:
        """Read frame ``index``.

        Raises:
            IndexError: there is no such frame.
            CloudError: the file is unreadable, has no usable point, or is not in the body frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path}: no frame {index} among {len(self)}")
        path = self.frames_paths[index]
        cloud = read_cloud(path) if self.source is None else self.source.read(index)
        if len(self) > 1 and cloud.origin.any():
            raise CloudError(
                f"{path}: coordinates near {cloud.origin.tolist()} cannot be in the body frame; "
                "write frames relative to the sensor"
            )
        return Frame(
            index,
            float(self.stamps[index]),
            cloud.points,
            self.poses[index],
            cloud.origin,
            path,
            cloud.dropped,
        )


def open_run(
    path: str | os.PathLike[str],
    odometry: str | os.PathLike[str] = "auto",
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    lidar: LidarOdometry | None = None,
    progress: Progress | None = None,
) -> Run:
    """Open a run and validate all but the clouds themselves.

    Layouts: ``frames/NNNNNN.{pcd,ply,bin,npy,las,laz}`` with ``odometry.tum``; KITTI (``velodyne/*.bin``,
    ``times.txt``, ``poses.txt``, and ``calib.txt`` where the poses are the camera's); one cloud file, or
    one frame without odometry, is a run of one frame with stamp 0 and the identity; a recording with PointCloud2 and
    Odometry (rosbag2 directory, ``.mcap``, ``.db3``, ROS 1 ``.bag``), whose clouds get the odometry at the stamps
    in their headers, interpolated, and are deskewed by it where their points have times.

    Args:
        path: directory, cloud file or recording.
        odometry: ``"auto"`` takes what the layout brings; otherwise a TUM file, or KITTI poses (12 columns)
            where the run has a ``times.txt``. For a recording a TUM file with poses at any stamps. ``"kiss-icp"``
            makes odometry out of the clouds, each of which is read for that: :mod:`coview_stream.odometry`.
        cloud_topic: which clouds of a recording, if it has several topics with PointCloud2.
        odometry_topic: which odometry of a recording, if it has several topics with Odometry.
        lidar: makes the odometry that ``"kiss-icp"`` asks for, instead of a ``LidarOdometry()``.
        progress: called with (frames done, frames) while it does.

    Raises:
        RunError: no frames, no odometry or odometry that does not fit; the message names file and line.
        DependencyError: kiss-icp is missing.
    """
    path = Path(path)
    if odometry == KISS_ICP:
        from coview_stream.odometry.runs import open_lidar_run

        return open_lidar_run(path, lidar, cloud_topic, odometry_topic, progress)
    if (bag := find_bag(path)) is not None:
        return _recorded(bag, None if odometry == "auto" else Path(odometry), cloud_topic, odometry_topic)
    if path.exists() and (cloud_topic is not None or odometry_topic is not None):
        raise RunError(
            f"{path}: is no ROS recording and has no topics; leave --cloud-topic and --odometry-topic out"
        )
    layout = find_layout(path)
    count = len(layout.frames)
    explicit = None if odometry == "auto" else Path(odometry)
    if explicit is None and layout.odometry is None:
        if count == 1:
            return single(layout)
        raise RunError(
            f"{path}: {count} frames but no odometry; add {path / 'odometry.tum'} "
            "(t x y z qx qy qz qw per frame) or name a file, or make it of the clouds: --odometry kiss-icp"
        )
    stamps, poses = read_odometry(layout, explicit)
    return Run(path, layout.frames, stamps, poses)


def single(layout: Layout) -> Run:
    """Run of one frame, which needs no odometry."""
    return Run(layout.path, layout.frames, np.zeros(1), np.eye(4)[None])


def _recorded(bag: Path, explicit: Path | None, cloud_topic: str | None, odometry_topic: str | None) -> Run:
    # imported here, for bags are read by the decoders of live messages, and those read no runs
    from coview_stream.clouds.bags import open_bag

    return of_bag(bag, open_bag(bag, explicit, cloud_topic, odometry_topic))


def of_bag(bag: Path, opened: Opened) -> Run:
    """Run of a recording that has been opened."""
    paths = (bag,) * len(opened.stamps)
    return Run(bag, paths, opened.stamps / 1e9, opened.poses, opened.source, opened.notes)
