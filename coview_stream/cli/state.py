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
        metavar="DIR",
        help="keep each robot's last pose here, to be tried first at the next start, and verified like any other "
        "place (the user's state directory, such as ~/.local/state/coview-stream)",
    )
    either.add_argument("--no-state", action="store_true", help="keep nothing, read nothing")


def state_folder(args: argparse.Namespace) -> Path | None:
    """Return where to keep it, None for nowhere; ConfigError for an empty ``--state``."""
    import logging

    from coview_stream.errors import ConfigError
    from coview_stream.last_pose import default_folder

    if args.no_state:
        return None
    if args.state is not None:
        if not args.state:
            raise ConfigError("--state '': name a directory, or leave it out, or use --no-state")
        return Path(args.state)
    try:
        return default_folder()
    except ConfigError as error:  # a service without a home has to run all the same
        logging.getLogger("coview_stream.node").warning("%s", error)
        return None


def ready_state(args: argparse.Namespace) -> Path | None:
    """Return what :func:`state_folder` does, tried out, and log it: a robot must not find out where it is first.

    Raises:
        InputError: ``--state`` names what cannot be used. ConfigError: it is empty.
    """
    import logging

    from coview_stream.errors import InputError
    from coview_stream.last_pose import try_out

    log = logging.getLogger("coview_stream.node")
    folder = state_folder(args)
    if folder is None:
        return None
    try:
        try_out(folder)
    except OSError as error:
        text = f"{folder}: the last poses cannot be kept here ({error.strerror or error})"
        if args.state is not None:
            raise InputError(
                f"--state {text}; name a directory that can be written, or use --no-state"
            ) from error
        log.warning("%s; use --state DIR or --no-state", text)  # and go on: a disk may come later
    else:
        log.info("the last poses are kept in %s", folder)
    return folder
