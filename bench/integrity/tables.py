"""Tables of results: by class, by family, and stated risk against what came of it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bench.harness.rows import NOTHING, number, table
from bench.integrity.plan import FAMILIES, STATED
from bench.integrity.work import Result

CONFIDENCE = 0.95
"""Of all bounds, one-sided."""


def upper(events: int, runs: int, confidence: float = CONFIDENCE) -> float:
    """Return the Clopper-Pearson bound that the true share is below; 1 without runs."""
    from scipy.stats import beta

    _checked(events, runs)
    return 1.0 if events == runs else float(beta.ppf(confidence, events + 1, runs - events))


def lower(events: int, runs: int, confidence: float = CONFIDENCE) -> float:
    """Return the Clopper-Pearson bound that the true share is above; 0 without runs."""
    from scipy.stats import beta

    _checked(events, runs)
    return 0.0 if events == 0 else float(beta.ppf(1.0 - confidence, events, runs - events + 1))


def _checked(events: int, runs: int) -> None:
    if not 0 <= events <= runs:
        raise ValueError(f"{events} events of {runs} runs: there are as many runs as events at least")


OUTCOMES = ("right", "false", "none")
"""What counts as a run; what failed or had no way to drive does not."""

FIX = 1e-4
"""Stated error below which a first fix counts in the table of reliability; of larger ones see :data:`STATED`."""

_LONG = 58  # characters of a reason that are shown


@dataclass(frozen=True)
class Tally:
    """Counts of some runs.

    Attributes:
        runs: how many count.
        sites: on how many maps.
        sites_false: on how many maps some first fix was false.
        right: first fixes that are right.
        false: first fixes that are not.
        ambiguous: runs without a fix whose last state was AMBIGUOUS.
        searching: those with any other last state.
        reason: what was said most often at the end of those without a fix, numbers left out.
        median_m: metres to the first fix if it is right.
        most_m: 90 % of those are not longer.
    """

    runs: int
    sites: int
    sites_false: int
    right: int
    false: int
    ambiguous: int
    searching: int
    reason: str
    median_m: float
    most_m: float

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
        between = f"{percent(lower(wrong, count))} to {percent(upper(wrong, count))}" if count else NOTHING
        lines.append([f"< {name}", str(count), mean, str(wrong), between])
    return table(("stated error", "first times", "mean stated", "wrong", "wrong, between (95 % each)"), lines)


def _stated(results: Sequence[Result]) -> dict[str, list[tuple[float, bool]]]:
    """Return stated errors, and whether the place was right, by limit."""
    counted = [each for each in results if each["outcome"] in OUTCOMES]
    found = {f"{limit:g}": list[tuple[float, bool]]() for limit in STATED}
    for name, stated in found.items():
        noted = [each["stated"][name] for each in counted if name in each.get("stated", {})]
        stated += [(each["error"], each["right"]) for each in noted]
    fixes = [(each["risk"], each["outcome"] == "right") for each in counted if each.get("risk", 1.0) < FIX]
    return found | {f"{FIX:g}": fixes}
