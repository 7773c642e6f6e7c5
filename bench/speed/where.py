"""Where the time of a step goes while tracking, stage by stage.

The drive of ``python -m bench engine`` with a clock around each stage. Stages that are part of another are indented
below it. The clocks cost some microseconds each.
"""

from __future__ import annotations

from argparse import Namespace
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any
from unittest.mock import patch

import numpy as np

from bench.harness.clock import Clock
from bench.harness.rows import Row, informs
from bench.harness.tables import number, table
from bench.speed.engine import drive, town
from coview_stream import Localizer
from coview_stream.localization import localizer
from coview_stream.localization.registration import local_map, verification
from coview_stream.localization.registration import register as registration
from coview_stream.localization.tracking import tracker

_SETTLED = 300  # frames before the numbers count

STAGES = (
    ("step", Localizer, "step"),
    ("take the frame in, check it", localizer, "validate_cloud"),
    ("one point per voxel", localizer.kernels.VoxelFilter, "__call__"),
    ("match to map", localizer.Tracker, "match_to_map"),
    ("  crop of the map", local_map.LocalMaps, "around"),
    ("  points to register", tracker, "prepare_scan"),
    ("  registration", registration, "register"),
    ("  rays of the newest frame", registration.RangeImage, "of"),
    ("  verification", registration, "verify"),
    ("    points against the map", verification.kernels, "match_points"),
    ("    rays against the map", verification, "free_space"),
)
"""Name in the table, and where the function is looked up."""


def measured(frames: int) -> list[dict[str, float]]:
    """Seconds of every stage, frame by frame."""
    base_map, run, truth = town(36.0)
    clock, out = Clock(), []
    with clock.around(STAGES):
        timed = Localizer.step

        def noted(*arguments: Any) -> Any:
            clock.seconds.clear()
            fix = timed(*arguments)
            out.append(dict(clock.seconds))
            return fix

        with patch.object(Localizer, "step", noted):
            drive(base_map, run, truth, frames)
    return out[_SETTLED:]


def rows(asked: Namespace) -> Iterator[Row]:
    """Medians of the stages, of both kinds of frames."""
    frames = measured(600 if asked.quick else 1500)
    for title, registers in (("frames that register", True), ("all others", False)):
        chosen = [frame for frame in frames if ("match to map" in frame) is registers]
        for label, _, _ in STAGES:
            values = 1e3 * np.array([frame.get(label, 0.0) for frame in chosen])
            if values.any():
                p50, p95 = np.percentile(values, [50, 95])
                about = {"part": f"{title}: {len(chosen)} of {len(frames)}", "stage": label, "p95": p95}
                yield informs(f"where/{title}, {label.strip()}", p50, "ms", about)


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Both kinds of frames, stage by stage, in one text."""
    parts: dict[str, list[list[str]]] = defaultdict(list)
    for row in rows:
        stage = row.details["stage"].replace("  ", "· ")
        parts[row.details["part"]].append([stage, number(row.ours, 2), number(row.details["p95"], 2)])
    head = ("stage", "ms, median", "ms, 95 %")
    return {"": "\n\n".join(f"{part}\n\n{table(head, cells)}" for part, cells in parts.items())}
