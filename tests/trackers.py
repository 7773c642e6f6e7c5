"""A tracker in the small world, and drives with odometry that is right or wrong."""

from dataclasses import dataclass

import numpy as np
import small_world

from coview_kernels import Registration
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.localization.calibration.calibration import RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import LocalMaps, prepare_scan, voxelized
from coview_stream.localization.tracking.tracker import Tracker

T_MAP_ODOM = pose_from(rot_z(1.9), [7.0, -3.0, 0.4])
OFF = pose_from(np.eye(3), [0.2, -0.15, 0.0])
"""How far from the truth a tracker begins."""


def follow(localizer, drive, frames=None, start=0.0):
    """Fixes of a drive's frames, two a second: the first ``frames`` of them, these, or all."""
    numbers = range(len(drive.clouds))[:frames] if frames is None or isinstance(frames, int) else frames
    return [localizer.step(drive.clouds[k], drive.T_odom_body[k], start + 0.5 * k) for k in numbers]


def assert_usual(fixes, usual, metres):
    """Fail unless fixes have the states and, but for so many metres, the poses of the usual ones, frame by frame."""
    for fix, known in zip(fixes, usual, strict=False):
        assert fix.state is known.state
        if known.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body, known.T_map_body, atol=metres)


def assert_same(fix, other):
    """Fail unless two fixes are one, but for rounding."""
    assert fix.state is other.state
    assert fix.stamp == other.stamp
    assert (fix.T_map_body is None) == (other.T_map_body is None)
    if fix.T_map_body is not None:
        np.testing.assert_allclose(fix.T_map_body, other.T_map_body, atol=1e-6)
        np.testing.assert_allclose(fix.covariance, other.covariance, rtol=1e-3, atol=1e-9)


def registration(T_map_odom):
    return Registration(T_map_odom, 1e4 * np.eye(6), 0.05, 2000, 20, True)


def garbage(seed=1, count=6000):
    """A frame that is like no place."""
    return np.random.default_rng(seed).uniform([-20, -20, -1.5], [20, 20, 6], (count, 3)).astype(np.float32)


def observed(cloud, T_odom_body, voxels=True):
    """A frame, body frame, as evidence and registration take it; ``voxels``: one point per voxel, as in tracking."""
    config = LocalizerConfig()
    points = transform(T_odom_body, cloud).astype(np.float32)
    points = voxelized(cloud, T_odom_body, config.keyframe) if voxels else points
    return ObservedScan.of(prepare_scan(points, T_odom_body[:3, 3], config.registration), cloud, T_odom_body)


def tracker_of(world_map, config=None):
    """A tracker that has not been started."""
    config = config or LocalizerConfig()
    return Tracker(world_map, config, LocalMaps(world_map, config.registration.source_range), CalibrationEstimator())


def add_frame(tracker, cloud, T_odom_body):
    """Add a raw frame, body frame, as the localizer does: one point per voxel, odometry frame."""
    tracker.add_scan(RawScan(voxelized(cloud, T_odom_body, tracker.config.keyframe), T_odom_body))


def match_and_update(tracker, cloud, T_odom_body, **how):
    """Register the newest scans, and correct the belief by what is verified; the verdict."""
    match = tracker.match_to_map(cloud, T_odom_body, **how)
    tracker.update(match, T_odom_body, match.verdict.verified)
    return match.verdict


@dataclass
class Ride:
    """A tracker and the odometry that it gets.

    Attributes:
        tracker: see :class:`coview_stream.localization.tracking.tracker.Tracker`.
        T_odom_map: (4, 4) what odometry is off by; change it for a slip.
    """

    tracker: Tracker
    T_odom_map: np.ndarray

    @classmethod
    def begin(cls, world_map, config, cloud, truth, off=OFF, T_map_odom=T_MAP_ODOM):
        """Start ``off`` the truth at the first frame."""
        ride = cls(tracker_of(world_map, config), inverse(T_map_odom))
        ride.see(cloud, truth)
        ride.tracker.start(registration(off @ T_map_odom), ride.odometry(truth), 0.0)
        return ride

    def odometry(self, truth):
        return self.T_odom_map @ truth

    def see(self, cloud, truth):
        add_frame(self.tracker, cloud, self.odometry(truth))

    def update(self, cloud, truth, **how):
        """Add a frame and register it; the verdict."""
        self.see(cloud, truth)
        return match_and_update(self.tracker, cloud, self.odometry(truth), **how)

    def error(self, truth):
        """Metres and degrees that the belief is off at a pose."""
        return small_world.pose_error(self.tracker.T_map_odom @ self.odometry(truth), truth)

    def assert_right(self, truth, metres):
        """Fail unless the belief is within so many metres, and a fifth of a degree, of a pose."""
        small_world.assert_pose(self.tracker.T_map_odom @ self.odometry(truth), truth, metres, 0.2)

    def slips(self, by, truth):
        """From here on odometry is off by a motion (4, 4) of the body at ``truth`` that was none."""
        self.T_odom_map = self.odometry(truth) @ by @ inverse(truth)


def ride_of(world_map, drive, config=None, frame=4, **more):
    """A ride that has been started at a frame of the drive, and has seen it."""
    return Ride.begin(world_map, config, drive.clouds[frame], drive.T_map_body[frame], **more)


def on_the_way(world_map, drive, config=None, frames=8):
    """A ride that has been verified at every frame so far."""
    ride = ride_of(world_map, drive, config, 0)
    for k in range(1, frames):
        assert ride.update(drive.clouds[k], drive.T_map_body[k]).verified
    return ride


def refused(ride, cloud, truth, **how):
    """Update with something that is not believed; the verdict. The belief stays where odometry leads."""
    before, sure = ride.tracker.T_map_odom.copy(), np.diag(ride.tracker.predicted_covariance())
    verdict = ride.update(cloud, truth, **how)
    assert not verdict.verified
    np.testing.assert_array_equal(ride.tracker.T_map_odom, before)
    assert (np.diag(ride.tracker.predicted_covariance()) >= 0.999 * sure).all()
    return verdict
