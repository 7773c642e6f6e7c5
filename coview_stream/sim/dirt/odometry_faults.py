"""Faults of odometry: a wrong scale, a turning gyro, slipping wheels, and a gravity that is not down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import exp_so3
from coview_stream.sim.dirt.ranges import within


@dataclass(frozen=True)
class Miscalibration:
    """Constant errors of odometry over a run, and a heading that walks.

    Attributes:
        scale: share by which distances are over- or underrated; the sign is drawn.
        yaw_rate: constant error of the heading, degrees per metre driven; the sign is drawn.
        yaw_walk: random walk of the heading, degrees per square root of a metre, one sigma.

    Raises:
        ConfigError: a value out of its range.
    """

    scale: float = 0.05
    yaw_rate: float = 0.05
    yaw_walk: float = 0.5

    def __post_init__(self) -> None:
        within(self, scale=(0.0, 0.5), yaw_rate=(0.0, 10.0), yaw_walk=(0.0, 20.0))

    def apply(self, odometry: Floats, rng: np.random.Generator) -> Floats:
        """Return the poses (N, 4, 4) ``T_odom_body`` as this odometry would give them."""
        driven = _driven(odometry)
        sides = rng.choice([-1.0, 1.0], 2)
        walk = rng.normal(size=len(driven)) * np.sqrt(driven) * self.yaw_walk
        yaw = np.radians(np.cumsum(walk + sides[1] * self.yaw_rate * driven))
        return spoilt(odometry, _about_z(yaw), np.full(len(driven), 1.0 + sides[0] * self.scale))


@dataclass(frozen=True)
class Slip:
    """Bursts of slipping wheels: distance counted that was not driven, or the other way round, and a false turn.

    Attributes:
        share: of the distance in a burst that is counted too much (spinning) or too little (skidding), either drawn.
        turn: false turn in a burst, degrees, one sigma.
        length: of a burst, metres driven.
        every: mean distance from burst to burst, metres driven.

    Raises:
        ConfigError: a value out of its range.
    """

    share: float = 0.5
    turn: float = 4.0
    length: float = 1.5
    every: float = 25.0

    def __post_init__(self) -> None:
        within(self, share=(0.0, 1.0), turn=(0.0, 90.0), length=(0.1, 100.0), every=(0.1, 1e4))

    def apply(self, odometry: Floats, rng: np.random.Generator) -> Floats:
        """Return the poses (N, 4, 4) ``T_odom_body`` as this odometry would give them."""
        driven = _driven(odometry)
        way = np.cumsum(driven)
        turns, factors = np.zeros(len(driven)), np.ones(len(driven))
        for begin in self.bursts(float(way[-1]) if len(way) else 0.0, rng):
            inside = (way > begin) & (way <= begin + self.length)
            share, turn = rng.choice([-1.0, 1.0]) * self.share, rng.normal() * self.turn
            factors[inside] = 1.0 + share
            turns[inside] += turn / max(int(inside.sum()), 1)
        return spoilt(odometry, _about_z(np.radians(np.cumsum(turns))), factors)

    def bursts(self, way: float, rng: np.random.Generator) -> Floats:
        """Draw where on a way of that length, metres, the wheels begin to slip: evenly spread, at least once."""
        count = max(1, round(way / self.every))
        return (np.arange(count) + rng.uniform(0.2, 0.8, count)) * way / count


@dataclass(frozen=True)
class Gravity:
    """Error of the direction that the inertial unit takes for down: constant in size, slowly turning.

    Attributes:
        error: angle between down and what is taken for it, degrees.
        period: seconds in which the false direction goes once round.

    Raises:
        ConfigError: a value out of its range.
    """

    error: float = 0.5
    period: float = 300.0

    def __post_init__(self) -> None:
        within(self, error=(0.0, 45.0), period=(1.0, 1e6))

    def apply(self, odometry: Floats, stamps: Floats, rng: np.random.Generator) -> Floats:
        """Return the poses (N, 4, 4) ``T_odom_body`` as this odometry would give them at (N,) stamps, seconds."""
        angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (stamps - stamps[0]) / self.period
        axes = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        tilts = exp_so3(np.radians(self.error) * axes)
        return spoilt(odometry, tilts[1:], np.ones(len(odometry) - 1), tilts[0])


def spoilt(odometry: Floats, turns: Floats, factors: Floats, first: Floats | None = None) -> Floats:
    """Return poses (N, 4, 4) put together anew from spoilt motions.

    Args:
        odometry: (N, 4, 4) ``T_odom_body``.
        turns: (N - 1, 3, 3) rotation of the odometry's axes after each motion, in place of none.
        factors: (N - 1,) on the length of each motion.
        first: (3, 3) rotation of the axes at the first pose, the identity if None.
    """
    every = np.concatenate([(np.eye(3) if first is None else first)[None], turns])
    moved = np.diff(odometry[:, :3, 3], axis=0) * factors[:, None]
    moved = np.einsum("nij,nj->ni", every[:-1], moved)
    poses = odometry.copy()
    poses[:, :3, :3] = every @ odometry[:, :3, :3]
    poses[1:, :3, 3] = odometry[0, :3, 3] + np.cumsum(moved, axis=0)
    return poses


def _about_z(angles: Floats) -> Floats:
    return exp_so3(np.column_stack([np.zeros((len(angles), 2)), angles]))


def _driven(odometry: Floats) -> Floats:
    return np.asarray(np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1))
