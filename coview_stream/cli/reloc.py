"""The option that says who names the places to look at, the same for every command that localizes."""

from __future__ import annotations

import argparse


def add_reloc(parser: argparse._ActionsContainer) -> None:
    """Declare ``--reloc``."""
    parser.add_argument(
        "--reloc",
        choices=("auto", "coview", "learned"),
        default="auto",
        help="who names places to look at: co-view descriptors, learned features, or both on maps that have "
        "features (auto)",
    )
