"""Search requests: plain data of a keyframe, as the search may run later and in another process."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from coview_stream.config import DescriptorConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Circle, Points, Pose, inverse, pose_from, rotation_angle, transform
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.search.keyframes import Keyframe, KeyframeBuffer

_SUBMAP_KEYFRAMES = 4  # newest keyframes that are registered; drift smears more of them
SAME_DISTANCE, SAME_ANGLE = 2.0, float(np.radians(5.0))  # metres, radians: closer registered hypotheses are one


class Epoch(NamedTuple):
    """Period within which scans and poses belong together: one odometry frame, between two losses."""

    odometry: int = 0  # the caller's number of the odometry frame
    restart: int = 0  # number of the localizer's restarts


FIRST_EPOCH = Epoch()


class LostPlace(NamedTuple):
    """The last known place, continued by odometry through a loss."""

    T_map_odom: Pose  # (4, 4)
    covariance: Floats  # (6, 6) of the body's pose over (rx, ry, rz, x, y, z), map axes
    odds: float  # that odometry does not lead there: the place was wrong, it has slipped, the robot was carried


def _no_points() -> Points:
    return np.empty((0, 3), dtype=np.float32)


@dataclass(frozen=True)
class RequestSpec:
    """Data that a search needs in its requests."""

    descriptor: DescriptorConfig | None  # of the local scan; None if no scan is needed
    reach: float | None = None  # radius of the surroundings, metres; None if unneeded


class EarlierKeyframe(NamedTuple):
    """An earlier searched keyframe, levelled by the present calibration; fields as in :class:`SearchRequest`."""

    T_odom_body: Pose
    submap: Points
    cloud: Points


@dataclass(frozen=True)
class SearchRequest:
    """One keyframe to search the map for."""

    stamp: float  # of the keyframe, seconds
    T_odom_body: Pose  # (4, 4) of the keyframe
    scan: Points  # (N, 3) float32 virtual local scan, odometry frame, metres; empty without a descriptor
    submap: Points  # (N, 3) float32 points to register, of the newest keyframes, odometry frame
    cloud: Points  # (N, 3) float32 newest frame, thinned to the rays of its range image, body frame
    travelled: float = 0.0  # metres that odometry had driven
    epoch: Epoch = FIRST_EPOCH  # a request of another epoch restarts the search
    hints: tuple[Pose, ...] = ()  # possible T_map_odom, each (4, 4), judged like the votes' hypotheses
    # T_map_odom by a PlaceGuess, each (4, 4), with unknown heights, judged likewise
    guesses: tuple[Pose, ...] = ()
    lost: LostPlace | None = None  # None before the first place, and where odometry has begun anew since
    # (N, 3) float32 points within RequestSpec.reach, odometry frame; empty if unneeded
    surroundings: Points = field(default_factory=_no_points)
    calibration: Calibration = field(default_factory=Calibration)  # that levelled cloud
    area: Circle | None = None  # the only part of the map to search, metres from its zero; None for all of it
    # keyframes with which the search continues, oldest first, where clouds were levelled again
    earlier: tuple[EarlierKeyframe, ...] = ()
    # log-probability of the lean that levels the clouds, where it was fitted at a leading place
    lean_prior: float = 0.0

    @property
    def position(self) -> Floats:
        """(3,) position of the body in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

    def turned(self, R: Floats) -> SearchRequest:
        """Return the request with the clouds to register rotated about the body by R (3, 3), axes of odometry."""
        T = pose_from(R, self.position - R @ self.position)
        T_body = pose_from(self.T_odom_body[:3, :3].T @ R @ self.T_odom_body[:3, :3], np.zeros(3))
        return replace(self, submap=transform(T, self.submap), cloud=transform(T_body, self.cloud))

    @classmethod
    def of(
        cls,
        buffer: KeyframeBuffer,
        keyframe: Keyframe,
        cloud: Points,
        spec: RequestSpec,
        travelled: float = 0.0,
        epoch: Epoch = FIRST_EPOCH,
        hints: tuple[Pose, ...] = (),
        guesses: tuple[Pose, ...] = (),
        area: Circle | None = None,
    ) -> SearchRequest:
        """Build the request of a buffer's newest keyframe; ``cloud`` (N, 3) is the newest frame, body frame."""
        scan = surroundings = _no_points()
        if spec.descriptor is not None:
            scan = buffer.virtual_scan(keyframe.position, spec.descriptor.radius, spec.descriptor.voxel)
        if spec.reach is not None:
            surroundings = buffer.virtual_scan(keyframe.position, spec.reach, buffer.config.voxel)
        held = buffer.at_earlier(_SUBMAP_KEYFRAMES) if keyframe.begins_anew else []
        level = buffer.calibration.level
        earlier = tuple(EarlierKeyframe(each.T_odom_body, submap, level(each.frame)) for each, submap in held)
        return cls(
            keyframe.stamp, keyframe.T_odom_body, scan=scan, submap=buffer.recent(_SUBMAP_KEYFRAMES), cloud=cloud,
            travelled=travelled, epoch=epoch, hints=hints, guesses=guesses, surroundings=surroundings,
            calibration=buffer.calibration, area=area, earlier=earlier,
        )  # fmt: skip


def same_place(
    T_a: Pose, T_b: Pose, request: SearchRequest, distance: float = SAME_DISTANCE, angle: float = SAME_ANGLE
) -> bool:
    """Whether two ``T_map_odom`` put the keyframe at the same place and heading."""
    a, b = T_a @ request.T_odom_body, T_b @ request.T_odom_body
    apart = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return apart < distance and rotation_angle(inverse(a) @ b) < angle
