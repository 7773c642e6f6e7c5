"""Checks of the network: connections, the robots' messages, and discovery of other clouds and odometry."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher

from coview_stream.config.mount import Mount
from coview_stream.doctor.capture import Codecs, RobotCapture, Wait, capture_cloud, capture_odometry, capture_robots
from coview_stream.doctor.finding import Finding
from coview_stream.doctor.frame_checks import frame_findings
from coview_stream.doctor.robot_checks import (
    captured_frames,
    cloud_findings,
    cross_findings,
    node_finding,
    odometry_findings,
)
from coview_stream.errors import ConfigError
from coview_stream.messages.types import Sample
from coview_stream.stream.transport.keys import RobotKeys, robot_keys
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
_LISTEN = 2.0  # seconds: clouds come at 5 Hz or more
_CLOUD = 100  # points: a message on a key of no preset counts as a cloud from this many on
_MAX_LISTED = 3  # candidates per line
_MAX_CANDIDATES = 200  # a large site has more than anyone reads


@dataclass(frozen=True, order=True)
class Candidate:
    """Clouds or odometry found on the network, and how to subscribe to them."""

    channel: str  # cloud or odometry
    where: str  # key or topic
    options: str  # options of serve and doctor that subscribe to it


def discover(
    transport: Transport, wait: Callable[[float], object] = time.sleep, names: Iterable[str] = ()
) -> list[Candidate]:
    """Return the clouds and odometry on the network, sorted.

    Listens for two seconds to the keys of all robots (and so receives all their clouds), and to any key with the name
    of a robot or a base among ``names``, whose messages are judged by content; then queries the tokens.
    """
    candidates: set[Candidate] = set()
    seen: set[str] = set()

    def add_sample(sample: Sample) -> None:
        if sample.key not in seen and len(seen) < _MAX_CANDIDATES:
            seen.add(sample.key)
            candidate = from_key(sample.key)
            guessed = candidate is None or (candidate.options.startswith("--preset ros2dds") and _is_json(sample))
            add(from_content(sample) if guessed else candidate)

    def add(candidate: Candidate | None) -> None:
        if candidate is not None and len(candidates) < _MAX_CANDIDATES:
            candidates.add(candidate)

    for key in _KEYS:
        transport.subscribe(key, add_sample, "newest")
    for name in names:
        transport.subscribe(f"**/{name}/**", add_sample, "newest")
    wait(_LISTEN)
    for expression in _TOKENS:
        for token in transport.tokens(expression):
            add(from_token(token))
    return sorted(candidates)


def candidates_text(candidates: Iterable[Candidate], channel: str, like: str = "", served: Iterable[str] = ()) -> str:
    """Name the candidates of a channel, with the options that subscribe to them; empty if there are none.

    Those spelt most like the silent key ``like`` come first; data of ``served`` robots, which have a node, is named
    only if there is no other.
    """
    others = set(served)
    fitting = [c for c in candidates if c.channel == channel]
    fitting = [c for c in fitting if not others & set(c.where.strip("/").split("/"))] or fitting
    if not fitting:
        return ""
    if like:
        fitting.sort(key=lambda c: SequenceMatcher(None, c.where.strip("/"), like.strip("/")).ratio(), reverse=True)
    subject = "clouds come" if channel == "cloud" else "odometry comes"
    listed = "; ".join(f"on {candidate.where}: try {candidate.options}" for candidate in fitting[:_MAX_LISTED])
    more = f"; and {len(fitting) - _MAX_LISTED} more" if len(fitting) > _MAX_LISTED else ""
    return f"{subject} {listed}{more}"


def from_token(token: str) -> Candidate | None:
    """Read a publisher's liveliness token; None for other tokens.

    rmw_zenoh: ``@ros2_lv/<domain>/<zid>/<nid>/<eid>/MP/<enclave>/<ns>/<node>/<topic>/<type>/<hash>/<qos>``, with '%'
    for '/' in names. The bridge: ``@/<zid>/@ros2_lv/MP/<topic>/<type>/<qos>``, with U+00A7 for '/'.
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
    """Read the key of a sample; None if it fits no preset."""
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


def _is_json(sample: Sample) -> bool:
    return sample.payload[:1] == b"{"


def from_content(sample: Sample) -> Candidate | None:
    """Read a sample on a key of no preset; None if it is neither clouds nor odometry, or a node's own."""
    if "/out/" in sample.key or "/rpc/" in sample.key:
        return None
    for channel, capture in (("odometry", capture_odometry), ("cloud", capture_cloud)):
        message = capture(sample, 0.0)
        codec = message.codec or message.readable_as
        if codec and (channel == "odometry" or message.readable_as or message.points >= _CLOUD):
            option = "--cloud-key" if channel == "cloud" else "--odometry-key"
            named = "" if message.codec else f" --{channel}-encoding {codec}"
            return Candidate(channel, sample.key, f"{option} {sample.key}{named}")
    return None


def _named(preset: str, channel: str, key: str, robot: str, base: str) -> Candidate | None:
    options = f"--robot {robot}" + (f" --base {base}" if base != "coview" else "")
    return _valid(preset, channel, key, options if preset == "native" else f"--preset {preset} {options}", robot, base)


