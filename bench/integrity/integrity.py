"""Share of false first fixes, over families of sites that nothing was fitted on, with exact bounds.

A run is a drive on a map until its first fix, or 60 metres: right (nearer than 3 m and 5 degrees), false, or none. Each
result is noted as it ends, so an interrupted benchmark resumes; ``--shard 1/3``, ``2/3`` and ``3/3`` divide the runs
among machines, whose files (``integrity/*.jsonl`` in ``--work``) are then put together in one folder. Runs share sites,
at most eight of them one map, but never map and drive; beside the share of false runs stands that of sites with a false
run. Bounds are Clopper-Pearson's, at 95 %, and hold for these families and this simulator. Where a search first states
an error below 0.1, 0.01 and 0.001 is noted as well, and whether its most probable place was right (reliability).
"""

from __future__ import annotations

import os
import re
import sys
import time
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.harness.files import fingerprint, folder
from bench.harness.rows import NOTHING, Row, informs, judged, number, table, upper
from bench.integrity.plan import FAMILIES, STATED, Site, plan
from bench.integrity.run import Result, Task, everywhere, read
from coview_stream.errors import InputError

OUTCOMES = ("right", "false", "none")
"""Outcomes of a run that counts; a failed run, or one without a street, does not."""

FIX = 1e-4
"""Stated error below which a first fix counts in the table of reliability; of larger ones see :data:`STATED`."""

_LONG = 58  # characters of a reason that are shown


@dataclass(frozen=True)
class Tally:
    """Counts of some runs."""

    runs: int
    sites: int  # maps
    sites_false: int  # maps with a false first fix
    right: int
    false: int
    ambiguous: int  # runs without a fix whose last state is AMBIGUOUS
    searching: int  # runs without a fix in any other state
    reason: str  # the most frequent last reason of runs without a fix, without numbers
    median_m: float  # metres to a right first fix
    most_m: float  # its 90th percentile

    @classmethod
    def of(cls, results: Iterable[Result]) -> Tally:
        """Count results."""
        counted = [each for each in results if each["outcome"] in OUTCOMES]
        outcome = Counter(each["outcome"] for each in counted)
        without = [each for each in counted if each["outcome"] == "none"]
        ambiguous = sum(each["state"] == "AMBIGUOUS" for each in without)
        reasons = Counter(plain(each.get("reason", "")) for each in without).most_common(1)
        metres = [each["metres"] for each in counted if each["outcome"] == "right"]
        median, most = (float(np.quantile(metres, q)) if metres else np.nan for q in (0.5, 0.9))
        sites = {(each["kind"], each["seed"]): False for each in counted}
        sites |= {(each["kind"], each["seed"]): True for each in counted if each["outcome"] == "false"}
        return cls(
            len(counted), len(sites), sum(sites.values()), outcome["right"], outcome["false"], ambiguous,
            len(without) - ambiguous, f"{reasons[0][0]} ({reasons[0][1]})" if reasons else "", median, most,
        )  # fmt: skip

    @property
    def bound(self) -> float:
        """Share of false first fixes that the true one is below, at 95 %."""
        return upper(self.false, self.runs)

    @property
    def site_bound(self) -> float:
        """Share of sites with a false first fix that the true one is below, at 95 %: runs of one map count once."""
        return upper(self.sites_false, self.sites)

    @property
    def found(self) -> float:
        """Share of the runs whose first fix is right."""
        return self.right / self.runs if self.runs else np.nan


def plain(reason: str) -> str:
    """Return a reason without its numbers."""
    short = re.sub(r"[\d,.]*\d", "N", reason)
    return short if len(short) <= _LONG else f"{short[: _LONG - 2]} .."


def percent(share: float, digits: int = 2) -> str:
    """Write a share."""
    return NOTHING if np.isnan(share) else f"{100 * share:.{digits}f} %"


def classes(results: Sequence[Result]) -> dict[str, Tally]:
    """Count all results, and those of each class."""
    of_class = {name: [r for r in results if r["class"] == name] for name in ("near copies", "outside", "ordinary")}
    # with nothing but buildings in view nothing tells that all of them have moved
    but = [r for r in results if r["family"] != "shifted"]
    parts = {"all": results, **of_class} | ({"all but shifted buildings": but} if len(but) < len(results) else {})
    return {name: Tally.of(each) for name, each in parts.items() if Tally.of(each).runs}


