"""The plots of ``docs/performance.md``: milliseconds over candidates, points and robots.

Medians of wall time, curves of one plot measured in turns, drawn as ``performance_NAME.png``. Threads are set from
outside (``OPENBLAS_NUM_THREADS``, ``COVIEW_THREADS``); a plot says how many there were.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

import coview_kernels as kernels
from bench.harness.rows import Row, informs, medians
from bench.harness.suite import counted
from bench.harness.worlds import WORLDS, opened
from bench.speed.engine import there_and_back
from bench.speed.frame import LIMITS, STANDING, best_numpy, frame
from bench.speed.match import Spectral, Turned, multiplied, town
from coview_kernels import runtime
from coview_stream import Localizer, LocalizerConfig
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.report.style import TRUTH, figure

OUT = Path("docs/images")
PERIOD_MS = 100.0  # between the frames of a robot, at 10 Hz

_COLOURS = ("#0072B2", "#D55E00", "#999999")
_SEARCH_FRAMES = 400  # at most, until a robot is tracked


class Curves(NamedTuple):
    """Milliseconds at each ``x`` of each of the ``names``; ``limit`` is a line that says how much is allowed."""

    title: str
    axis: str
    x: Sequence[int]
    names: tuple[str, ...]
    milliseconds: list[list[float]]
    limit: tuple[float, str] | None = None


def candidates(quick: bool) -> Curves:
    """One keyframe with 1,000 to 100,000 stations at all 60 shifts; what depends on the map is made beforehand."""
    sizes = [1_000, 3_000] if quick else [1_000, 3_000, 10_000, 30_000, 100_000]
    known, columns = town()
    stations, found = [multiplied(each, max(sizes)) for each in known], []
    for size in sizes:
        some = [each[:size] for each in stations]
        codes = kernels.StationCodes.of(some)
        exact = (partial(side(some), columns) for side in (Spectral, Turned))
        found.append(medians(partial(codes.best, codes.query(columns)), *exact))
    names = ("coview_stream, 512 bytes a station", "spectra, BLAS", "one product of turned queries, BLAS")
    return Curves("Best score of every station at all shifts", "stations", sizes, names, found)


def points(quick: bool) -> Curves:
    """Frames of 4,096 to 131,072 points: transform, range filter, voxels."""
    sizes = [4_096, 16_384] if quick else [4_096, 8_192, 16_384, 32_768, 65_536, 131_072]
    both, order, found = np.concatenate([frame(0), frame(1)]), np.random.default_rng(0), []
    for size in sizes:
        part = both[np.sort(order.choice(len(both), size, replace=False))]
        sides = kernels.VoxelFilter(*LIMITS), best_numpy
        found.append(medians(*(partial(side, part, STANDING) for side in sides)))
    return Curves("Taking in a frame", "points of the frame", sizes, ("coview_stream", "NumPy, one sort"), found)


def robots(quick: bool) -> Curves:
    """One round of frames, one of each robot in turn, of robots that share a map and its crops in one process."""
    counts = (1, 2) if quick else (1, 2, 4, 8, 16)
    fleet, found = _fleet(max(counts)), []
    for count in counts:

        def turn(few: Sequence[Callable[[], bool]] = fleet[:count]) -> None:
            for step in few:
                step()

        rounds = [medians(turn, repeat=1, warm_up=0)[0] for _ in range(11 if quick else 61)]
        found.append(np.percentile(rounds, [50, 95]).tolist())
    names, limit = ("a round of frames, median", "95th percentile"), (PERIOD_MS, "period of 10 Hz")
    return Curves("Tracking several robots on one map", "robots in one process", counts, names, found, limit)


def _fleet(count: int) -> list[Callable[[], bool]]:
    """Robots that have found their places along one run; a call takes in the next frame and tells whether it tracks."""
    site, run, _ = opened(WORLDS["town"])
    frames, config = list(run), LocalizerConfig()
    crops = LocalMaps(site, config.registration.source_range)

    def robot(start: int) -> Callable[[], bool]:
        localizer, ticks = Localizer(site, config, crops), enumerate(there_and_back(frames))
        for _ in range(start):
            next(ticks)

        def step() -> bool:
            tick, index = next(ticks)
            T_odom_body = frames[index].T_odom_body
            return localizer.step(frames[index].points, T_odom_body, tick * PERIOD_MS / 1e3).T_map_body is not None

        return step

    fleet = [robot(k * len(frames) // count) for k in range(count)]
    if not all(any(step() for _ in range(_SEARCH_FRAMES)) for step in fleet):
        raise RuntimeError("a robot has not found its place; the plot would show searches")
    return fleet


PLOTS: dict[str, Callable[[bool], Curves]] = {"candidates": candidates, "points": points, "robots": robots}


def draw(shown: Curves, command: str, path: Path) -> None:
    """Draw curves over logarithmic axes; below them, how they were made."""
    with figure(path, figsize=(7.2, 4.6)) as (drawing, axes):
        for k, name in enumerate(shown.names):
            curve = [found[k] for found in shown.milliseconds]
            axes.plot(shown.x, curve, "o-", color=_COLOURS[k], label=name, linewidth=1.8, markersize=5)
        if shown.limit:
            value, label = shown.limit
            axes.axhline(value, color=TRUTH, linestyle="--", linewidth=1.0, label=label)
        axes.set(xscale="log", yscale="log", xlabel=shown.axis, ylabel="milliseconds", title=shown.title)
        axes.set_xticks(list(shown.x), [f"{x:,}".replace(",", " ") for x in shown.x])
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.legend(fontsize=9)
        text = f"{command}    {counted(runtime.workers())}"
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
        for k, curve in enumerate(shown.names):
            for x, found in zip(shown.x, shown.milliseconds, strict=True):
                yield informs(f"plots/{name}: {curve}, {x} {shown.axis}", found[k], "ms")
