"""Share of false first fixes, over families of sites that nothing was fitted on, with exact bounds.

A run is a drive on a map until its first fix, or 60 metres: right (nearer than 3 m and 5 degrees), false, or none. Half
of the runs are on real airborne surveys (:mod:`bench.integrity.surveys`) where ``COVIEW_DATA`` has any; all 3,000 have
eight more on each real run there. The table of families says what is found where, and after how many metres. The
results of a site stay in ``--work`` until the code changes: the benchmark goes on where it ended, ``--minutes`` bounds
one call, and any number of calls may share the folder at once. Runs share sites, at most eight of them one map, and the
two runs of a map with a gap or a block twice one way; so beside the share of false runs stands that of sites with a
false run. The surveys are small: their squares overlap, and those whose middles are in one block of a square's size
count as one site. Bounds are Clopper-Pearson's, at 95 %, and hold for these families, surveys and this simulator.
Stated errors of searched keyframes are noted, and whether the most probable place was right: how often they hold.

``--kept FILE`` keeps in one small file what was found at the sites that are done, to go on with the others on another
machine: JSON, a line for each run below one that names the code and the data, compressed by xz. A file of other code or
data is refused.
"""

from __future__ import annotations

import functools
import json
import lzma
import math
import os
import sys
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import coview_stream
from bench.harness.files import ROOT, data, fingerprint, folder, imported, locked
from bench.harness.rows import NOTHING, Row, informs, interval, judged, number, table, upper
from bench.integrity.plan import FAMILIES, STATED, Site, plan, real_runs
from bench.integrity.run import Result, before, everywhere
from bench.integrity.surveys import files
from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError

OUTCOMES = ("right", "false", "none")  # of a run that counts; a failed run, or one without a street, does not


@dataclass(frozen=True)
class Tally:
    """Counts of some runs."""

    runs: int
    sites: int  # grounds
    sites_false: int  # grounds with a false first fix
    right: int
    false: int
    ambiguous: int  # runs without a fix whose last state is AMBIGUOUS
    searching: int  # runs without a fix in any other state
    metres: tuple[float, ...]  # to each right first fix

    @classmethod
    def of(cls, results: Iterable[Result]) -> Tally:
        """Count results."""
        runs = [run for run in results if run["outcome"] in OUTCOMES]
        by_outcome = {name: [run for run in runs if run["outcome"] == name] for name in OUTCOMES}
        sites, sites_false = (len(grounds(some)) for some in (runs, by_outcome["false"]))
        ambiguous = sum(run["state"] == "AMBIGUOUS" for run in by_outcome["none"])
        right, false, none = (len(some) for some in by_outcome.values())
        metres = tuple(run["metres"] for run in by_outcome["right"])
        return cls(len(runs), sites, sites_false, right, false, ambiguous, none - ambiguous, metres)

    def within(self, share: float) -> float:
        """Return the metres after which a share of the right first fixes was there; NaN without one."""
        return float(np.quantile(self.metres, share)) if self.metres else np.nan

    @property
    def bound(self) -> float:
        """Upper bound, at 95 %, of the share of false first fixes."""
        return upper(self.false, self.runs)

    @property
    def fix_bound(self) -> float:
        """Upper bound, at 95 %, of the share of false ones among the first fixes; NaN without one."""
        return upper(self.false, self.false + self.right) if self.false + self.right else np.nan

    @property
    def site_bound(self) -> float:
        """Upper bound, at 95 %, of the share of sites with a false first fix: runs of one ground count once."""
        return upper(self.sites_false, self.sites)

    @property
    def found(self) -> float:
        """Share of the runs whose first fix is right."""
        return self.right / self.runs if self.runs else np.nan


def grounds(runs: Iterable[Result]) -> set[str]:
    """Return the grounds of some runs."""
    return {run.get("ground") or f"{run['kind']}-{run['seed']}" for run in runs}


def percent(share: float, digits: int = 2) -> str:
    """Write a share."""
    return NOTHING if np.isnan(share) else f"{100 * share:.{digits}f} %"


