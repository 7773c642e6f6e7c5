"""Dirt of the robot: faults of its odometry, of the lidar's mounting, and motion during a sweep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.config.checks import within
from coview_stream.geometry.arrays import Floats, Indices
from coview_stream.geometry.transforms import Points, Pose, Poses, exp_so3, interpolate, inverse, pose_from, rot_z
from coview_stream.odometry.buffer import Segment
from coview_stream.odometry.deskew import deskew
from coview_stream.sim.sensors import FRAME_PERIOD


@dataclass(frozen=True)
class Miscalibration:
    """Constant errors of odometry over a run, and a random walk of the heading."""

    scale: float = 0.05  # share by which distances are over- or underestimated; the sign is drawn
    yaw_rate: float = 0.05  # constant error of the heading, degrees per metre driven; the sign is drawn
    yaw_walk: float = 0.5  # random walk of the heading, degrees per square root of a metre, one sigma

    def __post_init__(self) -> None:
        within(self, scale=(0.0, 0.5), yaw_rate=(0.0, 10.0), yaw_walk=(0.0, 20.0))

    def apply(self, odometry: Floats, rng: np.random.Generator) -> Floats:
        """Return ``T_odom_body`` (N, 4, 4) with this fault."""
        driven = _driven(odometry)
        sides = rng.choice([-1.0, 1.0], 2)
        walk = rng.normal(size=len(driven)) * np.sqrt(driven) * self.yaw_walk
        yaw = np.radians(np.cumsum(walk + sides[1] * self.yaw_rate * driven))
        return spoilt(odometry, _about_z(yaw), np.full(len(driven), 1.0 + sides[0] * self.scale))


@dataclass(frozen=True)
class Slip:
    """Bursts of wheel slip: distance counted but not driven, or driven but not counted, and a false turn."""

    share: float = 0.5  # of a burst's distance that is counted too much (spinning) or too little (skidding), at random
    turn: float = 4.0  # false turn in a burst, degrees, one sigma
    length: float = 1.5  # of a burst, metres driven
    every: float = 25.0  # mean distance between bursts, metres driven

    def __post_init__(self) -> None:
        within(self, share=(0.0, 1.0), turn=(0.0, 90.0), length=(0.1, 100.0), every=(0.1, 1e4))

    def apply(self, odometry: Floats, rng: np.random.Generator) -> Floats:
        """Return ``T_odom_body`` (N, 4, 4) with this fault."""
        driven = _driven(odometry)
        way = np.cumsum(driven)
        turns, factors = np.zeros(len(driven)), np.ones(len(driven))
        for begin in self.bursts(float(way[-1]) if len(way) else 0.0, rng):
            inside = (way > begin) & (way <= begin + self.length)
            share, turn = rng.choice([-1.0, 1.0]) * self.share, rng.normal() * self.turn
            factors[inside] = 1.0 + share
            turns[inside] += turn / max(int(inside.sum()), 1)
        return spoilt(odometry, _about_z(np.radians(np.cumsum(turns))), factors)

    def bursts(self, way: float, rng: np.random.Generator) -> Floats:
        """Draw the metres driven at which slip begins on a path of ``way`` metres: uniform, at least once."""
        count = max(1, round(way / self.every))
        return (np.arange(count) + rng.uniform(0.2, 0.8, count)) * way / count


@dataclass(frozen=True)
class Gravity:
    """Error of the inertial unit's gravity direction, constant in size and slowly rotating."""

    error: float = 0.5  # angle between the true and the estimated gravity direction, degrees
    period: float = 300.0  # seconds per rotation of the wrong direction

    def __post_init__(self) -> None:
        within(self, error=(0.0, 45.0), period=(1.0, 1e6))

    def apply(self, odometry: Floats, stamps: Floats, rng: np.random.Generator) -> Floats:
        """Return ``T_odom_body`` (N, 4, 4) at stamps (N,), seconds, with this fault."""
        angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (stamps - stamps[0]) / self.period
        axes = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        tilts = exp_so3(np.radians(self.error) * axes)
        return spoilt(odometry, tilts[1:], np.ones(len(odometry) - 1), tilts[0])


def spoilt(odometry: Floats, turns: Floats, factors: Floats, first: Floats | None = None) -> Floats:
    """Chain spoilt motions of ``odometry`` (N, 4, 4), ``T_odom_body``, to poses (N, 4, 4).

    ``turns`` (N - 1, 3, 3) rotate the odometry's axes after each motion, ``first`` (3, 3) at the first pose;
    ``factors`` (N - 1,) scale each motion.
    """
    axes = np.concatenate([(np.eye(3) if first is None else first)[None], turns])
    moved = np.diff(odometry[:, :3, 3], axis=0) * factors[:, None]
    moved = np.einsum("nij,nj->ni", axes[:-1], moved)
    poses = odometry.copy()
    poses[:, :3, :3] = axes @ odometry[:, :3, :3]
    poses[1:, :3, 3] = odometry[0, :3, 3] + np.cumsum(moved, axis=0)
    return poses


