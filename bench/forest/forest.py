"""Places named from one query in a forest: descriptors, learned features, and the product's search.

Worlds of the training simulator whose seeds were never trained on, and any worlds on disk (``--world``, in the layout
of ``coview-stream simulate``); each map is built with learned features. Answers stay in ``--work``, so an interrupted
benchmark resumes. AR@N is the share of queries with the right place (within 10 m) among the first N.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.forest.methods import METHODS, Methods
from bench.forest.worlds import Place, code, drawn, on_disk, place, recorded, say, weights
from bench.harness.files import remembered
from bench.harness.rows import NOTHING, Row, failed, informs, number, table
from coview_stream import BaseMap

FIRST_SEED = 20_000  # seeds from here on are neither for training nor for tuning
RADIUS = 30.0
"""Metres: virtual scans reach as far as the queries do, so that the descriptors compare like with like."""

_QUICK = 4  # queries of a world, and worlds

Answer = dict[str, Any]
RIGHT = 10.0  # metres from the truth within which a place is the right one
NEAR_METRES, NEAR_DEGREES = 2.0, 5.0
"""A pose before registration is a success within both; after it, one that is not is false ..."""
EXACT_METRES, EXACT_DEGREES = 0.3, 1.0
"""... and within these it is a success."""

WORDS = ("sparse", "medium", "dense", "flat", "hilly", "steep", "leaf-on", "leaf-off")
STEPS = {
    "descriptors": "Scan Context and co-view: describing, all stations and shifts",
    "network": "learned: bird view and ground network",
    "correlation": "learned: coarse correlation, the best places at 36 headings",
    "registration": "registration and verification of five places",
}
LEARNED = ("network", "correlation", "registration")
"""Steps of a search by learned features alone."""


def recall(answers: Sequence[Answer], method: str, best: int) -> float:
    """AR@best: the share of queries that a method puts right, with one of the ``best`` places that it named."""
    return float(np.mean([min(answer["off"][method][:best], default=RIGHT) < RIGHT for answer in answers]))


def recall_cell(answers: Sequence[Answer], method: str) -> str:
    """AR@1 and AR@5 in per cent."""
    return " / ".join(_percent(recall(answers, method, best)) for best in (1, 5))


def success(answers: Sequence[Answer], stage: str, metres: float, degrees: float) -> float:
    """Share of queries whose pose at a stage is within both; no pose is no success."""
    return float(np.mean([_within(answer[stage], metres, degrees) for answer in answers]))


def false(answer: Answer) -> bool:
    """Tell whether a wrong pose had the evidence for it: more probable than not of the places named."""
    return bool(answer["passes"]) and not _within(answer["after"], NEAR_METRES, NEAR_DEGREES)


def _within(errors: Sequence[float] | None, metres: float, degrees: float) -> bool:
    return errors is not None and errors[0] <= metres and errors[1] <= degrees


def groups(answers: Sequence[Answer]) -> Iterator[tuple[str, list[Answer]]]:
    """All answers, then those of each sensor, of forests by what they are like, of built places, of those on disk."""
    kinds: dict[str, Callable[[Answer], bool]] = {"all": lambda answer: True}
    for sensor in sorted({answer["sensor"] for answer in answers}):
        kinds[sensor] = partial(lambda answer, sensor: answer["sensor"] == sensor, sensor=sensor)
    kinds["forest"] = _is_forest
    kinds |= {f"forest, {word}": partial(_is_forest, word=word) for word in WORDS}
    kinds["built"] = lambda answer: not _is_forest(answer) and answer["kind"] != "on disk"
    kinds["on disk"] = lambda answer: answer["kind"] == "on disk"
    for name, belongs in kinds.items():
        if some := [answer for answer in answers if belongs(answer)]:
            yield name, some


def _is_forest(answer: Answer, word: str = "forest") -> bool:
    words = answer["kind"].split()
    return words[:1] == ["forest"] and word in words


def recall_table(answers: Sequence[Answer]) -> str:
    """AR@1 / AR@5 in per cent, by method; chance is that of one place drawn from all the map knows."""
    rows = []
    for name, some in groups(answers):
        shown = [recall_cell(some, method) for method in METHODS]
        rows.append([name, str(len(some)), f"{100 * np.mean([answer['chance'] for answer in some]):.1f}", *shown])
    return table(("AR@1 / AR@5, %", "n", "chance", *METHODS), rows)


_POSES = (
    "m", "deg", "2 m, 5 deg, %", "registered: m", "deg", "0.3 m, 1 deg, %", "2 m, 5 deg, %", "passes, false",
)  # fmt: skip
_GIVEN = ("search gives", "false")


def _poses(answers: Sequence[Answer]) -> list[str]:
    """Poses of the best hypothesis before registration, and of the best verified one after it, as ``_POSES`` heads."""
    return [
        *medians(answers, "before", (2, 1)), _percent(success(answers, "before", NEAR_METRES, NEAR_DEGREES)),
        *medians(answers, "after", (3, 2)), _percent(success(answers, "after", EXACT_METRES, EXACT_DEGREES)),
        _percent(success(answers, "after", NEAR_METRES, NEAR_DEGREES)),
        str(sum(false(answer) for answer in answers)),
    ]  # fmt: skip


def _given(answers: Sequence[Answer]) -> list[str]:
    """How many poses the product's search gave by this one keyframe, and how many of them were false."""
    given = [answer["found"][0] for answer in answers if answer["found"] is not None]
    return [str(len(given)), str(sum(metres > NEAR_METRES for metres in given))]


def medians(answers: Sequence[Answer], stage: str, digits: tuple[int, int]) -> list[str]:
    """Median errors, metres and degrees, of the poses that a stage gave."""
    poses = [answer[stage] for answer in answers if answer[stage] is not None]
    found = np.median(poses, axis=0).tolist() if poses else (None, None)
    return [number(value, places) for value, places in zip(found, digits, strict=True)]


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


def metric_table(answers: Sequence[Answer]) -> str:
    """Poses by learned features: of correlation, and after registration."""
    rows = [
        [name, str(len(some)), *_poses(some), *_given(some)]
        for name, some in groups(answers)
    ]  # fmt: skip
    head = ("", "n", f"correlation: {_POSES[0]}", *_POSES[1:], *_GIVEN)
    return table(head, rows)


def times_table(answers: Sequence[Answer]) -> str:
    """Medians over all queries, milliseconds; the first query of a map is left out."""
    warm = [answer for answer in answers if not answer.get("first")] or list(answers)
    rows = []
    for step, words in STEPS.items():
        values = [answer["ms"][step] for answer in warm if step in answer["ms"]]
        rows.append([words, f"{np.median(values):.0f}" if values else NOTHING])
    totals = [sum(answer["ms"][step] for step in LEARNED) for answer in warm]
    rows.append(["learned, from the query's points to verified poses", f"{np.median(totals):.0f}"])
    return table(("median of a query", "ms"), rows)


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
    answers = [answer for row in rows for answer in row.details.get("answers", ())]
    return {"recall": recall_table(answers), "metric": metric_table(answers), "times": times_table(answers)}