def classes(results: Sequence[Result]) -> dict[str, Tally]:
    """Count all results but those of real runs, which were seen while this was made, and those of each class."""
    every = [run for run in results if run["class"] != "real run"]
    parts = {"all": every} | {
        name: [run for run in results if run["class"] == name] for name in dict.fromkeys(FAMILIES.values())
    }
    # with buildings alone in view nothing shows that all of them have moved
    but = [run for run in every if not run["family"].endswith("shifted")]
    parts |= {"all but shifted buildings": but} if len(but) < len(every) else {}
    real = {name: [run for run in runs if run.get("group") == "surveys"] for name, runs in parts.items()}
    parts |= {f"real surveys: {name}": runs for name, runs in real.items()}
    return {name: tally for name, runs in parts.items() if (tally := Tally.of(runs)).runs}


def class_table(results: Sequence[Result]) -> str:
    """Lay out the counts of each class, with exact bounds."""
    head = (
        "runs", "number", "sites", "right", "false", "none", "false, below (95 %)", "of fixes", "of sites", "found",
        "median m", "90 % m",
    )  # fmt: skip
    lines = [
        [
            name, *map(str, (t.runs, t.sites, t.right, t.false, t.ambiguous + t.searching)), percent(t.bound),
            percent(t.fix_bound), percent(t.site_bound), percent(t.found, 1), number(t.within(0.5), 1),
            number(t.within(0.9), 1),
        ]
        for name, t in classes(results).items()
    ]  # fmt: skip
    return table(head, lines)


def family_table(results: Sequence[Result]) -> str:
    """Lay out the outcomes by metres driven, for each family and each real survey and run."""
    lines = []
    rows_of = sorted({(list(FAMILIES).index(run["family"]), run.get("place", "")) for run in results})
    for number_of, place in rows_of:
        family = list(FAMILIES)[number_of]
        some = [run for run in results if run["family"] == family and run.get("place", "") == place]
        t, lacking = Tally.of(some), sum(run["outcome"] == "no way" for run in some)
        if some:
            counts = map(str, (t.runs, lacking, t.right, t.ambiguous, t.searching))
            metres = number(t.within(0.5), 1), number(t.within(0.9), 1)
            lines.append([f"{family}, {place}".strip(" ,"), *counts, *metres, str(t.false), percent(t.bound, 1)])
    head = "family", "runs", "no way", "found", "AMBIGUOUS", "SEARCHING", "median m", "90 % m", "false", "below (95 %)"
    return table(head, lines)


def reliability_table(results: Sequence[Result]) -> str:
    """Lay out stated against found errors of searches, apart for ordinary, near-copy and shifted sites.

    A search counts once for each limit, at its first keyframe with a stated error below it, accepted or not. Where no
    place of the map is right, the share of searches that ever state an error below a limit should be below it (Ville).
    Metres are to a stated error below the limit of the right place.
    """
    counted = [run for run in results if run["outcome"] in OUTCOMES and run["searched"]]
    apart: dict[str, list[Result]] = {}
    for run in counted:
        shift = "shifted" if run["family"].endswith("shifted") else run["class"]
        apart.setdefault("no place is right" if run["class"] == "outside" else shift, []).append(run)
    lines = []
    for part in ("ordinary", "near copies", "shifted", "gap", "real run", "no place is right"):
        for limit in STATED if part in apart else ():
            runs = apart[part]
            found = [(next((at for at in run["searched"] if at[1] < limit), None), run) for run in runs]
            stated = [(at, run) for at, run in found if at is not None]
            wrong = [run for at, run in stated if not at[2]]
            of = runs if part == "no place is right" else [run for _, run in stated]
            metres = [at[0] for at, _ in stated if at[2]]
            sites = len(grounds(wrong)), len(grounds(of))
            lines.append([
                part, f"< {limit:g}", f"{np.mean([at[1] for at, _ in stated]):.1e}" if stated else NOTHING,
                f"{len(wrong)} of {len(of)}", f"{len(wrong) / len(of):.1e}" if of else NOTHING,
                between(len(wrong), len(of)), f"{sites[0]} of {sites[1]}: {between(*sites)}",
                f"{np.median(metres):.1f}, {np.quantile(metres, 0.9):.1f}" if metres else NOTHING,
            ])  # fmt: skip
    head = "runs", "stated error", "mean stated", "wrong", "found", "95 %", "sites, 95 %", "right: median, 90 % m"
    return table(head, lines)


