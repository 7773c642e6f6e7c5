"""Calibration of sensor and odometry, and raw scans, which are levelled by it on access.

Clouds *in the sensor's axes* are as received: in the body's axes by the stated mount. The calibration corrects this
mount: *levelled* clouds are in the body's true axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from coview_stream.config.localizer import MAX_DELAY
from coview_stream.config.mount import MAX_LEVER, Mount
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import OtherHeights
from coview_stream.geometry.transforms import (
    Points,
    Pose,
    exp_so3,
    inverse,
    pose_from,
    rot_z,
    rotation_angle,
    transform,
)
from coview_stream.localization.calibration.odometry_history import Moment
from coview_stream.odometry.deskew import SweepCorrection

_LEAN, _SCALE, _TURN, _GROUND = math.radians(0.5), 0.01, math.radians(0.05), 0.1
"""Smallest corrections that are reported: radians, factor, radians per metre, metres."""
_TURNED, _SHIFTED, _LATE = math.radians(1.0), 0.1, 0.02
"""Likewise: radians of heading, metres of lever arm, seconds."""
_RARE_SIGMAS = 3.29  # exceeded by a Gaussian once in a thousand, either way
_TOLD = 2.0  # sigmas; a less certain correction is not reported
_MOVED = {
    "sigma_tilt": math.radians(1.0), "sigma_scale": 0.02, "sigma_turn": math.radians(0.02),
    "sigma_heading": math.radians(0.3), "sigma_lever": 0.02, "sigma_delay": 0.005,
}  # fmt: skip
"""Lower limits of the sigmas of an earlier calibration: radians, factor, radians per metre, metres, seconds."""
_ONE_SCAN = "is it the vehicle or the sensor? set --mount only if the lean stays in a run with odometry"
HEADING_TOLERANCE, LEVER_TOLERANCE, CLOCK_TOLERANCE = math.radians(0.1), 0.005, 0.001
"""Sigmas of a mount taken from drawings and of clocks set by PTP or an edge: radians, metres, seconds."""
_RANGES = {
    **dict.fromkeys(("roll", "pitch"), math.radians(45.0)), "heading": math.pi,
    "sigma_tilt": 1.0, "sigma_heading": 1.0, "scale": 3.0, "sigma_scale": 1.0, "turn": 0.5, "sigma_turn": 1.0,
    **dict.fromkeys(("lever_x", "lever_y", "sigma_lever", "sigma_height", "ground", "changed"), MAX_LEVER),
    **dict.fromkeys(("delay", "stated_delay", "sigma_delay"), 2.0 * MAX_DELAY),
}  # fmt: skip
"""Largest plausible values, in the units of :class:`Calibration`; sigmas are not negative."""
_ACCELERATION, _TURN_ACCELERATION = 0.5, 0.2  # m/s2 and rad/s2 of wheeled robots, one sigma


@dataclass(frozen=True)
class Calibration:
    """Corrections of a robot's clouds and odometry, with their standard deviations.

    Attributes:
        roll: radians about the body's x that level clouds in odometry's gravity.
        pitch: radians about the body's y, likewise.
        scale: correction factor of odometry's distances, less one.
        turn: correction of odometry's heading, radians per metre driven.
        sigma_tilt: one sigma of roll and of pitch, radians.
        sigma_scale: one sigma of the scale.
        sigma_turn: one sigma of the turn, radians per metre.
        ground: height of the site's present ground above the survey's, metres.
        heading: radians about the body's z that rotate clouds into the body's axes, before roll and pitch.
        lever_x: metres forward from the body's origin to the origin of the clouds.
        lever_y: metres to the left, likewise.
        delay: seconds by which clouds are stamped later than odometry; negative where odometry is late.
        sigma_heading: one sigma of the heading, radians.
        sigma_lever: one sigma of each of lever_x and lever_y, metres.
        sigma_delay: one sigma of the delay, seconds.
        changed: height of the surrounding ground above the survey's, metres, if dug or filled since; 0 if not.
        stated_delay: the part of ``delay`` that ``LocalizerConfig.cloud_delay`` states.
        sigma_height: one sigma of the lever arm's height, metres, which motion does not show.
    """

    roll: float = 0.0
    pitch: float = 0.0
    scale: float = 0.0
    turn: float = 0.0
    sigma_tilt: float = math.radians(4.0)
    sigma_scale: float = 0.03
    sigma_turn: float = math.radians(0.05)
    ground: float = 0.0
    heading: float = 0.0
    lever_x: float = 0.0
    lever_y: float = 0.0
    delay: float = 0.0
    sigma_heading: float = HEADING_TOLERANCE
    sigma_lever: float = LEVER_TOLERANCE
    sigma_delay: float = CLOCK_TOLERANCE
    changed: float = 0.0
    stated_delay: float = 0.0
    sigma_height: float = 0.0

    def require_plausible(self) -> Calibration:
        """Return it; InputError if a value is not finite or not plausible for a robot."""
        for name, largest in _RANGES.items():
            value = getattr(self, name)
            least = 0.0 if name.startswith("sigma") else -largest
            if not least <= value <= largest:  # rejects NaN, too
                allowed = f"{least:.4g} to {largest:.4g} (radians, metres, seconds)"
                raise InputError(f"calibration: {name} is {value!r}, which is none of a robot; give {allowed}")
        return self

    @cached_property
    def R_tilt(self) -> Floats:
        """(3, 3) rotation that levels clouds, in the body's heading."""
        return exp_so3(np.array([self.roll, self.pitch, 0.0]))

    @cached_property
    def R_body_cloud(self) -> Floats:
        """(3, 3) rotation of clouds into the body's axes."""
        return self.R_tilt @ rot_z(self.heading) if self.heading else self.R_tilt

    @cached_property
    def T_body_cloud(self) -> Pose:
        """(4, 4) body <- cloud: rotation and lever arm."""
        return pose_from(self.R_body_cloud, [self.lever_x, self.lever_y, 0.0])

    @property
    def sweep(self) -> SweepCorrection:
        """The corrections that deskewing applies."""
        return SweepCorrection(self.R_body_cloud, self.scale)

    def leans_from(self, other: Calibration) -> float:
        """Return the angle in radians between the rotations of clouds by two calibrations."""
        return rotation_angle(self.R_body_cloud.T @ other.R_body_cloud)

    def level(self, cloud: Points) -> Points:
        """Return a cloud (N, 3) in the body's axes, given in the sensor's."""
        T = self.T_body_cloud
        return cloud if np.array_equal(T, np.eye(4)) else transform(T, cloud)

    def motion_covariance(self, step: Floats, turned: float = 0.0, change: Floats | None = None) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) that this calibration's errors give a motion between two clouds.

        All is in the axes of ``step`` (3,), metres. ``turned`` is radians about z, ``change`` (3,) the change of the
        body's velocities (x, y, rotation about z) from the start of the motion to its end.
        """
        along = np.concatenate([np.zeros(3), step])
        across = np.concatenate([np.zeros(3), [-step[1], step[0], 0.0]])
        spread = np.outer(along, along) * self.sigma_scale**2 + np.outer(across, across) * self.sigma_heading**2
        spread[2, 2] += (self.sigma_turn * float(np.linalg.norm(step))) ** 2
        spread[[3, 4], [3, 4]] += 2.0 * (1.0 - math.cos(turned)) * self.sigma_lever**2
        if change is not None:
            late = np.array([0.0, 0.0, change[2], change[0], change[1], 0.0])
            spread += np.outer(late, late) * self.sigma_delay**2
        return np.asarray(spread)

    def pose_covariance(self, R_map_body: Floats, rates: Floats) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z), map axes, that mount and clock add to a body pose.

        ``R_map_body`` is (3, 3), ``rates`` (3,) the body's velocities x, y and rotation about z in its axes. If clouds
        are late, an uncertain delay shifts the pose along the motion. Only sigmas beyond the tolerances of a correct
        robot count, as the stated mount defines the body, and the cloud's stamp the time.
        """
        heading = max(0.0, self.sigma_heading**2 - HEADING_TOLERANCE**2)
        lever = max(0.0, self.sigma_lever**2 - LEVER_TOLERANCE**2)
        spread = np.diag([0.0, 0.0, heading, lever, lever, self.sigma_height**2])
        moving = np.concatenate([[0.0, 0.0, rates[2]], R_map_body @ [rates[0], rates[1], 0.0]])
        late = 0.5 * (1.0 + math.erf(self.delay / max(self.sigma_delay, 1e-9) / math.sqrt(2.0)))  # probability
        return np.asarray(spread + np.outer(moving, moving) * late * max(0.0, self.sigma_delay**2 - CLOCK_TOLERANCE**2))

    def heights(self, others: OtherHeights) -> OtherHeights:
        """Return a pose's other possible heights, widened by the uncertain height of the lever arm."""
        reach = _RARE_SIGMAS * self.sigma_height
        return OtherHeights(others.variance + self.sigma_height**2, others.reach + reach)

    @property
    def extrapolation(self) -> Floats:
        """(6, 6) covariance over (rx, ry, rz, x, y, z) of late odometry, extrapolated without accelerations."""
        grown = 0.5 * min(self.delay, 0.0) ** 2
        moved = (grown * _ACCELERATION) ** 2
        return np.diag([0.0, 0.0, (grown * _TURN_ACCELERATION) ** 2, moved, moved, 0.0])

    def describe(self, mount: Mount | None = None, one_scan: bool = False) -> list[str]:
        """Return one clause of text per noticeable correction.

        Signs are as in ``--mount``; ``mount`` is already applied to the clouds. Without motion (``one_scan``) a
        lean may also be the vehicle's.
        """
        clauses: list[str] = []
        given = mount or Mount()
        beyond = "" if given == Mount() else " beyond its mount"
        # the remedy leaves out components that may be zero
        sits = math.hypot(self.lever_x, self.lever_y) >= max(_SHIFTED, _TOLD * self.sigma_lever)
        mended = self if sits else replace(self, lever_x=0.0, lever_y=0.0)
        option = given.moved(mended.T_body_cloud).option
        if not given.drawn:  # its height is not observable
            option = f"{option.rpartition(',')[0]},Z" if sits else f"{option},X,Y,Z"
        remedy = f"set --mount={option} to silence this" + ", metres by the drawing" * (not given.drawn)
        leans = [
            f"{math.degrees(angle):.1f} deg in {name}"
            for name, angle in (("roll", self.roll), ("pitch", self.pitch))
            if abs(angle) >= _LEAN
        ]
        if leans:
            whose, advice = ("cloud", _ONE_SCAN) if one_scan else ("sensor", remedy)
            clauses.append(f"{whose} leans {' and '.join(leans)}{beyond}: corrected; {advice}")
        if abs(self.heading) >= max(_TURNED, _TOLD * self.sigma_heading):
            side = "left" if self.heading > 0 else "right"
            angle = f"{abs(math.degrees(self.heading)):.1f} +- {math.degrees(self.sigma_heading):.1f} deg"
            clauses.append(f"sensor is turned {angle} to the {side} on the body{beyond}: corrected; {remedy}")
        if sits:
            place = f"{self.lever_x:.2f} m ahead and {self.lever_y:.2f} m left of the body's origin"
            clauses.append(f"sensor sits {place}{beyond}, +- {self.sigma_lever:.2f} m: corrected; {remedy}")
        if abs(self.delay - self.stated_delay) >= max(_LATE, _TOLD * self.sigma_delay):
            late, early = ("clouds are", "odometry") if self.delay > 0 else ("odometry is", "clouds")
            size = f"{abs(self.delay):.3f} +- {self.sigma_delay:.3f} s"
            can_be_set = abs(self.delay) <= MAX_DELAY
            stated = f"; set --cloud-delay={self.delay:.2f}: the first poses are off by it" if can_be_set else ""
            clauses.append(f"{late} {size} later than {early}: corrected{stated}")
        if abs(self.scale) >= _SCALE:
            size = "short" if self.scale > 0 else "long"
            clauses.append(f"odometry measures {abs(self.scale):.1%} too {size}: corrected")
        if abs(self.turn) >= _TURN:
            side = "left" if self.turn < 0 else "right"
            clauses.append(f"odometry turns {abs(math.degrees(self.turn)):.2f} deg per metre too far {side}: corrected")
        if abs(self.ground) >= _GROUND:
            side = "above" if self.ground > 0 else "below"
            clauses.append(
                f"the ground lies {abs(self.ground):.2f} m {side} the survey's (grass, snow): heights follow the rest"
            )
        if abs(self.changed) >= 2.0 * _GROUND:
            side, how = ("above", "filled, piled up") if self.changed > 0 else ("below", "dug")
            clauses.append(
                f"the ground here lies {abs(self.changed):.1f} m {side} the survey's ({how}): "
                "heights follow odometry and structure around"
            )
        return clauses

    def doubted(self) -> Calibration:
        """Return the calibration with wider sigmas, as the sensor may have been moved since."""
        return replace(self, **{name: max(getattr(self, name), least) for name, least in _MOVED.items()})

    def to_json(self) -> dict[str, Any]:
        """Plain data: degrees, metres, seconds, factors."""
        deg = math.degrees
        return {
            "roll_deg": round(deg(self.roll), 2),
            "pitch_deg": round(deg(self.pitch), 2),
            "tilt_sigma_deg": round(deg(self.sigma_tilt), 2),
            "odometry_scale": round(1.0 + self.scale, 4),
            "odometry_scale_sigma": round(self.sigma_scale, 4),
            "odometry_turn_deg_per_m": round(deg(self.turn), 3),
            "odometry_turn_sigma_deg_per_m": round(deg(self.sigma_turn), 3),
            "heading_deg": round(deg(self.heading), 2),
            "heading_sigma_deg": round(deg(self.sigma_heading), 2),
            "lever_x_m": round(self.lever_x, 3),
            "lever_y_m": round(self.lever_y, 3),
            "lever_sigma_m": round(self.sigma_lever, 3),
            "clouds_late_s": round(self.delay, 4),
            "clouds_late_sigma_s": round(self.sigma_delay, 4),
            "ground_offset_m": round(self.ground, 3),
            "changed_ground_m": round(self.changed, 2),
        }


