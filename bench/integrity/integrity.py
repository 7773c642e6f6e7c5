"""Share of false first fixes, over families of sites that nothing was fitted on, with exact bounds.

A run is a drive on a map until its first fix, or 60 metres: right (nearer than 3 m and 5 degrees), false, or none. It
counts once. Each is noted as it ends, so that an interrupted benchmark goes on where it was; ``--shard 1/3``, ``2/3``
and ``3/3`` divide it among machines, whose files (``integrity/*.jsonl`` in ``--work``) are then put together in one
folder. Runs share sites, at most eight of them one map, but never map and drive; so beside the share of runs that are
false stands that of sites with a false run. Bounds are Clopper-Pearson's, at 95 %, and hold for these families and this
simulator. A search states larger errors on its way to the fix: where it first states one below 0.1, 0.01 and 0.001 is
noted as well, and whether its most probable place was right, for the table of reliability.
"""

from __future__ import annotations

import os
import sys
import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Iterator, Sequence

import numpy as np

from bench.harness.files import fingerprint, folder
from bench.harness.rows import Row, informs, judged
from bench.integrity.plan import FAMILIES, Site, plan
from bench.integrity.store import ANY, Result, read
from bench.integrity.tables import (
    Tally,
    class_table,
    classes,
    false_list,
    family_table,
    percent,
    plain,
    reliability_table,
)
from bench.integrity.work import Task, everywhere
from coview_stream.errors import InputError

RUNS, QUICK = 1080, 60
"""Runs of a group, and with ``--quick``."""

MOST = {"all": 0.003, "near copies": 0.0075, "outside": 0.01}
"""Shares of false first fixes that the bounds have to be below."""

LEAST_FOUND, MEDIAN_METRES = 0.97, 10.0
"""Of ordinary runs."""


def options(parser: ArgumentParser) -> None:
    """Add what is run, and where."""
    parser.add_argument("--group", choices=("reported", "calibration"), default="reported", help="kinds of sites")
    parser.add_argument("--count", type=int, metavar="N", help=f"runs planned ({RUNS}; {QUICK} with --quick)")
    parser.add_argument("--families", metavar="A,B", help="parts of families' names: only these of the runs planned")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (all cores)")
    parser.add_argument("--shard", type=_shard, default=(1, 1), metavar="I/N", help="every Nth site, from the Ith on")
    parser.add_argument(
        "--risk", type=float, metavar="P", help="integrity risk, if not the product's own; has results of its own"
    )
    parser.add_argument("--keep", action="store_true", help="keep the sites' maps, 50 MB each")
    parser.add_argument("--fingerprint", default="", metavar="CODE", help=f"use results of other code; {ANY}: of all")
    parser.add_argument("--only-read", action="store_true", help="run nothing, show what is there")


def rows(asked: Namespace) -> Iterator[Row]:
    """Make the runs that are missing, then yield the counts and their verdicts."""
    code = code_of_runs()
    place = folder() / "integrity"
    task = Task(place / f"{asked.group}-{asked.shard[0]}of{asked.shard[1]}.jsonl", code, asked.risk, None)
    if asked.keep:
        task = Task(task.results, code, asked.risk, place / "maps")
    wanted = chosen(plan(asked.group, asked.count or (QUICK if asked.quick else RUNS)), asked.families)
    known = read(sorted(place.glob(f"{asked.group}-*.jsonl")), asked.fingerprint or code)
    if not asked.only_read:
        mine = [site for k, site in enumerate(wanted) if k % asked.shard[1] == asked.shard[0] - 1]
        known |= _make(mine, task, asked.jobs, known)
    keys = {task.key(run) for site in wanted for run in site}
    results = [result for key, result in known.items() if key in keys]
    if not results:
        raise InputError(f"{place}: no result of this code; run without --only-read")
    yield from verdicts(results, asked.group)
    yield informs("integrity/runs", len(results), "", {"results": results})


def code_of_runs() -> str:
    """Fingerprint of all that decides a run's outcome."""
    return f"{fingerprint()}-{fingerprint('bench/integrity', 'bench/tracking/worlds.py')}"


