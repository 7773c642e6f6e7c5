"""The plots of ``docs/performance.md``: milliseconds over candidates, points and robots.

* ``candidates``: matching one query with 1,000 to 100,000 stations, all of them at all shifts.
* ``points``: taking in a frame, by its points.
* ``robots``: one round of frames of several robots that are tracked on one map in one process.

Medians of wall time, curves of one plot measured in turns, drawn as ``performance_NAME.png``. Threads are set from
outside (``OPENBLAS_NUM_THREADS``, ``COVIEW_THREADS``); a plot says how many there were.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.files import folder
from bench.harness.rows import Row, informs, medians
from bench.harness.worlds import base_map, world
from bench.speed.engine import frames_of
from bench.speed.match import Spectral, Turned, multiplied, town

OUT = Path("docs/images")
PERIOD_MS = 100.0  # between the frames of a robot, at 10 Hz
BEST = 20  # stations that matching has to name

_COLOURS = ("#0072B2", "#D55E00", "#999999", "#009E73")
_SEARCH_FRAMES = 400  # at most, until a robot is tracked
_ROUNDS = 61


@dataclass
class Curves:
    """Milliseconds by name, at each ``x``; ``limit`` is a line that says how much is allowed."""

    title: str
    axis: str
    x: Sequence[int]
    milliseconds: dict[str, list[float]] = field(default_factory=dict)
    limit: tuple[float, str] | None = None


def candidates(quick: bool) -> Curves:
    """One keyframe with 1,000 to 100,000 stations at all 60 shifts; the best 20 are asked for.

    Index, spectra and transposed descriptors are made beforehand.
    """
    import coview_kernels as kernels

    sizes = [1_000, 3_000] if quick else [1_000, 3_000, 10_000, 30_000, 100_000]
    out = Curves("Matching one query at all shifts", "stations", sizes)
    known, queries = town()
    channel = next(iter(known))
    stations, query, found = multiplied(known[channel], max(sizes)), queries[channel], []
    for size in sizes:
        sides = [made(stations[:size]) for made in (kernels.MatchIndex, Spectral, Turned)]
        asked = [sides[0].top_k, *sides[1:]]
        found.append(medians(*(partial(side, query, BEST) for side in asked)))
    names = ("coview_stream, pruned", "spectra, BLAS", "one product of turned queries, BLAS")
    out.milliseconds = dict(zip(names, map(list, zip(*found, strict=True)), strict=True))
    return out


def points(quick: bool) -> Curves:
    """Frames of 4,096 to 131,072 points: transform, range filter, voxels."""
    from bench.speed.frame import LIMITS, best_numpy, frame, pose
    from coview_kernels import VoxelFilter

    sizes = [4_096, 16_384] if quick else [4_096, 8_192, 16_384, 32_768, 65_536, 131_072]
    out = Curves("Taking in a frame", "points of the frame", sizes)
    both, T, order = np.concatenate([frame(0), frame(1)]), pose(), np.random.default_rng(0)
    found = []
    for size in sizes:
        part = both[np.sort(order.choice(len(both), size, replace=False))]
        found.append(medians(partial(VoxelFilter(*LIMITS), part, T), partial(best_numpy, part, T)))
    ours, numpy = zip(*found, strict=True)
    out.milliseconds = {"coview_stream": list(ours), "NumPy, one sort": list(numpy)}
    return out


def robots(quick: bool) -> Curves:
    """One round of frames, one of each robot in turn, of robots that share a map and its crops in one process."""
    counts = (1, 2) if quick else (1, 2, 4, 8, 16)
    out = Curves("Tracking several robots on one map", "robots in one process", counts)
    out.limit = (PERIOD_MS, "period of 10 Hz")
    fleet, median, worst = _fleet(world(folder(), "town"), max(counts)), [], []
    for count in counts:
        steps = [robot.step for robot in fleet[:count]]
        rounds = [medians(lambda: [step() for step in steps], repeat=1, warm_up=0)[0]  # noqa: B023
                  for _ in range(11 if quick else _ROUNDS)]  # fmt: skip
        median.append(float(np.median(rounds)))
        worst.append(float(np.percentile(rounds, 95)))
    out.milliseconds = {"a round of frames, median": median, "95th percentile": worst}
    return out


class _Robot:
    """A tracked robot, which drives a run to and fro."""

    def __init__(self, localizer: Any, frames: list[Any], start: int) -> None:
        self._localizer, self._frames, self._tick = localizer, frames, start
        self._order = [index for index, _ in frames_of(frames, 2 * len(frames) - 2)]

    def step(self) -> bool:
        """Take in the next frame; tell whether the robot is tracked."""
        frame = self._frames[self._order[self._tick % len(self._order)]]
        self._tick += 1
        fix = self._localizer.step(frame.points, frame.T_odom_body, self._tick * PERIOD_MS / 1e3)
        return fix.T_map_body is not None


def _fleet(there: Path, count: int) -> list[_Robot]:
    """Robots that have found their places along one run, far from each other."""
    from coview_stream import Localizer, LocalizerConfig
    from coview_stream.localization.registration.local_map import LocalMaps
    from coview_stream.recordings.open_run import open_run

    site, run = base_map(folder(), "town"), open_run(there / "run")
    frames = [run.read(index) for index in range(len(run))]
    config = LocalizerConfig()
    crops = LocalMaps(site, config.registration.source_range)
    fleet = [_Robot(Localizer(site, config, crops), frames, k * len(frames) // count) for k in range(count)]
    for robot in fleet:
        if not any(robot.step() for _ in range(_SEARCH_FRAMES)):
            raise RuntimeError("a robot has not found its place; the plot would show searches")
    return fleet


PLOTS: dict[str, Callable[[bool], Curves]] = {"candidates": candidates, "points": points, "robots": robots}


def draw(shown: Curves, command: str, path: Path) -> None:
    """Draw curves over logarithmic axes; below them, how they were made.

    Raises:
        InputError: the picture cannot be written.
    """
    from coview_kernels import runtime
    from coview_stream.report.style import TRUTH, figure

    with figure(path, figsize=(7.2, 4.6)) as (drawing, axes):
        for colour, (name, milliseconds) in zip(_COLOURS, shown.milliseconds.items(), strict=False):
            axes.plot(shown.x, milliseconds, "o-", color=colour, label=name, linewidth=1.8, markersize=5)
        if shown.limit:
            value, label = shown.limit
            axes.axhline(value, color=TRUTH, linestyle="--", linewidth=1.0, label=label)
        axes.set(xscale="log", yscale="log", xlabel=shown.axis, ylabel="milliseconds", title=shown.title)
        axes.set_xticks(list(shown.x), [f"{x:,}".replace(",", " ") for x in shown.x])
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.legend(fontsize=9)
        threads = runtime.workers()
        text = f"{command}    {threads} thread{'s' if threads > 1 else ''}"
        drawing.supxlabel(text, fontsize=8, color="#666666", family="DejaVu Sans Mono")


def options(parser: ArgumentParser) -> None:
    """Add which plots, and where they go."""
    parser.add_argument("names", nargs="*", choices=[[], *PLOTS], metavar="PLOT", help=f"of {', '.join(PLOTS)}")
    parser.add_argument("--out", type=Path, default=OUT, help=f"directory for the pictures ({OUT})")


def rows(asked: Namespace) -> Iterator[Row]:
    """Measure and draw; a row per point of each curve."""
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.names or PLOTS:
        shown = PLOTS[name](asked.quick)
        command = f"python -m bench plots {name}{' --quick' * asked.quick}"
        draw(shown, command, asked.out / f"performance_{name}.png")
        for curve, milliseconds in shown.milliseconds.items():
            for x, value in zip(shown.x, milliseconds, strict=True):
                yield informs(f"plots/{name}: {curve}, {x} {shown.axis}", value, "ms")