def between(events: int, runs: int) -> str:
    """Write the interval of a share."""
    low, high = interval(events, runs)
    return f"{low:.1g} to {high:.1g}" if runs else NOTHING


RUNS, QUICK = 3240, 24  # runs planned, 3,000 without shifted buildings, and with ``--quick``
MOST = {"all": 0.003, "near copies": 0.0075, "outside": 0.01}  # shares of false fixes that bounds have to be below
LEAST_FOUND, MEDIAN_METRES = 0.97, 10.0  # of ordinary runs


def options(parser: ArgumentParser) -> None:
    """Add the runs and where they are made."""
    parser.add_argument("--count", type=int, metavar="N", help=f"runs planned ({RUNS}; {QUICK} with --quick)")
    parser.add_argument("--families", metavar="A,B", help="parts of families' names: only these of the runs planned")
    parser.add_argument("--minutes", type=float, default=math.inf, metavar="M", help="begin no map after so long")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (all cores)")
    parser.add_argument("--kept", type=Path, metavar="FILE.jsonl.xz", help="go on with this file, on any machine")


def rows(asked: Namespace) -> Iterator[Row]:
    """Make the missing runs, then yield the counts and their verdicts."""
    code = code_of_runs()
    sites = chosen(planned(asked.count or (QUICK if asked.quick else RUNS)), asked.families)
    total, begin, made = sum(map(len, sites)), time.monotonic(), 0
    there = kept(asked.kept, code) if asked.kept else {}
    left = [site for site in sites if not all(run.key in there for run in site)]
    results = [before(run) | there[run.key] for site in sites if site not in left for run in site]
    made_by = json.dumps(with_data(code))
    for some, new in everywhere(left, folder() / "integrity", made_by, asked.jobs, begin + 60 * asked.minutes):
        results += some
        if asked.kept and some and not any(result["outcome"] == "failed" for result in some):
            keep(asked.kept, code, some)
        made += len(some) * new
        minutes = (time.monotonic() - begin) / made * (total - len(results)) / 60 if made else math.nan
        for result in some * new:
            about = f"{result['key']}: {result['outcome']} {result.get('reason', '')}"
            print(f"{len(results)}/{total} {minutes:4.0f} min left: {about}", file=sys.stderr, flush=True)
    if len(results) < total:
        yield judged("integrity/runs that are missing yet", str(total - len(results)), "runs", False)
    if not files():
        yield judged("integrity/runs on real surveys", "0: no surveys in COVIEW_DATA", "half", False)
    yield from verdicts(results)
    yield informs("integrity/runs", len(results), "", {"results": results})


def code_of_runs() -> str:
    """Return the hash of the code that a run executes; a change of the commands, the node or the tables keeps it."""
    return fingerprint(*parts_of_runs())


@functools.cache
def parts_of_runs() -> tuple[str, ...]:
    """Return the files that runs depend on: of ``bench``, of the package at any depth, all kernels and weights."""
    below = Path(coview_stream.__path__[0]).parent
    names = ("run", "plan", "sites", "kinds", "made_up", "surveys")
    left = [*(ROOT / f"bench/integrity/{name}.py" for name in names), ROOT / "bench/tracking/worlds.py"]
    found = {file: str(file.relative_to(ROOT)) for file in left}

    def add(module: str) -> None:
        path = below / module.replace(".", "/")
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if module.startswith("coview_stream.") and file.is_file() and file not in found:
                found[file] = str(file.relative_to(below))
                left.append(file)

    homes = {f"coview_stream.{name}": f"coview_stream.{home}" for name, home in coview_stream._HOMES.items()}
    while left:
        for name in imported(left.pop().read_bytes()):
            add(homes.get(name, name))
    return ("coview_kernels", "coview_stream/descriptors/weights", *sorted(found.values()))


_FOUND = (
    "key",
    "place",
    "ground",
    "outcome",
    "state",
    "metres",
    "risk",
    "searched",
)  # of a result, all that the tables need


