"""``coview-stream eval``: how far a trajectory is from the truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coview_stream.report.evaluation import ErrorStats, Evaluation

HELP = "compare a trajectory with the truth: errors, success, share localised, false frames"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("estimate", type=Path, metavar="EST.tum", help="trajectory of `locate`, map <- body")
    parser.add_argument("truth", type=Path, metavar="TRUTH.tum", help="true trajectory, map <- body")
    parser.add_argument("--plot", type=Path, metavar="F.png", help="draw the errors over the distance driven")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(args: argparse.Namespace) -> int:
    """Print the evaluation; whatever it says, the comparison itself is done (exit code 0)."""
    from coview_stream.clouds.trajectory import read_tum
    from coview_stream.errors import InputError
    from coview_stream.report.evaluation import evaluate, frame_errors

    estimate, truth = read_tum(args.estimate), read_tum(args.truth)
    if not len(truth[0]):
        raise InputError(f"{args.truth}: holds no pose; give the trajectory that was really driven")
    verdict = evaluate(estimate, truth)
    if args.plot is not None:
        from coview_stream.report.plots import plot_errors

        errors = frame_errors(estimate, truth)
        plot_errors(errors.distance, errors.e_t, errors.e_r, args.plot)
    print(verdict.to_json() if args.json else table(verdict))
    return 0


def table(verdict: Evaluation) -> str:
    """Lay the evaluation out for a person to read."""
    fix = "never" if verdict.first_fix_m is None else f"after {verdict.first_fix_m:.1f} m"
    rows = [
        ("success", "yes" if verdict.success else "no"),
        ("localised", f"{verdict.share_localised:.1%} of {verdict.frames} frames"),
        ("false frames", f"{verdict.false_frames} of {verdict.posed} poses"),
        ("first pose", fix),
    ]
    if verdict.unmatched:
        rows.append(("not compared", f"{verdict.unmatched} poses without a true one at that time"))
    if verdict.translation and verdict.rotation:
        rows.append(("translation error", _spread(verdict.translation, "m")))
        rows.append(("rotation error", _spread(verdict.rotation, "deg")))
    if verdict.false_frames:
        rows.append(("worst pose", f"{verdict.worst_t_m:.2f} m, {verdict.worst_r_deg:.2f} deg"))
    return "\n".join(f"{name:<18} {value}" for name, value in rows)


def _spread(stats: ErrorStats, unit: str) -> str:
    return (
        f"mean {stats.mean:.3f}  rmse {stats.rmse:.3f}  median {stats.median:.3f}  max {stats.max:.3f} {unit}"
        "  (of the right poses)"
    )
