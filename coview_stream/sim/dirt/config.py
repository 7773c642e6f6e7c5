"""Kinds of dirt of the real world, and their strengths."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from coview_stream.config.checks import within
from coview_stream.errors import ConfigError
from coview_stream.sim.dirt.optics import Beams, Dust, Glass, Rain, Reflectors
from coview_stream.sim.dirt.robot import Gravity, Miscalibration, Motion, Mounting, Slip
from coview_stream.sim.dirt.scene import Grass, Seasons, Snow, Traffic, Years
from coview_stream.sim.dirt.survey import Density, Strips

REAL = "real"
"""Name of the preset with all kinds on."""


@dataclass(frozen=True)
class Dirt:
    """Dirt in a simulated world; each kind is None (off) or its settings.

    The written truth stays the true pose of the body.

    Raises:
        ConfigError: a value out of its range, here or in one of the kinds.
    """

    seed: int = 0  # of all random numbers for dirt, in addition to the world's own seed
    motion: Motion | None = None  # raw sweeps of a moving robot, deskewed by its odometry
    traffic: Traffic | None = None  # people and vehicles that move
    rain: Rain | None = None  # returns from drops
    dust: Dust | None = None  # returns from a cloud behind the robot
    beams: Beams | None = None  # noise that grows with the range, mixed echoes at edges
    reflectors: Reflectors | None = None  # signs that bloom
    glass: Glass | None = None  # windows that mirror beams or let them pass
    mounting: Mounting | None = None  # a leaning, displaced sensor
    gravity: Gravity | None = None  # a wrong gravity direction in the odometry
    odometry: Miscalibration | None = None  # wrong scale and a drifting heading
    slip: Slip | None = None  # bursts of slipping wheels
    strips: Strips | None = None  # survey strips that disagree
    density: Density | None = None  # an uneven density of the survey
    seasons: Seasons | None = None  # bare trees in the map, leaves now
    years: Years | None = None  # years between survey and run
    grass: Grass | None = None  # tall grass off the roads
    snow: Snow | None = None  # snow on the ground

    def __post_init__(self) -> None:
        within(self, seed=(0, 2**31 - 1))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the kinds that are on."""
        return tuple(name for name in KINDS_OF_DIRT if getattr(self, name) is not None)

    @property
    def on_sensor(self) -> bool:
        """Whether the robot's frames differ from a clean world's by more than the changes of the scene."""
        return any(name in _ON_SENSOR for name in self.kinds)

    def describe(self) -> list[str]:
        """Describe the strength of each kind that is on: "snow 0.4: m of snow off the roads"."""
        strengths = [(name, STRENGTHS[name]) for name in self.kinds]
        return [f"{name} {getattr(getattr(self, name), s.field):g}: {s.unit}" for name, s in strengths]

    def to_dict(self) -> dict[str, Any]:
        """Return the seed and the settings of the kinds that are on as plain values, for JSON."""
        return {"seed": self.seed} | {name: asdict(getattr(self, name)) for name in self.kinds}


class Strength(NamedTuple):
    """Dataclass of a kind of dirt, the field that a number on the command line sets, and its meaning."""

    settings: Any
    field: str
    unit: str


STRENGTHS: dict[str, Strength] = {
    "motion": Strength(Motion, "rate", "samples of odometry a second, by which sweeps are deskewed"),
    "traffic": Strength(Traffic, "people", "people on 100 m of street"),
    "rain": Strength(Rain, "drops", "share of the beams that meet a drop"),
    "dust": Strength(Dust, "reach", "m that a beam reaches into the cloud"),
    "beams": Strength(Beams, "divergence", "mrad of a beam's width"),
    "reflectors": Strength(Reflectors, "bloom", "degrees of the halo about a sign"),
    "glass": Strength(Glass, "share", "share of the buildings that have windows"),
    "mounting": Strength(Mounting, "lean", "degrees that the sensor leans"),
    "gravity": Strength(Gravity, "error", "degrees of odometry's down"),
    "odometry": Strength(Miscalibration, "scale", "share by which distances are wrong"),
    "slip": Strength(Slip, "share", "share of the distance in a burst"),
    "strips": Strength(Strips, "most", "m by which survey strips disagree at most"),
    "density": Strength(Density, "least", "pulses per m2 where the survey is thinnest"),
    "seasons": Strength(Seasons, "bare", "probability that a pulse passes one surface of a bare crown"),
    "years": Strength(Years, "years", "years between survey and run"),
    "grass": Strength(Grass, "height", "m of the tallest grass"),
    "snow": Strength(Snow, "depth", "m of snow off the roads"),
}
"""Settings of each kind, and the field that a number after its name on the command line sets."""

KINDS_OF_DIRT = tuple(STRENGTHS)
"""Names of all kinds of dirt."""

_ON_SENSOR = frozenset(
    ("motion", "traffic", "rain", "dust", "beams", "reflectors", "glass", "mounting", "grass", "snow")
)


def real(seed: int = 0) -> Dirt:
    """Return all kinds of dirt at once with their default strengths: the worst of all seasons in one run."""
    return Dirt(seed, **{name: strength.settings() for name, strength in STRENGTHS.items()})


def parse_dirt(text: str, seed: int = 0) -> Dirt:
    """Parse a list of dirt such as ``rain,snow:0.4``; ``real`` is all kinds.

    A number after a colon sets the kind's strength (:data:`STRENGTHS`); ``real,snow:0.1`` changes one of all kinds.

    Raises:
        ConfigError: an unknown kind, a word for a number, or a number out of its range.
    """
    dirt = Dirt(seed)
    for word in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = word.partition(":")
        if word == REAL:
            dirt = real(seed)
            continue
        if name not in STRENGTHS:
            raise ConfigError(f"dirt: {name!r} is unknown; use {REAL}, or some of {', '.join(KINDS_OF_DIRT)}")
        strength, settings = STRENGTHS[name], {}
        try:
            if value:
                settings = {strength.field: float(value)}
            kind = strength.settings(**settings)
        except ConfigError as error:
            raise ConfigError(f"dirt: {word!r}, the number being {strength.unit}: {error}") from error
        except ValueError as error:
            raise ConfigError(f"dirt: {word!r} does not end with a number; write for example snow:0.4") from error
        dirt = replace(dirt, **{name: kind})
    return dirt
