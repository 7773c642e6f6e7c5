"""What a search has to know of a keyframe; plain data, so that it may be asked later and elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from coview_stream.config import DescriptorConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, rotation_angle
from coview_stream.localization.registration.verification import RangeImage
from coview_stream.localization.search.keyframes import Keyframe, KeyframeBuffer

_SUBMAP_KEYFRAMES = 4  # of the newest in the local scan that is registered: more are smeared by drift
_SAME_DISTANCE = 2.0  # metres: hypotheses that registration brought this close together are one
_SAME_ANGLE = np.radians(5.0)


def _nothing() -> Points:
    return np.empty((0, 3), dtype=np.float32)


@dataclass(frozen=True)
class RequestSpec:
    """What queries have to bring: a scan for ``descriptor``, surroundings up to ``reach`` metres; None for neither."""

    descriptor: DescriptorConfig | None
    reach: float | None = None


@dataclass(frozen=True)
class SearchRequest:
    """All that a search needs to know of one keyframe; whoever searches may do it later and elsewhere.

    Attributes:
        stamp: seconds, of the keyframe.
        T_odom_body: (4, 4) of the keyframe.
        scan: (N, 3) float32 virtual local scan, odometry frame, metres; empty if no descriptor is made of it.
        submap: (N, 3) float32 points of the newest keyframes, odometry frame: what is registered.
        cloud: (N, 3) float32 newest frame, body frame.
        travelled: metres that odometry had driven.
        generation: of the localizer's memory; a query of another generation starts the search anew.
        suggested: (4, 4) each, ``T_map_odom`` that may be right: verified and judged as what the votes find.
        surroundings: (N, 3) float32 all that is known around the robot, odometry frame; empty if features are not
            compared.
    """

    stamp: float
    T_odom_body: Pose
    scan: Points
    submap: Points
    cloud: Points
    travelled: float = 0.0
    generation: int = 0
    suggested: tuple[Pose, ...] = ()
    surroundings: Points = field(default_factory=_nothing)

    @property
    def position(self) -> Floats:
        """(3,) sensor position in the odometry frame, metres."""
        return np.asarray(self.T_odom_body[:3, 3])

    @cached_property
    def seen(self) -> RangeImage:
        """The newest frame by direction."""
        return RangeImage.of(self.cloud)

    @classmethod
    def of(
        cls,
        buffer: KeyframeBuffer,
        keyframe: Keyframe,
        cloud: Points,
        needs: RequestSpec,
        travelled: float = 0.0,
        generation: int = 0,
        suggested: tuple[Pose, ...] = (),
    ) -> SearchRequest:
        """Ask about the newest keyframe of a buffer; ``cloud`` (N, 3) is its newest frame, body frame."""
        scan = surroundings = _nothing()
        if needs.descriptor is not None:
            radius, voxel = needs.descriptor.radius, needs.descriptor.voxel
            scan = buffer.virtual_scan(keyframe.position, radius, voxel)
        if needs.reach is not None:
            surroundings = buffer.virtual_scan(keyframe.position, needs.reach, buffer.config.voxel)
        submap = buffer.recent(_SUBMAP_KEYFRAMES)
        return cls(
            keyframe.stamp, keyframe.T_odom_body, scan, submap, cloud, travelled, generation, suggested,
            surroundings,
        )  # fmt: skip


def same_place(
    T_a: Pose,
    T_b: Pose,
    query: SearchRequest,
    distance: float = _SAME_DISTANCE,
    angle: float = float(_SAME_ANGLE),
) -> bool:
    """Whether two ``T_map_odom`` put the keyframe at the same place and heading."""
    a, b = T_a @ query.T_odom_body, T_b @ query.T_odom_body
    apart = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    return apart < distance and rotation_angle(inverse(a) @ b) < angle
