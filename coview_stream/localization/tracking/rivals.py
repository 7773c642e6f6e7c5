"""Rivals of a tracked place: poses metres beside it that a scan may fit as well.

Registration starts where odometry leads. Where odometry has slipped, that is beside the right place, and a wall that
was moved since the survey may hold it there. So around every registration the map is looked up on rings of poses, and
the most probable one is registered, too: a place has to explain the scan better than the best of those beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_METRES
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.register import register
from coview_stream.localization.registration.result import Prior
from coview_stream.localization.tracking.place_evidence import PlaceEvidence
from coview_stream.localization.tracking.slip import matters, off_by

# set by hand
_RINGS = ((0.9, 6), (1.7, 10), (2.5, 14), (3.3, 18))  # metres, poses; each is moved to the best within 0.4 m
_STRAIGHT, _TURNED = (0.0,), (-0.07, 0.0, 0.07)  # radians, of their headings
_WIDEST = 1.0  # metres: coarser scales are spared, as the poses are the best near them
_EVERY = 3  # of the scan's points is registered


@dataclass(frozen=True)
class Rival:
    """A probable pose beside a registered one.

    Attributes:
        T_map_odom: (4, 4) as registered there.
        ratio: log-likelihood ratio of the scan there, against chance around the other.
    """

    T_map_odom: Pose
    ratio: float


def find_rivals(
    place: PlaceEvidence,
    scan: ObservedScan,
    T_map_odom: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    count: int = 1,
) -> list[Rival]:
    """Return the most probable poses beside a registered one (4, 4) that do not lead back there; perhaps none.

    Args:
        place: what is known of how the map explains scans here.
        scan: what was registered.
        T_map_odom: (4, 4) where.
        target: the map around it.
        config: of the registration.
        count: so many at most; where more than one is asked for, other headings are tried, too.
    """
    T_odom_body = scan.T_odom_body
    here = scan.poses(T_map_odom[None])[0]
    poses, ratios = place.look_around(scan, T_map_odom, rings(here, _TURNED if count > 1 else _STRAIGHT))
    level = config.gravity_sigma**-2
    cloud = scan.cloud.every(_EVERY)
    upright, scales = np.diag([level, level, 0.0, 0.0, 0.0, 0.0]), tuple(s for s in config.search if s <= _WIDEST)
    taken, found = [here], [T_map_odom]
    for _ in range(count):
        ratios[np.linalg.norm(poses[:, :2] - taken[-1][:2], axis=1) < 0.5 * ALERT_METRES] = -np.inf
        best = int(ratios.argmax())
        if not np.isfinite(ratios[best]):
            break
        taken.append(poses[best])
        start = scan.transforms(poses[best][None])[0]
        settings = (config, scales or config.search[-1:], Prior(start, upright), T_odom_body[:3, 3])
        other = register(cloud, start, target, *settings)
        if other is None:
            continue
        T = other.T_map_source
        if all(_beside(T @ T_odom_body, each @ T_odom_body) for each in found):
            found.append(T)
    if len(found) == 1:
        return []
    ratio = place.ratios(scan, np.stack(found))
    return [Rival(found[k], float(ratio[k])) for k in np.argsort(-ratio, kind="stable") if k]


def _beside(T_map_body: Pose, T_map_other: Pose) -> bool:
    """Tell whether two poses are so far apart on the ground that it matters: wheels slip along it, not upwards."""
    along = T_map_body.copy()
    along[2, 3] = T_map_other[2, 3]
    return matters(*off_by(along, T_map_other))


def rings(pose: Floats, turns: tuple[float, ...]) -> Floats:
    """Return poses (H, 4), x, y, z and heading, in rings around one (4,), each with all the turns."""
    radius = np.concatenate([np.full(count, metres) for metres, count in _RINGS])
    angle = np.concatenate([2.0 * np.pi * np.arange(count) / count for _, count in _RINGS])
    around = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros((len(radius), 2))])
    return np.asarray(pose + np.concatenate([around + np.array([0.0, 0.0, 0.0, turn]) for turn in turns]))
