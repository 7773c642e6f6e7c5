"""Keys of a robot's traffic, in presets for the conventions in use, and the identity of a node.

``native`` is ours; ``ros2dds`` follows zenoh-bridge-ros2dds, ``rmw_zenoh`` ROS 2's own zenoh middleware and ``keelson``
RISE's maritime protocol. Status, liveliness and rpc stay native in all presets: no other convention has them. No robot
may read another's messages, and no pose may come back as input.
"""

from __future__ import annotations

import json
import re
import socket
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import Any

from coview_stream.errors import ConfigError
from coview_stream.stream.transport.rmw import dds_type, type_hash

_FORBIDDEN = re.compile(r"[*$?#]")


def check_chunk(text: str, option: str) -> str:
    """Return ``text`` if it can be one chunk of a key, such as a robot's name; ``option`` names it in errors.

    Raises:
        ConfigError: it is empty, starts with ``@``, or contains one of ``/*$?#`` or unprintable characters.
    """
    if not text:
        raise ConfigError(f"{option} is empty: give it a name")
    if "/" in text:
        raise ConfigError(f"{option} {text!r} holds a '/': a name is one chunk of a zenoh key")
    return _checked_plain(text, text, option)


def check_prefix(text: str, option: str) -> str:
    """Return ``text`` if it can start a key: one chunk or several. Arguments and errors as in :func:`check_chunk`."""
    for chunk in text.split("/"):
        if not chunk:
            raise ConfigError(f"{option} {text!r} has an empty part: no leading, trailing or double '/'")
        _checked_plain(chunk, text, option)
    return text


def _checked_plain(chunk: str, text: str, option: str) -> str:
    if forbidden := _FORBIDDEN.search(chunk):
        raise ConfigError(f"{option} {text!r} holds {forbidden.group()!r}, which zenoh reserves in keys: leave it out")
    if chunk.startswith("@"):
        raise ConfigError(f"{option} {text!r}: a part that starts with '@' is hidden from zenoh wildcards: rename it")
    if not chunk.isprintable():
        raise ConfigError(f"{option} {text!r} holds unprintable characters: leave them out")
    return text


def check_expression(text: str, option: str, wildcards: bool = True) -> str:
    """Return ``text`` if it is a key expression in zenoh's canonical form, else raise ConfigError about ``option``.

    Without ``wildcards`` (``*``, ``**`` and ``$*``) it must be a key to publish to.
    """
    chunks = text.split("/")
    for chunk in chunks:
        if not chunk:
            raise ConfigError(f"{option} {text!r} has an empty part: no leading, trailing or double '/'")
        wild = chunk in ("*", "**") or "$*" in chunk
        if wild and not wildcards:
            raise ConfigError(f"{option} {text!r} has a wildcard, but one can only publish on a plain key")
        rest = "" if chunk in ("*", "**") else chunk.replace("$*", "")
        if _FORBIDDEN.search(rest) or chunk == "$*" or "$*$*" in chunk or not chunk.isprintable():
            raise ConfigError(
                f"{option} {text!r}: {chunk!r} is not part of a zenoh key ('*' and '**' stand alone, '$*' within text)"
            )
    for first, second in pairwise(chunks):
        if first == "**" and second in ("*", "**"):
            short = "**" if second == "**" else "*/**"
            raise ConfigError(f"{option} {text!r}: write '{short}' for '{first}/{second}'")
    return text


def matches(expression: str, key: str) -> bool:
    """Whether two valid key expressions have a key in common; for a plain ``key``: whether ``expression`` matches."""
    import zenoh

    return bool(zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key)))


POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"