LEVEL = math.radians(0.5)
"""Lean in radians up to which a scan counts as level: 0.15 m, the tolerance of ground, at 17 m."""


def lean_prior(lean: float, sigma: float) -> float:
    """Return the log-probability of a lean that was fitted, for a sensor with ``sigma`` radians of lean per axis.

    It is the probability of all leans within :data:`LEVEL` of the fitted one, as scans do not tell them apart. A lean
    below :data:`LEVEL` counts as none and costs nothing.
    """
    if lean < LEVEL:
        return 0.0
    spread = math.hypot(sigma, LEVEL)
    return 2.0 * math.log(LEVEL / spread) - 0.5 * (lean / spread) ** 2


class RawScan:
    """Points of a frame in the sensor's axes, with its odometry; levelled on access, the newest result cached.

    Attributes:
        T_odom_body: (4, 4) odometry of the frame.
        calibration: calibration at the time of the frame.
        moment: of the frame; None if unknown.
    """

    def __init__(
        self, points: Points, T_odom_body: Pose, calibration: Calibration | None = None, moment: Moment | None = None
    ) -> None:
        """Store points (N, 3) float32, one per voxel, odometry frame, levelled by ``calibration`` (default: none)."""
        self.T_odom_body = T_odom_body
        self.calibration = calibration or Calibration()
        self.moment = moment
        self._newest = self.calibration.T_body_cloud, points
        self._raw: Points | None = None

    def __len__(self) -> int:
        """Return the number of points N."""
        return len(self._newest[1])

    @property
    def position(self) -> Floats:
        """(3,) position of the body in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

    def levelled(self, calibration: Calibration) -> Points:
        """Return the points (N, 3) in the odometry frame, levelled by a calibration."""
        T, points = self._newest
        level = calibration.T_body_cloud
        if np.array_equal(T, level):
            return points
        if self._raw is None:
            self._raw = transform(inverse(self.T_odom_body @ T), points)
        self._newest = level, transform(self.T_odom_body @ level, self._raw)
        return self._newest[1]
