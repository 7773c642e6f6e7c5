"""Evidence of a slip: whether odometry has slipped, or the registration is drawn to something that was moved.

A registration may fit, and yet not lie where odometry leads. Either odometry is wrong (wheels slip, the robot is
pushed), and the robot is where the lidar sees it; or odometry is right, and a building or a stack of containers stands
a metre off where it was surveyed. The scan itself decides, by how much better it is explained at the one place than at
the other: their log-likelihood ratio against the same background, which is measured at places all around. Of 69 slips
of 0.6 to 1.6 m the median ratio was 20 and the smallest 5; of three false ones on a map of which a third had been
moved, 0.8 to 2; seen once on the worlds of ``python -m bench protection``, no command prints it.
"""

from __future__ import annotations

import math

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES
from coview_stream.geometry.transforms import Pose, boxminus, inverse
from coview_stream.localization.evidence.background import estimate_background, scatter
from coview_stream.localization.evidence.likelihood import log_likelihood_ratios
from coview_stream.localization.evidence.observed_scan import ObservedScan
from coview_stream.localization.registration.register import ScanInput

# set by hand
_RISK = 1e-4  # that a place which is taken for better is not, both being as likely before
_RINGS = (3.0, 5.0, 8.0, 12.0)  # metres from the place, of the chance places around it
_SPOKES = 8  # of each ring
_TURNS = tuple(np.radians((-12.0, -4.0, 4.0, 12.0)))  # of the heading there, one after the other


def off_by(T_map_body: Pose, T_map_other: Pose) -> tuple[float, float]:
    """Return how far apart two poses are: metres, degrees."""
    gap = boxminus(T_map_body, T_map_other)
    return float(np.linalg.norm(gap[3:])), math.degrees(float(np.linalg.norm(gap[:3])))


def matters(metres: float, degrees: float) -> bool:
    """Tell whether poses so far apart cannot both be taken for right: by more than half of the alert limit."""
    return metres > 0.5 * ALERT_METRES or degrees > 0.5 * ALERT_DEGREES


def has_slipped(base_map: BaseMap, scan: ScanInput, T_map_predicted: Pose, T_map_seen: Pose) -> bool:
    """Tell whether a scan is so much better explained where it was registered that odometry must have slipped.

    Args:
        base_map: the map.
        scan: what was registered.
        T_map_predicted: (4, 4) pose of the body where odometry leads.
        T_map_seen: (4, 4) where it was registered.
    """
    return slip_ratio(base_map, scan, T_map_predicted, T_map_seen) >= -math.log(_RISK)


def slip_ratio(base_map: BaseMap, scan: ScanInput, T_map_predicted: Pose, T_map_seen: Pose) -> float:
    """Return the log-likelihood ratio of the second place to the first; arguments are those of :func:`has_slipped`."""
    seen, T_body_odom = ObservedScan.of(scan), inverse(scan.T_odom_body)
    both = seen.poses(np.stack([T_map_predicted @ T_body_odom, T_map_seen @ T_body_odom]))
    poses = np.concatenate([both, _around(both[0])])
    observed = seen.few.look_up(base_map.field, poses, "no")[1]
    places, chance = observed[:2], observed[2:]
    background = estimate_background(chance, scatter(chance), chance[:0])
    predicted, found = log_likelihood_ratios(places, background)[0]
    return float(found - predicted)


def _around(pose: Floats) -> Floats:
    """Return poses (H, 4) in rings around one, turned a little: places where chance alone explains the scan."""
    ring, spoke = (index.ravel() for index in np.indices((len(_RINGS), _SPOKES)))
    angle = 2.0 * np.pi * (spoke + 0.5 * (ring % 2)) / _SPOKES
    radius, turn = np.take(_RINGS, ring), np.take(_TURNS, (ring + spoke) % len(_TURNS))
    zero = np.zeros_like(radius)
    return np.asarray(pose + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), zero, turn]))
