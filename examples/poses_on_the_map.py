"""Poses drawn on the map, in the survey's coordinates, each with the circle that its error is meant to stay in.

coview-stream demo && python examples/poses_on_the_map.py coview-demo/world poses.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no screen is needed
from matplotlib import pyplot
from matplotlib.patches import Circle

from coview_stream import BaseMap, Localizer, State
from coview_stream.recordings import open_run

TIMES = 10.0
"""Factor by which circles are enlarged, as centimetres would be invisible."""


def main(world: Path, picture: Path) -> int:
    """Write the picture and return how many poses are in it."""
    base_map = BaseMap.build(world / "base.laz", learned=False)
    localizer = Localizer(base_map)
    axes = base_map.plot()
    poses = 0
    for frame in open_run(world / "run"):
        fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        if fix.state is State.TRACKING:  # only then is there a pose
            x, y, _ = fix.position
            axes.plot(x, y, ".", color="crimson", markersize=3)
            axes.add_patch(Circle((x, y), TIMES * fix.protection.metres, fill=False, color="crimson", alpha=0.3))
            poses += 1
    axes.set_title(f"{poses} poses; circles: protection level, {TIMES:.0f} times as large")
    axes.figure.savefig(picture, dpi=70)
    pyplot.close(axes.figure)
    return poses


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
