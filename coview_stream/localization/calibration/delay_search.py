"""Search for the delay between clouds and odometry, from the motions between registrations."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, inverse
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.odometry_history import OdometryHistory

RESOLUTION = 0.05  # seconds within which the filter converges to a delay
DELAYS: Floats = RESOLUTION * np.arange(-20.0, 21.0)
"""Delays that are compared, seconds."""
_FADES = 100.0  # metres over which evidence for a delay is forgotten, as clocks drift
_FORGOTTEN = 0.05  # weight below which a motion no longer counts
_FREEDOM = 4.0  # degrees of freedom of Student's distribution
_STEPS = math.log(1e-6)  # log-probability that a clock has just taken a step: once in twelve days
_TILT = 2.0  # ratio of a registration's errors of roll and pitch to that of its heading


class SeenMotion(NamedTuple):
    """Registered motion between two clouds."""

    motion: Pose  # (4, 4) in the body's axes
    begin: float  # stamp of the first cloud, seconds
    end: float  # stamp of the second cloud
    applied: Calibration  # calibration at that time
    noise: Floats  # (3, 3) covariance of x, y and heading without the calibration's errors
    J: Floats  # (3, 6) derivatives of x, y and heading by the calibration (eq. C2)

    @property
    def spread(self) -> Floats:
        """(3, 3) covariance including the calibration's errors, except for the delay's."""
        known = self.applied
        sigmas = [known.sigma_scale, known.sigma_turn, 0.0, known.sigma_heading, known.sigma_lever, known.sigma_lever]
        others = self.J * np.array(sigmas)
        return np.asarray(self.noise + others @ others.T)


class DelaySearch:
    """Grid search for the delay of the clouds.

    The calibration's Kalman filter only follows a delay that it nearly knows. Here a motion is compared with odometry
    at each delay, which finds large delays and also uses the shaking of the body. A motion is judged once odometry
    extends beyond it by the largest delay.

    Where odometry's noise is larger than the robot's changes of speed, each motion favours some delay by chance. So the
    motions also have to favour a delay steadily: by chance, a sum of symmetric terms exceeds x times the root of its
    sum of squares with probability exp(-x^2 / 2) at most.

    Attributes:
        evidence: (D,) log-likelihoods of DELAYS, up to a constant.
        shaking: (D,) the part of it from the body's roll and pitch.
    """

    def __init__(self) -> None:
        self.evidence, self.shaking = np.zeros((2, len(DELAYS)))
        self._judged: list[tuple[float, Floats]] = []  # weights and log-likelihoods (D,) of the motions
        self._waiting: deque[SeenMotion] = deque(maxlen=30)

    def add(self, seen: SeenMotion) -> None:
        """Add a motion, to be judged later."""
        self._waiting.append(seen)

    def forget_motions(self) -> None:
        """Forget the waiting motions, which belong to another mount, scale or delay."""
        self._waiting.clear()

    def judge(self, odometry: OdometryHistory) -> list[tuple[SeenMotion, Pose, Floats]]:
        """Judge the motions that odometry covers by now.

        Returns:
            The motions, odometry's motion (4, 4) at the applied delay, and its velocities (2, 3) at both ends.
        """
        judged: list[tuple[SeenMotion, Pose, Floats]] = []
        while self._waiting and odometry.reaches(self._waiting[0].end + DELAYS[-1]):
            seen = self._waiting.popleft()
            if odometry.covers(seen.begin - DELAYS[-1], seen.end):  # false after a stop longer than the history
                self._judge(seen, odometry)
                begin, end = seen.begin - seen.applied.delay, seen.end - seen.applied.delay
                step = inverse(odometry.at(begin)) @ odometry.at(end)
                judged.append((seen, step, np.array([odometry.rates(begin), odometry.rates(end)])))
        return judged

    def _judge(self, seen: SeenMotion, odometry: OdometryHistory) -> None:
        """Compare a motion with odometry at each delay; interpolation leaves a share of odometry's noise there."""
        before, after = odometry.all_at(seen.begin - DELAYS), odometry.all_at(seen.end - DELAYS)
        R = before[:, :3, :3].transpose(0, 2, 1)
        moved = (1.0 + seen.applied.scale) * np.einsum("dij,dj->di", R, after[:, :3, 3] - before[:, :3, 3])
        turned = seen.motion[:3, :3] @ (R @ after[:, :3, :3]).transpose(0, 2, 1)
        twice = turned.transpose(0, 2, 1) - turned  # twice the rotation, for small angles
        tilts, heading = 0.5 * np.stack([twice[:, 1, 2], twice[:, 2, 0]], axis=1), 0.5 * twice[:, 0, 1]
        spread, share = seen.spread, odometry.noise_share(seen.begin - DELAYS, seen.end - DELAYS)
        flat = np.column_stack([seen.motion[:2, 3] - moved[:, :2], heading])
        squares = np.einsum("di,ij,dj->d", flat, np.linalg.inv(spread), flat) / share
        shaken = (tilts**2).sum(axis=1) / (_TILT**2 * spread[2, 2])
        evidence = -0.5 * (_FREEDOM + 3.0) * np.log1p(squares / _FREEDOM)
        tilted = -0.5 * (_FREEDOM + 2.0) * np.log1p(shaken / _FREEDOM)
        evidence += tilted
        fade = math.exp(-float(np.linalg.norm(seen.motion[:3, 3])) / _FADES)
        self.evidence = fade * self.evidence + evidence - evidence.max()
        self._judged = [(fade * weight, row) for weight, row in self._judged if weight > _FORGOTTEN]
        self._judged.append((1.0, evidence))
        shaking = fade * self.shaking + tilted
        self.shaking = np.maximum(shaking - shaking.max(), _STEPS)

    def better_than(self, delay: float, sigma: float, surprise: float) -> float | None:
        """Return the most probable delay, seconds; None if it lies near the applied ``delay``, by its ``sigma``.

        None, too, if the evidence does not exceed ``surprise``, the log-odds against a delay anywhere else on the grid.
        """
        gap, best = np.abs(DELAYS - delay), int(self.evidence.argmax())
        near = gap <= max(3.0 * sigma + RESOLUTION, float(gap.min()))
        if near[best]:
            return None
        there = int(np.where(near, self.evidence, -math.inf).argmax())
        each = np.array([weight * (row[best] - row[there]) for weight, row in self._judged])
        steady = 0.5 * float(each.sum()) ** 2 / max(float(np.square(each).sum()), 1e-12)
        gain = min(float(self.evidence[best] - self.evidence[there]), steady)
        return float(DELAYS[best]) if gain > surprise + math.log(len(DELAYS)) else None