def chosen(sites: Sequence[Site], families: str | None) -> list[Site]:
    """Return the sites with those runs only whose families' names have one of the parts ``A,B`` in them."""
    if not families:
        return list(sites)
    parts = [each.strip() for each in families.split(",")]
    picked = (tuple(run for run in site if any(part in run.family for part in parts)) for site in sites)
    out = [site for site in picked if site]
    if not out:
        raise InputError(f"--families {families}: none of the runs planned; there are {', '.join(FAMILIES)}")
    return out


def _make(sites: Sequence[Site], task: Task, jobs: int, known: dict[str, Result]) -> dict[str, Result]:
    """Make the runs that are not known, or have failed; say on stderr how it goes."""
    done = {key for key, result in known.items() if result["outcome"] != "failed"}
    missing = [tuple(run for run in site if task.key(run) not in done) for site in sites]
    missing = [site for site in missing if site]
    total, begin = sum(map(len, missing)), time.monotonic()
    print(
        f"... {total} runs on {len(missing)} sites, {sum(map(len, sites)) - total} known", file=sys.stderr, flush=True
    )
    made: dict[str, Result] = {}
    for result in everywhere(missing, task, jobs) if missing else ():
        made[result["key"]] = result
        spent, outcome = time.monotonic() - begin, result["outcome"]
        more = {"none": plain(result.get("reason", "")), "failed": result.get("reason", "")}.get(outcome, "")
        if "error_m" in result:
            more = f"{result['metres']:.0f} m driven, {result['error_m']:.2f} m off"
        left = spent / len(made) * (total - len(made)) / 60
        print(
            f"{len(made)}/{total} {left:4.0f} min left: {result['key']}: {outcome} {more}", file=sys.stderr, flush=True
        )
    return made


def verdicts(results: Sequence[Result], group: str) -> Iterator[Row]:
    """Judge false first fixes by class, and how many of the ordinary runs are found, how soon."""
    name = "integrity" if group == "reported" else f"integrity, {group}"
    for part, t in classes(results).items():
        said = f"{t.false} of {t.runs}: below {percent(t.bound)}"
        most = MOST.get(part)
        enough = most is not None and 1.0 - 0.05 ** (1.0 / t.runs) <= most
        target, holds = ("0", t.false == 0) if not enough else (f"0, below {percent(most or 1.0)}", t.false == 0)
        yield judged(f"{name}/false first fixes, {part}", said, target, holds, t.false)
    ordinary = Tally.of(each for each in results if each["class"] == "ordinary")
    if ordinary.runs:
        said = f"{ordinary.right} of {ordinary.runs}: {percent(ordinary.found, 1)}"
        holds = ordinary.found >= LEAST_FOUND
        yield judged(f"{name}/found, ordinary", said, f">= {percent(LEAST_FOUND, 0)}", holds, ordinary.found)
        said, holds = (
            f"{ordinary.median_m:.1f} m, 90 % within {ordinary.most_m:.1f} m",
            ordinary.median_m <= MEDIAN_METRES,
        )
        yield judged(f"{name}/median first fix, ordinary", said, f"<= {MEDIAN_METRES:g} m", holds, ordinary.median_m)
    costs = [each["cost_s"] + each["site_s"] for each in results if "site_s" in each]
    yield informs(f"{name}/seconds of one core, a run with its share of the map", float(np.mean(costs)), "s")
    if failed := [each["key"] for each in results if each["outcome"] == "failed"]:
        yield judged(f"{name}/runs that failed", f"{len(failed)}: {failed[0]}", "0", False, len(failed))


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Classes, families, and reliability."""
    results = next(row.details["results"] for row in rows if "results" in row.details)
    code = " and ".join(sorted({each["code"] for each in results}))
    made = f"{len(results)} runs of the {asked.group} kinds, code {code}, {time.strftime('%Y-%m-%d')}."
    parts = {
        "": "\n\n".join(filter(None, (class_table(results), false_list(results), made))),
        "families": family_table(results),
        "reliability": reliability_table(results),
    }
    before = "" if asked.group == "reported" else f"{asked.group} "  # the page's places are for what is reported
    return {f"{before}{part}".strip(): text for part, text in parts.items()}


def _shard(text: str) -> tuple[int, int]:
    try:
        mine, of = (int(each) for each in text.split("/"))
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is no share like 1/3") from None
    if not 1 <= mine <= of:
        raise ArgumentTypeError(f"{text}: use 1/{of} to {of}/{of}")
    return mine, of
