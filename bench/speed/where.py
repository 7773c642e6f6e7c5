"""Where the time of a step goes while tracking: ``python -m bench.where [--frames N]``.

The drive of ``bench engine`` with a clock around each stage, median and 95th percentile of wall time over the frames
that register (about one in nine) and over the others, which take their frame in and answer by odometry. Stages that
are part of another are indented below it. The clocks cost some microseconds each.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from bench.harness.tables import number, table
from bench.harness.worlds import map_of, prepare, world_name
from bench.speed.engine import drive, folder, town

FRAMES = 1500
_SETTLED = 300  # frames before the numbers count
_HEAD = ("stage", "ms, median", "ms, 95 %")

Times = dict[str, float]


def stages() -> list[tuple[str, Any, str]]:
    """Return what is timed: name in the table, and where the function is looked up."""
    from coview_stream import localizer, tracking
    from coview_stream.pose import attempt, registration, verification

    return [
        ("take the frame in, check it", localizer.Localizer, "_checked"),
        ("remember its points, thinned", localizer.KeyframeBuffer, "thin"),
        ("update", localizer.Tracker, "update"),
        ("  crop of the map", registration.LocalMaps, "around"),
        ("  points to register", tracking, "local_source"),
        ("  registration", attempt, "register"),
        ("  rays of the newest frame", attempt.RangeImage, "of"),
        ("  verification", attempt, "verify"),
        ("    nearest map points", verification.kernels, "nearest"),
        ("    rays against the map", verification, "rays_against_map"),
    ]


@contextmanager
def clocks(known: Sequence[tuple[str, Any, str]]) -> Iterator[Times]:
    """Add up the seconds that each stage takes, until the block ends; clear the dictionary whenever you like."""
    spent: Times = defaultdict(float)
    before = [vars(owner)[name] for _, owner, name in known]
    try:
        for label, owner, name in known:
            bound = getattr(owner, name)
            fixed = isinstance(vars(owner)[name], classmethod)
            timed = _timed(bound, label, spent)
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
    import coview_kernels
    from coview_stream import BaseMap, Localizer
    from coview_stream.clouds import open_run, read_tum

    config = town(36.0)
    prepare(folder(), config)
    world = folder() / world_name(config)
    base_map = BaseMap.load(map_of(folder(), config))
    coview_kernels.warm_up()
    out: list[Times] = []
    with clocks([*stages(), ("step", Localizer, "step")]) as spent:
        whole = Localizer.step

        def noted(*arguments: Any) -> Any:
            spent.clear()
            fix = whole(*arguments)
            out.append(dict(spent))
            return fix

        Localizer.step = noted  # type: ignore[method-assign]  # clocks put the original back
        drive(base_map, open_run(world / "run"), read_tum(world / "truth.tum")[1], frames)
    return out[_SETTLED:]


def shown(frames: Sequence[Times]) -> str:
    """Lay out the stages of some frames, in order."""
    rows = []
    for label in ["step", *(label for label, _, _ in stages())]:
        values = 1e3 * np.array([frame.get(label, 0.0) for frame in frames])
        if values.any():
            rows.append(
                [label.replace("  ", "· "), *(number(float(np.percentile(values, q)), 2) for q in (50, 95))]
            )
    return table(_HEAD, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive and print both tables."""
    parser = argparse.ArgumentParser(prog="python -m bench.where", description=__doc__)
    parser.add_argument(
        "--frames", type=int, default=FRAMES, help=f"({FRAMES}; the first {_SETTLED} do not count)"
    )
    options = parser.parse_args(arguments)
    if options.frames <= _SETTLED:
        print(f"bench.where: --frames {options.frames}: {_SETTLED} go by before it counts", file=sys.stderr)
        return 2
    frames = measured(options.frames)
    for title, chosen in (
        ("frames that register", [f for f in frames if "update" in f]),
        ("all others", [f for f in frames if "update" not in f]),
    ):
        print(f"\n{title}: {len(chosen)} of {len(frames)}\n\n{shown(chosen) if chosen else 'none'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