def kept(file: Path, code: str) -> dict[str, Result]:
    """Return the results in a file by key; nothing without a file, InputError if other code made it."""
    if not file.is_file():
        return {}
    with lzma.open(file, "rt") as lines:
        if (head := json.loads(next(lines))) != (ours := with_data(code)):
            raise InputError(f"--kept {file}: of {head}, not {ours}: name another file, or remove it")
        return {result["key"]: result for result in map(json.loads, lines)}


def keep(file: Path, code: str, results: Iterable[Result]) -> None:
    """Add results to a file."""
    with locked(file.with_name(f"{file.name}.lock")):
        new = ({name: result[name] for name in _FOUND if name in result} for result in results)
        lines = [with_data(code), *(kept(file, code) | {result["key"]: result for result in new}).values()]
        with atomic_path(file) as part, lzma.open(part, "wt") as out:
            out.writelines(json.dumps(line, separators=(",", ":")) + "\n" for line in lines)


def with_data(code: str) -> dict[str, object]:
    """Name the code and the real data that results depend on."""
    real = (*files(), *sorted(data().glob("*/base.laz")), *sorted(data().glob("*/truth.tum")))
    return {"code": code, "bytes": {str(file.relative_to(data())): file.stat().st_size for file in real}}


def planned(count: int) -> list[Site]:
    """Return the sites of ``count`` runs, half on real surveys where there are any, and those of recorded runs."""
    names = sorted(file.parent.name for file in data().glob("*/base.laz"))
    recorded = real_runs(names) if count >= RUNS else []
    if not files():
        return [*recorded, *plan("reported", count)]
    real, simulated = plan("surveys", count // 2), plan("reported", count - count // 2)
    both = [(k / len(sites), site) for sites in (real, simulated) for k, site in enumerate(sites)]
    return [*recorded, *(site for _, site in sorted(both, key=lambda entry: entry[0]))]


def chosen(sites: Sequence[Site], families: str | None) -> list[Site]:
    """Return the sites with only the runs whose families' names contain one of the parts ``A,B``."""
    parts = [part.strip() for part in (families or "").split(",")]
    picked = (tuple(run for run in site if any(part in run.family for part in parts)) for site in sites)
    out = [site for site in picked if site]
    if not out:
        raise InputError(f"--families {families}: none of the runs planned; there are {', '.join(FAMILIES)}")
    return out


def verdicts(results: Sequence[Result]) -> Iterator[Row]:
    """Judge false first fixes by class; of ordinary runs, the share found and the metres until then."""
    for part, t in classes(results).items():
        text = f"{t.false} of {t.runs}: below {percent(t.bound)}; of {t.right + t.false} fixes: {percent(t.fix_bound)}"
        most = MOST.get(part)
        enough = most is not None and upper(0, t.runs) <= most
        target = f"0, below {percent(most or 1.0)}" if enough else "0"
        yield judged(f"integrity/false first fixes, {part}", text, target, t.false == 0, t.false)
    simulated = (
        result for result in results if result["class"] == "ordinary" and result["group"] in ("reported", "calibration")
    )
    ordinary = Tally.of(simulated)
    if ordinary.runs:
        text = f"{ordinary.right} of {ordinary.runs}: {percent(ordinary.found, 1)}"
        holds = ordinary.found >= LEAST_FOUND
        yield judged(
            "integrity/found, ordinary and simulated", text, f">= {percent(LEAST_FOUND, 0)}", holds, ordinary.found
        )
        median = ordinary.within(0.5)
        text = f"{median:.1f} m, 90 % within {ordinary.within(0.9):.1f} m"
        holds = median <= MEDIAN_METRES
        yield judged("integrity/median first fix, of these", text, f"<= {MEDIAN_METRES:g} m", holds, median)
    if failed := [result["key"] for result in results if result["outcome"] == "failed"]:
        yield judged("integrity/runs that failed", f"{len(failed)}: {failed[0]}", "runs", False, len(failed))


def tables(rows: Sequence[Row], asked: Namespace) -> dict[str, str]:
    """Classes, families, and reliability."""
    results = next(row.details["results"] for row in rows if "results" in row.details)
    return {
        "": class_table(results), "families": family_table(results), "reliability": reliability_table(results),
    }  # fmt: skip
