"""Where ``serve`` keeps what it knows from one start to the next: its two options."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_state(parser: argparse.ArgumentParser) -> None:
    """Declare ``--state`` and ``--no-state``."""
    group = parser.add_argument_group("from one start to the next")
    either = group.add_mutually_exclusive_group()
    either.add_argument(
        "--state",
        type=Path,
        metavar="DIR",
        help="keep each robot's last pose here, to be tried first at the next start, and verified like any other "
        "place (the user's state directory, such as ~/.local/state/coview-stream)",
    )
    either.add_argument("--no-state", action="store_true", help="keep nothing, read nothing")


def state_folder(args: argparse.Namespace) -> Path | None:
    """Return where to keep it, None for nowhere."""
    import logging

    from coview_stream.errors import ConfigError
    from coview_stream.last_pose import default_folder

    if args.no_state:
        return None
    if args.state is not None:
        folder: Path = args.state
        return folder
    try:
        return default_folder()
    except ConfigError as error:  # a service without a home has to run all the same
        logging.getLogger("coview_stream.node").warning("%s", error)
        return None
