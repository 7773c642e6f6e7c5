"""Instructions of a search step and of tracked frames: python .ci/count_instructions.py SITE RUN COUNTS.

Runs in QEMU on one core, with the plugin instructions.c, which writes COUNTS; ``.ci/aarch64 count`` starts it.
"""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import numpy as np

from coview_stream import BaseMap, Localizer
from coview_stream.recordings import Frame, open_run

# assumed, as no board was tried: clock, GHz; least and greatest instructions per cycle. An A55 issues two in order, an
# A76 four out of order; neither keeps that up on code that waits for memory
CORES = {"Cortex-A55, 2.0 GHz": (2.0, 0.5, 1.0), "Cortex-A76, 2.4 GHz": (2.4, 1.0, 2.0)}
_MARK = 1 << 29  # as in the plugin


def mark(number: int) -> None:
    """Let the plugin write the count."""
    with contextlib.suppress(ProcessLookupError):
        os.getpgid(_MARK + number)


def step(localizer: Localizer, frame: Frame, kinds: list[str]) -> None:
    """Count a frame."""
    kinds.append("tracked" if localizer.state.has_place else "search")
    mark(2 * len(kinds))
    localizer.step(frame.points, frame.T_odom_body, frame.stamp)
    mark(2 * len(kinds) + 1)


def started(base_map: BaseMap) -> Localizer:
    """Return a localizer that has all in memory."""
    localizer = Localizer(base_map)
    localizer.prepare()
    return localizer


def main() -> None:
    """Print a table in Markdown."""
    base_map, run = BaseMap.load(sys.argv[1]), open_run(sys.argv[2])
    frames = [run.read(k) for k in range(len(run))]
    localizer = started(base_map)
    for frame in frames[:15]:  # compiles
        localizer.step(frame.points, frame.T_odom_body, frame.stamp)
    kinds: list[str] = []
    for frame in frames[20::20]:
        step(started(base_map), frame, kinds)
    localizer = started(base_map)
    for frame in frames:
        step(localizer, frame, kinds)
    counts = dict(np.loadtxt(Path(sys.argv[3]), dtype=np.int64).tolist())
    millions = np.array([counts[2 * k + 1] - counts[2 * k] for k in range(1, len(kinds) + 1)]) / 1e6
    search, tracked = (millions[np.array(kinds) == kind] for kind in ("search", "tracked"))
    points = round(float(np.mean([len(frame.points) for frame in frames])))
    lines = {
        f"tracked frame, mean of {len(tracked)}": tracked.mean(),
        "tracked frame, median": np.median(tracked),
        "tracked frame, greatest": tracked.max(),
        f"search step, mean of {len(search)}": search.mean(),
    }
    table = [f"|step|million instructions|{'|'.join(CORES)}|", "|---|---:|" + "---:|" * len(CORES)]
    for name, million in lines.items():
        times = [f"{million / ghz / most:.0f} to {million / ghz / least:.0f} ms" for ghz, least, most in CORES.values()]
        table.append(f"|{name}|{million:.1f}|{'|'.join(times)}|")
    sys.stdout.write("\n".join([f"{points} points a frame, {len(base_map)} stations\n", *table, ""]))


if __name__ == "__main__":
    main()
