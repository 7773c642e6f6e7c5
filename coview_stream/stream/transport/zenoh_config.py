"""Configuration of a zenoh session: the user's file, else our defaults; zenoh's errors as one line with a remedy."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coview_stream.errors import TransportError, nearest
from coview_stream.stream.transport.error_guard import is_panic

_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")
_WITH_PORT = ("tcp", "udp", "tls", "quic", "ws")
_HOST_PORT = re.compile(r"(\[[^\]]+\]|[^:\[\]]+):(\d+)")

_DEFAULTS: dict[str, Any] = {
    # explicit endpoints only: a robot must not join sessions of others who test on the same network
    "scouting/multicast/enabled": False,
    "scouting/gossip/autoconnect": {"router": [], "peer": [], "client": []},
    # zenoh's own retry period grows to 4 s; a robot that stops without poses needs its router back within 2 s
    "connect/retry": {"period_init_ms": 250, "period_max_ms": 1000, "period_increase_factor": 2.0},
    # a host that is off does not refuse: each attempt, and at worst the end of the process, waits this long. It is
    # enough for five satellite round trips. connect/timeout_ms would bound the wait too, but with it a client never
    # tries its second endpoint (zenoh#1602)
    "transport/unicast/open_timeout": 3000,
    # poses are express: each takes a batch, and is dropped after a millisecond without a free one: room for a fleet
    "transport/link/tx/queue/size/real_time": 16,
    # the kernel's send buffer, bytes, has no priorities: by default it grows to 4 MB, and on a thin link odometry waits
    # behind the clouds in it. At half this size the throughput on one machine fell to a third at times
    "transport/link/tcp/so_sndbuf": 131072,
}

# zenoh enables shared memory by default. It saves 0.5 ms of 1.5 ms for a 1 MB cloud between processes on one machine,
# but loses messages silently when the receiver stalls for 100 ms (zenoh#2628), leaves segments of killed processes
# behind (zenoh#2571), and logs an error where memory locking is limited, as for ordinary users.
_SHARED_MEMORY = "transport/shared_memory/enabled"

_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.S)
_FILES = (
    *("transport/link/tls/root_ca_certificate", "transport/link/tls/listen_certificate"),
    *("transport/link/tls/listen_private_key", "transport/link/tls/connect_certificate"),
    *("transport/link/tls/connect_private_key", "transport/auth/usrpwd/dictionary_file"),
)

# zenoh's error texts
_REMEDIES = {
    "Address already in use": "another node or router holds the port: --connect to it, or another --listen",
    "Cannot assign requested address": "no address of this machine: --listen on one that it has, or --connect to the "
    "machine that has it",
}

_MESSAGE = re.compile(r'JSON error: Message \{ msg: "((?:[^"\\]|\\.)*)", location: (?:Some\(.*?line: (\d+),.*|None.*)')
_SYNTAX = re.compile(r"^--> (\d+):(\d+) \|.*\| = (.*)$")
_FIELD = re.compile(r"unknown field `([^`]*)`(?:, (?:expected (?:one of )?)?(.*?))?(?=$| at line )")
_PLACE = re.compile(r" at line (\d+) column \d+")


@contextmanager
def zenoh_errors(subject: str) -> Iterator[None]:
    """Turn zenoh's errors, and panics in its Rust core, into :class:`TransportError` about ``subject``."""
    import zenoh

    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(f"{subject}: {reason(error)}") from error
    except BaseException as error:
        if not is_panic(error):
            raise
        raise TransportError(f"{subject}: zenoh failed inside: {reason(error)}") from error


