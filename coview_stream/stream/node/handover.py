"""Place of a robot as one node hands it to another: a hypothesis to verify, like the last known place after a start."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from coview_stream.geometry.transforms import Pose, is_pose
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.stream.node.last_pose import read_calibration


@dataclass(frozen=True, eq=False)
class Handover:
    """What one node knows of where a robot is.

    Attributes:
        map_sha256: of the base map; of a site that of its state, which all parts of it share.
        T_map_odom: (4, 4) map <- odometry; the robot's odometry goes on when its node changes.
        calibration: what is corrected of its sensor and odometry; None if that is not known.
    """

    map_sha256: str
    T_map_odom: Pose
    calibration: Calibration | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain data."""
        found: dict[str, Any] = {"map_sha256": self.map_sha256, "T_map_odom": np.asarray(self.T_map_odom).tolist()}
        return found if self.calibration is None else found | {"calibration": asdict(self.calibration)}

    @classmethod
    def from_json(cls, told: Any) -> Handover:
        """Read what :meth:`to_json` wrote, from anyone; ValueError, TypeError or KeyError for something else."""
        T = np.asarray(told["T_map_odom"], dtype=np.float64)
        if not is_pose(T):
            raise ValueError("T_map_odom is not a finite rigid 4x4 transform")
        return cls(str(told["map_sha256"])[:64], T, read_calibration(told.get("calibration")))
