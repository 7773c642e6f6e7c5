"""Staying localized: when to register, how far odometry is believed, and how poses are smoothed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import counts, positive, require


@dataclass(frozen=True)
class TrackingConfig:
    """How a fix is kept: how often to register, with what, and how fast odometry is believed to drift.

    Register after ``distance`` metres of driving or ``turn`` radians of turning, or ``seconds`` (sensor time) whatever
    odometry says, for wheels slip, drivers hang and robots are carried; and, where odometry is bad, as soon as the pose
    has become uncertain by ``unsure_position`` metres or ``unsure_yaw`` radians, but not before ``least_distance``
    metres. Registered is the newest frame, and as many before it as it takes to ``min_points``, but none from before
    the last ``window`` metres once there are that many, and none once there are ``max_points``: older ones are smeared
    by the drift. (With odometry that drifts by 3 % the heading came out nearly ten times as well from one frame as from
    the last two metres'; seen once on worlds 5103 and 5106, no command prints it.)

    Drifts are random-walk sigmas per square root of a metre driven; ``turn_drift`` is yaw error per radian turned.
    They are where :class:`coview_stream.pose.drift.DriftEstimator` begins: it believes them like ``drift_trust`` metres
    of driving, and forgets what it has measured over ``drift_memory`` metres.
    """

    distance: float = 1.0
    seconds: float = 1.0
    least_distance: float = 0.3
    unsure_position: float = 0.03
    unsure_yaw: float = math.radians(0.2)
    window: float = 0.01
    min_points: int = 2500
    max_points: int = 50_000
    turn: float = math.radians(10)
    position_drift: float = 0.015
    height_drift: float = 0.004
    tilt_drift: float = math.radians(0.05)
    yaw_drift: float = math.radians(0.15)
    turn_drift: float = 0.02
    drift_trust: float = 6.0
    drift_memory: float = 40.0

    def __post_init__(self) -> None:
        positive(
            self,
            "distance",
            "seconds",
            "least_distance",
            "unsure_position",
            "unsure_yaw",
            "window",
            "turn",
            "position_drift",
            "height_drift",
            "tilt_drift",
            "yaw_drift",
            "turn_drift",
            "drift_trust",
            "drift_memory",
        )
        counts(self, "min_points", "max_points")


@dataclass(frozen=True)
class GraphConfig:
    """How poses are smoothed (see :mod:`coview_stream.pose.graph`).

    The graph grows to ``restart`` keyframes and begins anew with the newest ``window`` of them. What it drops lives on
    in the belief that it left behind, so a longer window only lets old registrations be weighed again, and linearised
    again, in the light of later ones.
    ``huber`` is where, in standard deviations, a registration's pull stops growing. It is the norm of six residuals at
    once, which is 2.4 on average and exceeds 3.5 in one case of twenty; the usual 1.345 is meant for a single one. It
    must not be a kernel that lets go altogether: with an optimistic covariance that locks the map out for good.
    """

    window: int = 40
    restart: int = 120
    huber: float = 3.5

    def __post_init__(self) -> None:
        counts(self, "window", "restart", least=2)
        require(self.restart > self.window, self, "restart", f"greater than window ({self.window})")
        positive(self, "huber")
