"""Refinement: registration of the most probable place (eq. 13), and the modes of a place that may be accepted.

A place comprises all poses within two metres of its best pose. Registration converges to the nearest fitting pose;
where the scan shows little, or the site has changed, that may be a metre off. So registration also starts from poses
all around, and the results are weighted by the evidence of all keyframes, like places, and after a loss by odometry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import Prior
from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig, RegistrationConfig
from coview_stream.config.localizer import MIN_PAIRS
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.geometry.protection import ALERT_METRES
from coview_stream.geometry.transforms import (
    Pose,
    boxminus,
    exp_so3,
    inverse,
    log_so3,
    pose_from,
    rot_z,
    tilt_of,
    transform,
    yaw_of,
)
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import LocalMaps, prepare_scan
from coview_stream.localization.registration.register import gravity_information, register
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.search.places import BASIN_ANGLE, BASIN_DISTANCE
from coview_stream.localization.search.request import SearchRequest, same_place

_WIDEST = 1.0  # metres; scoring moves to the best pose nearby, so coarser scales are not needed
_EVERY = 3  # every third point is registered: changes the score by 0.002 and the pose by a centimetre
_AROUND = 1.2  # metres to the other starts, slightly beyond the reach of registration
_DIRECTIONS = 8  # of the other starts from the leader
_SAME_METRES, _SAME_RADIANS = 0.3, np.radians(2.0)  # closer poses are one mode

Beside = Callable[[Floats], Floats]
"""Returns log-evidence (M,) of poses (M, 4, 4) beside a place, as :meth:`PlaceScorer.beside`, and any log-prior."""


@dataclass(frozen=True)
class Modes:
    """The modes of a place."""

    best: Hypothesis  # the most probable mode
    distances: Floats  # (M,) metres from the best mode
    probabilities: Floats  # (M,) add up to one
    places: list[Hypothesis]  # the modes

    @property
    def distant(self) -> list[Hypothesis]:
        """Distant modes; their ``probability`` is their odds against the best mode."""
        odds = self.probabilities / self.probabilities[0]
        return [replace(self.places[k], probability=float(odds[k])) for k in np.flatnonzero(self._elsewhere)]

    @property
    def _elsewhere(self) -> Bools:
        return self.distances > 0.5 * ALERT_METRES

    @property
    def undecided(self) -> float:
        """Metres to the most probable distant mode, if the distant modes together exceed one half; else 0."""
        elsewhere = self._elsewhere
        if self.probabilities[elsewhere].sum() < 0.5:
            return 0.0
        return float(self.distances[elsewhere][self.probabilities[elsewhere].argmax()])


def register_place(
    place: Hypothesis, scan: ObservedScan, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps,
    start: Pose | None = None, widest: float = _WIDEST,
) -> Hypothesis | None:  # fmt: skip
    """Register a scan at a place; None off the map, with too few pairs, or if the result leans.

    Registration starts at ``start`` (4, 4), a ``T_map_odom``, by default the place's, with correspondences up to
    ``widest`` metres long.
    """
    settings, T = config.registration, place.T_map_odom if start is None else start
    scales = tuple(scale for scale in settings.search if scale <= widest) or settings.search[-1:]
    target = local_maps.around(transform(T, scan.body[None])[0])
    if target is None:
        return None
    upright = Prior(pose_from(rot_z(yaw_of(T)), T[:3, 3]), gravity_information(settings.gravity_sigma))
    registration = register(scan.cloud.every(_EVERY), T, target, settings, scales, upright, scan.body)
    if registration is None or tilt_of(registration.T_map_source) > config.acceptance.max_tilt:
        return None
    T = registration.T_map_source
    return replace(place, T_map_odom=T, registration=registration, evidence=scan.evidence(base_map.field, T))


def levelled_by_frame(leader: Pose, request: SearchRequest, config: RegistrationConfig, local_maps: LocalMaps) -> Pose:
    """Return a ``T_map_odom`` (4, 4) with roll and pitch of the newest frame, registered alone; unchanged on failure.

    Several keyframes are combined by odometry, so together they follow odometry's gravity: only a part of the sensor's
    lean remains.
    """
    T_odom_body = request.T_odom_body
    frame = prepare_scan(transform(T_odom_body, request.cloud), T_odom_body[:3, 3], config)
    body = leader @ T_odom_body
    target = local_maps.around(body[:3, 3])
    if target is None or len(frame.points) < MIN_PAIRS:
        return leader
    upright = Prior(pose_from(rot_z(yaw_of(leader)), leader[:3, 3]), gravity_information(config.gravity_sigma))
    registration = register(frame, leader, target, config, config.track, upright, T_odom_body[:3, 3])
    if registration is None:
        return leader
    turned = log_so3((registration.T_map_source @ T_odom_body)[:3, :3] @ body[:3, :3].T)
    turned[2] = 0.0
    return pose_from(exp_so3(turned) @ body[:3, :3], body[:3, 3]) @ inverse(T_odom_body)


def find_modes(
    place: Hypothesis, leader: Hypothesis, scan: ObservedScan, request: SearchRequest, base_map: BaseMap,
    config: LocalizerConfig, local_maps: LocalMaps, beside: Beside,
) -> Modes:  # fmt: skip
    """Register a scan from poses around ``leader``, the registered ``place``, and weight the results within it.

    ``beside`` returns the evidence of poses by the keyframes of the search, after a loss with odometry's prior.
    """
    candidates = [leader]
    for angle in 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        start = leader.T_map_odom.copy()
        start[:2, 3] += _AROUND * np.cos(angle), _AROUND * np.sin(angle)
        other = register_place(place, scan, base_map, config, local_maps, start)
        if other is not None and same_place(other.T_map_odom, place.T_map_odom, request, BASIN_DISTANCE, BASIN_ANGLE):
            candidates.append(other)
    poses = np.array([candidate.T_map_odom for candidate in candidates])
    ratios = beside(poses)

    def gap(k: int, other: int) -> tuple[float, float]:
        """Return metres and radians between two poses of the robot."""
        step = boxminus(poses[k] @ scan.T_odom_body, poses[other] @ scan.T_odom_body)
        return float(np.linalg.norm(step[3:])), float(np.linalg.norm(step[:3]))

    modes: list[int] = []
    for k in np.argsort(-ratios, kind="stable").tolist():
        gaps = (gap(k, mode) for mode in modes)
        if not any(metres < _SAME_METRES and radians < _SAME_RADIANS for metres, radians in gaps):
            modes.append(k)
    weights = np.exp(ratios[modes] - ratios[modes[0]])
    metres = [gap(k, modes[0])[0] for k in modes]
    places = [candidates[k] for k in modes]
    return Modes(places[0], np.array(metres), weights / weights.sum(), places)
