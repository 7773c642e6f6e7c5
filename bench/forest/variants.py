"""Parts of the method by themselves: odometry, GNSS and odometry, the map, and tracking with and without its graph."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import numpy as np

from bench.accuracy.scores import Track
from bench.forest.gnss import fused
from bench.tracking.drives import Drive, follow
from bench.tracking.worlds import Recorded
from coview_stream import BaseMap
from coview_stream.config import KeyframeConfig, LocalizerConfig, RegistrationConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import CloudError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, inverse, orthonormal, pose_from, rot_z, to_local, yaw_of
from coview_stream.localization.registration.clouds import LocalMaps, prepare_scan, voxelized
from coview_stream.localization.registration.register import register
from coview_stream.localization.tracking.pose_graph import PoseGraph
from coview_stream.odometry.lidar_odometry import LidarOdometry

_WIDE = np.diag([np.radians(0.3), np.radians(0.3), np.radians(1.5), 0.5, 0.5, 0.3]) ** 2
"""Covariance of a predicted pose without the graph: that of a place which the search has accepted."""


class ForgetfulGraph(PoseGraph):
    """A graph that forgets: odometry predicts where a registration begins, which alone makes the pose."""

    def move(self, T_between: Pose, covariance: Floats) -> None:
        """Predict a pose, and forget all that made it certain."""
        self.start(orthonormal(self.estimate.T_map_body @ T_between), _WIDE)

    def correct(self, T_map_body: Pose, covariance: Floats) -> None:
        """Take the registration as it is."""
        self.start(T_map_body, covariance)


def of_poses(stamps: Floats, poses: Floats) -> Track:
    """Track of poses (N, 4, 4) that are always given, without a covariance."""
    count = len(poses)
    return Track(stamps, ["TRACKING"] * count, poses, np.full((count, 6, 6), np.nan), np.full((count, 2), np.nan))


def by_odometry(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig) -> Track:
    """Take odometry alone, from the true start."""
    return of_poses(drive.stamps, drive.truth[0] @ inverse(drive.odometry[0]) @ drive.odometry)


def by_gnss(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig) -> Track:
    """Fuse GNSS and odometry (:mod:`bench.forest.gnss`)."""
    return of_poses(drive.stamps, fused(drive.stamps, drive.truth, drive.odometry, len(drive)))


def by_map(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig) -> Track:
    """Register each frame from where the last shift and turn lead once more, as widely as a search does.

    From the true start, without odometry.
    """
    base_map, settings, keyframe = BaseMap.load(site), RegistrationConfig(), KeyframeConfig()
    maps, poses = LocalMaps(base_map, settings.source_range), [to_local(drive.truth[0], base_map.origin)]
    for frame in drive.frames:
        before, last = poses[-2:] if len(poses) > 2 else [poses[-1]] * 2
        turned = rot_z(yaw_of(last) - yaw_of(before)) @ last[:3, :3]  # its tilt sways, and leads nowhere
        guess = pose_from(turned, 2.0 * last[:3, 3] - before[:3, 3])
        turn, place = pose_from(guess[:3, :3], np.zeros(3)), pose_from(np.eye(3), guess[:3, 3])
        scan = prepare_scan(voxelized(recorded.read(int(frame)), turn, keyframe), np.zeros(3), settings)
        target = maps.around(guess[:3, 3])
        found = None if target is None else register(scan, place, target, settings, settings.search, centre=np.zeros(3))
        poses.append(guess if found is None else orthonormal(found.T_map_source @ turn))
    out = np.array(poses[1:])
    out[:, :3, 3] += base_map.origin
    return of_poses(drive.stamps, out)


def without_graph(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig) -> Track:
    """Run the product, but every registration is the pose, and odometry only leads from one to the next."""
    with patch("coview_stream.localization.tracking.tracker.PoseGraph", ForgetfulGraph):
        return follow(site, recorded, drive, config)


Variant = Callable[[Path, Recorded, Drive, LocalizerConfig], Track]

VARIANTS: dict[str, Variant] = {
    "odometry": by_odometry,
    "GNSS and odometry": by_gnss,
    "map": by_map,
    "graph off": without_graph,
    "ours": follow,
}
"""In the tables' order."""


def lidar_odometry(truth: Floats) -> LidarOdometry:
    """Return the product's lidar odometry; down is given, as an accelerometer does: a dense forest shows no plane."""
    down = -truth[0, 2, :3]
    return LidarOdometry(LidarOdometryConfig(gravity=(float(down[0]), float(down[1]), float(down[2]))))


def by_lidar(recorded: Recorded, drive: Drive) -> Floats:
    """Odometry (N, 4, 4) of the lidar's own frames; one that it refuses has the pose of the one before."""
    odometry, poses = lidar_odometry(drive.truth), [np.eye(4)]
    for frame, stamp in zip(drive.frames, drive.stamps, strict=True):
        try:
            poses.append(odometry.step(recorded.read(int(frame)), None, float(stamp)))
        except CloudError:
            poses.append(poses[-1])
    return np.array(poses[1:])
