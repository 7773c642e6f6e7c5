"""Noise of odometry: the configured rates of its drift, and what registrations show them to be.

A wheeled robot on asphalt drifts by half a per cent, one on gravel by five. With one sigma for all, the poses of the
first would be reported far too uncertain and those of the second too certain. So the rates are measured while tracking:
the motion between two registrations, less the motion that odometry tells, is its drift and the noise of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np

from coview_stream.config import TrackingConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.localization.registration.covariance import swap_rotation_translation

_GROUPS = ((0, 1), (2,), (3, 4), (5,))  # of (rx, ry, rz, x, y, z): tilt, yaw, position, height
# set by hand
_MIN_FACTOR = 0.3  # of the configured rates
_MAX_FACTOR = 20.0  # likewise: a scale error is no random walk, and looks like a high rate
_OUTLIER = 16.0  # variances; a slip beyond counts as one so large, so that rates grow step by step
_MIN_STEP = 0.2  # metres; over less, drift cannot be told from the registrations' noise
_MIN_TURN = float(np.radians(5.0))  # likewise
_MIN_DRIVEN = 1e-3  # metres: standing still, a covariance of zero would be none


@dataclass(frozen=True)
class Drift:
    """Sigmas of odometry's errors, of a random walk: per square root of a metre driven.

    Attributes:
        position: metres, each of x and y.
        height: metres.
        tilt: radians, each of roll and pitch.
        yaw: radians.
        turn: radians of yaw per radian turned.
    """

    position: float
    height: float
    tilt: float
    yaw: float
    turn: float

    @classmethod
    def of(cls, config: TrackingConfig) -> Drift:
        """Return the configured rates."""
        return cls(
            config.position_drift, config.height_drift, config.tilt_drift, config.yaw_drift, config.turn_drift
        )

    def variances(self, driven: float, turned: float) -> Floats:
        """Variances (6,) over (rx, ry, rz, x, y, z) that gather in metres driven and radians turned."""
        rates = np.array([self.tilt, self.tilt, self.yaw, self.position, self.position, self.height])
        gathered: Floats = rates**2 * max(driven, _MIN_DRIVEN)
        gathered[2] += (self.turn * turned) ** 2
        return gathered

    def covariance(self, driven: float, turned: float) -> Floats:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) of the body's motion; positive definite even standing still."""
        return np.diag(self.variances(driven, turned))

    def reported(self, driven: float, turned: float) -> Floats:
        """Return the same covariance over (x, y, z, roll, pitch, yaw)."""
        return swap_rotation_translation(self.covariance(driven, turned))


class DriftEstimator:
    """Rates of the drift: the configured ones at first, then measured, and forgotten by the metre."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._nominal = Drift.of(config)
        self._metres = np.full(len(_GROUPS), config.drift_prior)
        self._sums = self._metres.copy()

    @property
    def drift(self) -> Drift:
        """The rates as they seem to be now."""
        factors = np.sqrt(np.clip(self._sums / self._metres, _MIN_FACTOR**2, _MAX_FACTOR**2))
        tilt, yaw, position, height = factors.tolist()
        known = self._nominal
        return Drift(
            position * known.position, height * known.height, tilt * known.tilt, yaw * known.yaw, yaw * known.turn
        )  # fmt: skip

    def add(self, gap: Floats, noise: Floats, driven: float, turned: float) -> None:
        """Add the motion between two registrations, where it is :func:`worth_learning`.

        Args:
            gap: (6,) over (rx, ry, rz, x, y, z): the later one, less where odometry leads from the earlier one.
            noise: (6,) variances that the two registrations alone account for.
            driven: metres between them.
            turned: radians between them.
        """
        nominal = self._nominal.variances(driven, turned)
        now = self.drift.variances(driven, turned)
        # one by one less than nothing at times; only so is their mean right
        seen = np.minimum(gap**2, _OUTLIER * (now + noise)) - noise
        for group, axes in enumerate(_GROUPS):
            rows = list(axes)
            if driven < _MIN_STEP and rows != [2]:
                continue  # turning on the spot tells of the heading alone
            # a turn on the spot says of the heading what metres of driving do
            metres = float(nominal[rows[0]] / self._nominal.variances(1.0, 0.0)[rows[0]])
            # by how much it can tell: a registration that hardly knows a direction says nothing of its drift
            weight = metres * float((now[rows] / (now[rows] + noise[rows])).mean()) ** 2
            fade = exp(-weight / self._config.drift_memory)
            ratio = float((seen[rows] / nominal[rows]).mean())
            self._sums[group] = fade * self._sums[group] + weight * ratio
            self._metres[group] = fade * self._metres[group] + weight


def worth_learning(driven: float, turned: float) -> bool:
    """Tell whether a motion of so many metres and radians tells drift from the registrations' noise."""
    return driven >= _MIN_STEP or turned >= _MIN_TURN
