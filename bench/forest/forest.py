"""Where am I in a forest: every method on the same queries.

Worlds of the training simulator whose seeds were never trained on, and any worlds on disk (``--world``, in the layout
of ``coview-stream simulate``); of each the map is built with learned features. docs/forest.md says what the methods
and columns mean. What is done stays in ``--work``: an interrupted benchmark goes on.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bench.forest.methods import Methods
from bench.forest.tables import EXACT_DEGREES, EXACT_METRES, success
from bench.forest.tables import tables as tables_of
from bench.forest.worlds import Place, code, drawn, noted, on_disk, place, recorded, say, weights
from bench.harness.files import remembered
from bench.harness.rows import Row, failed, informs
from coview_stream import BaseMap

FIRST_SEED = 20_000  # seeds from here on are neither for training nor for tuning
RADIUS = 30.0
"""Metres: virtual scans reach as far as the queries do, so that the descriptors compare like with like."""

_QUICK = 4  # queries of a world, and worlds


def options(parser: ArgumentParser) -> None:
    """Add the worlds."""
    parser.add_argument("--seeds", type=int, default=FIRST_SEED, metavar="FIRST", help=f"({FIRST_SEED})")
    parser.add_argument("--worlds", type=int, default=8, metavar="N", help="worlds of these seeds (8)")
    parser.add_argument("--queries", type=int, default=16, metavar="N", help="of each world (16)")
    parser.add_argument("--world", type=Path, nargs="+", default=[], metavar="DIR", help="worlds on disk as well")


def answers(name: str, opened: Callable[[], Place], about: dict[str, Any]) -> list[dict[str, Any]]:
    """Answers to all queries of a place (a function that opens it), now or when the same was asked before.

    ``about`` says what else they depend on: what lies in a folder, say.
    """
    spec = {"name": name, "weights": weights(), "code": code(), "radius": RADIUS, **about}

    def work() -> dict[str, Any]:
        begin, there = time.perf_counter(), opened()
        methods = Methods(BaseMap.build(there.base, radius=RADIUS, learned=True))
        told = {"world": there.name, "kind": there.kind}
        found = [{**told, "first": not k, **methods.ask(drive)} for k, drive in enumerate(there.drives)]
        say(f"{name}: {there.kind}, {len(found)} queries, {time.perf_counter() - begin:.0f} s")
        return {"answers": found}

    return list(remembered(place() / "answers" / f"{name}.json", spec, work)["answers"])


def rows(asked: Namespace) -> Iterator[Row]:
    """Ask all methods in all worlds; a row per world, with every answer."""
    if asked.quick:
        asked.worlds, asked.queries = min(asked.worlds, _QUICK), min(asked.queries, _QUICK)
    jobs: list[tuple[str, Callable[[], Place], dict[str, Any]]] = [
        (f"drawn-{seed}-{asked.queries}", partial(drawn, place(), seed, asked.queries), {})
        for seed in range(asked.seeds, asked.seeds + asked.worlds)
    ]
    for path in asked.world:
        # the name of a folder alone is not unique
        key = f"disk-{path.resolve().parent.name}-{path.name}-{asked.queries}"
        jobs.append((key, partial(recorded, path, asked.queries), on_disk(path)))
    for job in jobs:
        name = f"forest/{job[0]}"
        try:
            found = answers(*job)
        except Exception as error:  # the other worlds are still worth having; the exit code tells
            yield failed(name, f"{type(error).__name__}: {error}")
            continue
        share = 100 * success(found, "after", EXACT_METRES, EXACT_DEGREES)
        yield informs(f"{name}: within 0.3 m and 1 deg", share, "%", {"answers": found})


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Recall, accuracy and times, by kind of place."""
    found = [answer for row in rows for answer in row.details.get("answers", ())]
    about = f"--seeds {asked.seeds} --worlds {asked.worlds} --queries {asked.queries}"
    disk = " --world" * bool(asked.world) + " DIR" * len(asked.world)
    return {name: noted(text, f"forest {about}{disk}") for name, text in tables_of(found).items()} if found else {}
