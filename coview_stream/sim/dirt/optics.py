"""Optical dirt: beams of finite width, rain, dust, windows, and signs that bloom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from coview_stream.config.checks import within
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Indices


@dataclass(frozen=True)
class Beams:
    """Range noise and divergence of a lidar's beams."""

    noise: float = 0.0007  # range noise, metres per metre, one sigma, added to the sensor's constant noise
    divergence: float = 3.0  # full angle of the beam, milliradians
    pulse: float = 0.8  # metres within which two echoes of one beam merge, and their ranges mix

    def __post_init__(self) -> None:
        within(self, noise=(0.0, 0.05), divergence=(0.0, 50.0), pulse=(0.0, 10.0))

    def aside(self, rays: Floats, rng: np.random.Generator) -> Floats:
        """Draw other unit rays (N, 3) within the beams around unit rays (N, 3)."""
        shift = rng.normal(size=rays.shape)
        shift -= np.einsum("ij,ij->i", shift, rays)[:, None] * rays
        shift *= (np.sqrt(rng.random(len(rays))) / np.linalg.norm(shift, axis=1))[:, None]
        spread = rays + 0.5e-3 * self.divergence * shift
        return np.asarray(spread / np.linalg.norm(spread, axis=1)[:, None])

    def mixed(self, first: Floats, second: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return the ranges (N,) of beams with two echoes each, and the second echo's share (N,) in them.

        Of echoes farther apart than the pulse the stronger wins.
        """
        share = rng.random(len(first))
        with np.errstate(invalid="ignore"):
            together = np.abs(second - first) < self.pulse
        share = np.where(together, share, np.round(share))
        share = np.where(np.isfinite(first), np.where(np.isfinite(second), share, 0.0), 1.0)
        safe = [np.where(np.isfinite(ranges), ranges, 0.0) for ranges in (first, second)]
        returned = np.isfinite(first) | np.isfinite(second)
        return np.where(returned, (1 - share) * safe[0] + share * safe[1], np.inf), share


@dataclass(frozen=True)
class Rain:
    """Rain: near drops return some beams, and far surfaces return fewer."""

    drops: float = 0.02  # share of the beams that meet a drop, and return from it unless a surface is nearer
    reach: float = 5.0  # mean range of such a return, metres
    extinction: float = 0.006  # extinction coefficient, per metre

    def __post_init__(self) -> None:
        within(self, drops=(0.0, 1.0), reach=(0.1, 100.0), extinction=(0.0, 1.0))

    def returns(self, count: int, rng: np.random.Generator) -> Floats:
        """Return the ranges (N,) of the drops that beams meet, metres; inf without a drop."""
        hit = rng.random(count) < self.drops
        return np.where(hit, rng.exponential(self.reach, count), np.inf)


@dataclass(frozen=True)
class Dust:
    """Dust cloud that the robot drags behind it, an ellipsoid whose density varies in gusts."""

    reach: float = 3.0  # mean path of a beam into the cloud in a gust of medium strength, metres
    centre: float = 5.0  # of the cloud, metres behind the body
    size: tuple[float, float, float] = (3.5, 2.0, 1.2)  # half of its length, width and height, metres
    gusts: float = 0.8  # logarithm of the factor by which the density varies, one sigma

    def __post_init__(self) -> None:
        within(self, reach=(0.01, 1e3), centre=(0.0, 100.0), gusts=(0.0, 3.0))

    def returns(self, origins: Floats, rays: Floats, height: float, rng: np.random.Generator) -> Floats:
        """Return the ranges (N,) at which beams (N, 3) from (N, 3), body frame, end in the dust, metres; else inf.

        ``height`` is the height of the body above the ground, on which the cloud lies.
        """
        reach = self.reach * float(np.exp(self.gusts * rng.normal()))
        middle = np.array([-self.centre, 0.0, self.size[2] - height])
        o, d = (origins - middle) / self.size, rays / self.size
        a, b, c = (d * d).sum(axis=1), (o * d).sum(axis=1), (o * o).sum(axis=1) - 1.0
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        enters, leaves = np.maximum((-b - root) / a, 0.0), (-b + root) / a
        ends = enters + rng.exponential(reach, len(rays))
        return np.where((b * b > a * c) & (ends < leaves), ends, np.inf)


# metres
_STOREY, _SILL, _LINTEL = 3.2, 0.7, 2.7
_BAY, _FRAME = 3.0, 0.3
_UPRIGHT = 0.3  # greatest vertical part of a wall's unit normal
_STEP = 0.02  # distance beyond the pane at which a ray continues


@dataclass(frozen=True)
class Glass:
    """Windows in the walls of some buildings."""

    share: float = 0.4  # share of the buildings with windows
    mirrors: float = 0.4  # probability that a window mirrors a beam
    passes: float = 0.4  # probability that the beam passes; the rest returns from the pane
    strength: float = 0.5  # share of the light that returns from surfaces behind or mirrored in the glass

    def __post_init__(self) -> None:
        within(self, share=(0.0, 1.0), mirrors=(0.0, 1.0), passes=(0.0, 1.0 - self.mirrors), strength=(0.0, 1.0))


class Panes(NamedTuple):
    """Beams that continue at a window."""

    which: Indices  # (K,) indices among all beams
    origins: Floats32  # (K, 3) new origins, scene frame, metres
    rays: Floats32  # (K, 3) new directions, unit vectors


def windows(points: Floats, normals: Floats, height: Floats) -> Bools:
    """Mask the points (N, 3) on walls that are panes, in a row of windows on each storey.

    ``normals`` (N, 3) are the walls' unit normals, ``height`` (N,) metres above the ground.
    """
    level = np.maximum(np.hypot(normals[:, 0], normals[:, 1]), 1e-6)
    along = (points[:, 1] * normals[:, 0] - points[:, 0] * normals[:, 1]) / level
    above, bay = np.mod(height, _STOREY), np.mod(along, _BAY)
    pane = (above > _SILL) & (above < _LINTEL) & (bay > _FRAME) & (height > 0.0)
    return np.asarray(pane & (np.abs(normals[:, 2]) < _UPRIGHT))


def panes(glass: Glass, points: Floats, rays: Floats, normals: Floats, rng: np.random.Generator) -> tuple[Bools, Panes]:
    """Return which of the (N,) beams that meet a pane continue, and how.

    ``points`` (N, 3) on the pane, ``rays`` (N, 3) and ``normals`` (N, 3) are in the scene frame.
    """
    fate = rng.random(len(rays))
    mirrored, passed = fate < glass.mirrors, (fate >= glass.mirrors) & (fate < glass.mirrors + glass.passes)
    into = np.einsum("ij,ij->i", rays, normals)[:, None]
    on = np.where(mirrored[:, None], rays - 2.0 * into * normals, rays)
    goes_on = mirrored | passed
    start = points + _STEP * on
    which = np.flatnonzero(goes_on)
    return goes_on, Panes(which, start[which].astype(np.float32), on[which].astype(np.float32))


_LIMIT = 2.5  # radius of the halo, in widths of the bloom
_NOISE = 0.03  # metres; a saturated receiver has noisier ranges


@dataclass(frozen=True)
class Reflectors:
    """Blooming of retro-reflecting signs: a halo at the sign's range."""

    bloom: float = 0.8  # width of the halo, degrees, one sigma
    reach: float = 40.0  # metres within which a sign is bright enough

    def __post_init__(self) -> None:
        within(self, bloom=(0.01, 10.0), reach=(0.0, 500.0))

    def halo(self, rays: Floats, distance: Floats, signs: Bools, rng: np.random.Generator) -> Floats:
        """Return the ranges (N,) of unit ``rays`` (N, 3); rays close to a bright sign get its range.

        ``signs`` (N,) masks the distances (N,) to signs. Nearer returns stay.
        """
        bright = signs & (distance < self.reach)
        if not bright.any():
            return distance
        from scipy.spatial import cKDTree

        width = np.radians(self.bloom)
        apart, which = cKDTree(rays[bright]).query(rays, distance_upper_bound=_LIMIT * width)
        close = np.flatnonzero(np.isfinite(apart) & ~signs)
        sign = distance[bright][which[close]] + rng.normal(0, _NOISE, len(close))
        lit = rng.random(len(close)) < np.exp(-0.5 * (apart[close] / width) ** 2)
        bloomed = distance.copy()
        bloomed[close] = np.where(lit & (sign < distance[close]), sign, distance[close])
        return bloomed
