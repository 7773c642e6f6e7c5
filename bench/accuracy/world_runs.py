"""A simulated world's run on a map: localized, timed, and judged by the truth."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import peak_megabytes
from coview_stream import BaseMap
from coview_stream.clouds import read_tum
from coview_stream.localization.offline import RunResult, locate
from coview_stream.recordings.open_run import open_run
from coview_stream.report.evaluation import evaluate

Run = dict[str, Any]  # what one run came to: the figures of ``evaluate``, and where it was


def measure(world: Path, site: Path, inside: bool) -> Run:
    """Localize a world's run on the map in a file; judged by the truth if the run is inside of that map."""
    base_map = BaseMap.load(site)
    begin = time.perf_counter()
    located = locate(base_map, open_run(world / "run"))
    found: Run = {
        "locate_s": round(time.perf_counter() - begin, 2),
        "p50_ms": round(1e3 * float(np.median(located.seconds)), 2),
        "megabytes": peak_megabytes(),
        "map_points": len(base_map.points),
        "state": located.state.reported,
        "reason": located.keyframes[-1].reason if located.keyframes else "",
        "frames": located.frames,
        "posed": len(located.posed),
    }
    if not inside:
        return found | {"false_frames": len(located.posed), "success": not located.posed}
    return found | evaluated(located, world)


def evaluated(located: RunResult, world: Path) -> Run:
    """Figures of ``evaluate`` for a world's run on its own map."""
    poses = np.array([fix.T_map_body for fix in located.posed]).reshape(-1, 4, 4)
    estimate = np.array([fix.stamp for fix in located.posed]), poses
    return dict(json.loads(evaluate(estimate, read_tum(world / "truth.tum")).to_json()))
