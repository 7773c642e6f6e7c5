"""Poses by their six numbers, for tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from coview_stream.geometry import Pose, pose_from
from coview_stream.rotation import exp_so3


def exp_se3(xi: npt.NDArray[np.float64]) -> Pose:
    """Left-multiplied pose increment from (rx, ry, rz, x, y, z): rotate, then shift."""
    return pose_from(exp_so3(xi[:3]), xi[3:])
