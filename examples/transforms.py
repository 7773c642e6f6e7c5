"""Map <- odometry for programs that keep a tree of transforms (ROS' tf, say), out of poses as they come; asyncio.

coview-stream demo --web                                          # or a node of yours
python examples/transforms.py rover1 tcp/127.0.0.1:7447
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any

import numpy as np

from coview_stream import RobotClient


async def main(robot: str, endpoint: str | None = None, count: int = 100, **options: Any) -> list[np.ndarray]:
    """Print where the odometry frame begins on the map, pose by pose; return what to publish as map -> odom."""
    found: list[np.ndarray] = []
    async with RobotClient(robot, endpoint, **options) as client:
        async for pose in client.poses(timeout=30.0):
            if pose.T_map_odom is None:  # an encoding without it: keep the odometry's pose and divide
                continue
            # odom -> base_link stays the business of the robot's own odometry; this one moves slowly
            found.append(pose.T_map_odom)
            x, y, z = pose.T_map_odom[:3, 3]
            print(f"{pose.stamp_ns / 1e9:.2f} s: odometry's zero is at {x:.2f} {y:.2f} {z:.2f} on the map")
            if len(found) >= count:
                break
    return found


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    asyncio.run(main(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None))
