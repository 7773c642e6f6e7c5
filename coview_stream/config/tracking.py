"""Settings of tracking: when to register, how odometry is believed to drift, and the graph of poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coview_stream.config.checks import all_positive, check_types, counts, positive, require


@dataclass(frozen=True)
class TrackingConfig:
    """Registrations while tracking: when, with which frames; and the drift that odometry is believed to have.

    A registration is due after ``distance``, ``turn`` or ``seconds``. ``seconds`` counts regardless of odometry, for
    wheels slip, drivers hang and robots are carried. Where odometry is so bad that the pose has become uncertain, it is
    due sooner.

    Registered are the newest frame and as many before it as it takes to reach ``min_points``. Drift smears older
    frames: with odometry that drifts by 3 % the heading came out nearly ten times as well from one frame as from those
    of the last two metres (seen once on worlds 5103 and 5106, no command prints it).

    Drifts are sigmas of a random walk per square root of a metre driven, with which
    :class:`coview_stream.localization.tracking.motion.DriftEstimator` begins before it measures them. All are set by
    hand.

    Attributes:
        distance: metres driven.
        seconds: of sensor time.
        min_distance: metres; no uncertainty makes a registration due before.
        max_position_sigma: metres by which odometry may have drifted, each of x and y.
        max_yaw_sigma: radians, likewise.
        window: metres; no frame older than this is added once there are ``min_points``.
        min_points: see above.
        max_points: no frame is added once there are so many.
        turn: radians turned.
        position_drift: metres, each of x and y.
        height_drift: metres.
        tilt_drift: radians, each of roll and pitch.
        yaw_drift: radians.
        turn_drift: radians of yaw per radian turned.
        drift_prior: metres of driving that these rates count like beside the measured ones.
        drift_memory: metres over which measured drift is forgotten.
    """

    distance: float = 1.0
    seconds: float = 1.0
    min_distance: float = 0.3
    max_position_sigma: float = 0.03
    max_yaw_sigma: float = math.radians(0.2)
    window: float = 0.01
    min_points: int = 2500
    max_points: int = 50_000
    turn: float = math.radians(10)
    position_drift: float = 0.015
    height_drift: float = 0.004
    tilt_drift: float = math.radians(0.05)
    yaw_drift: float = math.radians(0.15)
    turn_drift: float = 0.02
    drift_prior: float = 6.0
    drift_memory: float = 40.0

    def __post_init__(self) -> None:
        check_types(self)
        all_positive(self)
        counts(self, "min_points", "max_points")


@dataclass(frozen=True)
class GraphConfig:
    """Smoothing of poses (see :mod:`coview_stream.localization.tracking.pose_graph`); set by hand.

    Attributes:
        window: newest keyframes with which the graph begins anew. What it drops lives on in the belief that it left
            behind, so a longer window only lets older registrations be weighed and linearised again in the light of
            later ones.
        restart: keyframes at which the graph begins anew.
        huber: standard deviations from which a registration's pull grows no more. It is the norm of six residuals at
            once, 2.4 on average and above 3.5 in one case of twenty; the usual 1.345 is meant for one residual. A
            kernel that lets go altogether would, with an optimistic covariance, lock the map out for good
            (``tests/localization/tracking/test_pose_graph_robust_kernel.py``).
    """

    window: int = 40
    restart: int = 120
    huber: float = 3.5

    def __post_init__(self) -> None:
        check_types(self)
        counts(self, "window", "restart", minimum=2)
        require(self.restart > self.window, self, "restart", f"greater than window ({self.window})")
        positive(self, "huber")
