"""Belief over what is constant about a robot: a Gaussian, and what is applied of it.

Most sensors stand straight and most odometry has the right scale. So each group of the state is a mixture: zero but for
a small spread, or anything up to a large one; what is applied is the mean of both, weighed by how probable they are
(Savage and Dickey's ratio, eq. C3).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.localization.calibration.calibration import Calibration


class _Prior(NamedTuple):
    """What is known of a group of components before anything is seen; all set by hand.

    Attributes:
        axes: of the state.
        exact: sigma of one that is as it should be.
        wide: sigma of one that is not.
        share: probability that it is not.
        walk: sigma of its random walk, per square root of a metre.
    """

    axes: slice
    exact: float
    wide: float
    share: float
    walk: float


_TILT = _Prior(slice(0, 2), math.radians(0.15), math.radians(4.0), 0.5, math.radians(0.03))
_SCALE = _Prior(slice(2, 3), 0.003, 0.04, 0.3, 5e-4)
_TURN = _Prior(slice(3, 4), math.radians(0.005), math.radians(0.05), 0.3, math.radians(5e-4))
GRAVITY = _Prior(slice(4, 6), math.radians(0.25), math.radians(0.25), 1.0, math.radians(0.1))
_GROUPS = (_TILT, _SCALE, _TURN)  # that are corrected
_WIDE = np.concatenate([np.full(g.axes.stop - g.axes.start, g.wide) for g in (*_GROUPS, GRAVITY)])
SIZE = len(_WIDE)
"""Components of the state."""
_FREEDOM = 4.0  # degrees of freedom of Student's distribution; set by hand


class Belief:
    """Gaussian over the state x = (roll, pitch, s, w, g), heavy-tailed where measurements contradict it.

    Attributes:
        x: (6,) mean.
        P: (6, 6) covariance.
    """

    def __init__(self, sensor_leans: bool = True) -> None:
        """Begin with nothing known; ``sensor_leans``: whether the sensor may lean against odometry's gravity."""
        self.x = np.zeros(SIZE)
        self.P = np.diag(_WIDE**2)
        self._sensor_leans = sensor_leans
        self._stand_straight()

    def copy(self) -> Belief:
        """Return the same belief, to be changed on its own."""
        other = Belief(self._sensor_leans)
        other.x, other.P = self.x.copy(), self.P.copy()
        return other

    def restore(self, known: Calibration) -> None:
        """Begin with what was known of this robot before."""
        self.x = np.array([known.roll, known.pitch, known.scale, known.turn, 0.0, 0.0])
        self.P = np.diag(_WIDE**2)
        sigmas = [known.sigma_tilt, known.sigma_tilt, known.sigma_scale, known.sigma_turn]
        self.P[:4, :4] = np.diag(np.square(sigmas))
        self._stand_straight()

    def learn(self, known: Calibration) -> None:
        """Take over what was known of this robot before, as far as it is known better than here."""
        own = self.applied()
        values = np.array([known.roll, known.pitch, known.scale, known.turn])
        sigmas = (known.sigma_tilt, known.sigma_scale, known.sigma_turn)
        for group, sigma, here in zip(_GROUPS, sigmas, (own.sigma_tilt, own.sigma_scale, own.sigma_turn), strict=True):
            if sigma < here:
                self.x[group.axes] = values[group.axes]
                self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0
                axes = np.arange(SIZE)[group.axes]
                self.P[axes, axes] = sigma**2
        self._stand_straight()

    def begin_odometry(self) -> None:
        """Forget how odometry's frame leans, for another one begins; what is known of the robot stays."""
        self.x[GRAVITY.axes] = 0.0
        self.P[GRAVITY.axes], self.P[:, GRAVITY.axes] = 0.0, 0.0
        self.P[GRAVITY.axes, GRAVITY.axes] = np.eye(2) * GRAVITY.wide**2

    def walk(self, driven: float) -> None:
        """Let everything have changed a little over ``driven`` metres."""
        for group in (*_GROUPS, GRAVITY):
            axes = np.arange(SIZE)[group.axes]
            self.P[axes, axes] = np.minimum(self.P[axes, axes] + group.walk**2 * driven, group.wide**2)
        self._stand_straight()

    def doubt_tilt(self, seen: Floats, H: Floats, R: Floats) -> None:
        """Widen a tilt that a measurement contradicts by far: it is as probably right as what the state came from."""
        gap, spread = seen - H @ self.x, H @ self.P @ H.T + R
        factor = heavier(float(gap @ np.linalg.solve(spread, gap)), len(gap))
        widest = _TILT.wide**2 / max(float(self.P[0, 0]), float(self.P[1, 1]), 1e-30)
        wider = math.sqrt(min(factor, max(widest, 1.0)))
        self.P[:2] *= wider
        self.P[:, :2] *= wider

    def update(self, seen: Floats, H: Floats, R: Floats) -> float:
        """Take in a measurement ``seen`` = H x + noise of covariance R; return its log-likelihood before."""
        gap = seen - H @ self.x
        distance = float(gap @ np.linalg.solve(H @ self.P @ H.T + R, gap))
        R = R * heavier(distance, len(gap))
        spread = H @ self.P @ H.T + R
        gain = np.linalg.solve(spread, H @ self.P).T
        self.x = self.x + gain @ gap
        rest = np.eye(SIZE) - gain @ H
        self.P = rest @ self.P @ rest.T + gain @ R @ gain.T
        return -0.5 * float(gap @ np.linalg.solve(spread, gap) + np.linalg.slogdet(spread)[1])

    def applied(self) -> Calibration:
        """Weigh, group by group, "as it should be" against "anything" (eq. C3)."""
        means, sigmas = np.zeros(4), []
        for group in _GROUPS:
            x, P = self.x[group.axes], self.P[group.axes, group.axes]
            size = len(x)
            spread = P + group.exact**2 * np.eye(size)
            exact = -0.5 * (x @ np.linalg.solve(spread, x) + np.linalg.slogdet(spread)[1]) + size * math.log(group.wide)
            weight = 1.0 / (1.0 + (1.0 - group.share) / group.share * math.exp(min(exact, 500.0)))
            means[group.axes] = weight * x
            about = group.exact**2 * np.trace(P) / (np.trace(P) + size * group.exact**2)
            within = weight * np.trace(P) + (1.0 - weight) * about
            sigmas.append(math.sqrt((within + weight * (1.0 - weight) * float(x @ x)) / size))
        return Calibration(*means.tolist(), *sigmas)

    def _stand_straight(self) -> None:
        """Know for sure that the sensor does not lean, if it cannot: then what leans is odometry's gravity."""
        if not self._sensor_leans:
            self.x[:2] = 0.0
            self.P[:2], self.P[:, :2] = 0.0, 0.0


def mixed(one: Calibration, other: Calibration, share: float) -> Calibration:
    """Return the mean of two calibrations, ``share`` of it the other's, with the sigmas of the mixture."""

    def mean(a: float, b: float) -> float:
        return (1.0 - share) * a + share * b

    def sigma(a: float, b: float, apart: float) -> float:
        return math.sqrt(mean(a**2, b**2) + share * (1.0 - share) * apart**2)

    apart = math.hypot(one.roll - other.roll, one.pitch - other.pitch) / math.sqrt(2.0)  # of each of the two
    return Calibration(
        mean(one.roll, other.roll),
        mean(one.pitch, other.pitch),
        mean(one.scale, other.scale),
        mean(one.turn, other.turn),
        sigma(one.sigma_tilt, other.sigma_tilt, apart),
        sigma(one.sigma_scale, other.sigma_scale, one.scale - other.scale),
        sigma(one.sigma_turn, other.sigma_turn, one.turn - other.turn),
    )


def heavier(distance: float, size: int) -> float:
    """Return what a variance is to be multiplied with under Student's t distribution.

    Args:
        distance: squared Mahalanobis distance of what was measured.
        size: how many numbers that were.
    """
    return max(1.0, (_FREEDOM + distance) / (_FREEDOM + size))
