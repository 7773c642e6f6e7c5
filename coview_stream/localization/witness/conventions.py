"""Conventions: the units and axes in which clouds and odometry are sent, by the motions that both see.

The ground shows which axis of the clouds points up. A *reading* says how clouds and odometry may have been sent. Under
each, odometry's motion is compared with that of pairs of clouds, which
:mod:`coview_stream.localization.witness.first_motions` registers. The log odds of a reading are those of "odometry
follows the clouds" against "the two are unrelated", summed over the pairs; as registrations sometimes fail, no single
pair decides. The doctor and the localizer share all of this.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coview_stream.clouds.reference_system import FOOT
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.planar import planar_motion
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    inverse,
    log_so3,
    norms,
    pose_from,
    quat_to_matrix,
    quaternion_of,
    rot_z,
    wrap_angle,
    yaw_of,
)
from coview_stream.odometry.gravity import ground_plane

HEADING, SCALE = math.radians(8.0), 0.12
"""Heading of the lidar on the body, radians, and error of odometry's scale that are not another convention."""
SURE = math.log(99.0)
"""Log odds of a finding: agreement of two motions may be chance (1 in 48), that of three is not (1 in 340)."""
STILL = 0.5  # metres; a robot that moves less is taken to stand
BASELINE = 1.0  # metre between two clouds that are compared

_FAILS = 0.1  # probability that a registration fails, as in the calibration
METRES_PER_RADIAN = 5.0  # of a misfit
_SWAY = math.radians(0.3)  # sigma of a rotation about x or y: 0.2 each by registration and by odometry's level
_FARTHEST = 300.0  # metres; above the median range of any lidar anywhere
MILLIMETRE = 0.001  # metres

UP = np.array([0.0, 0.0, 1.0])
AXES = np.array([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
AXIS_NAMES = ("+z", "-z", "+y", "-y", "+x", "-x")
R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

Change = Callable[[Pose], Pose]
"""Maps odometry's poses to the poses that should have been sent."""

RIVALS: dict[str, Change] = {
    "inverse": inverse,
    "transposed": lambda T: pose_from(T[:3, :3].T, T[:3, 3]),
    "z down": lambda T: np.diag([1.0, -1.0, -1.0, 1.0]) @ T @ np.diag([1.0, -1.0, -1.0, 1.0]),
    "camera": lambda T: pose_from(R_body_camera, np.zeros(3)) @ T @ pose_from(R_body_camera.T, np.zeros(3)),
    "millimetres": lambda T: pose_from(T[:3, :3], MILLIMETRE * T[:3, 3]),
    "feet": lambda T: pose_from(T[:3, :3], FOOT * T[:3, 3]),
}
"""Usual mistakes in odometry, each with the change that corrects it."""


def _order_mended(T: Pose) -> Pose:
    """Correct a pose (4, 4) whose quaternion was written w, x, y, z and read x, y, z, w."""
    return pose_from(quat_to_matrix(quaternion_of(T)[[1, 2, 3, 0]]), T[:3, 3])


def _heading_mended(T: Pose) -> Pose:
    """Correct a pose (4, 4) whose heading was counted from y towards x."""
    return pose_from(rot_z(math.pi / 2.0 - 2.0 * yaw_of(T)) @ T[:3, :3], T[:3, 3])


class Pair(NamedTuple):
    """Motion between two clouds: the clouds' (4, 4) in level axes, its sigma in metres, and odometry (4, 4) at both."""

    motion: Pose
    sigma: float
    before: Pose
    after: Pose


@dataclass(frozen=True)
class Reading:
    """A way in which clouds and odometry may have been sent, with a finding and a remedy for people."""

    found: str
    remedy: str
    heading: float = 0.0  # of the body's x in the level axes of the clouds, radians
    mirrored: bool = False  # whether the clouds' y points right
    change: Change | None = None  # correction of odometry


@dataclass(frozen=True)
class Fit:
    """Odometry against the clouds' motion, as medians over pairs."""

    odds: float  # log odds that odometry follows the clouds, over all pairs
    misfit: float  # metres, with a radian as five
    yaw: float  # angle from odometry's motion to the clouds', radians: the heading of the lidar on the body
    spread: float  # deviation from ``yaw``
    scale: float  # the clouds' distance over odometry's
    pairs: int  # number of pairs that moved


AS_SENT_WORDS = "x forward, y left, z up"
AS_SENT = Reading("clouds and odometry are sent as they should", "")

ODOMETRY = (
    Reading("odometry is inverse: it is body <- odometry", "send T_odom_body, its inverse", change=RIVALS["inverse"]),
    Reading("odometry's rotation is transposed", "send T_odom_body: rows for columns, or a conjugate",
            change=RIVALS["transposed"]),
    Reading("odometry's z points down (north-east-down)", f"send it with {AS_SENT_WORDS}", change=RIVALS["z down"]),
    Reading("odometry has a camera's axes (z forward, y down)", f"send it with {AS_SENT_WORDS}",
            change=RIVALS["camera"]),
    Reading("odometry's quaternion is written w, x, y, z", "send x, y, z, w", change=_order_mended),
    Reading("odometry's x and y are swapped (north before east)", "send x before y, left of it",
            change=lambda T: pose_from(T[:3, :3], T[[1, 0, 2], 3])),
    Reading("odometry's heading is counted clockwise from north", "count it from x towards y", change=_heading_mended),
    Reading("odometry is in millimetres", "send metres", change=RIVALS["millimetres"]),
    Reading("odometry is in feet", "send metres", change=RIVALS["feet"]),
)  # fmt: skip
"""Readings of odometry, with correct clouds."""

FEET = Reading("clouds are in feet", "send metres")
MILLIMETRES = Reading("clouds are in millimetres", "send metres")
"""Readings of clouds that are scaled before registration; :func:`unit_of` detects millimetres."""
MIRRORED = Reading(
    "clouds and odometry mirror each other: the axes of one are left-handed (y points right)",
    f"send both with {AS_SENT_WORDS}", mirrored=True,
)  # fmt: skip
SWAPPED = Reading(
    "clouds and odometry mirror each other: x and y of one are swapped", f"send both with {AS_SENT_WORDS}",
    heading=math.pi / 2.0, mirrored=True,
)  # fmt: skip
BOTH_CAMERA = Reading(
    "clouds and odometry have a camera's axes (z forward, y down)", f"send both with {AS_SENT_WORDS}",
    heading=math.pi / 2.0, change=RIVALS["camera"],
)  # fmt: skip


def turning(start: Floats, end: Floats) -> Floats:
    """Return the smallest rotation (3, 3) from a unit vector (3,) to another; for opposite ones half a turn about x."""
    v, c = np.cross(start, end), float(start @ end)
    if c < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + c))


