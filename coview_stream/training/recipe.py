"""Recipe of training worlds: the ranges from which worlds, trees and submaps are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, get_type_hints

import numpy as np

from coview_stream.config.checks import counts, positive
from coview_stream.errors import ConfigError
from coview_stream.sim.kinds import KINDS
from coview_stream.sim.sensors import SENSORS
from coview_stream.training.sensors import TRAINED_DIRT

Range = tuple[float, float]


@dataclass(frozen=True)
class Recipe:
    """Ranges (minimum, maximum) of the values drawn for worlds, trees and submaps; single numbers are shares or counts.

    The defaults span known forests and towns; they are not calibrated.

    Raises:
        ConfigError: a value out of its range, or an unknown kind or sensor.
    """

    built: Annotated[float, 0.0, 1.0] = 0.25  # share of worlds with buildings; the others are forests
    kinds: tuple[str, ...] = ("town", "campus", "village", "industrial")  # scenes of the worlds with buildings
    size: Annotated[Range, 80.0, 400.0] = (160.0, 200.0)  # side of the square map, metres
    submaps: Annotated[int, 1, 1000] = 60  # queries per world, evenly divided among the sensors
    # share of trees, cars and poles that differ between map and drive, in worlds with buildings
    changed: Annotated[Range, 0.0, 0.5] = (0.0, 0.2)
    stems: Annotated[Range, 20.0, 3000.0] = (150.0, 1200.0)  # trees per hectare
    tree_height: Annotated[Range, 2.0, 60.0] = (4.0, 35.0)  # metres
    crown_width: Annotated[Range, 0.03, 0.6] = (0.08, 0.5)  # diameter, in shares of the tree's height
    crown_base: Annotated[Range, 0.0, 0.9] = (0.1, 0.75)  # height of the lowest leaves, in shares of the tree's height
    crown_offset: Annotated[Range, 0.0, 3.0] = (0.0, 1.5)  # metres between a crown's centre and its stem's foot
    stem_radius: Annotated[Range, 0.03, 1.0] = (0.05, 0.5)  # metres
    # share of trees that stand, or have leaves, at only one of the two times
    mortality: Annotated[Range, 0.0, 0.5] = (0.0, 0.15)
    dead: Annotated[Range, 0.0, 0.5] = (0.0, 0.1)  # share of bare trees
    leaf_off: Annotated[float, 0.0, 1.0] = 0.2  # probability that one of the two times lies in winter
    understory: Annotated[Range, 0.0, 0.3] = (0.0, 0.1)  # bushes and saplings per square metre
    slope: Annotated[Range, 0.0, 35.0] = (0.0, 30.0)  # steepest slopes of a world, degrees
    roughness: Annotated[Range, 0.0, 0.5] = (0.0, 0.15)  # of the ground, metres
    wind: Annotated[Range, 0.0, 1.0] = (0.0, 0.3)  # shift of each crown between the two times, metres, 1 sigma
    # probability that an airborne pulse passes a surface of leaves
    aerial_porosity: Annotated[Range, 0.0, 0.95] = (0.2, 0.7)
    ground_porosity: Annotated[Range, 0.0, 0.95] = (0.1, 0.6)  # probability that a robot's beam passes one
    # mean depth below a crown's hull at which leaves are hit, metres
    leaf_depth: Annotated[Range, 0.0, 2.0] = (0.05, 0.6)
    pulses: Annotated[Range, 1.0, 200.0] = (5.0, 60.0)  # airborne, per square metre
    altitude: Annotated[Range, 150.0, 1000.0] = (180.0, 400.0)  # of the flight, metres
    swath: Annotated[Range, 5.0, 45.0] = (12.0, 30.0)  # half angle of the scan, degrees
    strip_shift: Annotated[Range, 0.0, 1.0] = (0.0, 0.1)  # error of a strip's horizontal position, metres, 1 sigma
    strip_lift: Annotated[Range, 0.0, 1.0] = (0.0, 0.05)  # error of a strip's height, metres, 1 sigma
    aerial_noise: Annotated[Range, 0.0, 0.3] = (0.02, 0.06)  # of airborne ranges, metres
    ground_noise: Annotated[Range, 0.0, 0.3] = (0.01, 0.04)  # of the robot's ranges, metres
    # names for trained_sensor
    sensors: tuple[str, ...] = ("vlp16", "os64", "mid360", "vlp16-inclined")
    sensor_height: Annotated[Range, 0.3, 5.0] = (0.6, 2.2)  # metres above the ground
    travel: Annotated[Range, 0.0, 60.0] = (3.0, 25.0)  # metres that the robot drives
    standing: Annotated[float, 0.0, 1.0] = 0.2  # share of submaps of robots that drive less than 3 m
    frame_step: Annotated[Range, 0.1, 5.0] = (0.7, 2.0)  # metres between the frames of a submap
    tilt: Annotated[Range, 0.0, 20.0] = (0.3, 1.5)  # sway of the robot, degrees, 1 sigma
    gravity_error: Annotated[Range, 0.0, 3.0] = (0.0, 0.4)  # error of its odometry's vertical, degrees, 1 sigma
    scale_error: Annotated[Range, 0.0, 0.2] = (0.0, 0.02)  # drift of its odometry, a share
    yaw_walk: Annotated[Range, 0.0, 2.0] = (0.0, 0.2)  # drift of its odometry, degrees per square root of a metre
    rays: Annotated[int, 5_000, 2_000_000] = 160_000  # most beams cast for a submap, thinned evenly
    dirt: tuple[str, ...] = ()  # kinds of TRAINED_DIRT in drives

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(Recipe, include_extras=True).items():
            if not hasattr(hint, "__metadata__"):
                continue
            (low, high), value = hint.__metadata__, getattr(self, name)
            ends = (value, value) if hint.__origin__ in (int, float) else tuple(value)
            if len(ends) != 2 or not low <= ends[0] <= ends[1] <= high:
                bounds = f"stay, smallest first, within {low:g} to {high:g}"
                raise ConfigError(f"{name}: {value!r} is out of range; {bounds}")
        for name, choices in (("kinds", tuple(KINDS)), ("sensors", tuple(SENSORS))):
            values = getattr(self, name)
            if not values or not set(values) <= set(choices):
                raise ConfigError(f"{name}: {values!r}; use one or more of {', '.join(choices)}")
        if not set(self.dirt) <= set(TRAINED_DIRT):
            raise ConfigError(f"dirt: {self.dirt!r}; use none or some of {', '.join(TRAINED_DIRT)}")

    def draw(self, rng: np.random.Generator, name: str) -> float:
        """Draw one value uniformly from the range ``name``."""
        low, high = getattr(self, name)
        return float(rng.uniform(low, high))


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of the training loop."""

    steps: int = 600  # number of batches
    pieces: int = 4  # maps (136 m) in a batch
    each: int = 5  # queries per map
    rate: float = 3e-3  # initial learning rate of AdamW, which falls along a cosine
    decay: float = 1e-4  # AdamW's weight decay
    width: int = 24  # the encoder's channels at 1 m
    wrong: int = 4  # wrong headings that compete with each query's true heading
    seed: int = 0  # of the initial weights and of the batches

    def __post_init__(self) -> None:
        counts(self, "steps", "pieces", "each", "width", "wrong")
        counts(self, "seed", minimum=0)
        positive(self, "rate", "decay")
