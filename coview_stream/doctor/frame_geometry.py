"""What a robot's frames and odometry say of each other: which axis points up, how it leans, how it moved.

Pure functions of frames and poses, NumPy only. The findings are made of it by
:mod:`coview_stream.doctor.frame_checks`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from coview_stream.doctor.ground_plane import GroundPlane, ground_planes
from coview_stream.doctor.planar_motion import PlanarMotion, overhead, planar_motion
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rot_z, transform, wrap_angle, yaw_of

# set by hand; metres and radians
_STEP, _LONGEST = 2.5, 9.0  # driven between two frames that are compared
_TURN = math.radians(25)
_PAIRS = 16
_DISTINCT = 1.12  # height of the peak over all others, from which on a motion seen is taken for one
_METRES_PER_RADIAN = 5.0


@dataclass(frozen=True)
class SeenFrame:
    """One frame as it came.

    Attributes:
        stamp: seconds.
        points: (N, 3) body frame, metres.
        T_odom_body: (4, 4) odometry at its stamp.
    """

    stamp: float
    points: Points
    T_odom_body: Pose


@dataclass(frozen=True)
class Attitude:
    """Where the ground is, over several frames, in body axes levelled by odometry.

    Attributes:
        axis: of :data:`AXES`, which points up; 0 is as it should be.
        margin: score of that axis over that of z; 1 where it is z.
        up: (3,) median normal in body axes levelled by odometry: it turns with a leaning sensor.
        spread: median angle of the frames' normals from it, radians.
        up_odom: (3,) the same in odometry's axes: it stays where odometry leans.
        spread_odom: likewise.
        height: of the sensor above the ground, metres, median.
        frames: how many show the ground.
    """

    axis: int
    margin: float
    up: Floats
    spread: float
    up_odom: Floats
    spread_odom: float
    height: float
    frames: int


@dataclass(frozen=True)
class PairMotion:
    """Motion between two frames.

    Attributes:
        seen: by the lidar alone.
        one: odometry at the first, (4, 4).
        other: odometry at the second, (4, 4).
    """

    seen: PlanarMotion
    one: Pose
    other: Pose


def levelling(T_odom_body: Pose) -> Floats:
    """Return R (3, 3) that levels body axes by odometry, and leaves the heading."""
    return np.asarray(rot_z(-yaw_of(T_odom_body)) @ T_odom_body[:3, :3])


def turning(start: Floats, end: Floats) -> Floats:
    """Return the smallest rotation (3, 3) that takes one unit vector (3,) to another."""
    v, c = np.cross(start, end), float(start @ end)
    if c < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + c))


def attitude(frames: Sequence[SeenFrame]) -> Attitude | None:
    """Return where the ground is; None if no axis has one in half of the frames."""
    planes = [ground_planes(f.points @ levelling(f.T_odom_body).T.astype(f.points.dtype)) for f in frames]
    scores = np.array([[0.0 if p is None else max(p.score, 0.0) for p in row] for row in planes])
    if not len(scores):
        return None
    total = np.median(scores, axis=0)
    axis = int(np.argmax(total))
    if total[axis] <= 0.0:
        return None
    kept = [(row[axis], f) for row, f in zip(planes, frames, strict=True) if row[axis] is not None]
    pairs: list[tuple[GroundPlane, SeenFrame]] = [(p, f) for p, f in kept if p is not None]
    ups = np.array([p.up for p, _ in pairs])
    up, spread = _middle(ups)
    turned = np.array([rot_z(yaw_of(f.T_odom_body)) @ p.up for p, f in pairs])
    up_odom, spread_odom = _middle(turned)
    height = float(np.median([p.height for p, _ in pairs]))
    margin = float(total[axis] / max(total[0], 1e-3))
    return Attitude(axis, margin, up, spread, up_odom, spread_odom, height, len(pairs))


def _middle(directions: Floats) -> tuple[Floats, float]:
    """Return the median direction (3,) of unit vectors (N, 3), and the median angle from it."""
    middle = np.median(directions, axis=0)
    middle /= np.linalg.norm(middle)
    return middle, float(np.median(np.arccos(np.clip(directions @ middle, -1.0, 1.0))))


def pair_motions(frames: Sequence[SeenFrame], R_up: Floats, height: float) -> list[PairMotion]:
    """Return the motions between frames a few metres apart, by what the lidar sees; those that are not clear left out.

    Args:
        frames: in order.
        R_up: (3, 3) levels points that odometry has levelled.
        height: of the sensor above the ground, metres.
    """
    found = []
    for i, j in _pairs(frames):
        drawn = [overhead(frames[k].points, R_up @ levelling(frames[k].T_odom_body), height) for k in (i, j)]
        seen = planar_motion(*drawn)
        if seen is not None and seen.distinct > _DISTINCT:
            found.append(PairMotion(seen, frames[i].T_odom_body, frames[j].T_odom_body))
    return found


def _pairs(frames: Sequence[SeenFrame]) -> list[tuple[int, int]]:
    """Return pairs some metres apart by odometry; frames farther and farther apart where that stands still."""
    at = np.array([f.T_odom_body[:3, 3] for f in frames])
    pairs = []
    for i in np.unique(np.linspace(0, max(len(frames) - 2, 0), 3 * _PAIRS).astype(int)):
        far = np.linalg.norm(at[i + 1 :] - at[i], axis=1)
        if len(far) and far.max() < 0.5:
            pairs += [(int(i), min(int(i) + lag, len(frames) - 1)) for lag in (1 + i % 8,)]
            continue
        for j in np.flatnonzero((far > _STEP) & (far < _LONGEST))[:1] + i + 1:
            turn = inverse(frames[i].T_odom_body) @ frames[j].T_odom_body
            if abs(yaw_of(turn)) < _TURN:
                pairs.append((int(i), int(j)))
    if not pairs:
        return []
    keep = np.unique(np.linspace(0, len(pairs) - 1, _PAIRS).astype(int))
    return [pairs[k] for k in keep]


def planar_step(one: Pose, other: Pose) -> tuple[complex, float]:
    """Return odometry's step, metres, x + iy in the first pose's levelled axes, and its heading, radians."""
    step = rot_z(-yaw_of(one)) @ (other[:3, 3] - one[:3, 3])
    return complex(step[0], step[1]), wrap_angle(yaw_of(other) - yaw_of(one))


Rival = Callable[[Pose], Pose]
"""What odometry may be instead of what it says it is: what its poses have to be put through to be right."""

RIVALS: dict[str, Rival] = {
    "inverse": inverse,
    "transposed": lambda T: pose_from(T[:3, :3].T, T[:3, 3]),
    "z down": lambda T: np.diag([1.0, -1.0, -1.0, 1.0]) @ T @ np.diag([1.0, -1.0, -1.0, 1.0]),
}


@dataclass(frozen=True)
class MotionFit:
    """How odometry, read in some way, fits the motions seen.

    Attributes:
        misfit: median over pairs, metres, a radian counting as five.
        yaw: of the clouds in the body, radians: the angle from odometry's motion to the one seen, median.
        spread: median of the deviations from that.
        scale: seen distance over odometry's, median.
        pairs: how many.
    """

    misfit: float
    yaw: float
    spread: float
    scale: float
    pairs: int


def fit(pairs: Sequence[PairMotion], rival: Rival | None = None) -> MotionFit:
    """Compare the motions seen with odometry's, put through ``rival``."""
    misfits, ratios = [], []
    for pair in pairs:
        one, other = (pair.one, pair.other) if rival is None else (rival(pair.one), rival(pair.other))
        step, heading = planar_step(one, other)
        turn = abs(wrap_angle(heading - pair.seen.heading))
        misfits.append(abs(step - pair.seen.step) + _METRES_PER_RADIAN * turn)
        if min(abs(step), abs(pair.seen.step)) > 0.5:
            ratios.append(pair.seen.step / step)
    if not ratios:
        return MotionFit(float(np.median(misfits)), 0.0, math.pi, float("nan"), 0)
    angles = np.angle(ratios)
    middle = float(np.angle(np.median(np.cos(angles)) + 1j * np.median(np.sin(angles))))
    spread = float(np.median(np.abs(np.angle(np.exp(1j * (angles - middle))))))
    return MotionFit(float(np.median(misfits)), middle, spread, float(np.median(np.abs(ratios))), len(ratios))


def turned_frames(frames: Sequence[SeenFrame], R: Floats, odometry_too: bool) -> list[SeenFrame]:
    """Return frames whose clouds, and odometry if asked, are given in axes turned by R (3, 3)."""
    T = pose_from(R, np.zeros(3))
    return [
        SeenFrame(f.stamp, transform(T, f.points), T @ f.T_odom_body @ inverse(T) if odometry_too else f.T_odom_body)
        for f in frames
    ]
