"""Configuration of a simulated world."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from coview_stream.errors import ConfigError
from coview_stream.sim.dirt.config import Dirt
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.odometry import OdometryConfig
from coview_stream.sim.sensors import SENSORS

_RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "drive_seed": (0, 2**31 - 1),
    "size": (80.0, 2000.0),
    "length": (0.0, 10_000.0),
    "density": (0.5, 200.0),
    "changed": (0.0, 1.0),
    "speed": (0.1, 30.0),
    "height": (0.3, 5.0),
}


@dataclass(frozen=True)
class SimulationConfig:
    """Configuration of a world and a drive through it.

    Attributes:
        scene: town, campus, village, industrial or forest.
        sensor: vlp16, os64, os64-2048 or mid360.
        seed: of all random numbers; equal configurations give equal files.
        size: side of the square map, metres.
        length: distance driven, metres.
        density: airborne pulses per square metre.
        changed: share of the trees, cars and poles that were replaced since the map was made.
        origin: added to all map coordinates, metres (a UTM-like offset).
        speed: of the robot, metres per second.
        height: of the sensor above the ground, metres.
        odometry: errors of the odometry.
        dirt: what is imperfect beyond that; nothing by default.
        drive_seed: of the drive, its scans and its odometry; others give other runs through the same world.

    Raises:
        ConfigError: unknown scene or sensor, or a value out of its range.
    """

    scene: str = "town"
    sensor: str = "vlp16"
    seed: int = 1
    size: float = 240.0
    length: float = 80.0
    density: float = 20.0
    changed: float = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed: float = 1.5
    height: float = 1.5
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    dirt: Dirt = field(default_factory=Dirt)
    drive_seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("scene", KINDS), ("sensor", SENSORS)):
            value = getattr(self, name)
            if value not in known:
                raise ConfigError(f"{name}: {value!r} is unknown; use one of {', '.join(known)}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"{name}: {value!r} is out of range; use {low:g} to {high:g}")
        if len(self.origin) != 3 or not all(abs(value) <= 1e7 for value in self.origin):
            raise ConfigError(f"origin: {self.origin!r} is no offset; give x y z in metres, up to 10,000 km")

    def to_dict(self) -> dict[str, Any]:
        """Return all fields as plain values, for JSON; ``dirt`` and ``drive_seed`` only if there is some."""
        values = asdict(self) | {"dirt": self.dirt.to_dict()}
        if not self.dirt.kinds:
            del values["dirt"]
        if not self.drive_seed:
            del values["drive_seed"]
        return values
