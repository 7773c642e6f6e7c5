"""Scan registration by kiss-icp (MIT; Vizzo et al., RA-L 2023), which no other module imports.

kiss-icp's own deskewing normalises the time stamps of a frame and takes the result for a rotation, unchecked: where
all are equal, or one is not finite, 1.3.0 aborts the interpreter (``SOPHUS_ENSURE failed``). So deskewing is off, it
gets no time stamps, and the frames come deskewed by :func:`~coview_stream.odometry.deskew.deskew`, which refers them
to the frame's stamp as well: kiss-icp's refers them to the sweep's end, or its middle, by version.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, inverse

_NO_TIMES = np.zeros(0)


class ScanRegistration(Protocol):
    """Registration of frames to a local map that grows with them."""

    def register(self, points: Floats, guess: Pose) -> Pose:
        """Return the pose (4, 4) of a deskewed frame (N, 3), local map <- body, from a guess near it; add the frame."""
        ...

    def clear(self) -> None:
        """Forget the local map; the next frame is placed where it is guessed to be."""
        ...


class KissRegistration:
    """kiss-icp's point-to-point ICP against its voxel map, with its adaptive threshold."""

    def __init__(self, config: LidarOdometryConfig) -> None:
        self._kiss_icp, self._settings = _settings(config)
        self.clear()

    def register(self, points: Floats, guess: Pose) -> Pose:
        """As of :class:`ScanRegistration`."""
        icp = self._icp
        # register_frame predicts by the last motion, for any time between: so the guess goes in as that motion
        icp.last_delta = inverse(icp.last_pose) @ guess
        icp.register_frame(points, _NO_TIMES)
        return np.array(icp.last_pose, dtype=np.float64)

    def clear(self) -> None:
        """As of :class:`ScanRegistration`."""
        self._icp = self._kiss_icp(self._settings)


def _settings(config: LidarOdometryConfig) -> tuple[Any, Any]:
    """Return the class ``KissICP`` and its configuration; DependencyError where there is no kiss-icp."""
    pipeline, configuration = (
        require_library(f"kiss_icp.{module}", "kiss-icp>=1.2", "lidar odometry") for module in ("kiss_icp", "config")
    )
    settings = configuration.KISSConfig()
    settings.data.min_range, settings.data.max_range = config.min_range, config.max_range
    settings.data.deskew = False
    settings.mapping.voxel_size = config.voxel
    settings.registration.max_num_threads = config.threads
    settings.registration.convergence_criterion = config.convergence
    settings.registration.max_num_iterations = config.iterations
    return pipeline.KissICP, settings
