"""Evidence of a slip: whether odometry has slipped, or the registration is drawn to something that was moved.

A registration may fit, and yet not lie where odometry leads. Either odometry is wrong (wheels slip, the robot is
pushed), and the robot is where the lidar sees it; or odometry is right, and a building or a stack of containers stands
a metre off where it was surveyed. The scan itself decides, by how much better it is explained at the one place than at
the other: the ratio of their likelihoods, with what is usual here taken into account.
"""

from __future__ import annotations

import math

import numpy as np

from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES
from coview_stream.geometry.transforms import Pose, boxminus, inverse
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.tracking.place_evidence import PlaceEvidence


def off_by(T_map_body: Pose, T_map_other: Pose) -> tuple[float, float]:
    """Return how far apart two poses are: metres, degrees."""
    gap = boxminus(T_map_body, T_map_other)
    return float(np.linalg.norm(gap[3:])), math.degrees(float(np.linalg.norm(gap[:3])))


def matters(metres: float, degrees: float) -> bool:
    """Tell whether poses so far apart cannot both be taken for right: by more than half of the alert limit."""
    return metres > 0.5 * ALERT_METRES or degrees > 0.5 * ALERT_DEGREES


def has_slipped(place: PlaceEvidence, scan: ScanInput, T_map_predicted: Pose, T_map_seen: Pose, risk: float) -> bool:
    """Tell whether a scan is so much better explained where it was registered that odometry must have slipped.

    Args:
        place: what is known of how the map explains scans here.
        scan: what was registered.
        T_map_predicted: (4, 4) pose of the body where odometry leads.
        T_map_seen: (4, 4) where it was registered.
        risk: probability that the better place is not the right one, both being as likely before.
    """
    T_body_odom = inverse(scan.T_odom_body)
    return place.gain(scan, T_map_predicted @ T_body_odom, T_map_seen @ T_body_odom) >= -math.log(risk)
