"""A robot that is switched off, carried elsewhere and switched on: told to search again, it is found.

coview-stream demo && python examples/carried_away.py coview-demo/world
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from coview_stream import BaseMap, Localizer, State
from coview_stream.recordings import open_run


def main(world: Path) -> list[float]:
    """Return after how many metres each of the two drives is found."""
    localizer = Localizer(BaseMap.build(world / "base.laz", learned=False))
    frames = list(open_run(world / "run"))
    found = []
    for name, drive in (("first drive", frames[: len(frames) // 2]), ("carried back", frames)):
        begin, stamp = drive[0], drive[0].stamp if not found else frames[-1].stamp + 60.0
        if found:
            # the odometry did not notice the move: without this call the localizer has to detect it
            localizer.relocalize()
        for frame in drive:
            fix = localizer.step(frame.points, frame.T_odom_body, stamp + frame.stamp - begin.stamp)
            if fix.state is State.TRACKING:
                metres = float(np.linalg.norm(frame.T_odom_body[:3, 3] - begin.T_odom_body[:3, 3]))
                print(f"{name}: found after {metres:.1f} m at {np.round(fix.position, 2)}")
                found.append(metres)
                break
    return found


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
