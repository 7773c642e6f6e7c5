"""Discovery of clouds and odometry on the network: by keys of samples, by liveliness tokens of ROS publishers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from difflib import SequenceMatcher

from coview_stream.errors import ConfigError
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.rmw import dds_type
from coview_stream.stream.transport.transport import Transport

_TYPES = {"cloud": "sensor_msgs/msg/PointCloud2", "odometry": "nav_msgs/msg/Odometry"}
_DDS = {dds_type(name): channel for channel, name in _TYPES.items()}
_TOKENS = ("@ros2_lv/**", "@/*/@ros2_lv/**")  # rmw_zenoh's and zenoh-bridge-ros2dds's
_KEYS = (
    "**/in/cloud",
    "**/in/odom",
    "**/points",
    "**/odom",
    *(f"*/**/{dds}/*" for dds in _DDS),
    "**/@v0/*/pubsub/point_cloud/**",
    "**/@v0/*/pubsub/frame_transform/odometry/**",
)
_LISTEN = 2.0  # seconds, set by hand: clouds come at 5 Hz or more
_MAX_LISTED = 3  # candidates in one line, set by hand
_MAX_CANDIDATES = 200  # set by hand; a large site has more than anyone reads


@dataclass(frozen=True, order=True)
class Candidate:
    """Clouds or odometry that a robot could be served from.

    Attributes:
        channel: ``cloud`` or ``odometry``.
        where: key or topic.
        options: options of ``serve`` and ``doctor`` that subscribe to it.
    """

    channel: str
    where: str
    options: str


def discover(transport: Transport, wait: Callable[[float], object] = time.sleep) -> list[Candidate]:
    """Return the clouds and odometry on the network, sorted.

    Listens for two seconds to the keys of all robots, whose clouds all come here meanwhile, then asks for tokens.
    """
    found: set[Candidate] = set()

    def add(candidate: Candidate | None) -> None:
        if candidate is not None and len(found) < _MAX_CANDIDATES:
            found.add(candidate)

    for key in _KEYS:
        transport.subscribe(key, lambda sample: add(from_key(sample.key)), "newest")
    wait(_LISTEN)
    for expression in _TOKENS:
        for token in transport.tokens(expression):
            add(from_token(token))
    return sorted(found)


def served_robots(transport: Transport) -> set[str]:
    """Return the names of the robots for which a node holds a liveliness token, of any base."""
    return {token.split("/")[-2] for token in transport.tokens("**/alive") if "/" in token}


def candidates_text(candidates: Iterable[Candidate], channel: str, like: str = "", served: Iterable[str] = ()) -> str:
    """Name the candidates of a channel, with the options that subscribe to them; empty if there are none.

    Args:
        candidates: found on the network.
        channel: ``cloud`` or ``odometry``.
        like: key that nothing came on: those that are spelt most like it come first.
        served: robots that have a node; their data is named only if there is no other.
    """
    others = set(served)
    fitting = [c for c in candidates if c.channel == channel]
    fitting = [c for c in fitting if not others & set(c.where.strip("/").split("/"))] or fitting
    if not fitting:
        return ""
    if like:
        fitting.sort(key=lambda c: SequenceMatcher(None, c.where.strip("/"), like.strip("/")).ratio(), reverse=True)
    what = "clouds come" if channel == "cloud" else "odometry comes"
    listed = "; ".join(f"on {candidate.where}: try {candidate.options}" for candidate in fitting[:_MAX_LISTED])
    more = f"; and {len(fitting) - _MAX_LISTED} more" if len(fitting) > _MAX_LISTED else ""
    return f"{what} {listed}{more}"


def from_token(token: str) -> Candidate | None:
    """Read a publisher's liveliness token; None for any other.

    rmw_zenoh: ``@ros2_lv/<domain>/<zid>/<nid>/<eid>/MP/<enclave>/<ns>/<node>/<topic>/<type>/<hash>/<qos>``, a '/' in
    names being '%'. The bridge: ``@/<zid>/@ros2_lv/MP/<topic>/<type>/<qos>``, with U+00A7 for '/'.
    """
    parts = token.split("/")
    if parts[0] == "@ros2_lv" and len(parts) >= 12 and parts[5] == "MP" and parts[10] in _DDS:
        topic = parts[9].replace("%", "/").strip("/")
        return _ros_topic("rmw_zenoh", _DDS[parts[10]], topic, parts[1], f"/{parts[10]}/*")
    if parts[0] == "@" and len(parts) >= 6 and parts[2:4] == ["@ros2_lv", "MP"]:
        topic, kind = (part.replace("\xa7", "/").strip("/") for part in parts[4:6])
        channel = next((channel for channel, name in _TYPES.items() if name == kind), None)
        return _ros_topic("ros2dds", channel, topic) if channel else None
    return None


def from_key(key: str) -> Candidate | None:
    """Read the key of a sample; None if no preset has such keys."""
    parts = key.split("/")
    if len(parts) >= 4 and parts[-2] == "in":
        channel = {"cloud": "cloud", "odom": "odometry"}.get(parts[-1])
        return _named("native", channel, key, parts[-3], "/".join(parts[:-3])) if channel else None
    if len(parts) >= 4 and parts[-2] in _DDS:
        return _ros_topic("rmw_zenoh", _DDS[parts[-2]], "/".join(parts[1:-2]), parts[0], f"/{parts[-2]}/*")
    if "@v0" in parts[1:] and len(parts) >= (at := parts.index("@v0")) + 4:
        channel = "cloud" if parts[at + 3] == "point_cloud" else "odometry"
        return _named("keelson", channel, key, parts[at + 1], "/".join(parts[:at]))
    if parts[-1] in ("points", "odom") and len(parts) > 1:
        return _ros_topic("ros2dds", "cloud" if parts[-1] == "points" else "odometry", key)
    return None


def _named(preset: str, channel: str, key: str, robot: str, base: str) -> Candidate | None:
    options = f"--robot {robot}" + (f" --base {base}" if base != "coview" else "")
    return _valid(preset, channel, key, options if preset == "native" else f"--preset {preset} {options}", robot, base)


def _ros_topic(preset: str, channel: str, topic: str, domain: str = "0", ending: str = "") -> Candidate | None:
    """Return the candidate of a ROS topic: by the preset where its name is the preset's, else by an explicit key."""
    more = f" --domain {domain}" if domain != "0" else ""
    robot, _, rest = topic.partition("/")
    if rest == {"cloud": "points", "odometry": "odom"}[channel]:
        return _valid(preset, channel, f"/{topic}", f"--preset {preset} --robot {robot}{more}", robot)
    key = f"{{domain}}/{topic}{ending}" if ending else topic
    option = "--cloud-key" if channel == "cloud" else "--odometry-key"
    return Candidate(channel, f"/{topic}", f"--preset {preset}{more} {option} '{key}'")


def _valid(preset: str, channel: str, where: str, options: str, robot: str, base: str = "coview") -> Candidate | None:
    """Return the candidate; None if its names are none that the options accept."""
    try:
        robot_keys(preset, base, robot)
    except ConfigError:
        return None
    return Candidate(channel, where, options)
