"""Mounting of a lidar on the robot's body."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.config.checks import check_types, require
from coview_stream.errors import ConfigError, counted
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, exp_so3, pose_from, rot_z, transform

MAX_LEVER = 100.0  # metres from the body's origin to the sensor; more means another unit
_UPRIGHT = math.sin(math.radians(0.05))  # least cosine of a pitch that is not 90 degrees to the nearest 0.1


@dataclass(frozen=True)
class Mount:
    """Position and orientation of a lidar: T_body_sensor, body x forward and z up.

    Points are rolled about the body's x first, then pitched about its y (positive: nose down), then turned about its z.

    Attributes:
        roll: radians, at most a full turn either way; pi is upside down.
        pitch: radians, likewise.
        yaw: radians, likewise.
        x: metres forward of the body's origin.
        y: metres to its left.
        z: metres above it.
        drawn: heading and place are taken from a drawing, to 0.1 degrees and 5 mm. Else, as with angles alone, the
            heading is a guess and the place is unknown.
    """

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    drawn: bool = True

    def __post_init__(self) -> None:
        check_types(self)
        for name in ("roll", "pitch", "yaw"):
            require(abs(getattr(self, name)) <= 2 * math.pi + 1e-9, self, name, "at most 360 degrees, in radians")
        for name in ("x", "y", "z"):
            require(abs(getattr(self, name)) <= MAX_LEVER, self, name, f"at most {MAX_LEVER:g} m")

    @property
    def T_body_sensor(self) -> Pose:
        """(4, 4), body <- sensor, metres."""
        pitched = exp_so3([0.0, self.pitch, 0.0]) @ exp_so3([self.roll, 0.0, 0.0])
        return pose_from(rot_z(self.yaw) @ pitched, [self.x, self.y, self.z])

    def turned(self, R: Floats) -> Mount:
        """Return the mount of this lidar if its clouds in the body frame need a further rotation ``R`` (3, 3)."""
        return self.moved(pose_from(R, np.zeros(3)))

    def moved(self, T_body_cloud: Pose) -> Mount:
        """Return the mount of this lidar if its clouds in the body frame need a further motion by a pose (4, 4)."""
        T = T_body_cloud @ self.T_body_sensor
        roll, pitch = math.atan2(T[2, 1], T[2, 2]), -math.asin(max(-1.0, min(1.0, float(T[2, 0]))))
        yaw = math.atan2(T[1, 0], T[0, 0])
        if math.cos(pitch) < _UPRIGHT:  # roll and yaw share an axis
            roll, yaw = 0.0, math.atan2(-T[0, 1], T[1, 1])
        x, y, z = T[:3, 3].tolist()
        return Mount(roll, pitch, yaw, x, y, z, self.drawn)

    def to_json(self) -> dict[str, float]:
        """Return roll, pitch, yaw (degrees) and x, y, z (metres) as plain data, with the unit in each name."""
        angles = {f"{name}_deg": round(math.degrees(getattr(self, name)), 6) for name in ("roll", "pitch", "yaw")}
        return angles | {f"{name}_m": getattr(self, name) for name in ("x", "y", "z")}

    @property
    def option(self) -> str:
        """Text for :func:`parse_mount`, to a tenth of a degree and a centimetre."""
        angles = [round(math.degrees(angle), 1) for angle in (self.roll, self.pitch, self.yaw)]
        metres = [round(m, 2) for m in (self.x, self.y, self.z)]
        stated = any(metres) or (self.drawn and any(angles))
        return ",".join(f"{number + 0.0:g}" for number in angles + metres * stated)

    def to_body(self, points: Points) -> Points:
        """Return a cloud (N, 3), sensor frame, metres, in the body frame; the cloud itself if the frames coincide."""
        if replace(self, drawn=True) == Mount():
            return points
        with np.errstate(invalid="ignore", over="ignore"):  # missing returns may be infinite
            return transform(self.T_body_sensor, points)


def parse_mount(text: str) -> Mount:
    """Read the value of an option, ``roll,pitch,yaw[,x,y,z]`` in degrees and metres; ConfigError for other text.

    Angles alone are not ``drawn``, unless all are 0.
    """
    given = f"--mount={text}"
    shape = "give roll,pitch,yaw in degrees, or roll,pitch,yaw,x,y,z with metres, such as --mount=180,0,0"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"{given}: {shape}") from error
    if len(numbers) not in (3, 6):
        raise ConfigError(f"{given}: {counted(len(numbers), 'number')}; {shape}")
    if not all(math.isfinite(number) for number in numbers):
        raise ConfigError(f"{given}: not finite; {shape}")
    if max(abs(angle) for angle in numbers[:3]) > 360.0:
        raise ConfigError(f"{given}: an angle is beyond 360 degrees; {shape}")
    if any(abs(metres) > MAX_LEVER for metres in numbers[3:]):
        raise ConfigError(f"{given}: a sensor {MAX_LEVER:g} m away is not a mount; metres follow the angles")
    drawn = len(numbers) == 6 or not any(numbers)
    roll, pitch, yaw = (math.radians(angle) for angle in numbers[:3])
    x, y, z = numbers[3:] or (0.0, 0.0, 0.0)
    return Mount(roll, pitch, yaw, x, y, z, drawn)
