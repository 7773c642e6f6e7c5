"""A robot without ROS: clouds and odometry sent, poses read.

    coview-stream demo                                               # makes a site and a run
    coview-stream serve coview-demo/site.coview --robot rover1       # in another terminal
    python examples/robot.py coview-demo/world/run rover1

`drive` is where your lidar and your odometry go: anything that gives NumPy arrays.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from coview_stream import RobotClient
from coview_stream.geometry.protection import one_in
from coview_stream.recordings import Frame, open_run


def drive(robot: RobotClient, frames: Iterable[Frame], seconds: float) -> None:
    """Send a recorded frame every ``seconds``, as a lidar driver would."""
    for frame in frames:
        robot.send_odometry(frame.T_odom_body, frame.stamp)  # before the cloud of the same stamp
        robot.send_cloud(frame.points, frame.stamp)
        time.sleep(seconds)


def main(run: Path, name: str, endpoint: str | None = None, seconds: float = 0.1, **options: Any) -> int:
    """Drive on one thread, read poses on this one; return how many came."""
    count, frames = 0, open_run(run)
    with RobotClient(name, endpoint, **options) as robot:
        if not robot.wait_for_node(10.0):
            print("no node subscribes to this robot; is `coview-stream serve` running?")
        driver = threading.Thread(target=drive, args=(robot, frames, seconds), daemon=True)
        driver.start()
        driving = True
        while driving:
            driving = driver.is_alive()
            for pose in robot.poses(timeout=1.0):  # ends when none came for a second: not localized, or done
                count += 1
                x, y, z = pose.T_map_body[:3, 3]
                wrong = one_in(1.0 - pose.confidence)
                print(f"{pose.stamp_ns / 1e9:.2f} s: x {x:.2f}  y {y:.2f}  z {z:.2f}  (wrong {wrong})")
        if robot.latest_status:
            print(f"at the end: {robot.latest_status.get('state')} ({robot.latest_status.get('reason')})")
    return count


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else None)
