"""Faults of an airborne survey: misaligned strips and an uneven density."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from coview_stream.config.checks import require, within
from coview_stream.geometry.arrays import Bools, Floats

_PATCH = 70.0  # metres: wavelength of the density
_WAVES = 6  # number of summed waves
_UPRIGHT = 0.5  # share of a strip's error that may be vertical


@dataclass(frozen=True)
class Strips:
    """Misalignment of whole strips of a survey, zero on average."""

    least: float = 0.05  # least root mean square distance between the offsets of two strips, metres
    most: float = 0.15  # greatest; the distance is drawn uniformly between the two

    def __post_init__(self) -> None:
        within(self, least=(0.0, 5.0), most=(0.0, 5.0))
        require(self.least <= self.most, self, "most", "at least .least")

    def offsets(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw the offsets (count, 3) of the strips, metres."""
        apart = rng.uniform(self.least, self.most)
        offsets = rng.normal(size=(count, 3)) * (1.0, 1.0, _UPRIGHT)
        offsets -= offsets.mean(axis=0)
        size = disagreement(offsets)
        return np.asarray(offsets * (apart / size if size > 0.0 else 0.0))


def disagreement(offsets: Floats) -> float:
    """Return the root mean square distance between pairs of offsets (N, 3), metres."""
    i, j = np.triu_indices(len(offsets), 1)
    return float(np.sqrt(((offsets[i] - offsets[j]) ** 2).sum(axis=1).mean())) if len(i) else 0.0


@dataclass(frozen=True)
class Density:
    """Density of a survey that varies with the place; replaces the configured density."""

    least: float = 4.0  # pulses per square metre where it is thinnest
    most: float = 60.0  # where it is densest

    def __post_init__(self) -> None:
        within(self, least=(0.1, 500.0), most=(0.1, 500.0))
        require(self.least <= self.most, self, "most", "at least .least")


class Thinning:
    """Density of a survey by place, and the thinning of an even scan to this density."""

    def __init__(self, density: Density, rng: np.random.Generator) -> None:
        self._density = density
        angle = rng.uniform(0, 2 * np.pi, _WAVES)
        k = 2 * np.pi / (_PATCH * rng.uniform(0.7, 2.0, _WAVES))
        self._k = np.stack([k * np.cos(angle), k * np.sin(angle)])
        self._phase = rng.uniform(0, 2 * np.pi, _WAVES)

    def at(self, xy: Floats) -> Floats:
        """Return the pulses per square metre (N,) at places (N, 2), metres."""
        wave = np.sin(xy @ self._k + self._phase).sum(axis=1) / np.sqrt(_WAVES / 2)
        share = 0.5 + 0.5 * np.tanh(1.2 * wave)
        return np.asarray(self._density.least * (self._density.most / self._density.least) ** share)

    def keeps(self, points: Floats, rng: np.random.Generator) -> Bools:
        """Mask the points (N, 3), of a scan with the largest density, that remain."""
        return np.asarray(rng.random(len(points)) * self._density.most < self.at(points[:, :2]))


def spoilt_strips(
    strips: Iterable[tuple[float, Floats]], faults: Strips | None, thinning: Thinning | None, rng: np.random.Generator
) -> Iterator[tuple[float, Floats]]:
    """Yield the strips of ``airborne_scan`` with their faults, after all have been flown."""
    thinned = [(done, points if thinning is None else points[thinning.keeps(points, rng)]) for done, points in strips]
    offsets = np.zeros((len(thinned), 3)) if faults is None else faults.offsets(len(thinned), rng)
    for (done, points), offset in zip(thinned, offsets, strict=True):
        yield done, points + offset
