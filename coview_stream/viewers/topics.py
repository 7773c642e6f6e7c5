"""Topics: the key expressions on which what there is to see of robots comes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from coview_stream.stream.transport.keys import RobotKeys, check_prefix

TopicKind = Literal["pose", "status", "hypotheses", "cloud"]


class Topic(NamedTuple):
    """One key expression to subscribe to.

    Attributes:
        key: the expression.
        kind: what comes on it.
        robot: whose; None if the keys of the samples say.
        hint: codec of messages without an Encoding; None if there is no such rule.
        depth: chunks of a sample's key before the robot's name, where ``robot`` is None.
    """

    key: str
    kind: TopicKind
    robot: str | None = None
    hint: str | None = None
    depth: int = 0


def topics_of_robots(keys: Sequence[RobotKeys]) -> list[Topic]:
    """Return the topics of named robots, of any preset."""
    found = []
    for k in keys:
        found += [
            Topic(k.pose, "pose", k.robot, k.pose_hint),
            Topic(k.status, "status", k.robot),
            Topic(k.hypotheses, "hypotheses", k.robot),
            Topic(k.cloud, "cloud", k.robot, k.cloud_hint),
        ]
    return found


def topics_of_base(base: str) -> list[Topic]:
    """Return the topics of all robots of a base, with native keys; ConfigError if it cannot start a key."""
    base = check_prefix(base, "--base")
    depth = len(base.split("/"))
    ends: tuple[tuple[str, TopicKind], ...] = (
        ("out/pose", "pose"), ("out/status", "status"), ("out/hypotheses", "hypotheses"), ("in/cloud", "cloud"),
    )  # fmt: skip
    return [Topic(f"{base}/*/{end}", kind, depth=depth) for end, kind in ends]
