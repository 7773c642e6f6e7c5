"""What callers hand the localizer: checked, and copied where they may write into it again."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, is_pose, orthonormal, pose_from

_LEAST_POINTS = 10
_LOOKED_AT = 2000  # of a frame's points, to see how far they lie
_FARTHEST = 10_000.0  # metres: no lidar sees this far, float32 is coarse there
_OTHER_WORLD = 1e7  # metres from the map's origin: no place on this planet


def validate_cloud(cloud: npt.ArrayLike) -> Points:
    """Return a frame's finite points, a copy (N, 3) float32 in rows; CloudError where it is no cloud."""
    try:
        with np.errstate(over="ignore"):
            rows = np.asarray(cloud).astype(np.float32, copy=False)
    except (TypeError, ValueError) as error:
        raise CloudError(f"cloud is not an array of numbers ({error}); expected (N, 3) float32") from error
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise CloudError(f"cloud has shape {rows.shape}; expected (N, 3)")
    whole = np.isfinite(rows).all()
    # a copy even so: the caller may write the next frame into the same array
    finite = rows.copy(order="C") if whole else rows.compress(np.isfinite(rows).all(axis=1), axis=0)
    if len(finite) < _LEAST_POINTS:
        raise CloudError(f"cloud has {len(finite)} finite points; a frame needs {_LEAST_POINTS} or more")
    if np.median(np.abs(finite[:: 1 + len(finite) // _LOOKED_AT])) > _FARTHEST:
        raise CloudError("cloud lies kilometres from its origin; give it relative to the sensor")
    return finite


def validate_odometry(T_odom_body: npt.ArrayLike, stamp: float) -> Pose:
    """Return a frame's pose (4, 4), exactly rigid; RunError where it is not, or its stamp (seconds) not finite."""
    try:
        T = np.asarray(T_odom_body, dtype=np.float64)
        known = bool(np.isfinite(stamp))
    except (TypeError, ValueError) as error:
        raise RunError(f"T_odom_body or stamp is not numeric ({error})") from error
    if not known:
        raise RunError(f"stamp is {stamp}; it must be finite, in seconds")
    if not is_pose(T):
        raise RunError("T_odom_body is not a finite rigid 4x4 transform; check the odometry")
    return orthonormal(T)


def validate_pose(T_map_body: npt.ArrayLike, origin: Floats) -> Pose:
    """Return a place (4, 4), given in the frame of the map's sources, about the map's ``origin`` (3,).

    RunError where it is not rigid or not on this planet.
    """
    try:
        T = np.asarray(T_map_body, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RunError(f"T_map_body is not numeric ({error})") from error
    if not is_pose(T):
        raise RunError("T_map_body is not a finite rigid 4x4 transform")
    local = orthonormal(pose_from(T[:3, :3], T[:3, 3] - origin))
    if np.abs(local[:3, 3]).max() > _OTHER_WORLD:
        raise RunError("T_map_body lies 10,000 km off the map; is it in the frame of the map's sources?")
    return local
