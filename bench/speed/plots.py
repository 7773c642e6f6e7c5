"""The plots of ``docs/performance.md``: ``python -m bench.plots [NAME...] [--out DIR] [--quick]``.

* ``candidates``: matching one query with 1,000 to 100,000 stations, all of them at all shifts.
* ``points``: taking in a frame, by its points.
* ``robots``: one round of frames of several robots that are tracked on one map in one process.

Medians of wall time, curves of one plot measured in turns, written as ``performance_NAME.png`` with the numbers
beside them (``.json``). Threads are set from outside (``OPENBLAS_NUM_THREADS``, ``COVIEW_THREADS``); a plot says
how many there were.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from bench.speed import curves
from bench.speed.curves import Curves

OUT = Path("docs/images")
_COLOURS = ("#0072B2", "#D55E00", "#999999", "#009E73")

PLOTS: dict[str, Callable[[bool], Curves]] = {
    "candidates": curves.candidates,
    "points": curves.points,
    "robots": curves.robots,
}


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and draw."""
    parser = argparse.ArgumentParser(prog="python -m bench.plots", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(PLOTS)} (all)")
    parser.add_argument("--out", type=Path, default=OUT, help=f"directory for the pictures ({OUT})")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.names if name not in PLOTS]:
        print(f"bench.plots: no plot {unknown[0]!r}; there are {', '.join(PLOTS)}", file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names or PLOTS:
        print(f"... {name}", file=sys.stderr, flush=True)
        shown = PLOTS[name](options.quick)
        command = f"python -m bench.plots {name}{' --quick' if options.quick else ''}"
        path = options.out / f"performance_{name}.png"
        draw(shown, command, path)
        path.with_suffix(".json").write_text(json.dumps(asdict(shown), indent=1) + "\n")
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
