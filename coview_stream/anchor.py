"""The anchor: where the localizer moves the origin of the odometry frame to, so that float32 stays exact."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Pose, inverse, pose_from


def relative_to(T_odom_body: Pose, anchor: npt.NDArray[np.float64]) -> Pose:
    """Return the same pose with the odometry frame's origin moved to ``anchor`` (3,)."""
    return pose_from(T_odom_body[:3, :3], T_odom_body[:3, 3] - anchor)


def unanchored(T_map_local: Pose, anchor: npt.NDArray[np.float64], origin: npt.NDArray[np.float64]) -> Pose:
    """Return ``T_map_odom`` in the source's frame from the localizer's: undo both shifts, in float64."""
    shifted = T_map_local @ inverse(pose_from(np.eye(3), anchor))
    return pose_from(shifted[:3, :3], shifted[:3, 3] + origin)
