"""Stated and true errors of poses: one sigma and protection level beside the error.

coview-stream demo && python examples/errors_and_bounds.py coview-demo/world errors.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")  # no screen is needed
from matplotlib import pyplot

from coview_stream import BaseMap, Localizer, State
from coview_stream.clouds import read_tum
from coview_stream.recordings import open_run


def main(world: Path, picture: Path) -> np.ndarray:
    """Write the picture and return (N, 4): seconds, error, one sigma of the position, protection level, metres."""
    localizer = Localizer(BaseMap.build(world / "base.laz", learned=False))
    _, truth = read_tum(world / "truth.tum")
    rows = []
    for frame in open_run(world / "run"):
        fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        if fix.state is State.TRACKING:
            error = np.linalg.norm(fix.position - truth[frame.index, :3, 3])
            rows.append((fix.stamp, error, np.linalg.norm(fix.stddev[:3]), fix.protection.metres))
    table = np.array(rows)
    figure, axes = pyplot.subplots(figsize=(7, 3))
    for column, name in enumerate(("error", "one sigma", "protection level"), start=1):
        axes.semilogy(table[:, 0] - table[0, 0], table[:, column], label=name)
    axes.set(xlabel="seconds", ylabel="metres")
    axes.legend()
    figure.savefig(picture, dpi=70, bbox_inches="tight")
    pyplot.close(figure)
    return table


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