def _about_z(angles: Floats) -> Floats:
    return exp_so3(np.column_stack([np.zeros((len(angles), 2)), angles]))


def _driven(odometry: Floats) -> Floats:
    return np.asarray(np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1))


@dataclass(frozen=True)
class Mounting:
    """Uncalibrated mounting: points in the sensor frame are sent as points in the body frame."""

    lean: float = 2.0  # angle between the vertical axes of sensor and body, degrees; its direction is drawn
    yaw: float = 0.0  # rotation about the vertical, degrees, one sigma; no map reveals it on a straight road
    lever: float = 0.05  # distance between sensor and body, metres; its direction is drawn

    def __post_init__(self) -> None:
        within(self, lean=(0.0, 30.0), yaw=(0.0, 180.0), lever=(0.0, 5.0))

    def draw(self, rng: np.random.Generator) -> Pose:
        """Draw the pose ``T_body_sensor`` (4, 4)."""
        towards, turn, offset = rng.uniform(0, 2 * np.pi), rng.normal(), rng.normal(size=3)
        axis = np.array([np.cos(towards), np.sin(towards), 0.0])
        R = exp_so3(np.radians(self.lean) * axis) @ rot_z(float(np.radians(self.yaw) * turn))
        return pose_from(R, self.lever * offset / np.linalg.norm(offset))


_STEPS = 200  # true poses along a sweep, every 0.5 ms
_NS = 1e9


@dataclass(frozen=True)
class Motion:
    """Raw sweeps, each from one stamp to the next, stamped at its end."""

    rate: float = 50.0  # odometry samples per second for deskewing
    deskewed: bool = True  # whether the product's code deskews the frames; if not they stay distorted

    def __post_init__(self) -> None:
        within(self, rate=(10.0, 1000.0))


class Track:
    """Smooth motion through the true and the odometry poses of a run's frames.

    The robot passes the frames' poses at their stamps; between frames the odometry error grows linearly.
    """

    def __init__(self, stamps: Floats, T_scene_body: Poses, T_odom_body: Poses) -> None:
        """Fit the track to stamps (N,) in seconds and poses (N, 4, 4); it begins one frame before the first."""
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        before = T_scene_body[0]
        if len(stamps) > 1:
            before = T_scene_body[0] @ inverse(T_scene_body[1]) @ T_scene_body[0]
        self.stamps = stamps
        self.odometry = T_odom_body
        self._at: Floats = np.concatenate([stamps[:1] - FRAME_PERIOD, stamps])
        poses = np.concatenate([before[None], T_scene_body])
        self._positions = CubicSpline(self._at, poses[:, :3, 3])
        self._rotations = RotationSpline(self._at, Rotation.from_matrix(poses[:, :3, :3]))
        wrong = np.stack([odom @ inverse(true) for odom, true in zip(T_odom_body, T_scene_body, strict=True)])
        self._wrong = np.concatenate([wrong[:1], wrong])

    def true(self, stamps: Floats) -> Poses:
        """Return ``T_scene_body`` (M, 4, 4) at (M,) seconds."""
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3, :3] = self._rotations(stamps).as_matrix()
        poses[:, :3, 3] = self._positions(stamps)
        return poses

    def odom(self, stamps: Floats) -> Poses:
        """Return ``T_odom_body`` (M, 4, 4) at (M,) seconds."""
        k = np.clip(np.searchsorted(self._at, stamps, side="right") - 1, 0, len(self._at) - 2)
        share = (stamps - self._at[k]) / (self._at[k + 1] - self._at[k])
        return np.asarray(interpolate(self._wrong[k], self._wrong[k + 1], share) @ self.true(stamps))

    def along(self, frame: int, times: Floats) -> tuple[Poses, Indices]:
        """Return true poses (K, 4, 4) along a sweep, and the index (N,) of the pose at each of the times (N,)."""
        grid = np.linspace(-FRAME_PERIOD, 0.0, _STEPS)
        nearest = np.rint((times + FRAME_PERIOD) * ((_STEPS - 1) / FRAME_PERIOD)).astype(np.intp)
        return self.true(self.stamps[frame] + grid), np.clip(nearest, 0, _STEPS - 1)

    def segment(self, frame: int, rate: float) -> Segment:
        """Return the odometry of a sweep at ``rate`` samples per second."""
        count = round(FRAME_PERIOD * rate) + 1
        stamps = self.stamps[frame] + np.linspace(-FRAME_PERIOD, 0.0, count)
        return Segment(np.rint(stamps * _NS).astype(np.int64), self.odom(stamps))

    def straightened(self, frame: int, points: Points, times: Floats, rate: float) -> Points:
        """Deskew a sweep's points (N, 3) by odometry, as a node does, each in the body frame at its time (N,)."""
        stamp_ns = round(float(self.stamps[frame]) * _NS)
        return deskew(points, times, self.segment(frame, rate), stamp_ns, self.odometry[frame])


def beam_times(count: int) -> Floats:
    """Return the times (N,) of a sweep's beams in seconds relative to its stamp, the end of the sweep."""
    return np.asarray((np.arange(1, count + 1) / count - 1.0) * FRAME_PERIOD)
