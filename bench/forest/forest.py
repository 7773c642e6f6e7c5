"""Where am I in a forest: every method on the same queries: ``python -m bench.forest [--runs] [--write PAGE]``.

Without more words: worlds of the training simulator whose seeds were never trained on, and any worlds on disk
(``--world``, in the layout of ``coview-stream simulate``). Of each the map is built with learned features, and every
query is asked of Scan Context, co-view context, both together, the correlation of canopy heights, the learned global
descriptor, dense correlation, keypoints with cliques, and registration with verification (docs/forest.md says what the
columns mean). ``--runs`` localizes whole runs, and runs on the map of another place. ``--plot`` asks for a real plot
among real tiles. ``--scale`` times a query on maps of 0.1 and 1 km2. What is done stays in ``--work``: an interrupted
benchmark goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.forest.common import code, on_disk, say, weights
from bench.harness.worlds import remembered
from coview_stream.errors import CoViewError

FIRST_SEED = 20_000
"""Nobody trains or tunes on the seeds from here on."""

RADIUS = 30.0
"""Metres: virtual scans reach as far as the queries do, so that the descriptors compare like with like."""

PAGE = Path("docs/forest.md")

_QUICK = 4  # queries of a world, and worlds


def asked(folder: Path, name: str, place: Any, about: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """Answers to all queries of a place (a function that opens it), now or when the same was asked before.

    ``about`` says what else they depend on: what lies in a folder, say.
    """
    spec = {"name": name, "weights": weights(), "code": code(), "radius": RADIUS, **(about or {})}

    def work() -> dict[str, Any]:
        from bench.forest.methods import Methods
        from coview_stream.basemap.basemap import BaseMap

        begin = time.perf_counter()
        opened = place()
        base_map = BaseMap.build(opened.base, radius=RADIUS, learned=True)
        methods = Methods(base_map)
        say(f"{name}: {opened.kind}, {len(base_map)} stations, {time.perf_counter() - begin:.0f} s")
        answers = []
        for k, drive in enumerate(opened.drives):
            answers.append({"world": opened.name, "kind": opened.kind, "first": not k, **methods.ask(drive)})
        return {"answers": answers, "seconds": round(time.perf_counter() - begin, 1)}

    result = remembered(folder / "answers" / f"{name}.json", spec, work)
    say(f"{name}: {len(result['answers'])} queries, {result['seconds']:.0f} s")
    return list(result["answers"])


def all_answers(folder: Path, options: argparse.Namespace) -> tuple[list[dict[str, Any]], list[str]]:
    """Answers of all worlds, and what went wrong in which."""
    from bench.forest.worlds import drawn, recorded

    jobs: list[tuple[str, Any, dict[str, Any]]] = [
        (f"drawn-{seed}-{options.queries}", lambda seed=seed: drawn(folder, seed, options.queries), {})
        for seed in range(options.seeds, options.seeds + options.worlds)
    ]
    for path in options.world:
        # the name of a folder alone is not unique
        key = f"disk-{path.resolve().parent.name}-{path.name}-{options.queries}"
        jobs.append((key, lambda path=path: recorded(path, options.queries), on_disk(path)))
    answers, troubles = [], []
    for name, place, about in jobs:
        try:
            answers += asked(folder, name, place, about)
        except Exception as error:  # the other worlds are still worth having; the exit code tells
            troubles.append(f"{name}: {type(error).__name__}: {error}")
            say(troubles[-1])
    return answers, troubles


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m bench.forest", description=__doc__)
    parser.add_argument("--seeds", type=int, default=FIRST_SEED, metavar="FIRST", help=f"({FIRST_SEED})")
    parser.add_argument("--worlds", type=int, default=8, metavar="N", help="worlds of these seeds (8)")
    parser.add_argument("--queries", type=int, default=16, metavar="N", help="of each world (16)")
    parser.add_argument(
        "--world", type=Path, nargs="+", default=[], metavar="DIR", help="worlds on disk as well"
    )
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="where all is kept (COVIEW_BENCH, or temporary)"
    )
    parser.add_argument("--quick", action="store_true", help="four worlds, four queries each; one run")
    parser.add_argument("--runs", action="store_true", help="whole runs instead, and runs outside the map")
    parser.add_argument("--scale", action="store_true", help="time one query on 0.1 and 1 km2 instead")
    parser.add_argument("--plot", type=Path, metavar="DATA", help="the real plot in DATA/forest_plot instead")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all answers")
    parser.add_argument("--write", type=Path, metavar="PAGE", help=f"put the tables into a page ({PAGE})")
    return parser


def command(options: argparse.Namespace) -> str:
    """Say what was asked for, without the paths of a machine."""
    if options.plot:
        asked_for = "--plot DATA"
    elif options.scale:
        asked_for = "--scale"
    elif options.runs:
        asked_for = "--runs" + " --quick" * options.quick
    else:
        asked_for = f"--seeds {options.seeds} --worlds {options.worlds} --queries {options.queries}"
    return (
        f"python -m bench.forest {asked_for}" + " --world" * bool(options.world) + " DIR" * len(options.world)
    )


def _measured(
    folder: Path, options: argparse.Namespace
) -> tuple[list[dict[str, Any]], dict[str, str], list[str]]:
    """Rows or answers, tables by name, and troubles."""
    if options.plot:
        from bench.forest.plot import measured, plot_table

        rows = measured(options.plot)
        return rows, {"forest plot": plot_table(rows)}, []
    if options.scale:
        from bench.forest.scale import scale_table, scaled

        rows = list(scaled(folder))
        return rows, {"forest scale": scale_table(rows)}, []
    if options.runs:
        from bench.forest.runs import all_runs, runs_table

        rows, troubles = all_runs(folder, options.quick, options.world)
        return rows, {"forest runs": runs_table(rows)}, troubles
    from bench.forest.tables import tables

    answers, troubles = all_answers(folder, options)
    return answers, tables(answers) if answers else {}, troubles


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, and write; exit code 1 if a world could not be asked, 2 if nothing could be measured."""
    from bench.harness.publish import filled

    options = _parser().parse_args(arguments)
    if options.quick:
        options.worlds, options.queries = min(options.worlds, _QUICK), min(options.queries, _QUICK)
    if options.write and not options.write.is_file():
        print(f"bench.forest: --write {options.write}: there is no such page", file=sys.stderr)
        return 2
    kept = options.work or os.environ.get("COVIEW_BENCH")
    folder = Path(kept) if kept else Path(tempfile.mkdtemp(prefix="coview-bench-"))
    say(f"worlds and answers are kept in {folder}")
    try:
        found, shown, troubles = _measured(folder / "forest", options)
    except CoViewError as error:
        print(f"bench.forest: {error}", file=sys.stderr)
        return 2
    note = f"`{command(options)}`. Weights {weights()}, code {code()}, {time.strftime('%Y-%m-%d')}."
    for name, text in shown.items():
        print(f"\n{name}\n\n{text}")
    print(f"\n{note}")
    if options.json:
        options.json.write_text(
            json.dumps({"rows": found, "note": note, "troubles": troubles}, indent=1) + "\n"
        )
    if options.write and shown:
        notes = {name: f"{text}\n\n{note}" for name, text in shown.items()}
        options.write.write_text(filled(options.write.read_text(), notes))
    for trouble in troubles:
        print(f"bench.forest: {trouble}", file=sys.stderr)
    return 1 if troubles or not found else 0


if __name__ == "__main__":
    sys.exit(main())