def compose(
    connect: Sequence[str] = (), listen: Sequence[str] = (), path: Path | None = None, lease_ms: int | None = None,
    max_message: int | None = None,
) -> Any:  # fmt: skip
    """Build a ``zenoh.Config``.

    The file's settings override our defaults; ``connect`` and ``listen`` replace its endpoints. If the file sets no
    mode, we are a client if there is an endpoint to connect to and none to listen on, else a peer: two peers do not see
    each other through a router, a client is seen by all.

    Args:
        connect: endpoints, for example ``tcp/10.0.0.1:7447``.
        listen: endpoints.
        path: a zenoh configuration, JSON5 or YAML.
        lease_ms: time without a sign of life after which others consider us dead; None: zenoh's 10 s.
        max_message: bytes after which zenoh stops receiving a message; None: zenoh's 1 GiB.

    Raises:
        TransportError: the file cannot be read, is not a zenoh configuration or names a missing file, or an endpoint is
            malformed.
    """
    import zenoh

    for endpoint in connect:
        _check_endpoint(endpoint, "--connect")
    for endpoint in listen:
        _check_endpoint(endpoint, "--listen")
    config, text = zenoh.Config(), ""
    if path is not None:
        try:
            text = _COMMENT.sub("", Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            cause = error.strerror if isinstance(error, OSError) else "not a text file"
            raise TransportError(f"zenoh configuration {path}: {cause}: give a JSON5 file that can be read") from error
        with zenoh_errors(f"zenoh configuration {path}"):
            config = zenoh.Config.from_file(str(path))
    defaults = zenoh.Config()

    def is_unset(key: str) -> bool:  # zenoh does not list a file's settings; the default value counts as unset
        return bool(_get(config, key) == _get(defaults, key))

    if connect:
        _insert(config, "connect/endpoints", list(connect))
    if listen:
        _insert(config, "listen/endpoints", list(listen))
    elif mode_of(config) != "router" and is_unset("listen/endpoints"):
        _insert(config, "listen/endpoints", [])  # if unset, a peer would listen on all interfaces
    if _get(config, "mode") is None:
        has_listen, has_connect = (bool(_get(config, "listen/endpoints")), bool(_get(config, "connect/endpoints")))
        _insert(config, "mode", "client" if has_connect and not has_listen else "peer")
    for key, value in _DEFAULTS.items():
        if is_unset(key):
            _insert(config, key, value)
    if lease_ms is not None and "lease" not in text:
        _insert(config, "transport/link/tx/lease", lease_ms)
    if max_message is not None and "max_message_size" not in text:
        _insert(config, "transport/link/rx/max_message_size", max_message)
    if "shared_memory" not in text:  # reads the same whether set or not: check the file's text
        _insert(config, _SHARED_MEMORY, False)
    if _get(config, "transport/unicast/lowlatency"):
        raise TransportError(
            f"zenoh configuration {path}: transport/unicast/lowlatency loses messages over 64 KB: take it out"
        )
    for key in _FILES:
        name = _get(config, key)
        if name is not None and not Path(name).is_file():  # zenoh would retry for ever without an error
            raise TransportError(f"zenoh configuration {path}: {key} names {name}, which is not a file")
    return config


def mode_of(config: Any) -> str:
    """Return ``client``, ``peer`` or ``router``."""
    return str(_get(config, "mode"))


def endpoints_of(config: Any) -> str:
    """List the endpoints to connect to, for messages."""
    found = _get(config, "connect/endpoints")
    if isinstance(found, dict):
        found = found.get(mode_of(config)) or []
    return ", ".join(map(str, found)) or "no endpoint"


def _check_endpoint(endpoint: str, option: str) -> None:
    protocol, slash, rest = endpoint.partition("/")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if protocol not in _PROTOCOLS or not slash or not address:
        raise TransportError(
            f"{option} {endpoint!r} is not <protocol>/<address>, such as tcp/127.0.0.1:7447; "
            f"protocols: {', '.join(_PROTOCOLS)}"
        )
    if protocol in _WITH_PORT:
        found = _HOST_PORT.fullmatch(address)
        if not found:
            raise TransportError(f"{option} {endpoint!r}: {address!r} is not <host>:<port>, such as 127.0.0.1:7447")
        min_port = 0 if option == "--listen" else 1  # listening on 0 takes any free port
        if not min_port <= int(found.group(2)) <= 65535:
            raise TransportError(f"{option} {endpoint!r}: port must be 1..65535, such as 7447")


def _get(config: Any, key: str) -> Any:
    return json.loads(config.get_json(key))


def _insert(config: Any, key: str, value: Any) -> None:
    with zenoh_errors(f"zenoh setting {key} = {value!r}"):
        config.insert_json5(key, json.dumps(value))


def reason(error: BaseException) -> str:
    """Return zenoh's message on one line, without Rust source lines, and with any remedy we know."""
    text = re.sub(r" at \S+\.rs:\d+\.?", "", " ".join(str(error).split()))
    text = _shortened(text.strip()) or type(error).__name__
    for cause, remedy in _REMEDIES.items():
        if cause in text:
            return f"{text}; {remedy}"
    return text


def _shortened(text: str) -> str:
    """Shorten an error about a configuration file, which lists all valid keys."""
    line = ""
    if syntax := _SYNTAX.match(text):
        return f"line {syntax[1]}, column {syntax[2]}: {syntax[3]}"
    if message := _MESSAGE.fullmatch(text):
        line = f"line {message[2]}: " if message[2] else ""
        text = re.sub(r"\\(.)", r"\1", message[1])
    field: Any = _FIELD.search(text)
    if field is None:
        return line + text
    place = _PLACE.search(text)
    near = nearest(field[1], re.findall(r"`([^`]+)`", field[2] or ""))
    line += f"line {place[1]}: " if place else ""
    return f"{line}unknown key {field[1]!r}" + (f"; did you mean {near!r}?" if near else "; take it out")
