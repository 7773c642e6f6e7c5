"""``coview-stream train``: train the encoders of learned re-localization on simulated worlds.

Two cores take about an hour, a third of it for simulation, and 2 GB. An interrupted training continues.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = "train the networks of learned re-localization on simulated worlds: an hour, and the extra learn-train"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; the defaults are those of the packaged weights."""
    parser.add_argument("out", type=Path, metavar="OUT", help="directory for the weights, card and training data")
    parser.add_argument("--worlds", type=int, metavar="N", help="worlds to train on (62; smoke: 3)")
    parser.add_argument("--first-world", type=int, default=10_000, metavar="SEED", help="first world's seed (10000)")
    parser.add_argument("--steps", type=int, metavar="N", help="batches to train on (600; smoke: 100)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the weights' start and the batches (0)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes that simulate (2)")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="threads that train (PyTorch's choice)")
    parser.add_argument(
        "--dirt", action="store_true", help="drives with leaning sensors, wide and noisy beams, grass, bare trees"
    )
    parser.add_argument(
        "--smoke", action="store_true", help="a minute's training of tiny networks, to see that all of it works"
    )


def run(args: argparse.Namespace) -> int:
    """Simulate missing worlds, train, write the weights and their card, and print their recall."""
    from coview_stream.training.train import DEFAULT, SMOKE, train_session

    plan = SMOKE if args.smoke else DEFAULT
    plan = plan.with_dirt() if args.dirt else plan
    card = train_session(
        args.out,
        plan.with_numbers(args.worlds, args.steps, args.first_world, args.seed),
        args.workers,
        args.threads,
        lambda line: print(line, file=sys.stderr, flush=True),
    )
    recall = card["validation"]
    print(
        f"{args.out}: right at once {recall['AR@1']:.2f}, among the best five {recall['AR@5']:.2f} of "
        f"{recall['queries']} queries in {recall['worlds']} worlds of other seeds (chance {recall['chance']:.3f})"
    )
    return 0
