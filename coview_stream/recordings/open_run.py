"""Opening of runs: directories, ROS recordings and single clouds, with given odometry or odometry from the clouds."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from coview_stream.config.mount import Mount
from coview_stream.errors import RunError
from coview_stream.recordings.datasets import is_kitti_raw, open_kitti_raw, open_mulran
from coview_stream.recordings.layouts import find_bag, find_layout, find_sweeps, read_odometry
from coview_stream.recordings.run import Run, single_frame_run

if TYPE_CHECKING:
    from coview_stream.odometry.lidar_odometry import LidarOdometry
    from coview_stream.recordings.lidar_runs import Progress


STAMPS = "stamps look like "
"""How a note begins that doubts the unit of the stamps."""

KISS_ICP = "kiss-icp"
"""Instead of an odometry file: compute odometry from the clouds."""


def open_run(
    path: str | os.PathLike[str],
    odometry: str | os.PathLike[str] = "auto",
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    lidar: LidarOdometry | None = None,
    progress: Progress | None = None,
    mount: Mount | None = None,
) -> Run:
    """Open a run and validate everything but the clouds themselves.

    Layouts: ``frames/NNNNNN.{pcd,ply,bin,npy,las,laz}`` with ``odometry.tum``; KITTI (``velodyne/*.bin``,
    ``times.txt``, ``poses.txt``, and ``calib.txt`` if the poses are the camera's); SC-LIO-SAM (``Scans/*.pcd``,
    ``times.txt``, ``odom_poses.txt``); MulRan (``sensor_data/Ouster/*.bin``, ``global_pose.csv``); a drive of KITTI's
    raw data (``velodyne_points/``, ``oxts/``); and recordings with PointCloud2 or Livox clouds, and Odometry or /tf
    (rosbag2 directory, ``.mcap``, ``.db3``, ROS 1 ``.bag``): odometry is interpolated at the clouds' header stamps, and
    deskews clouds whose points have times. One cloud file, or one frame without odometry, is a run of one frame with
    stamp 0 and the identity.

    Args:
        path: directory, cloud file or recording.
        odometry: ``"auto"`` takes the layout's own; otherwise a TUM file, or KITTI poses (12 columns) if the run has a
            ``times.txt``. For a recording a TUM file with any stamps. ``"kiss-icp"`` computes odometry in a pass over
            all clouds: :mod:`coview_stream.odometry`.
        cloud_topic: topic of the clouds, if a recording has several with PointCloud2.
        odometry_topic: topic of the odometry, if a recording has several with Odometry.
        lidar: used for ``"kiss-icp"`` instead of a ``LidarOdometry()``.
        progress: called with (frames done, frames) during ``"kiss-icp"``.
        mount: pose of the lidar; clouds are read into the body frame, the frame of the odometry. None: the lidar is
            the body; for a recording the pose is read from its /tf_static.

    Raises:
        RunError: no frames, no odometry, or odometry that does not match; the message names file and line.
        DependencyError: kiss-icp is missing.
    """
    path = Path(path)
    explicit = None if odometry == "auto" else Path(odometry)
    if odometry == KISS_ICP:
        from coview_stream.recordings.lidar_runs import open_lidar_run

        return open_lidar_run(path, lidar, cloud_topic, odometry_topic, progress, mount)
    if (bag := find_bag(path)) is not None:
        from coview_stream.recordings.bags import open_bag

        return open_bag(bag, explicit, cloud_topic, odometry_topic, mount=mount)
    if path.exists() and (cloud_topic is not None or odometry_topic is not None):
        raise RunError(
            f"{path}: is not a ROS recording and has no topics; leave --cloud-topic and --odometry-topic out"
        )
    if explicit is None and (sweeps := find_sweeps(path)) is not None:
        return open_mulran(path, sweeps, mount)
    if explicit is None and is_kitti_raw(path):
        return open_kitti_raw(path, mount)
    layout = find_layout(path)
    count = len(layout.frames)
    if explicit is None and layout.odometry is None:
        if count == 1:
            return single_frame_run(layout, mount)
        raise RunError(
            f"{path}: {count} frames but no odometry; add {path / 'odometry.tum'} "
            "(t x y z qx qy qz qw per frame) or name a file, or make it of the clouds: --odometry kiss-icp"
        )
    stamps, poses = read_odometry(layout, explicit)
    run = Run(path, layout.frames, stamps, poses, mount=mount)
    told = f"{path}: {STAMPS}{run.stamp_unit}, {run.interval:.4g} from one frame to the next; write seconds"
    return run if run.stamp_unit == "seconds" else replace(run, notes=(told,))
