"""The answers of all queries become tables: recall, metric success and times, by sensor and by kind of place."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from bench.forest.methods import BASELINES, METHODS
from bench.harness.tables import NOTHING, number, table

Answer = dict[str, Any]
Group = tuple[str, list[Answer]]
RIGHT = 10.0  # metres from the truth within which a place is the right one
NEAR_METRES, NEAR_DEGREES = 2.0, 5.0
"""A pose before registration is a success within both; after it, one that is not is false ..."""
EXACT_METRES, EXACT_DEGREES = 0.3, 1.0
"""... and within these it is a success."""

_BROAD = ("all", "forest", "built", "on disk")
WORDS = ("sparse", "medium", "dense", "flat", "hilly", "steep", "leaf-on", "leaf-off")
STEPS = {
    "descriptors": "Scan Context and co-view: describing, all stations and shifts",
    "canopy": "canopy heights: drawing, all places and 72 headings",
    "network": "learned: bird view and ground network",
    "correlation": "learned: dense correlation, 36 headings, five peaks",
    "keypoints": "learned: keypoints and cliques at five places",
    "registration": "registration and verification of five places",
}
LEARNED = ("network", "correlation", "keypoints", "registration")
"""What a search by learned features alone takes."""


def right(answer: Answer, method: str, best: int) -> bool:
    """Whether one of the ``best`` places that a method named is the right one."""
    return any(metres < RIGHT for metres in answer["off"][method][:best])


def recall(answers: Sequence[Answer], method: str, best: int) -> float:
    """AR@best: the share of queries that a method puts right."""
    return float(np.mean([right(answer, method, best) for answer in answers]))


def success(answers: Sequence[Answer], stage: str, metres: float, degrees: float) -> float:
    """Share of queries whose pose at a stage is within both; no pose is no success."""
    return float(np.mean([_within(answer[stage], metres, degrees) for answer in answers]))


def false(answer: Answer, believed: str) -> bool:
    """Whether a wrong pose would have been ``believed``: its score ``passes``, or it is ``accepted``."""
    return bool(answer[believed]) and not _within(answer["after"], NEAR_METRES, NEAR_DEGREES)


def _within(errors: Sequence[float] | None, metres: float, degrees: float) -> bool:
    return errors is not None and errors[0] <= metres and errors[1] <= degrees


def groups(answers: Sequence[Answer]) -> Iterator[Group]:
    """All answers, then those of each sensor, of forests by what they are like, of built places, of those on disk."""
    yield "all", list(answers)
    for sensor in sorted({answer["sensor"] for answer in answers}):
        yield sensor, [answer for answer in answers if answer["sensor"] == sensor]
    kinds: list[tuple[str, Callable[[Answer], bool]]] = [("forest", _is_forest)]
    kinds += [(f"forest, {word}", partial(_is_forest, word=word)) for word in WORDS]
    kinds += [
        ("built", lambda answer: not _is_forest(answer) and answer["kind"] != "on disk"),
        ("on disk", lambda answer: answer["kind"] == "on disk"),
    ]
    for name, belongs in kinds:
        if some := [answer for answer in answers if belongs(answer)]:
            yield name, some


def _is_forest(answer: Answer, word: str = "forest") -> bool:
    words = answer["kind"].split()
    return words[:1] == ["forest"] and word in words


def recall_table(answers: Sequence[Answer]) -> str:
    """AR@1 / AR@5 in per cent, by method; chance is that of one place drawn from all the map knows."""
    rows = []
    for name, some in groups(answers):
        chance = 100 * float(np.mean([answer["chance"] for answer in some]))
        pairs = [[100 * recall(some, method, best) for best in (1, 5)] for method in METHODS]
        shown = [f"{first:.0f} / {fifth:.0f}" for first, fifth in pairs]
        rows.append([name, str(len(some)), f"{chance:.1f}", *shown])
    return table(("AR@1 / AR@5, %", "n", "chance", *METHODS), rows)


def metric_table(answers: Sequence[Answer]) -> str:
    """Poses of the best hypothesis before registration, and of the best verified one after it."""
    head = (
        "", "n", "dense: m", "deg", "moved by keypoints, %", "keypoints: m", "deg", "2 m, 5 deg, %",
        "registered: m", "deg",
        "0.3 m, 1 deg, %", "2 m, 5 deg, %", "passes, false", "accepted", "accepted, false",
    )  # fmt: skip
    rows = []
    for name, some in groups(answers):
        dense, before, after = (_medians(some, stage) for stage in ("dense", "before", "after"))
        rows.append([
            name, str(len(some)), number(dense[0], 2), number(dense[1], 1),
            _percent(float(np.mean([answer["moved"] for answer in some]))), number(before[0], 2),
            number(before[1], 1), _percent(success(some, "before", NEAR_METRES, NEAR_DEGREES)),
            number(after[0], 3), number(after[1], 2),
            _percent(success(some, "after", EXACT_METRES, EXACT_DEGREES)),
            _percent(success(some, "after", NEAR_METRES, NEAR_DEGREES)),
            str(sum(false(answer, "passes") for answer in some)),
            str(sum(answer["accepted"] for answer in some)),
            str(sum(false(answer, "accepted") for answer in some)),
        ])  # fmt: skip
    return table(head, rows)


def compared_table(answers: Sequence[Answer]) -> str:
    """Poses from the five best places of each method, before and after the same registration and decision."""
    head = (
        "", "n", "places of", "named: m", "deg", "2 m, 5 deg, %", "registered: m", "deg", "0.3 m, 1 deg, %",
        "2 m, 5 deg, %", "passes, false", "accepted", "accepted, false", "ms",
    )  # fmt: skip
    rows = []
    for name, some in groups(answers):
        if name not in _BROAD or (name != "all" and len(some) == len(answers)):
            continue
        for method in (*BASELINES, "learned"):
            chains = [_chain(answer, method) for answer in some]
            before, after = (_medians(chains, stage) for stage in ("before", "after"))
            rows.append([
                name, str(len(some)), method, number(before[0], 2), number(before[1], 1),
                _percent(success(chains, "before", NEAR_METRES, NEAR_DEGREES)),
                number(after[0], 3), number(after[1], 2),
                _percent(success(chains, "after", EXACT_METRES, EXACT_DEGREES)),
                _percent(success(chains, "after", NEAR_METRES, NEAR_DEGREES)),
                str(sum(false(chain, "passes") for chain in chains)),
                str(sum(chain["accepted"] for chain in chains)),
                str(sum(false(chain, "accepted") for chain in chains)),
                f"{np.median([chain['ms'] for chain in chains]):.0f}",
            ])  # fmt: skip
    return table(head, rows)


def _chain(answer: Answer, method: str) -> Answer:
    if method != "learned":
        return dict(answer["chains"][method])
    return answer | {"ms": answer["ms"]["registration"]}


def _medians(answers: Sequence[Answer], stage: str) -> tuple[float | None, float | None]:
    """Median errors of the poses that a stage gave."""
    poses = [answer[stage] for answer in answers if answer[stage] is not None]
    if not poses:
        return None, None
    metres, degrees = np.median(np.array(poses), axis=0)
    return float(metres), float(degrees)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


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


def tables(answers: Sequence[Answer]) -> dict[str, str]:
    """All tables by the names of their places in docs/forest.md; worlds on disk alone have places of their own."""
    if all(answer["kind"] == "on disk" for answer in answers):
        return {
            "disk recall": recall_table(answers),
            "disk metric": metric_table(answers),
            "disk compared": compared_table(answers),
        }
    return {
        "recall": recall_table(answers),
        "metric": metric_table(answers),
        "compared": compared_table(answers),
        "times": times_table(answers),
    }
