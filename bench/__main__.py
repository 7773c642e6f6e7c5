"""Measure one thing: ``python -m bench NAME [options]``; without a name, the list. ``results`` writes docs/results.md.

Prints a row per figure: ours, the baseline's, their ratio, and whether the target holds; then the benchmark's own
tables. Exit code 1 if a target does not hold, 2 if nothing could be measured. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bench.harness.files import environment
from bench.harness.rows import HEAD, WIDTHS, Row, failed, line, rule
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import CoViewError


class Benchmark(NamedTuple):
    """A benchmark: the module of its ``rows`` below ``bench``, one line about it, and its thread counts."""

    module: str
    about: str
    threads: tuple[int | None, ...] = ()  # one process each, None: the machine's; empty: this process

    def load(self) -> Any:
        """Import its module."""
        return importlib.import_module(f"bench.{self.module}")


_BOTH, _ANY = (1, 2), (None,)

BENCHMARKS = {
    "registration": Benchmark("speed.registration", "trimmed ICP beside small_gicp", _BOTH),
    "engine": Benchmark("speed.engine", "Localizer.step on a large map: times, CPU share, memory", _ANY),
    "search": Benchmark("speed.search", "a step of the whole search"),
    "city": Benchmark("speed.city", "a city of 4 km2 as a directory: build, open, find robots, memory"),
    "start": Benchmark("speed.start", "import, first run, ready to serve", _ANY),
    "memory": Benchmark("speed.memory", "memory of serve with one robot, process by process, on 0.05 to 4 km2"),
    "peers": Benchmark("peers.peers", "other libraries on the same queries", _ANY),
    "accuracy": Benchmark("accuracy.accuracy", "errors, runs localized and false fixes in held-out worlds"),
    "conditions": Benchmark("accuracy.conditions", "real runs: leaning sensor, bad odometry, airborne-like maps"),
    "ground": Benchmark("accuracy.ground", "ground that was dug or filled; the ground filter on labelled LAS files"),
    "ablation": Benchmark("accuracy.ablation", "effect of each choice of the method"),
    "tracking": Benchmark("tracking.tracking", "errors, covariance, loss and recovery while tracked"),
    "smooth": Benchmark("tracking.smoothing", "locate --smooth against live poses and the truth"),
    "covariance": Benchmark(
        "tracking.covariance", "errors against their covariance, on real runs and simulated drives"
    ),
    "protection": Benchmark("tracking.protection", "errors against their protection levels; calibrates these"),
    "surveys": Benchmark("tracking.surveys", "robots on real airborne surveys of few points: found, tracked, levels"),
    "exposure": Benchmark("tracking.exposure", "false poses per km and hour of tracking, of four benchmarks"),
    "faults": Benchmark("faults.run", "sensors that lie: false frames, the last pose, the cause being named"),
    "integrity": Benchmark("integrity.integrity", "independent first fixes: right, false, none; with exact bounds"),
    "challenge": Benchmark("integrity.challenge", "near copies for other programs, and a scorer of TUM files"),
    "forest": Benchmark("forest.forest", "learned re-localization beside descriptors"),
    "forest_drives": Benchmark("forest.drives", "400 m and 2 km in forests: odometry, GNSS, the map alone, ours"),
    "changes": Benchmark("fusion.changes", "precision and recall of fuse --changes"),
    "stream": Benchmark("stream.stream", "robots over zenoh: rates, delays; sixteen robots on one node"),
    "fleet": Benchmark("stream.fleet", "hundreds of robots on a fleet of nodes, of which one is killed"),
    "fuzz": Benchmark("fuzz.fuzz", "untrusted bytes into every decoder and reader, within limits"),
    "soak": Benchmark("soak.soak", "hours with a fault every minute: false poses, stuck states, recovery, leaks"),
}


def counted(threads: int) -> str:
    """Write a number of threads."""
    return "1 thread" if threads == 1 else f"{threads} threads"


def run(name: str, words: Sequence[str], threads: int | None) -> Iterator[Row]:
    """Yield the rows of ``python -m bench NAME WORDS`` as they come.

    A benchmark that raises, is killed or yields nothing adds a row that does not hold, and only then its own output is
    shown on stderr. Its CoViewError is raised again.
    """
    conditions = (threads and counted(threads), "--quick" in words and "quick")
    label = "".join(f", {text}" for text in conditions if text)
    read, write = os.pipe()
    with tempfile.TemporaryFile("w+") as output, os.fdopen(read) as pipe:
        process = subprocess.Popen(
            [sys.executable, "-m", "bench", name, *words, "--rows-to", str(write)],
            env=environment(threads), pass_fds=(write,), stdin=subprocess.DEVNULL, stdout=output,
            stderr=subprocess.STDOUT, start_new_session=True,  # its own children end with it
        )  # fmt: skip
        os.close(write)
        why = "yielded no row"
        try:
            for text in pipe:
                if text.endswith("\n"):  # not cut off
                    row, why = Row.from_dict(json.loads(text)), ""
                    yield replace(row, name=f"{row.name}{label}")
            code = process.wait()
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(0)
        tail = output.read().splitlines()[-12:]
        if code == 2 and tail:
            raise CoViewError(tail[-1].removeprefix(f"bench {name}: "))
        if code:
            why = f"ended by signal {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        if why:
            print("\n".join(tail), file=sys.stderr)
            yield failed(f"{name}{label}", why)


BUSY = 0.7  # load average above which another process computes


def parser_of(name: str) -> argparse.ArgumentParser:
    """Return the options that all benchmarks share, with those of the named one."""
    module = BENCHMARKS[name].load()
    parser = argparse.ArgumentParser(
        prog=f"python -m bench {name}", description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="smaller sizes; no proof of the targets")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows: a list of objects")
    parser.add_argument("--threads", type=int, choices=(1, 2), help="one count instead of each benchmark's own")
    parser.add_argument("--work", type=Path, metavar="DIR", help="folder of worlds and answers (COVIEW_BENCH)")
    parser.add_argument("--rows-to", type=int, help=argparse.SUPPRESS)
    if hasattr(module, "options"):
        module.options(parser)
    return parser


def measured(name: str, words: Sequence[str], asked: argparse.Namespace) -> Iterator[Row]:
    """Yield the rows of a benchmark, from this process or from one process per thread count."""
    benchmark, cores = BENCHMARKS[name], os.cpu_count() or 1
    if not benchmark.threads or asked.rows_to is not None:
        yield from benchmark.load().rows(asked)
        return
    counts = [count for count in benchmark.threads if count is None or count <= cores] or [None]
    for count in counts if asked.threads is None else [asked.threads]:
        print(f"... {name if count is None else f'{name}, {counted(count)}'}", file=sys.stderr, flush=True)
        yield from run(name, words, count)


def tables_of(name: str, rows: Sequence[Row], asked: argparse.Namespace) -> dict[str, str]:
    """Return the benchmark's own tables by name, in Markdown."""
    module = BENCHMARKS[name].load()
    good = [row for row in rows if row.target != "runs"]
    return dict(module.tables(good, asked)) if good and hasattr(module, "tables") else {}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark, write the results page, or list the names."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words.pop(0) if words else "--list"
    if name in ("results", "release"):
        from bench.results import main as results

        return results(words, release=name == "release")
    if name.startswith("-"):
        print(*(f"{key:14}{entry.about}" for key, entry in BENCHMARKS.items()), sep="\n")
        print(f"{'results':14}run several of them and write docs/results.md")
        print(f"{'release':14}run all of them on one code, in steps, and write docs/results.md")
        return 0
    if name not in BENCHMARKS:
        print(f"bench: no benchmark {name!r}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    asked = parser_of(name).parse_args(words)
    if asked.work:
        os.environ["COVIEW_BENCH"] = str(asked.work)
    if asked.json and not (asked.json.parent.is_dir() and not asked.json.is_dir()):
        print(f"bench {name}: --json {asked.json}: name a file in a directory that exists", file=sys.stderr)
        return 2
    begin, rows = time.monotonic(), []
    try:
        if asked.rows_to is not None:
            with os.fdopen(asked.rows_to, "w") as out:
                for row in measured(name, words, asked):
                    print(json.dumps(row.to_dict(), allow_nan=False), file=out, flush=True)
            return 0
        if (load := os.getloadavg()[0]) > BUSY:
            print(f"bench {name}: the machine is busy (load {load:.1f}); times suffer", file=sys.stderr)
        print(line(HEAD, WIDTHS), rule(WIDTHS), sep="\n", flush=True)
        for row in measured(name, words, asked):
            rows.append(row)
            print(line(row.cells(), WIDTHS), flush=True)
        for part, text in tables_of(name, rows, asked).items():
            print(f"\n{f'{name} {part}'.strip()}\n\n{text}")
        if asked.json:
            with atomic_path(asked.json) as file:
                file.write_text(json.dumps([row.to_dict() for row in rows], indent=1, allow_nan=False) + "\n")
    except KeyboardInterrupt:
        print(f"\nbench {name}: interrupted, nothing written", file=sys.stderr)
        return 130
    except CoViewError as error:
        print(f"bench {name}: {error}", file=sys.stderr)
        return 2
    verdicts = [row.holds for row in rows if row.holds is not None]
    print(f"\n{sum(verdicts)} of {len(verdicts)} targets hold; {time.monotonic() - begin:.0f} s")
    return 0 if all(verdicts) and rows else 1


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the benchmark's own processes end with this one
    sys.exit(main())