def _ros_topic(preset: str, channel: str, topic: str, domain: str = "0", ending: str = "") -> Candidate | None:
    """Return the candidate for a ROS topic: by preset if the name is the preset's, else by an explicit key."""
    more = f" --domain {domain}" if domain != "0" else ""
    robot, _, rest = topic.partition("/")
    if rest == {"cloud": "points", "odometry": "odom"}[channel]:
        return _valid(preset, channel, f"/{topic}", f"--preset {preset} --robot {robot}{more}", robot)
    key = f"{{domain}}/{topic}{ending}" if ending else topic
    option = "--cloud-key" if channel == "cloud" else "--odometry-key"
    return Candidate(channel, f"/{topic}", f"--preset {preset}{more} {option} '{key}'")


def _valid(preset: str, channel: str, where: str, options: str, robot: str, base: str = "coview") -> Candidate | None:
    """Return the candidate; None if the options refuse its names."""
    try:
        robot_keys(preset, base, robot)
    except ConfigError:
        return None
    return Candidate(channel, where, options)


# seconds
_CONNECT_TIMEOUT = 2.0  # for a first connection to the given endpoints
_LISTEN_TIMEOUT = 6.0  # for a first connection from outside: a client retries every 1 to 4 s
_POLL_PERIOD = 0.05
_TCP_TIMEOUT = 1.0
_OPEN = "is open, but no zenoh session came about"
_TCP = re.compile(r"(?:tcp|tls|ws)/(\[[^\]]+\]|[^:/]+):(\d+)")


def connection_finding(transport: Transport, connect: Sequence[str], wait: Wait = time.sleep) -> Finding:
    """Judge whether a router or a peer is connected; ``connect`` are the endpoints to name if none is."""
    waited = 0.0
    connection = transport.connection()
    while not (connection.routers or connection.peers) and waited < (_CONNECT_TIMEOUT if connect else _LISTEN_TIMEOUT):
        wait(_POLL_PERIOD)
        waited += _POLL_PERIOD
        connection = transport.connection()
    if connection.routers or connection.peers:
        clients = len(connection.clients)
        counts = {"router": len(connection.routers), "peer": len(connection.peers) - clients, "client": clients}
        text = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items() if n)
        return Finding("ok", "network", f"connected: {text}")
    if not connect:
        return Finding("FAIL", "network", "nothing has connected", "start the others, and name this endpoint to them")
    reasons = [(endpoint, try_tcp(endpoint)) for endpoint in connect]
    found = "no session: " + ", ".join(f"{endpoint} {reason}" for endpoint, reason in reasons)
    if any(reason == _OPEN for _, reason in reasons):
        remedy = "another program, or it wants TLS or a password: RUST_LOG=zenoh=warn says more"
    else:
        remedy = (
            "start the router or node there ('coview-stream serve SITE.coview --robot NAME'), let the firewall pass "
            "its port, and give this the same --connect as the others"
        )
    return Finding("FAIL", "network", found, remedy)


def try_tcp(endpoint: str) -> str:
    """Try a plain TCP connection to an endpoint that zenoh cannot reach, and return the result in words."""
    address = _TCP.match(endpoint)
    if address is None:
        return "does not answer"
    try:
        with socket.create_connection((address[1].strip("[]"), int(address[2])), timeout=_TCP_TIMEOUT):
            return _OPEN
    except ConnectionRefusedError:
        return "refuses: nothing listens there"
    except socket.gaierror:
        return "is not a host known here"
    except TimeoutError:
        return "does not answer: off, or behind a firewall"
    except OSError as error:
        return f"cannot be reached: {error.strerror or error}"


@dataclass(frozen=True)
class Heard:
    """Result of listening: the robots' messages, other clouds and odometry, and robots that have a node."""

    captures: list[RobotCapture]
    candidates: list[Candidate]
    served: set[str]


def listen(
    transport: Transport,
    keys: Sequence[RobotKeys],
    seconds: float,
    codecs: Codecs = (None, None),
    wait: Wait = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Heard:
    """Listen to all robots at once; if there are none, or one is silent, look for others."""
    captures = capture_robots(transport, keys, seconds, codecs, wait, clock) if keys else []
    silent = not all(capture.clouds and capture.odometry for capture in captures)
    names = [*(k.robot for k in keys), *{k.alive.partition(f"/{k.robot}/")[0] for k in keys}]
    candidates = discover(transport, wait, names) if silent or not keys else []
    # robots of any base whose node holds a liveliness token
    tokens = transport.tokens("**/alive") if silent else ()
    return Heard(captures, candidates, {token.split("/")[-2] for token in tokens if "/" in token})


def robots_findings(heard: Heard, sha256: str | None = None, mount: Mount | None = None) -> Iterator[Finding]:
    """Judge each robot, with its clouds moved by ``mount`` as in a node; without robots, list those that send.

    ``sha256`` is the hash of the map that the robots' node should serve; None: any map.
    """
    for capture in heard.captures:
        k = capture.keys
        others = heard.served - {k.robot}
        yield from cloud_findings(capture, candidates_text(heard.candidates, "cloud", k.cloud, others))
        yield from odometry_findings(capture, candidates_text(heard.candidates, "odometry", k.odometry, others))
        yield from cross_findings(capture)
        yield from frame_findings(captured_frames(capture, mount), k.robot, mount)
        yield node_finding(capture, sha256, others)
    if not heard.captures:
        texts = [text for channel in ("cloud", "odometry") if (text := candidates_text(heard.candidates, channel))]
        if texts:
            yield Finding("ok", "robots", "; ".join(texts))
        else:
            yield Finding("warn", "robots", "nothing that looks like clouds or odometry", "name one: --robot NAME")
