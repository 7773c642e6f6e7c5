"""A keyframe as the search needs it: plain data, so that the search may run later and in another process."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from coview_stream.config import DescriptorConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Circle, Points, Pose, inverse, rotation_angle
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.search.keyframes import Keyframe, KeyframeBuffer

_SUBMAP_KEYFRAMES = 4  # of the newest in the submap that is registered: more are smeared by drift
SAME_DISTANCE = 2.0  # metres: hypotheses that registration brought this close together are one
SAME_ANGLE = float(np.radians(5.0))  # likewise


class Epoch(NamedTuple):
    """Period within which scans and poses belong together: one odometry frame, between two losses.

    Attributes:
        odometry: number of the odometry frame, as the caller counts them.
        restart: how often the localizer has begun anew.
    """

    odometry: int = 0
    restart: int = 0


FIRST_EPOCH = Epoch()


def _no_points() -> Points:
    return np.empty((0, 3), dtype=np.float32)


@dataclass(frozen=True)
class RequestSpec:
    """Parts that requests have to bring.

    Attributes:
        descriptor: the local scan's descriptor; None if no scan is needed.
        reach: radius of the surroundings, metres; None if they are not needed.
    """

    descriptor: DescriptorConfig | None
    reach: float | None = None


@dataclass(frozen=True)
class SearchRequest:
    """One keyframe to search the map for.

    Attributes:
        stamp: seconds, of the keyframe.
        T_odom_body: (4, 4) of the keyframe.
        scan: (N, 3) float32 virtual local scan, odometry frame, metres; empty if no descriptor is made of it.
        submap: (N, 3) float32 points of the newest keyframes, odometry frame: to be registered.
        cloud: (N, 3) float32 newest frame, body frame.
        travelled: metres that odometry had driven.
        epoch: of the localizer's memory; a request of another epoch starts the search from nothing.
        hints: (4, 4) each, ``T_map_odom`` that may be right: verified and judged like the votes' hypotheses.
        guesses: (4, 4) each, ``T_map_odom`` of a place that somebody named, heights open: tried likewise.
        surroundings: (N, 3) float32 all that is known around the robot, odometry frame; empty if features are not
            compared.
        calibration: has levelled ``cloud``.
        area: of the map, metres from its zero, that is searched alone; None for all of it.
    """

    stamp: float
    T_odom_body: Pose
    scan: Points
    submap: Points
    cloud: Points
    travelled: float = 0.0
    epoch: Epoch = FIRST_EPOCH
    hints: tuple[Pose, ...] = ()
    guesses: tuple[Pose, ...] = ()
    surroundings: Points = field(default_factory=_no_points)
    calibration: Calibration = field(default_factory=Calibration)
    area: Circle | None = None

    @property
    def position(self) -> Floats:
        """(3,) sensor position in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

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
        """Make the request of a buffer's newest keyframe; ``cloud`` (N, 3) is its newest frame, body frame."""
        scan = surroundings = _no_points()
        if spec.descriptor is not None:
            scan = buffer.virtual_scan(keyframe.position, spec.descriptor.radius, spec.descriptor.voxel)
        if spec.reach is not None:
            surroundings = buffer.virtual_scan(keyframe.position, spec.reach, buffer.config.voxel)
        submap = buffer.recent(_SUBMAP_KEYFRAMES)
        return cls(
            keyframe.stamp,
            keyframe.T_odom_body,
            scan=scan,
            submap=submap,
            cloud=cloud,
            travelled=travelled,
            epoch=epoch,
            hints=hints,
            guesses=guesses,
            surroundings=surroundings,
            calibration=buffer.calibration,
            area=area,
        )


def same_place(
    T_a: Pose, T_b: Pose, request: SearchRequest, distance: float = SAME_DISTANCE, angle: float = SAME_ANGLE
) -> bool:
    """Whether two ``T_map_odom`` put the keyframe at the same place and heading."""
    a, b = T_a @ request.T_odom_body, T_b @ request.T_odom_body
    apart = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return apart < distance and rotation_angle(inverse(a) @ b) < angle
