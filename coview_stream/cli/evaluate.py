"""``coview-stream eval``: errors of a trajectory against the truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coview_stream.report.evaluation import Evaluation
from coview_stream.cli.options import add_shared
from coview_stream.errors import InputError, counted

HELP = "compare a trajectory with the truth: errors, success, share localized, false frames"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "estimate",
        type=Path,
        metavar="EST.tum",
        help="trajectory of `locate`, map <- body; with its --smooth, filtered.tum is the live one",
    )
    parser.add_argument("truth", type=Path, metavar="TRUTH.tum", help="true trajectory, map <- body")
    parser.add_argument("--plot", type=Path, metavar="F.png", help="draw the errors over the distance driven")
    add_shared(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Print the evaluation; exit code 0 for a bad trajectory too: the comparison is done."""
    from coview_stream.clouds.trajectory import read_tum
    from coview_stream.report.evaluation import constant_offset, evaluate, frame_errors

    estimate, truth = read_tum(args.estimate), read_tum(args.truth)
    if not len(truth[0]):
        raise InputError(f"{args.truth}: holds no pose; give the trajectory that was really driven")
    evaluation = evaluate(estimate, truth)
    if evaluation.unmatched and not evaluation.posed:
        fault = "have no stamp in common: is the truth of this run, and in seconds of the same clock?"
        raise InputError(f"{args.estimate} and {args.truth} {fault}")
    if args.plot is not None:
        from coview_stream.report.plots import plot_errors

        errors = frame_errors(estimate, truth)
        plot_errors(errors.distance, errors.e_t, errors.e_r, args.plot)
    compared = f"{'compared':<18} {args.estimate}, with the truth in {args.truth}"  # the files are easily swapped
    print(evaluation.to_json() if args.json else f"{compared}\n{table(evaluation)}")
    if evaluation.false_frames > evaluation.posed / 2 and (offset := constant_offset(estimate, truth)):
        print(f"{args.truth}: {offset}", file=sys.stderr)
    return 0


def table(evaluation: Evaluation) -> str:
    """Return the evaluation as lines of names and values."""
    from coview_stream.report.evaluation import MIN_RIGHT_SHARE

    first = "never" if evaluation.first_fix_m is None else f"after {evaluation.first_fix_m:.1f} m"
    few = evaluation.false_frames < (1.0 - MIN_RIGHT_SHARE) * evaluation.posed
    failure = "the first pose is wrong" if few else f"{evaluation.false_frames} of {evaluation.posed} poses are wrong"
    rows = [
        ("success", "yes" if evaluation.success else f"no: {failure if evaluation.posed else 'no pose'}"),
        ("localized", f"{evaluation.share_localised:.1%} of {counted(evaluation.frames, 'frame')}"),
        ("false frames", f"{evaluation.false_frames} of {counted(evaluation.posed, 'pose')}"),
        ("first pose", first),
    ]
    if evaluation.unmatched:
        rows.append(("not compared", f"{counted(evaluation.unmatched, 'pose')} without a true one at that time"))
    for name, stats, unit in (("translation", evaluation.translation, "m"), ("rotation", evaluation.rotation, "deg")):
        if stats is not None:
            numbers = f"mean {stats.mean:.3f}  rmse {stats.rmse:.3f}  median {stats.median:.3f}  max {stats.max:.3f}"
            rows.append((f"{name} error", f"{numbers} {unit}  (of the right poses)"))
    if evaluation.false_frames:
        rows.append(("worst pose", f"{evaluation.worst_t_m:.2f} m, {evaluation.worst_r_deg:.2f} deg"))
    return "\n".join(f"{name:<18} {value}" for name, value in rows)