def class_table(results: Sequence[Result]) -> str:
    """Lay out the counts of each class, with exact bounds."""
    head = (
        "runs", "number", "sites", "right", "false", "none", "false, below (95 %)", "sites with false",
        "sites, below (95 %)", "found", "median m", "90 % m",
    )  # fmt: skip
    return table(
        head,
        [
            [
                name, str(t.runs), str(t.sites), str(t.right), str(t.false), str(t.ambiguous + t.searching),
                percent(t.bound), str(t.sites_false), percent(t.site_bound), percent(t.found, 1),
                number(t.median_m, 1), number(t.most_m, 1),
            ]
            for name, t in classes(results).items()
        ],
    )  # fmt: skip


def family_table(results: Sequence[Result]) -> str:
    """Lay out the counts of each family, and what is said where there is no fix."""
    head = (
        "family", "runs", "right", "false", "AMBIGUOUS", "SEARCHING", "median m", "90 % m", "false, below",
        "most said without a fix", "what it is",
    )  # fmt: skip
    lines = []
    for family, (_, what) in FAMILIES.items():
        t = Tally.of(each for each in results if each["family"] == family)
        if t.runs:
            lines.append([
                family, str(t.runs), str(t.right), str(t.false), str(t.ambiguous), str(t.searching),
                number(t.median_m, 1), number(t.most_m, 1), percent(t.bound, 1), t.reason, what,
            ])  # fmt: skip
    return table(head, lines)


def false_list(results: Sequence[Result]) -> str:
    """List the false first fixes, one a line."""
    lines = []
    for each in results:
        if each["outcome"] == "false":
            off = (
                f"{each['error_m']:.1f} m, {each['error_deg']:.1f} degrees off"
                if "error_m" in each
                else "no pose is right"
            )
            lines.append(
                f"- {each['key']} ({each['sensor']}): after {each['metres']:.0f} m, {off}; stated {each['risk']:.1e}"
            )
    return "\n".join(lines)


def reliability_table(results: Sequence[Result]) -> str:
    """Lay out how often what a search states is wrong: once a run, when it first states an error below each limit.

    Above :data:`FIX` it is the most probable place of the keyframe, accepted or not; below, the first fix.
    """
    lines = []
    for name, stated in _stated(results).items():
        count, wrong = len(stated), sum(not right for _, right in stated)
        mean = f"{np.mean([error for error, _ in stated]):.1e}" if count else NOTHING
        lines.append([f"< {name}", str(count), mean, str(wrong)])
    return table(("stated error", "first times", "mean stated", "wrong"), lines)


def _stated(results: Sequence[Result]) -> dict[str, list[tuple[float, bool]]]:
    """Return stated errors, and whether the place was right, by limit."""
    counted = [each for each in results if each["outcome"] in OUTCOMES]
    found = {f"{limit:g}": list[tuple[float, bool]]() for limit in STATED}
    for name, stated in found.items():
        noted = [each["stated"][name] for each in counted if name in each.get("stated", {})]
        stated += [(each["error"], each["right"]) for each in noted]
    fixes = [(each["risk"], each["outcome"] == "right") for each in counted if each.get("risk", 1.0) < FIX]
    return found | {f"{FIX:g}": fixes}


RUNS, QUICK = 1080, 60
"""Runs of a group, and with ``--quick``."""

MOST = {"all": 0.003, "near copies": 0.0075, "outside": 0.01}
"""Shares of false first fixes that the bounds have to be below."""

LEAST_FOUND, MEDIAN_METRES = 0.97, 10.0
"""Of ordinary runs."""


def options(parser: ArgumentParser) -> None:
    """Add the runs and where they are made."""
    parser.add_argument("--group", choices=("reported", "calibration"), default="reported", help="kinds of sites")
    parser.add_argument("--count", type=int, metavar="N", help=f"runs planned ({RUNS}; {QUICK} with --quick)")
    parser.add_argument("--families", metavar="A,B", help="parts of families' names: only these of the runs planned")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (all cores)")
    parser.add_argument("--shard", type=_shard, default=(1, 1), metavar="I/N", help="every Nth site, from the Ith on")
    parser.add_argument("--risk", type=float, metavar="P", help="another integrity risk, with results of its own")
    parser.add_argument("--keep", action="store_true", help="keep the sites' maps, 50 MB each")


def rows(asked: Namespace) -> Iterator[Row]:
    """Make the missing runs, then yield the counts and their verdicts."""
    code = f"{fingerprint()}-{fingerprint('bench/integrity', 'bench/tracking/worlds.py')}"
    place = folder() / "integrity"
    results_file = place / f"{asked.group}-{asked.shard[0]}of{asked.shard[1]}.jsonl"
    task = Task(results_file, code, asked.risk, place / "maps" if asked.keep else None)
    wanted = chosen(plan(asked.group, asked.count or (QUICK if asked.quick else RUNS)), asked.families)
    known = read(sorted(place.glob(f"{asked.group}-*.jsonl")), code)
    mine = [site for k, site in enumerate(wanted) if k % asked.shard[1] == asked.shard[0] - 1]
    known |= _make(mine, task, asked.jobs, known)
    keys = {task.key(run) for site in wanted for run in site}
    results = [result for key, result in known.items() if key in keys]
    yield from verdicts(results, asked.group)
    yield informs("integrity/runs", len(results), "", {"results": results})


