"""The speed of everything, with verdicts: ``python -m bench [NAME...] [--json FILE] [--quick] [--list]``.

Each benchmark runs in a process of its own, with 1 and with 2 threads where that matters, and prints a row per
figure: ours, the best formulation without us beside it (medians, taken in turns), how many times better ours
is, and whether the target holds. Exit code 1 if any does not. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.harness.rows import Row
from bench.harness.running import counted, run
from bench.harness.suite import OWN, SUITE, Entry
from bench.harness.tables import line, rule

HEAD = ("benchmark", "ours", "baseline", "unit", "ratio", "target", "verdict")
_WIDTHS = (60, 9, 9, 7, 7, 12, 13)
_BUSY = 0.7  # load average: someone else computes
_VERDICTS = {True: "holds", False: "DOES NOT HOLD", None: "informs"}


def cells(row: Row) -> list[str]:
    """One line of the table."""
    verdict = _VERDICTS[row.holds]
    return [
        row.name, _figure(row.ours), _figure(row.baseline), row.unit, _figure(row.ratio), row.target, verdict
    ]  # fmt: skip


def _figure(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


class _Progress:
    """A line on stderr that says what runs, over itself in a terminal, once a benchmark elsewhere."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._live = sys.stderr.isatty()
        if not self._live:
            print(f"... {label}", file=sys.stderr, flush=True)

    def __call__(self, seconds: float) -> None:
        if self._live:
            print(f"\r... {self._label} {seconds:4.0f} s", end="\r", file=sys.stderr, flush=True)

    def clear(self) -> None:
        if self._live:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _measure(entries: Sequence[Entry], threads: int | None, quick: bool) -> list[Row]:
    rows: list[Row] = []
    for entry in entries:
        for count in _thread_counts(entry, threads):
            progress = _Progress(entry.name if count is None else f"{entry.name}, {counted(count)}")
            for row in run(entry, count, quick, progress):
                progress.clear()
                rows.append(row)
                print(line(cells(row), _WIDTHS), flush=True)
            progress.clear()
    return rows


def _thread_counts(entry: Entry, asked: int | None) -> list[int | None]:
    """Return the counts to run with: the one asked for, else its own as far as the machine has cores."""
    if asked is not None:
        return [asked]
    cores = os.cpu_count() or 1
    return [count for count in entry.threads if count is None or count <= cores] or [None]


def _write(file: Path, rows: Sequence[Row]) -> None:
    """Write the rows under a passing name first: the file is whole, or not there."""
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        part.write_text(json.dumps([row.to_dict() for row in rows], indent=1, allow_nan=False) + "\n")
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def _refused(options: Any, suite: Sequence[Entry]) -> str:
    """Say what is wrong with the arguments, in one line; empty if nothing is."""
    known = [entry.name for entry in suite]
    for name in options.names:
        if name in OWN and name not in known:
            return f"{name} is a command of its own: python -m bench.{name}"
        if name not in known:
            return f"no benchmark {name!r}; there are {', '.join(known)}"
    if options.json and not options.json.parent.is_dir():
        return f"--json {options.json}: there is no directory {options.json.parent}"
    if options.json and options.json.is_dir():
        return f"--json {options.json}: this is a directory, name a file"
    return ""


def main(arguments: Sequence[str] | None = None, suite: Sequence[Entry] = SUITE) -> int:
    """Run the suite, or the named part of it."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks to run (all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows: a list of objects")
    parser.add_argument("--quick", action="store_true", help="smaller sizes; says little about the targets")
    parser.add_argument(
        "--threads", type=int, choices=(1, 2), help="one count instead of each benchmark's own"
    )
    parser.add_argument("--list", action="store_true", help="name the benchmarks and end")
    options = parser.parse_args(arguments)
    if wrong := _refused(options, suite):
        print(f"bench: {wrong}", file=sys.stderr)
        return 2
    if options.list:
        print("\n".join(f"{entry.name:14}{entry.what}" for entry in suite))
        print(
            "\nCommands of their own:\n" + "\n".join(f"bench.{name:14}{what}" for name, what in OWN.items())
        )
        return 0
    chosen = [entry for entry in suite if not options.names or entry.name in options.names]
    begin = time.monotonic()
    if (load := os.getloadavg()[0]) > _BUSY:
        print(f"bench: the machine is busy (load {load:.1f}); figures and ratios suffer", file=sys.stderr)
    print(line(HEAD, _WIDTHS), rule(_WIDTHS), sep="\n", flush=True)
    try:
        rows = _measure(chosen, options.threads, options.quick)
    except KeyboardInterrupt:
        print("\nbench: interrupted, nothing written", file=sys.stderr)
        return 130
    if options.json:
        _write(options.json, rows)
    judged = [row.holds for row in rows if row.holds is not None]
    print(f"\n{sum(judged)} of {len(judged)} targets hold; {time.monotonic() - begin:.0f} s")
    return 0 if all(judged) else 1


if __name__ == "__main__":
    sys.exit(main())
