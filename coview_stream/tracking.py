"""Tracking: keep ``T_map_odom`` right by registering recent points, a Kalman filter with ICP as its measurement."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import AcceptanceConfig, LocalizerConfig
from coview_stream.geometry import Points, Pose, inverse, pose_from, rotation_angle, tilt_of, transform
from coview_stream.place.keyframes import thinned
from coview_stream.pose.covariance import angles_first, drift_covariance
from coview_stream.pose.rays import RangeImage
from coview_stream.pose.registration import LocalMaps, Prior, Registration, register
from coview_stream.pose.source import local_source
from coview_stream.pose.verification import Evidence, verify

_MOST_FRAMES = 40
_IDLE_DRIVE = 0.2  # metres: what standing still until the next look counts as
_START_COVARIANCE = np.diag([np.radians(0.3), np.radians(0.3), np.radians(1.5), 0.5, 0.5, 0.3]) ** 2


@dataclass(frozen=True)
class _Recent:
    travelled: float
    points: Points  # (N, 3) odometry frame


class Tracker:
    """Belief over ``T_map_odom``: a mean and a covariance (6, 6) over (rx, ry, rz, x, y, z) about the body.

    Odometry adds random-walk noise with every metre driven; a registration of the last metres' points, with the
    predicted pose as its prior, takes it away.

    Attributes:
        T_map_odom: (4, 4) map <- odometry, the mean.
        covariance: (6, 6) right after the newest registration.
        travelled: metres that odometry has driven.
    """

    def __init__(self, base_map: BaseMap, config: LocalizerConfig, local_maps: LocalMaps) -> None:
        self.base_map = base_map
        self.config = config
        self.local_maps = local_maps
        self.T_map_odom: Pose = np.eye(4)
        self.covariance: npt.NDArray[np.float64] = np.eye(6)
        self._recent: deque[_Recent] = deque(maxlen=_MOST_FRAMES)
        self.travelled = 0.0
        self._registered_at = 0.0
        self._turned = 0.0
        self._unseen = 0  # frames since the last update
        self._last: Pose | None = None

    def observe(self, cloud: Points, T_odom_body: Pose, thin: Points | None = None) -> None:
        """Remember a frame's points (body frame) and how far odometry has driven.

        ``thin`` is what :func:`coview_stream.place.keyframes.thinned` makes of it, if that is known already.
        """
        if self._last is not None:
            self.travelled += float(np.linalg.norm(T_odom_body[:3, 3] - self._last[:3, 3]))
            self._turned += rotation_angle(inverse(self._last) @ T_odom_body)
        self._last = T_odom_body
        points = thinned(cloud, T_odom_body, self.config.keyframe) if thin is None else thin
        self._recent.append(_Recent(self.travelled, points))
        self._unseen += 1

    def forget(self) -> None:
        """Drop the remembered frames: what made the robot lose its place may be an odometry that jumped."""
        self.forget_points()
        self._last = None

    def forget_points(self) -> None:
        """Drop the points that the next registration would use beside the next frame's."""
        self._recent.clear()

    def start(self, registration: Registration, travelled: float) -> None:
        """Begin with an accepted fix, found where odometry had driven ``travelled`` metres.

        It may not have converged yet: its own covariance is not believed.
        """
        self.T_map_odom = registration.T_map_source
        self.covariance = self._posterior(registration) + _START_COVARIANCE
        self._registered_at, self._turned = travelled, 0.0

    def due(self, patience: float = 1.0) -> bool:
        """Whether the robot has driven or turned far enough for another registration; ``patience`` times as far."""
        driven, turned = self.travelled - self._registered_at, self._turned
        settings = self.config.tracking
        return driven >= patience * settings.distance or turned >= patience * settings.turn

    def look_around(self, T_odom_body: Pose) -> None:
        """Crop the map here already, on a frame that registers nothing: a new crop takes as long as a registration."""
        position = transform(self.T_map_odom, T_odom_body[None, :3, 3])[0]
        if (target := self.local_maps.around(position)) is not None:
            target.prepare(self.config.registration.method)

    def update(self, cloud: Points, T_odom_body: Pose, idle: bool = False) -> Evidence | None:
        """Register the recent points from the predicted pose; None where the map offers nothing to register to.

        ``idle``: use only frames since the last update, for a robot that by its odometry stands still, and believe the
        odometry a little less: standing and looking again and again must not add up to certainty.
        """
        if idle:
            while len(self._recent) > max(1, self._unseen):
                self._recent.popleft()
        self._unseen = 0
        position = T_odom_body[:3, 3]
        target = self.local_maps.around(transform(self.T_map_odom, position[None])[0])
        covariance = self.predicted_covariance()
        if idle:
            covariance = covariance + angles_first(drift_covariance(self.config.tracking, _IDLE_DRIVE, 0.0))
        self._registered_at, self._turned, self.covariance = self.travelled, 0.0, covariance
        if target is None:
            return None
        source = local_source(self._window(), position, self.config.registration)
        if len(source.points) < 100:
            return None
        found = register(
            source, self.T_map_odom, target, self.config.registration, self.config.registration.track,
            Prior(self.T_map_odom, np.asarray(np.linalg.inv(covariance))), position,
        )  # fmt: skip
        T = self.T_map_odom if found is None else found.T_map_source
        surveyed = self.base_map.surveyed(transform(T, source.points)[:, :2])
        evidence = verify(source, T, RangeImage.of(cloud), T @ T_odom_body, target, surveyed)
        rule = self.config.acceptance
        if tilt_of(T) > rule.most_tilt:
            return None
        if found is not None and kept(evidence, rule):
            self.T_map_odom = found.T_map_source
            self.covariance = self._posterior(found)
        else:
            # bad frames among the last metres' must not spoil the next registration too
            self._recent.clear()
        return evidence

    def predicted_covariance(self) -> npt.NDArray[np.float64]:
        """Covariance (6, 6) over (rx, ry, rz, x, y, z) after the metres driven since the last registration."""
        grown = drift_covariance(self.config.tracking, self.travelled - self._registered_at, self._turned)
        return self.covariance + angles_first(grown)

    def reported_covariance(self) -> npt.NDArray[np.float64]:
        """Covariance (6, 6) over (x, y, z, roll, pitch, yaw), floors included, map axes."""
        settings = self.config.registration
        floor = np.array([settings.sigma_floor] * 3 + [settings.sigma_floor_angle] * 3) ** 2
        return np.asarray(angles_first(self.predicted_covariance()) + np.diag(floor))

    def _posterior(self, registration: Registration) -> npt.NDArray[np.float64]:
        information = registration.information + 1e-6 * np.eye(6)
        return np.asarray(np.linalg.inv(information) * self.config.registration.inflation**2)

    def _window(self) -> Points:
        """Points of the last metres, more if they are too few."""
        settings = self.config.tracking
        parts: list[Points] = []
        count = 0
        for frame in reversed(self._recent):
            old = self.travelled - frame.travelled > settings.window
            if count >= settings.max_points or (old and count >= settings.min_points):
                break
            parts.append(frame.points)
            count += len(frame.points)
        return np.concatenate(parts) if parts else np.empty((0, 3), dtype=np.float32)


def kept(evidence: Evidence, rule: AcceptanceConfig) -> bool:
    """Whether a registration while tracking speaks for the place it found."""
    return (
        evidence.inside >= rule.inside
        and evidence.score >= rule.keep_score
        and evidence.ground >= rule.keep_ground
    )


def relative_to(T_odom_body: Pose, anchor: npt.NDArray[np.float64]) -> Pose:
    """Return the same pose with the odometry frame's origin moved to ``anchor`` (3,)."""
    return pose_from(T_odom_body[:3, :3], T_odom_body[:3, 3] - anchor)


def unanchored(T_map_local: Pose, anchor: npt.NDArray[np.float64], origin: npt.NDArray[np.float64]) -> Pose:
    """Return ``T_map_odom`` in the source's frame from the localizer's: undo both shifts, in float64."""
    shifted = T_map_local @ inverse(pose_from(np.eye(3), anchor))
    return pose_from(shifted[:3, :3], shifted[:3, 3] + origin)
