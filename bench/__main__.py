"""The figures of the documentation: ``python -m bench NAME [options]``; without a name, the speed of everything.

Prints a row per figure: ours, the best formulation without us beside it (medians, taken in turns), how many times
better ours is, and whether the target holds; then the tables that a benchmark has of its own. The suite runs each
benchmark in a process of its own, with 1 and with 2 threads where that matters. Exit code 1 if a target does not hold,
2 if nothing could be measured. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.harness.rows import RUNS, Row, failed
from bench.harness.suite import BENCHMARKS, counted, run
from bench.harness.tables import HEAD, WIDTHS, benchmark_of, cells, filled, line, machine, missed, rule, suite_tables
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import CoViewError, InputError

_BUSY = 0.7  # load average: someone else computes


def _parser(name: str) -> argparse.ArgumentParser:
    """Options that all share, and those of the named benchmark."""
    module = BENCHMARKS[name].load() if name else sys.modules[__name__]
    parser = argparse.ArgumentParser(
        prog=f"python -m bench {name}".rstrip(), description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="smaller sizes; says little about the targets")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows: a list of objects")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the tables into their places in a page")
    parser.add_argument("--read", type=Path, metavar="FILE", help="take the rows from --json, measure nothing")
    parser.add_argument("--threads", type=int, choices=(1, 2), help="one count instead of each benchmark's own")
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="keeps worlds and answers (COVIEW_BENCH, or temporary)"
    )
    parser.add_argument("--list", action="store_true", help="name all benchmarks and end")
    parser.add_argument("--rows-to", type=int, help=argparse.SUPPRESS)
    if hasattr(module, "options"):
        module.options(parser)
    return parser


def _apart(name: str, words: Sequence[str], threads: int | None, limit_s: float) -> Iterator[Row]:
    """Rows of a benchmark in processes of its own: with the thread count asked for, else one for each of its own."""
    cores = os.cpu_count() or 1
    own = [count for count in BENCHMARKS[name].threads if count is None or count <= cores] or [None]
    for count in own if threads is None else [threads]:
        print(f"... {name if count is None else f'{name}, {counted(count)}'}", file=sys.stderr, flush=True)
        yield from run(name, words, count, limit_s)


def _measured(name: str, words: Sequence[str], asked: argparse.Namespace) -> Iterator[Row]:
    if asked.read:
        try:
            yield from [Row.from_dict(values) for values in json.loads(asked.read.read_text())]
        except (ValueError, TypeError) as error:
            raise InputError(f"--read {asked.read} is not what --json writes: {error}") from error
    elif not name:
        for each, entry in BENCHMARKS.items():
            if entry.in_suite(bool(asked.write)):
                try:
                    words = [*(entry.suite or ()), *["--quick"] * asked.quick]
                    yield from _apart(each, words, asked.threads, entry.limit_s)
                except CoViewError as error:  # a library is missing, say: the others go on
                    yield failed(each, str(error))
    elif BENCHMARKS[name].threads and asked.rows_to is None:
        yield from _apart(name, words, asked.threads, math.inf)
    else:
        yield from BENCHMARKS[name].load().rows(asked)


def _refused(asked: argparse.Namespace) -> str:
    """Say what is wrong with the files that were named, in one line; empty if nothing is."""
    if asked.json and not (asked.json.parent.is_dir() and not asked.json.is_dir()):
        return f"--json {asked.json}: name a file in a directory that exists"
    for option, file in (("--write", asked.write), ("--read", asked.read)):
        if file and not file.is_file():
            return f"{option} {file}: there is no such file"
    return ""


def _tables(name: str, rows: Sequence[Row], asked: argparse.Namespace) -> dict[str, str]:
    """Return the tables that a benchmark has of its own, or each of the suite, by their places in a page."""
    out: dict[str, str] = {}
    measured = [row for row in rows if row.target != RUNS]
    for each in [name] if name else dict.fromkeys(map(benchmark_of, measured)):
        module: Any = BENCHMARKS[each].load() if each in BENCHMARKS else None
        own = measured if name else [row for row in measured if benchmark_of(row) == each]
        if own and hasattr(module, "tables"):
            options = asked if name else _parser(each).parse_args(BENCHMARKS[each].suite or ())
            out |= {f"bench {each} {part}".strip(): text for part, text in module.tables(own, options).items()}
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark, or the suite."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words.pop(0) if words and not words[0].startswith("-") else ""
    if name and name not in BENCHMARKS:
        print(f"bench: no benchmark {name!r}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    asked = _parser(name).parse_args(words)
    if asked.list:
        print("\n".join(f"{each:14}{entry.what}" for each, entry in BENCHMARKS.items() if entry.what))
        return 0
    if asked.work:
        os.environ["COVIEW_BENCH"] = str(asked.work)
    label = f"bench {name}".rstrip()
    if wrong := _refused(asked):
        print(f"{label}: {wrong}", file=sys.stderr)
        return 2
    begin, rows = time.monotonic(), []
    try:
        if asked.rows_to is not None:
            with os.fdopen(asked.rows_to, "w") as out:
                for row in _measured(name, words, asked):
                    print(json.dumps(row.to_dict(), allow_nan=False), file=out, flush=True)
            return 0
        if (load := os.getloadavg()[0]) > _BUSY and not asked.read:
            print(f"{label}: the machine is busy (load {load:.1f}); times suffer", file=sys.stderr)
        print(line(HEAD, WIDTHS), rule(WIDTHS), sep="\n", flush=True)
        for row in _measured(name, words, asked):
            rows.append(row)
            print(line(cells(row), WIDTHS), flush=True)
        own = _tables(name, rows, asked)
        for place, text in own.items():
            print(f"\n{place}\n\n{text}")
        if asked.json:
            with atomic_path(asked.json) as part:
                text = json.dumps([row.to_dict() for row in rows], indent=1, allow_nan=False)
                part.write_text(f"{text}\n")
        if asked.write:
            figures = [row for row in rows if row.target != RUNS]  # what came to none leaves its table as it was
            places = {"machine": machine()} | suite_tables(figures) | own
            if not name:  # a single benchmark knows nothing of the others
                places |= {"missed": missed(rows)}
            asked.write.write_text(filled(asked.write.read_text(), places))
    except KeyboardInterrupt:
        print(f"\n{label}: interrupted, nothing written", file=sys.stderr)
        return 130
    except CoViewError as error:
        print(f"{label}: {error}", file=sys.stderr)
        return 2
    verdicts = [row.holds for row in rows if row.holds is not None]
    print(f"\n{sum(verdicts)} of {len(verdicts)} targets hold; {time.monotonic() - begin:.0f} s")
    return 0 if all(verdicts) and rows else 1


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the benchmark's own processes end with this one
    sys.exit(main())
