"""Measure one thing: ``python -m bench NAME [options]``; without a name, the list. ``results`` writes docs/results.md.

Prints a row per figure: ours, the best formulation without us beside it, how many times better ours is, and whether
the target holds; then the benchmark's own tables. Exit code 1 if a target does not hold, 2 if nothing could be
measured. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.harness.rows import HEAD, WIDTHS, Row, line, rule
from bench.harness.run import BENCHMARKS, counted, run
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import CoViewError

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
    """Yield the rows of a benchmark: in this process, or in one for each of its thread counts."""
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
    if name == "results":
        from bench.results import main as results

        return results(words)
    if name.startswith("-"):
        print(*(f"{key:14}{entry.about}" for key, entry in BENCHMARKS.items()), sep="\n")
        print(f"{'results':14}run several of them and write docs/results.md")
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
            with atomic_path(asked.json) as part:
                part.write_text(json.dumps([row.to_dict() for row in rows], indent=1, allow_nan=False) + "\n")
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
