"""Whether robots can be told apart by their keys: what one sends must be nobody else's, and no pose anybody's input."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from coview_stream.errors import ConfigError
from coview_stream.stream.keyexpr import matches
from coview_stream.stream.keys import RobotKeys

_OPTIONS = ("--cloud-key", "--odometry-key")


def check_apart(keys: Sequence[RobotKeys]) -> None:
    """Check the keys of all robots that one node serves.

    Raises:
        ConfigError: a name is given twice, two robots would read the same messages or write poses on one key, or a
            pose would come back as input.
    """
    names = [k.robot for k in keys]
    if len(set(names)) < len(names):
        raise ConfigError(f"--robot: {', '.join(names)}: each name once")
    for one, other in combinations(keys, 2):
        _check_inputs(one, other)
        if one.pose == other.pose:
            raise ConfigError(
                f"--pose-key: poses of robots {one.robot} and {other.robot} would both go to {one.pose!r}: "
                "use {robot} in --pose-key"
            )
    for writer in keys:
        for reader in keys:
            for option, expression in zip(_OPTIONS, (reader.cloud, reader.odometry), strict=True):
                if matches(expression, writer.pose):
                    raise ConfigError(
                        f"--pose-key: the poses of robot {writer.robot} on {writer.pose!r} would be read as input of "
                        f"{reader.robot}, which is {expression!r}: choose a --pose-key or {option} apart from that"
                    )


def _check_inputs(one: RobotKeys, other: RobotKeys) -> None:
    for first, a in zip(_OPTIONS, (one.cloud, one.odometry), strict=True):
        for second, b in zip(_OPTIONS, (other.cloud, other.odometry), strict=True):
            if matches(a, b):
                both = first if first == second else f"{first} and {second}"
                raise ConfigError(
                    f"{first} {a!r} of robot {one.robot} and {second} {b!r} of {other.robot} have messages in common: "
                    f"use {{robot}} in {both}"
                )
