"""How tracking holds, loses and recovers: ``python -m bench.tracking [NAME...] [--json F] [--plot F] [--seeds N]``.

Ten plain drives of 300 to 600 m in towns, on campuses and in sparse forests, with odometry that drifts by 0.5 to 5 %;
and drives on which the robot is kidnapped or carried, crosses 100 m without a map, is covered for half a minute, meets
a changed world (30 %), or has an odometry that jumps, starts again or is 5 % out of scale
(:mod:`bench.tracking_scenarios`). The truth only scores. NAME picks the scenarios whose names contain it; worlds, maps
and answers stay in ``--worlds``, so that a run can be made in portions and an unchanged engine is not asked twice.

Coverage is the share of the poses whose error lies within 1, 2, 3 sigma of the reported covariance: of one axis by
itself, of several by their squared Mahalanobis distance. Exit code 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.tables import line, number, rule, table
from bench.harness.trajectory_scores import errors, score
from bench.harness.worlds import fingerprint
from bench.tracking.coverage import WITHIN, coverage_table, honest, pooled, shares, spread
from bench.tracking.drives import drift_share
from bench.tracking.plot import draw
from bench.tracking.run import told_of
from bench.tracking.scenarios import QUICK, SEEDS, Scenario, scenarios

MOST_METRES, MOST_DEGREES, MOST_RECOVERY = 0.12, 0.35, 20.0
"""The targets: root mean squares over the plain drives, and metres driven after an event."""

_JUDGED = ("x", "y", "z", "yaw", "x,y", "x,y,z")
"""What the coverage target is about; roll, pitch and the whole pose are told."""

Row = dict[str, Any]

_HEAD = (
    "scenario", "drift %", "driven m", "right %", "first m", "rmse m", "max m", "rmse deg", "max deg", "false",
    "false s", "> 0.5 m", "lost", "back m", "back s", "p50 ms", "p99 ms",
)  # fmt: skip
_WIDTHS = (31, 7, 8, 7, 7, 6, 6, 8, 7, 5, 7, 7, 4, 6, 6, 6, 6)


def measure(folder: Path, scenario: Scenario) -> tuple[Row, Any]:
    """Return the figures of a scenario, and the squared distances that its coverage is made of."""
    told, drive = told_of(folder, scenario)
    row = score(told, drive.truth, drive.driven, [(e.what, e.begin, e.end) for e in drive.events])
    parts = spread(told, errors(told, drive.truth))
    drift = scenario.drift if drive.events else drift_share(drive.truth, drive.odometry)
    row |= {
        "name": scenario.name,
        "plain": scenario.plain,
        "drift": drift,
        "coverage": shares(pooled([parts])),
    }
    return row, parts


def cells(row: Row) -> list[str]:
    """One line of the table; of several events the worst."""
    metres, degrees = row["metres"] or {}, row["degrees"] or {}
    back = [[e[key] for e in row["events"]] for key in ("recovery_m", "recovery_s")]
    steps = row["tracking_step_ms"] or {}
    return [
        row["name"],
        number(100 * row["drift"], 1),
        f"{row['driven_m']:.0f}",
        number(100 * row["share_right"], 1),
        number(row["first_fix_m"], 1),
        number(metres.get("rmse"), 3),
        number(metres.get("max"), 2),
        number(degrees.get("rmse"), 2),
        number(degrees.get("max"), 1),
        str(row["false_frames"]),
        number(row["false_s"], 1),
        str(row["doubtful_frames"]),
        str(row["losses"]),
        *("" if not part else "never" if None in part else f"{max(part):.1f}" for part in back),
        number(steps.get("p50"), 1),
        number(steps.get("p99"), 0),
    ]


def verdicts(
    rows: Sequence[Row], found: dict[str, dict[str, Any]], quick: bool = False
) -> list[tuple[str, str, str, bool]]:
    """Judge: (what, target, measured, met) per target. ``found`` is the coverage of all drives together.

    ``quick`` drives are too short to be found again on, and too few for a coverage.
    """
    plain = [row for row in rows if row["plain"]]
    out = []
    for what, key, most in (
        ("rmse of plain drives, m", "metres", MOST_METRES),
        ("rmse of plain drives, deg", "degrees", MOST_DEGREES),
    ):
        if plain:
            each = [row[key]["rmse"] if row[key] else np.inf for row in plain]
            mean = float(np.sqrt(np.mean(np.square(each))))
            text = f"{mean:.3f} (worst drive {max(each):.3f})"
            out.append((what, f"<= {most}", text, mean <= most))
    false, seconds = sum(row["false_frames"] for row in rows), sum(row["false_s"] for row in rows)
    out.append(("false frames", "0", f"{false} ({seconds:.1f} s)", false == 0))
    if quick:
        return out
    events = [event for row in rows for event in row["events"]]
    if events:
        metres = [np.inf if e["recovery_m"] is None else e["recovery_m"] for e in events]
        late = sum(m > MOST_RECOVERY for m in metres)
        text = f"{np.median(metres):.1f} median, {max(metres):.1f} worst; {late} of {len(metres)} later"
        out.append(("recovery, m driven", f"<= {MOST_RECOVERY:.0f}", text, not late))
    for part in ("first minute", "later"):
        wrong = [name for name in _JUDGED if not honest(found[part][name])]
        if found[part]["yaw"]["frames"]:
            text = f"out of it: {'; '.join(wrong)}" if wrong else "all within"
            out.append((f"coverage, {part}", f"+-{100 * WITHIN:.0f} points", text, not wrong))
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark, or some of its scenarios."""
    parser = argparse.ArgumentParser(prog="python -m bench.tracking", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="part of a scenario's name (all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows, coverage and verdicts")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the coverage")
    parser.add_argument(
        "--worlds", type=Path, default=Path("out/worlds"), help="worlds, maps, answers (out/worlds)"
    )
    parser.add_argument("--quick", action="store_true", help="two short drives in one small town")
    parser.add_argument(
        "--seeds", type=int, default=SEEDS, metavar="N", help=f"worlds of the ten seeds after N ({SEEDS})"
    )
    parser.add_argument("--list", action="store_true", help="name the scenarios and end")
    options = parser.parse_args(arguments)
    every = QUICK if options.quick else scenarios(options.seeds)
    chosen = [s for s in every if not options.names or any(name in s.name for name in options.names)]
    if not chosen:
        print(f"bench.tracking: no scenario like {' or '.join(options.names)}; see --list", file=sys.stderr)
        return 2
    if options.list:
        print("\n".join(scenario.name for scenario in chosen))
        return 0
    for option, path in (("--json", options.json), ("--plot", options.plot)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            print(f"bench.tracking: {option} {path}: name a file in a directory that exists", file=sys.stderr)
            return 2
    return _run(chosen, options)


def _run(chosen: Sequence[Scenario], options: argparse.Namespace) -> int:
    rows: list[Row] = []
    parts = []
    print(line(_HEAD, _WIDTHS), rule(_WIDTHS), sep="\n", flush=True)
    for scenario in chosen:
        row, squared = measure(options.worlds, scenario)
        rows.append(row)
        parts.append(squared)
        print(line(cells(row), _WIDTHS), flush=True)
    together = pooled(parts)
    found = shares(together)
    judged = verdicts(rows, found, options.quick)
    print(f"\n{coverage_table(found)}\n\n{_said(rows)}")
    print(
        table(
            ("target", "asked", "measured", "verdict"),
            [(*v[:3], "met" if v[3] else "MISSED") for v in judged],
        )
    )
    code = fingerprint()
    print(f"\nCode {code}, {time.strftime('%Y-%m-%d')}.")
    if options.json:
        named = [dict(zip(("what", "asked", "measured", "met"), v, strict=True)) for v in judged]
        whole = {"code": code, "rows": rows, "coverage": found, "verdicts": named}
        options.json.write_text(json.dumps(whole, indent=1) + "\n")
    if options.plot:
        draw(together, options.plot, f"python -m bench.tracking: {len(rows)} drives, code {code}")
    return 0 if all(met for *_, met in judged) else 1


def _said(rows: Sequence[Row]) -> str:
    """List the losses by reason, and what each event came to."""
    lines = [f"- {row['name']}: lost {n} x, {reason}" for row in rows for reason, n in _counted(row)]
    for row in rows:
        for event in row["events"]:
            m, s = event["recovery_m"], event["recovery_s"]
            back = "never right again" if m is None else f"right after {m:.1f} m, {s:.1f} s"
            lines.append(f"- {row['name']}: {event['what']}: {event['false_s']:.1f} s false, {back}")
    return "\n".join(lines) + ("\n" if lines else "")


def _counted(row: Row) -> list[tuple[str, int]]:
    reasons: list[str] = row["reasons"]
    return Counter(reasons).most_common()


if __name__ == "__main__":
    sys.exit(main())
