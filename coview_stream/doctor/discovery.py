"""Who else is on the network: robots by their keys, ROS topics by the liveliness tokens of bridge and rmw_zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

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
_MOST = 3  # suggestions in one line
_KEPT = 200  # different offers: a large site has more, and nobody reads them


@dataclass(frozen=True, order=True)
class Offer:
    """Clouds or odometry that could be had.

    Attributes:
        channel: ``cloud`` or ``odometry``.
        where: key or topic.
        options: of ``serve`` and ``doctor`` to get at it.
    """

    channel: str
    where: str
    options: str


def look(
    transport: Transport, seconds: float = 2.0, wait: Callable[[float], object] = time.sleep
) -> list[Offer]:
    """Listen for ``seconds``, ask for tokens, and return what there is, sorted.

    Subscribes to keys of all robots, so clouds of all of them come here for the time.
    """
    found: set[Offer] = set()

    def add(offer: Offer | None) -> None:
        if offer is not None and len(found) < _KEPT:
            found.add(offer)

    for key in _KEYS:
        transport.subscribe(key, lambda sample: add(from_key(sample.key)), "newest")
    wait(seconds)
    for expression in _TOKENS:
        for token in transport.tokens(expression):
            add(from_token(token))
    return sorted(found)


def suggestion(offers: Iterable[Offer], channel: str) -> str:
    """Where else clouds or odometry come, with the options that would take them; empty if nowhere."""
    fitting = [offer for offer in offers if offer.channel == channel]
    if not fitting:
        return ""
    what = "clouds come" if channel == "cloud" else "odometry comes"
    listed = "; ".join(f"on {offer.where}: try {offer.options}" for offer in fitting[:_MOST])
    more = f"; and {len(fitting) - _MOST} more" if len(fitting) > _MOST else ""
    return f"{what} {listed}{more}"


def from_token(token: str) -> Offer | None:
    """Read a publisher's liveliness token; None for any other.

    rmw_zenoh: ``@ros2_lv/<domain>/<zid>/<nid>/<eid>/MP/<enclave>/<ns>/<node>/<topic>/<type>/<hash>/<qos>``, a '/' in
    names being '%'. The bridge: ``@/<zid>/@ros2_lv/MP/<topic>/<type>/<qos>``, with U+00A7 for '/'.
    """
    parts = token.split("/")
    if parts[0] == "@ros2_lv" and len(parts) >= 12 and parts[5] == "MP" and parts[10] in _DDS:
        topic = parts[9].replace("%", "/").strip("/")
        return _ros("rmw_zenoh", _DDS[parts[10]], topic, parts[1], f"/{parts[10]}/*")
    if parts[0] == "@" and len(parts) >= 6 and parts[2:4] == ["@ros2_lv", "MP"]:
        topic, kind = (part.replace("\xa7", "/").strip("/") for part in parts[4:6])
        channel = next((channel for channel, name in _TYPES.items() if name == kind), None)
        return _ros("ros2dds", channel, topic) if channel else None
    return None


def from_key(key: str) -> Offer | None:
    """Read the key of a sample; None if no preset has such keys."""
    parts = key.split("/")
    if len(parts) >= 4 and parts[-2] == "in":
        channel = {"cloud": "cloud", "odom": "odometry"}.get(parts[-1])
        return _plain("native", channel, key, parts[-3], "/".join(parts[:-3])) if channel else None
    if len(parts) >= 4 and parts[-2] in _DDS:
        return _ros("rmw_zenoh", _DDS[parts[-2]], "/".join(parts[1:-2]), parts[0], f"/{parts[-2]}/*")
    if "@v0" in parts[1:] and len(parts) >= (at := parts.index("@v0")) + 4:
        channel = "cloud" if parts[at + 3] == "point_cloud" else "odometry"
        return _plain("keelson", channel, key, parts[at + 1], "/".join(parts[:at]))
    if parts[-1] in ("points", "odom") and len(parts) > 1:
        return _ros("ros2dds", "cloud" if parts[-1] == "points" else "odometry", key)
    return None


def _plain(preset: str, channel: str, key: str, robot: str, base: str) -> Offer | None:
    options = f"--robot {robot}" + (f" --base {base}" if base != "coview" else "")
    return _checked(
        preset, channel, key, options if preset == "native" else f"--preset {preset} {options}", robot, base
    )


def _ros(preset: str, channel: str, topic: str, domain: str = "0", ending: str = "") -> Offer | None:
    """Return the offer of a ROS topic: by the preset where its name is the preset's, else by an explicit key."""
    more = f" --domain {domain}" if domain != "0" else ""
    robot, _, rest = topic.partition("/")
    if rest == {"cloud": "points", "odometry": "odom"}[channel]:
        return _checked(preset, channel, f"/{topic}", f"--preset {preset} --robot {robot}{more}", robot)
    key = f"{{domain}}/{topic}{ending}" if ending else topic
    option = "--cloud-key" if channel == "cloud" else "--odometry-key"
    return Offer(channel, f"/{topic}", f"--preset {preset}{more} {option} '{key}'")


def _checked(
    preset: str, channel: str, where: str, options: str, robot: str, base: str = "coview"
) -> Offer | None:
    """Return the offer, unless its names are none that we could be told."""
    try:
        robot_keys(preset, base, robot)
    except ConfigError:
        return None
    return Offer(channel, where, options)
