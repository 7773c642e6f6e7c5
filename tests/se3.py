"""Poses by their six numbers, for tests."""

import numpy as np
import numpy.typing as npt

from coview_stream.geometry.transforms import Pose, exp_so3, pose_from


def exp_se3(xi: npt.NDArray[np.float64]) -> Pose:
    """Left-multiplied pose increment from (rx, ry, rz, x, y, z): rotate, then shift."""
    return pose_from(exp_so3(xi[:3]), xi[3:])
