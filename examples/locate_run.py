"""A base map built, saved and loaded, and a run localized on it frame by frame.

    coview-stream demo && python examples/locate_run.py coview-demo/world

The directory holds base.laz, run/ and truth.tum, written by the commands demo and simulate.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from coview_stream import BaseMap, Localizer, State
from coview_stream.clouds import read_tum
from coview_stream.recordings import open_run


def main(world: Path) -> list[float]:
    """Print what the localizer says and return the position errors of all frames that got a pose, metres."""
    site = world.parent / "site.coview"
    BaseMap.build(world / "base.laz").save(site)  # once per site; loading takes milliseconds
    localizer = Localizer(BaseMap.load(site))

    stamps, truth = read_tum(world / "truth.tum")
    errors: list[float] = []
    state = None
    for frame in open_run(world / "run"):
        fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        if fix.state is not state:
            reason = fix.evidence.reason if fix.evidence else "no keyframe yet"
            print(f"t = {fix.stamp:.1f} s: {fix.state.reported} ({reason})")
            state = fix.state
        if fix.state is State.TRACKING:  # only then is there a pose
            true_position = truth[np.abs(stamps - fix.stamp).argmin(), :3, 3]
            errors.append(float(np.linalg.norm(fix.T_map_body[:3, 3] - true_position)))
    if errors:
        print(f"{len(errors)} of {len(stamps)} frames localized, mean position error {np.mean(errors):.3f} m")
    return errors


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "coview-demo/world"))
