"""Weather: returns of rain drops, and of the dust behind a vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.sim.dirt.ranges import within


@dataclass(frozen=True)
class Rain:
    """Rain: near drops return some beams, and far surfaces return fewer.

    Attributes:
        drops: share of the beams that meet a drop; they return from it where nothing is nearer.
        reach: mean range of such a return, metres.
        extinction: of the light, per metre.

    Raises:
        ConfigError: a value out of its range.
    """

    drops: float = 0.02
    reach: float = 5.0
    extinction: float = 0.006

    def __post_init__(self) -> None:
        within(self, drops=(0.0, 1.0), reach=(0.1, 100.0), extinction=(0.0, 1.0))

    def returns(self, count: int, rng: np.random.Generator) -> Floats:
        """Return (N,) ranges of the drops that beams meet, metres; inf where there is none."""
        hit = rng.random(count) < self.drops
        return np.where(hit, rng.exponential(self.reach, count), np.inf)


@dataclass(frozen=True)
class Dust:
    """Dust cloud that the robot drags behind it, an ellipsoid that comes in gusts.

    Attributes:
        reach: mean way of a beam into the cloud, metres, in a gust of medium strength.
        centre: of the cloud, metres behind the body.
        size: half of its length, width and height, metres.
        gusts: logarithm of the factor by which its thickness varies, one sigma.

    Raises:
        ConfigError: a value out of its range.
    """

    reach: float = 3.0
    centre: float = 5.0
    size: tuple[float, float, float] = (3.5, 2.0, 1.2)
    gusts: float = 0.8

    def __post_init__(self) -> None:
        within(self, reach=(0.01, 1e3), centre=(0.0, 100.0), gusts=(0.0, 3.0))

    def returns(self, origins: Floats, rays: Floats, height: float, rng: np.random.Generator) -> Floats:
        """Return (N,) ranges at which beams (N, 3) from (N, 3), body frame, end in the dust, metres; inf elsewhere.

        ``height`` is the body's above the ground, on which the cloud lies.
        """
        reach = self.reach * float(np.exp(self.gusts * rng.normal()))
        middle = np.array([-self.centre, 0.0, self.size[2] - height])
        o, d = (origins - middle) / self.size, rays / self.size
        a, b, c = (d * d).sum(axis=1), (o * d).sum(axis=1), (o * o).sum(axis=1) - 1.0
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        enters, leaves = np.maximum((-b - root) / a, 0.0), (-b + root) / a
        ends = enters + rng.exponential(reach, len(rays))
        return np.where((b * b > a * c) & (ends < leaves), ends, np.inf)