_CLOUD_DDS = dds_type("sensor_msgs/msg/PointCloud2")
_ODOMETRY_DDS = dds_type("nav_msgs/msg/Odometry")
_POSE_DDS = dds_type(POSE_TYPE)
_RMW_KEY = re.compile(r"\d+(/[^/]+)+/[^/]+/[^/]+")
_INPUT_OPTIONS = ("--cloud-key", "--odometry-key")


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Templates of keys, with ``{base}``, ``{robot}``, ``{domain}`` and ``{pose_hash}`` to fill in, and formats.

    ``hint`` is the codec of a convention whose messages have no Encoding; None if Encoding, key or payload identify it.
    """

    cloud: str  # key expression of lidar frames
    odometry: str  # likewise
    pose: str  # key of our poses
    hint: str | None = None
    rmw: bool = False  # poses need rmw_zenoh's attachment and liveliness tokens

    @property
    def pose_format(self) -> str:
        """Codec of published poses, unless the user chooses another."""
        return self.hint or "json"


PRESETS: dict[str, Preset] = {
    "native": Preset(
        cloud="{base}/{robot}/in/cloud", odometry="{base}/{robot}/in/odom", pose="{base}/{robot}/out/pose"
    ),
    "ros2dds": Preset(cloud="{robot}/points", odometry="{robot}/odom", pose="{robot}/coview/pose", hint="cdr"),
    # the last part of an input is the type's hash: '*' accepts every ROS 2 release, Humble too
    "rmw_zenoh": Preset(
        cloud=f"{{domain}}/{{robot}}/points/{_CLOUD_DDS}/*",
        odometry=f"{{domain}}/{{robot}}/odom/{_ODOMETRY_DDS}/*",
        pose=f"{{domain}}/{{robot}}/coview/pose/{_POSE_DDS}/{{pose_hash}}",
        hint="cdr",
        rmw=True,
    ),
    # keelson has no subject for a pose in a map frame, only foxglove.FrameTransform: ours is map -> body, from source
    # 'coview'; odometry must therefore name its source, or it would match our own poses
    "keelson": Preset(
        cloud="{base}/@v0/{robot}/pubsub/point_cloud/**",
        odometry="{base}/@v0/{robot}/pubsub/frame_transform/odometry/**",
        pose="{base}/@v0/{robot}/pubsub/frame_transform/coview",
        hint="keelson",
    ),
}


@dataclass(frozen=True, kw_only=True)
class RobotKeys(Preset):
    """A preset filled in for one robot, with the keys that are native in all presets."""

    robot: str  # the robot's name
    status: str
    hypotheses: str  # places that a search considers
    location: str  # places on Earth, if requested
    alive: str  # of the liveliness token
    relocalize: str  # query: forget the pose and search again
    initial_pose: str  # subscribed to for guesses of the place
    suggest: str  # query: a guess of the place in its parameters
    reset: str  # query: forget everything
    map_view: str  # query: a thinned map to display


@dataclass(frozen=True)
class NodeKeys:
    """Keys of a node, whichever robots it serves; no wildcard matches them, as ``@node`` is a verbatim chunk."""

    health: str  # health and metrics, once a second
    ask_health: str  # query: the same
    reload: str  # query: open the map's file again


ANY = "*"  # any node name


def node_keys(base: str, name: str) -> NodeKeys:
    """Return the keys of the node called ``name``, or of ANY; ConfigError if it is not one chunk of a key."""
    own = f"{check_prefix(base, '--base')}/@node/{ANY if name == ANY else check_chunk(name, '--node')}"
    return NodeKeys(f"{own}/out/health", f"{own}/rpc/health", f"{own}/rpc/reload")


def robot_keys(
    preset: str,
    base: str,
    robot: str,
    cloud: str | None = None,
    odometry: str | None = None,
    pose: str | None = None,
    domain: int = 0,
    humble: bool = False,
) -> RobotKeys:
    """Fill in a preset for one robot.

    Args:
        preset: ``native``, ``ros2dds``, ``rmw_zenoh`` or ``keelson``.
        base: first part of our own keys, one chunk or several (``site/hall3``).
        robot: the robot's name, one chunk; in ROS its namespace.
        cloud: key expression instead of the preset's; ``{base}``, ``{robot}`` and ``{domain}`` are filled in.
        odometry: the same for odometry.
        pose: the same for poses: a plain key without wildcards; with ``rmw_zenoh`` it keeps the convention's form, and
            ``{pose_hash}`` is filled in too.
        domain: ROS domain id, 0 to 232.
        humble: name types as ROS 2 Humble does, without a hash.

    Raises:
        ConfigError: the preset is unknown, or a name or key is invalid in zenoh.
    """
    if preset not in PRESETS:
        raise ConfigError(f"--preset {preset!r} is unknown: choose one of {', '.join(PRESETS)}")
    if not 0 <= domain <= 232:
        raise ConfigError(f"--domain {domain} is not a ROS domain id: 0 to 232")
    row = PRESETS[preset]
    values = {"base": check_prefix(base, "--base"), "robot": check_chunk(robot, "--robot"), "domain": str(domain)}
    if row.rmw:
        values["pose_hash"] = type_hash(POSE_TYPE, humble)
    pose_key = _filled(pose or row.pose, values, "--pose-key", wildcards=False)
    if row.rmw and not _RMW_KEY.fullmatch(pose_key):
        raise ConfigError(
            f"--pose-key {pose_key!r} is not an rmw_zenoh key: <domain>/<topic>/<type>/<hash>, such as {row.pose!r}"
        )
    own = f"{base}/{robot}"
    return RobotKeys(
        **vars(row)
        | {
            "cloud": _filled(cloud or row.cloud, values, "--cloud-key"),
            "odometry": _filled(odometry or row.odometry, values, "--odometry-key"),
            "pose": pose_key,
        },
        robot=robot,
        status=f"{own}/out/status",
        hypotheses=f"{own}/out/hypotheses",
        location=f"{own}/out/location",
        alive=f"{own}/alive",
        relocalize=f"{own}/rpc/relocalize",
        initial_pose=f"{own}/in/initial_pose",
        suggest=f"{own}/rpc/suggest",
        reset=f"{own}/rpc/reset",
        map_view=f"{own}/rpc/map_view",
    )


def _filled(template: str, values: dict[str, str], option: str, wildcards: bool = True) -> str:
    def value(found: re.Match[str]) -> str:
        name = found.group(1)
        if name not in values:
            raise ConfigError(f"{option} {template!r}: unknown placeholder {{{name}}}: there are {', '.join(values)}")
        return values[name]

    return check_expression(re.sub(r"\{([^{}]*)\}", value, template), option, wildcards)


def check_disjoint(keys: Sequence[RobotKeys]) -> None:
    """Raise ConfigError if a name is given twice, robots share inputs or a pose key, or a pose returns as input."""
    names = [k.robot for k in keys]
    if len(set(names)) < len(names):
        raise ConfigError(f"--robot: {', '.join(names)}: each name once")
    for one, other in combinations(keys, 2):
        for first, a in zip(_INPUT_OPTIONS, (one.cloud, one.odometry), strict=True):
            for second, b in zip(_INPUT_OPTIONS, (other.cloud, other.odometry), strict=True):
                if matches(a, b):
                    both = first if first == second else f"{first} and {second}"
                    raise ConfigError(
                        f"{first} {a!r} of robot {one.robot} and {second} {b!r} of {other.robot} have messages in "
                        f"common: use {{robot}} in {both}"
                    )
        if one.pose == other.pose:
            raise ConfigError(
                f"--pose-key: poses of robots {one.robot} and {other.robot} would both go to {one.pose!r}: "
                "use {robot} in --pose-key"
            )
    for writer in keys:
        for reader in keys:
            for option, expression in zip(_INPUT_OPTIONS, (reader.cloud, reader.odometry), strict=True):
                if matches(expression, writer.pose):
                    raise ConfigError(
                        f"--pose-key: the poses of robot {writer.robot} on {writer.pose!r} would be read as input of "
                        f"{reader.robot}, which is {expression!r}: choose a --pose-key or {option} apart from that"
                    )


_MAX_STATUS = 65_536  # bytes of a status to read
_MAX_NAME = 64  # characters of a node's name or host
_MAX_PERIOD = 60.0  # seconds between statuses


@dataclass(frozen=True)
class NodeIdentity:
    """Identity of a node in its statuses: a unique ``node``, its ``host`` for people, seconds between statuses."""

    node: str = field(default_factory=lambda: uuid.uuid4().hex[:12])
    host: str = field(default_factory=lambda: socket.gethostname()[:_MAX_NAME])
    period: float = 1.0
    ending: bool = False  # it no longer serves

    def __str__(self) -> str:
        return f"{self.node} on {self.host}" if self.host else self.node

    def to_json(self, ending: bool = False) -> dict[str, Any]:
        """Return its form in a status."""
        return {"id": self.node, "period_s": self.period, "ending": ending, "host": self.host}

    @classmethod
    def read(cls, status: bytes) -> NodeIdentity | None:
        """Return the identity in a status, from anyone; None if unreadable."""
        if len(status) > _MAX_STATUS:
            return None
        try:
            node = json.loads(status)["node"]
            name, period, ending, host = node["id"], node["period_s"], node["ending"], node.get("host", "")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
        numeric = isinstance(period, int | float) and type(period) is not bool and 0.0 < period <= _MAX_PERIOD
        if not (numeric and isinstance(ending, bool) and _is_name(name) and name and _is_name(host)):
            return None
        return cls(name, host, float(period), ending)


def _is_name(text: object) -> bool:
    """Whether a text can be logged as a name."""
    return isinstance(text, str) and len(text) <= _MAX_NAME and text.isprintable()