def chosen(sites: Sequence[Site], families: str | None) -> list[Site]:
    """Return the sites with only the runs whose families' names contain one of the parts ``A,B``."""
    if not families:
        return list(sites)
    parts = [part.strip() for part in families.split(",")]
    picked = (tuple(run for run in site if any(part in run.family for part in parts)) for site in sites)
    out = [site for site in picked if site]
    if not out:
        raise InputError(f"--families {families}: none of the runs planned; there are {', '.join(FAMILIES)}")
    return out


def _make(sites: Sequence[Site], task: Task, jobs: int, known: dict[str, Result]) -> dict[str, Result]:
    """Make the runs that are not known or have failed; report progress on stderr."""
    done = {key for key, result in known.items() if result["outcome"] != "failed"}
    missing = [tuple(run for run in site if task.key(run) not in done) for site in sites]
    missing = [site for site in missing if site]
    total, begin = sum(map(len, missing)), time.monotonic()
    print(f"... {total} runs on {len(missing)} sites to make", file=sys.stderr, flush=True)
    made: dict[str, Result] = {}
    for result in everywhere(missing, task, jobs) if missing else ():
        made[result["key"]] = result
        spent, outcome = time.monotonic() - begin, result["outcome"]
        more = {"none": plain(result.get("reason", "")), "failed": result.get("reason", "")}.get(outcome, "")
        if "error_m" in result:
            more = f"{result['metres']:.0f} m driven, {result['error_m']:.2f} m off"
        left = spent / len(made) * (total - len(made)) / 60
        progress = f"{len(made)}/{total} {left:4.0f} min left"
        print(f"{progress}: {result['key']}: {outcome} {more}", file=sys.stderr, flush=True)
    return made


def verdicts(results: Sequence[Result], group: str) -> Iterator[Row]:
    """Judge false first fixes by class; of ordinary runs, the share found and the metres until then."""
    name = "integrity" if group == "reported" else f"integrity, {group}"
    for part, t in classes(results).items():
        text = f"{t.false} of {t.runs}: below {percent(t.bound)}"
        most = MOST.get(part)
        enough = most is not None and 1.0 - 0.05 ** (1.0 / t.runs) <= most
        target = f"0, below {percent(most or 1.0)}" if enough else "0"
        yield judged(f"{name}/false first fixes, {part}", text, target, t.false == 0, t.false)
    ordinary = Tally.of(result for result in results if result["class"] == "ordinary")
    if ordinary.runs:
        text = f"{ordinary.right} of {ordinary.runs}: {percent(ordinary.found, 1)}"
        holds = ordinary.found >= LEAST_FOUND
        yield judged(f"{name}/found, ordinary", text, f">= {percent(LEAST_FOUND, 0)}", holds, ordinary.found)
        text = f"{ordinary.median_m:.1f} m, 90 % within {ordinary.most_m:.1f} m"
        holds = ordinary.median_m <= MEDIAN_METRES
        yield judged(f"{name}/median first fix, ordinary", text, f"<= {MEDIAN_METRES:g} m", holds, ordinary.median_m)
    costs = [result["cost_s"] + result["site_s"] for result in results if "site_s" in result]
    yield informs(f"{name}/seconds of one core, a run with its share of the map", float(np.mean(costs)), "s")
    if failed := [result["key"] for result in results if result["outcome"] == "failed"]:
        yield judged(f"{name}/runs that failed", f"{len(failed)}: {failed[0]}", "0", False, len(failed))


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Classes, families, and reliability."""
    results = next(row.details["results"] for row in rows if "results" in row.details)
    parts = {
        "": "\n\n".join(filter(None, (class_table(results), false_list(results)))),
        "families": family_table(results),
        "reliability": reliability_table(results),
    }
    group = "" if asked.group == "reported" else f"{asked.group} "
    return {f"{group}{part}".strip(): text for part, text in parts.items()}


def _shard(text: str) -> tuple[int, int]:
    try:
        mine, of = (int(part) for part in text.split("/"))
    except ValueError:
        raise ArgumentTypeError(f"{text!r} is no share like 1/3") from None
    if not 1 <= mine <= of:
        raise ArgumentTypeError(f"{text}: use 1/{of} to {of}/{of}")
    return mine, of