def unit_of(points: Points) -> float:
    """Return the unit of a cloud (N, 3) in metres: a thousandth where its points lie beyond any lidar's range."""
    finite = norms(points[:: 1 + len(points) // 2000])
    return MILLIMETRE if len(finite) and float(np.median(finite)) > _FARTHEST else 1.0


def _log_odds(gap: float, far: float, farther: float, sigma: float) -> float:
    """Return the log odds that odometry follows the clouds by one motion, ``gap`` metres from it.

    If it follows, the gap stays within tolerable errors of heading and scale over ``far`` metres; if not, odometry is
    an unrelated motion of up to ``farther`` metres. The clouds' motion has ``sigma``, and sometimes fails.
    """
    return _mixed(_gaussian(gap, math.hypot(math.hypot(HEADING, SCALE) * far, sigma), farther))


def _gaussian(gap: float, sigma: float, farther: float) -> float:
    """Return the likelihood ratio of a planar gap: of ``sigma`` alone, against ``sigma`` and ``farther`` together."""
    follows, unrelated = sigma**2, sigma**2 + farther**2
    return unrelated / follows * math.exp(0.5 * gap**2 * (1.0 / unrelated - 1.0 / follows))


def _mixed(ratio: float) -> float:
    """Return the log odds of a motion by its likelihood ratio, if registrations sometimes fail."""
    return math.log(((1.0 - _FAILS) * ratio + _FAILS) / (_FAILS * ratio + 1.0 - _FAILS))


def fit(pairs: Sequence[Pair], reading: Reading = AS_SENT) -> Fit:
    """Compare the clouds' motions with odometry's, both under a reading."""
    change = reading.change or (lambda T: T)
    odometry = np.array([(change(pair.before), change(pair.after)) for pair in pairs]).reshape(-1, 2, 4, 4)
    # all at once, for speed
    turns = log_so3(np.swapaxes(odometry[:, 0, :3, :3], -1, -2) @ odometry[:, 1, :3, :3])
    seen = log_so3(np.array([pair.motion[:3, :3] for pair in pairs]).reshape(-1, 3, 3))
    misfits, ratios, odds, sways = [], [], 0.0, np.zeros(2)
    for pair, (before, after), turned, rotation in zip(pairs, odometry, turns, seen, strict=True):
        moved = planar_motion(before, after)
        step, swayed = complex(moved[0], moved[1]), complex(turned[0], turned[1])
        driven, sway, turn = _as_read(pair.motion, rotation, reading)
        if max(abs(step), abs(driven)) < STILL:  # under this reading the robot stood
            continue
        misfits.append(abs(step - driven) + METRES_PER_RADIAN * abs(wrap_angle(moved[2] - turn)))
        far = max(abs(driven), BASELINE)
        odds += _log_odds(misfits[-1], far, max(far, abs(step)), pair.sigma)
        sways += [_sways_odds(each, swayed) for each in (sway, _other_hand(sway))]
        if min(abs(step), abs(driven)) > STILL:
            ratios.append(driven / step)
    # sways only decide between this reading and its mirror image; planar odometry has none
    this, other = np.logaddexp(sways, 0.0)
    odds += min(0.0, float(this - other))
    misfit = float(np.median(misfits)) if misfits else math.inf
    if not ratios:
        return Fit(odds, misfit, 0.0, math.pi, 1.0, 0)
    angles = np.angle(ratios)
    yaw = float(np.angle(np.median(np.cos(angles)) + 1j * np.median(np.sin(angles))))
    spread = float(np.median(np.abs(np.angle(np.exp(1j * (angles - yaw))))))
    return Fit(odds, misfit, yaw, spread, float(np.median(np.abs(ratios))), len(ratios))


def _sways_odds(sway: complex, swayed: complex) -> float:
    """Return the log odds that odometry sways with the clouds, radians about x and y, against unrelated sways."""
    return _mixed(_gaussian(abs(sway - swayed), _SWAY, math.hypot(abs(sway), abs(swayed))))


def _other_hand(sway: complex) -> complex:
    return complex(-sway.real, sway.imag)


def _as_read(motion: Pose, rotation: Floats, reading: Reading) -> tuple[complex, complex, float]:
    """Return the clouds' motion (4, 4) in the body's axes: x and y, the turns about x and y, and the turn about z.

    ``rotation`` (3,) is its rotation vector.
    """
    turned = cmath.exp(-1j * reading.heading)
    driven, sway = complex(motion[0, 3], motion[1, 3]) * turned, complex(rotation[0], rotation[1]) * turned
    if reading.mirrored:
        return driven.conjugate(), _other_hand(sway), -yaw_of(motion)
    return driven, sway, yaw_of(motion)


def turned_clouds(axis: int, heading: float) -> Reading:
    """Return the reading of clouds whose axis number ``axis`` of :data:`AXES` points up, the body's x at ``heading``.

    It names the axes for quarter turns, else the angle.
    """
    R_body_cloud = rot_z(-heading) @ turning(AXES[axis], UP)
    forward = AXIS_NAMES[int(np.argmax(AXES @ R_body_cloud[0]))]
    quarter = abs(wrap_angle(4.0 * heading)) < 4.0 * HEADING
    parts = []
    if axis:
        parts.append("z points down" if axis == 1 else f"{AXIS_NAMES[axis]} points up")
    if quarter and (forward != "+x" or not axis):
        parts.append(f"{forward.removeprefix('+')} points forward")
    if not quarter:
        parts.append(f"x points {abs(math.degrees(heading)):.0f} degrees to the {'right' if heading > 0 else 'left'}")
    found = f"clouds have other axes than the body: {', '.join(parts)}"
    return Reading(found, f"send them with {AS_SENT_WORDS}, or set --mount (`doctor` prints it)", heading=heading)


def axis_up(points: Points) -> int | None:
    """Return the number of the axis of a cloud (N, 3) that points up from the ground; None without ground.

    A ceiling is a floor upside down, so z is tried first, also for a cloud in feet.
    """
    found = []
    if not isinstance(ground_plane(points * np.float32(FOOT)), str):
        return 0
    for number, axis in enumerate(AXES):
        plane = ground_plane(points @ turning(axis, UP).T.astype(np.float32))
        if not isinstance(plane, str):
            if number == 0:
                return 0
            found.append((plane.share, number))
    return max(found)[1] if found else None
