"""Parts of the method by themselves: odometry, GNSS and odometry, the map, and tracking with and without its graph.

The GNSS receiver is simulated, and has one frequency: under forest canopies such ones were 4.2 to 9.3 m off in two
dimensions, root mean square, at any density of the stand (Kaartinen et al., Accuracy of Kinematic Positioning
Using Global Satellite Navigation Systems under Forest Canopies, Forests 6(9), 2015). Ours has the best of them. Most of
its error is multipath that changes within a minute; its split, the height's error and the outages are set by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np

from bench.accuracy.scores import Track
from bench.tracking.drives import Drive, follow
from bench.tracking.worlds import Recorded
from coview_stream import BaseMap
from coview_stream.config import KeyframeConfig, LocalizerConfig, RegistrationConfig, TrackingConfig
from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Pose, inverse, orthonormal, pose_from, rot_z, to_local, yaw_of
from coview_stream.localization.registration.clouds import LocalMaps, prepare_scan, voxelized
from coview_stream.localization.registration.register import register
from coview_stream.localization.tracking.motion import Drift
from coview_stream.localization.tracking.pose_graph import PoseGraph

_COMPASS, _TILT = np.radians(5.0), np.radians(0.5)  # sigmas of the heading and tilt at the start
_UNKNOWN = 100.0  # radians: sigma of a fix's heading


@dataclass(frozen=True)
class Receiver:
    """Errors of a receiver; metres and seconds."""

    horizontal: float = 4.2  # root mean square in two dimensions
    vertical: float = 1.5  # times as far off in height as along one horizontal axis
    slow: float = 0.9  # share of the variance that is slow
    memory: float = 60.0  # after which the slow part's correlation is down to 1/e
    period: float = 1.0  # from fix to fix
    heard: float = 90.0  # mean length of a stretch with fixes, and
    silent: float = 10.0  # of one without

    @property
    def sigmas(self) -> Floats:
        """(3,) of x, y and z."""
        return np.asarray(self.horizontal / np.sqrt(2.0) * np.array([1.0, 1.0, self.vertical]))

    def errors(self, count: int, rng: np.random.Generator) -> Floats:
        """Errors (count, 3) of successive fixes: a Gauss-Markov process, and white noise."""
        kept = np.exp(-self.period / self.memory)
        drawn, fresh = rng.normal(size=(2, count, 3))
        walk = np.empty((count, 3))
        for k in range(count):
            walk[k] = drawn[k] if k == 0 else kept * walk[k - 1] + np.sqrt(1.0 - kept**2) * drawn[k]
        return np.asarray(self.sigmas * (np.sqrt(self.slow) * walk + np.sqrt(1.0 - self.slow) * fresh))

    def fixes(self, stamps: Floats, truth: Floats, rng: np.random.Generator) -> tuple[Ints, Floats]:
        """Frames (K,) of the fixes, and what they say (K, 3), map; of stamps (N,) and true poses (N, 4, 4)."""
        seconds = np.arange(stamps[0], stamps[-1], self.period)
        frames = np.searchsorted(stamps, seconds - 1e-6)
        told = truth[frames, :3, 3] + self.errors(len(frames), rng)
        hears = np.ones(len(frames), dtype=bool)
        leaves, comes = self.period / self.heard, self.period / self.silent
        for k in range(1, len(frames)):
            hears[k] = rng.random() >= leaves if hears[k - 1] else rng.random() < comes
        return frames[hears], told[hears]


def fused(stamps: Floats, truth: Floats, odometry: Floats, seed: int, receiver: Receiver | None = None) -> Floats:
    """Poses (N, 4, 4) map <- body by GNSS and odometry (N, 4, 4) in the product's graph of poses, without the map.

    It begins at the first fix, with the true tilt and a compass's heading. Successive fixes err alike: each counts as
    little as the process that they are drawn from warrants.
    """
    receiver, rng = receiver or Receiver(), np.random.default_rng([seed, 61])
    frames, told = receiver.fixes(stamps, truth, rng)
    alike = receiver.slow * 2.0 * receiver.memory / receiver.period + 1.0 - receiver.slow
    unknown = np.full(3, _UNKNOWN**2)
    fix, drift = np.diag(np.r_[unknown, alike * receiver.sigmas**2]), Drift.of(TrackingConfig())
    start = pose_from(rot_z(_COMPASS * rng.normal()) @ truth[0, :3, :3], told[0])
    graph = PoseGraph()
    graph.start(start, np.diag(np.r_[_TILT, _TILT, _COMPASS, receiver.sigmas] ** 2))
    poses, last = np.empty_like(truth), 0
    T_map_odom: Pose = start @ inverse(odometry[0])
    for frame, place in zip(frames, told, strict=True):
        poses[last:frame] = T_map_odom @ odometry[last:frame]
        if frame:
            step = inverse(odometry[last]) @ odometry[frame]
            way, turn = float(np.linalg.norm(step[:3, 3])), abs(yaw_of(step))
            graph.move(step, drift.covariance(way, turn))
            graph.correct(pose_from(graph.estimate.T_map_body[:3, :3], place), fix)
            T_map_odom = graph.estimate.T_map_body @ inverse(odometry[frame])
        last = int(frame)
    poses[last:] = T_map_odom @ odometry[last:]
    return poses


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


def by_odometry(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig) -> Track:
    """Take odometry alone, from the true start."""
    return Track.of_poses(drive.stamps, drive.truth[0] @ inverse(drive.odometry[0]) @ drive.odometry)


def by_gnss(site: Path, recorded: Recorded, drive: Drive, config: LocalizerConfig) -> Track:
    """Fuse GNSS and odometry."""
    return Track.of_poses(drive.stamps, fused(drive.stamps, drive.truth, drive.odometry, len(drive)))


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
    return Track.of_poses(drive.stamps, out)


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
