"""Where the time of a step goes while tracking, stage by stage.

The drive of ``python -m bench engine`` with a clock around each stage, median and 95th percentile of wall time over the
frames that register (about one in nine) and over the others, which take their frame in and answer by odometry. Stages
that are part of another are indented below it. The clocks cost some microseconds each.
"""

from __future__ import annotations

import functools
import time
from argparse import ArgumentParser, Namespace
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from bench.harness.rows import Row, informs
from bench.harness.tables import number, table
from bench.speed.engine import drive, opened

FRAMES = 1500
_SETTLED = 300  # frames before the numbers count

Times = dict[str, float]


def stages() -> list[tuple[str, Any, str]]:
    """Return what is timed: name in the table, and where the function is looked up."""
    from coview_stream.localization import localizer
    from coview_stream.localization.registration import local_map, verification
    from coview_stream.localization.registration import register as registration
    from coview_stream.localization.tracking import tracker

    return [
        ("take the frame in, check it", localizer, "validate_cloud"),
        ("remember its points, thinned", localizer.KeyframeBuffer, "voxelize"),
        ("match to map", localizer.Tracker, "match_to_map"),
        ("  crop of the map", local_map.LocalMaps, "around"),
        ("  points to register", tracker, "prepare_scan"),
        ("  registration", registration, "register"),
        ("  rays of the newest frame", registration.RangeImage, "of"),
        ("  verification", registration, "verify"),
        ("    nearest map points", verification.kernels, "nearest"),
        ("    rays against the map", verification, "free_space"),
    ]


@contextmanager
def clocks(known: Sequence[tuple[str, Any, str]]) -> Iterator[Times]:
    """Add up the seconds that each stage takes, until the block ends; the dictionary may be cleared at any time."""
    spent: Times = defaultdict(float)
    before = [vars(owner)[name] for _, owner, name in known]
    try:
        for label, owner, name in known:
            timed = _timed(getattr(owner, name), label, spent)
            fixed = isinstance(vars(owner)[name], classmethod)
            setattr(owner, name, staticmethod(timed) if fixed else timed)
        yield spent
    finally:
        for (_, owner, name), original in zip(known, before, strict=True):
            setattr(owner, name, original)


def _timed(stage: Callable[..., Any], label: str, spent: Times) -> Callable[..., Any]:
    @functools.wraps(stage)
    def run(*arguments: Any, **options: Any) -> Any:
        begin = time.perf_counter()
        try:
            return stage(*arguments, **options)
        finally:
            spent[label] += time.perf_counter() - begin

    return run


def measured(frames: int) -> list[Times]:
    """Seconds of every stage and of the ``step``, frame by frame."""
    from coview_stream import Localizer

    base_map, run, truth = opened(36.0)
    out: list[Times] = []
    with clocks([*stages(), ("step", Localizer, "step")]) as spent:
        timed = Localizer.step

        def noted(*arguments: Any) -> Any:
            spent.clear()
            fix = timed(*arguments)
            out.append(dict(spent))
            return fix

        Localizer.step = noted  # type: ignore[method-assign]  # clocks put the original back
        drive(base_map, run, truth, frames)
    return out[_SETTLED:]


def options(parser: ArgumentParser) -> None:
    """Add how many frames."""
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"({FRAMES}; the first {_SETTLED} do not count)")


def rows(asked: Namespace) -> Iterator[Row]:
    """Medians of the stages, of both kinds of frames."""
    frames = measured(600 if asked.quick else max(asked.frames, _SETTLED + 1))
    for title, chosen in (
        ("frames that register", [each for each in frames if "match to map" in each]),
        ("all others", [each for each in frames if "match to map" not in each]),
    ):
        for label in ["step", *(label for label, _, _ in stages())]:
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
