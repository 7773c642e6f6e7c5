"""Retro-reflectors: traffic signs so bright that beams beside them return from them too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.sim.dirt.ranges import within

_LIMIT = 2.5  # times the width of the bloom; set by hand
_NOISE = 0.03  # metres; a saturated receiver ranges worse than it should; set by hand


@dataclass(frozen=True)
class Reflectors:
    """Blooming of retro-reflecting signs: a halo at the sign's range.

    Attributes:
        bloom: width of the halo, degrees, one sigma.
        reach: metres within which a sign is bright enough.

    Raises:
        ConfigError: a value out of its range.
    """

    bloom: float = 0.8
    reach: float = 40.0

    def __post_init__(self) -> None:
        within(self, bloom=(0.01, 10.0), reach=(0.0, 500.0))

    def halo(self, rays: Floats, distance: Floats, signs: Bools, rng: np.random.Generator) -> Floats:
        """Return (N,) ranges with those beams of (N, 3) unit ``rays`` put to a sign that leave close to one.

        ``signs`` tells which of the (N,) distances are those of signs. What is nearer than the sign stays.
        """
        bright = signs & (distance < self.reach)
        if not bright.any():
            return distance
        from scipy.spatial import cKDTree

        width = np.radians(self.bloom)
        apart, which = cKDTree(rays[bright]).query(rays, distance_upper_bound=_LIMIT * width)
        beside = np.flatnonzero(np.isfinite(apart) & ~signs)
        sign = distance[bright][which[beside]] + rng.normal(0, _NOISE, len(beside))
        lit = rng.random(len(beside)) < np.exp(-0.5 * (apart[beside] / width) ** 2)
        bloomed = distance.copy()
        bloomed[beside] = np.where(lit & (sign < distance[beside]), sign, distance[beside])
        return bloomed
