"""Position, heading and spread of a pose as separate numbers, for those who need no matrix."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, matrix_to_quat, yaw_of


def position_of(T: Pose) -> Floats:
    """Return the position (3,) of a pose, metres; a copy."""
    return np.array(T[:3, 3], dtype=np.float64)


def quaternion_of(T: Pose) -> Floats:
    """Return the unit quaternion (4,) x y z w of a pose."""
    return matrix_to_quat(T[:3, :3])


def stddev_of(covariance: Floats) -> Floats:
    """Return one sigma (6,) of x, y, z, roll, pitch, yaw, metres and radians; NaN where a variance is not known."""
    return np.asarray(np.sqrt(np.diag(covariance)))


def pose_fields(T: Pose, covariance: Floats | None) -> dict[str, Any]:
    """Return a pose as plain data: position, orientation (quaternion) and covariance in rows, None where not known."""
    known = covariance is not None and not np.isnan(covariance).any()
    return {
        "position": position_of(T).tolist(),
        "orientation": quaternion_of(T).tolist(),
        "covariance": np.ravel(covariance).tolist() if known and covariance is not None else None,
    }


def place_fields(T: Pose) -> dict[str, Any]:
    """Return a pose as plain data: position and orientation (quaternion)."""
    return {"position": position_of(T).tolist(), "orientation": quaternion_of(T).tolist()}


def pose_in_words(T: Pose, covariance: Floats | None) -> str:
    """Return a pose in half a line: ``x 12.30, y 4.00, z 1.70 m, yaw 12.3 deg, sigma 0.02 m``."""
    x, y, z = T[:3, 3].tolist()
    sigma = math.nan if covariance is None else math.sqrt(abs(float(np.trace(covariance[:3, :3]))))
    spread = "" if math.isnan(sigma) else f", sigma {sigma:.2g} m"
    return f"x {x:.2f}, y {y:.2f}, z {z:.2f} m, yaw {math.degrees(yaw_of(T)):.1f} deg{spread}"
