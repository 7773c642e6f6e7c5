"""Beams of finite width: noise that grows with the range, and echoes of two surfaces mixed at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.sim.dirt.ranges import within


@dataclass(frozen=True)
class Beams:
    """Range noise and divergence of a lidar's beams.

    Attributes:
        noise: of the range, metres per metre, one sigma, besides the sensor's constant noise.
        divergence: full angle of the beam, milliradians.
        pulse: metres within which two echoes of one beam are not told apart; their ranges mix.

    Raises:
        ConfigError: a value out of its range.
    """

    noise: float = 0.0007
    divergence: float = 3.0
    pulse: float = 0.8

    def __post_init__(self) -> None:
        within(self, noise=(0.0, 0.05), divergence=(0.0, 50.0), pulse=(0.0, 10.0))

    def aside(self, rays: Floats, rng: np.random.Generator) -> Floats:
        """Return (N, 3) unit rays elsewhere in the beams about (N, 3) unit rays."""
        shift = rng.normal(size=rays.shape)
        shift -= np.einsum("ij,ij->i", shift, rays)[:, None] * rays
        shift *= (np.sqrt(rng.random(len(rays))) / np.linalg.norm(shift, axis=1))[:, None]
        spread = rays + 0.5e-3 * self.divergence * shift
        return np.asarray(spread / np.linalg.norm(spread, axis=1)[:, None])

    def mixed(self, first: Floats, second: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return (N,) ranges that beams with echoes at both of (N,) ranges give, and the second echo's share in each.

        Echoes farther apart than the pulse stay apart, and the stronger wins.
        """
        share = rng.random(len(first))
        with np.errstate(invalid="ignore"):
            together = np.abs(second - first) < self.pulse
        share = np.where(together, share, np.round(share))
        share = np.where(np.isfinite(first), np.where(np.isfinite(second), share, 0.0), 1.0)
        safe = [np.where(np.isfinite(each), each, 0.0) for each in (first, second)]
        some = np.isfinite(first) | np.isfinite(second)
        return np.where(some, (1 - share) * safe[0] + share * safe[1], np.inf), share
