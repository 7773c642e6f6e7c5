"""An agent whose loop never waits: it hands over each frame, and gets the newest pose at once.

    coview-stream demo && python examples/agent.py coview-demo/world

Two processes search the map and register frames meanwhile, without a network.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from coview_stream import AsyncLocalizer, BaseMap, CoViewError, Fix
from coview_stream.recordings import open_run


def act(fix: Fix) -> None:
    """Stand in for the agent's own work: print the pose, its sigma, and how old the newest registration is."""
    age = fix.stamp - fix.evidence.stamp if fix.evidence else np.inf
    where = fix.state if fix.position is None else f"{np.round(fix.position, 2)} +- {max(fix.stddev[:3]):.2f} m"
    print(f"{fix.stamp:.1f} s: {where}, by evidence {age:.1f} s old")


def main(world: Path, period: float = 0.1) -> tuple[Fix, float]:
    """Run the loop, a frame each ``period`` seconds; return the last fix and the longest call, seconds."""
    site = world / "site.coview"
    if not site.exists():
        BaseMap.build(world / "base.laz").save(site)
    longest = 0.0
    with AsyncLocalizer(site) as localizer:
        localizer.prepare()  # takes some seconds, more the first time; without it the first fix is later by this time
        for frame in open_run(world / "run"):
            begin = time.perf_counter()
            try:
                fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
            except CoViewError as error:  # a useless frame, or a process that died: it is started again
                print(error)
                continue
            longest = max(longest, time.perf_counter() - begin)
            act(fix)
            time.sleep(max(0.0, begin + period - time.perf_counter()))
        print(f"{localizer.skipped} frames left out, longest call {1e3 * longest:.1f} ms")
        return localizer.wait(60.0), longest


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
