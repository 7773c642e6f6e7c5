"""A drive and a track on it, small enough to know the score."""

import numpy as np

from bench.accuracy.scores import Track
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z


def way(count=1500, step=0.2):
    """A winding drive of ``step`` metres a frame, tilted by a degree."""
    heading = 0.6 * np.sin(np.arange(count) * step / 20.0) + 0.3
    steps = step * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    tilt = exp_so3(np.radians([1.0, 0.0, 0.0]))
    places = np.cumsum(steps, axis=0)
    return np.stack([pose_from(rot_z(h) @ tilt, p) for h, p in zip(heading, places, strict=True)])


def track(states, poses=None, covariance=None, stamps=None, level=(0.2, 1.0, 0.15, 0.1)):
    count = len(states)
    known = np.array([state == "TRACKING" for state in states])
    poses = np.tile(np.eye(4), (count, 1, 1)) if poses is None else poses.copy()
    poses[~known] = np.nan
    covariance = np.eye(6) if covariance is None else covariance
    stamps = 0.1 * np.arange(count) if stamps is None else np.asarray(stamps)
    covariances, levels = np.tile(covariance, (count, 1, 1)), np.tile(level, (count, 1))
    return Track(stamps, states, poses, covariances, levels)
