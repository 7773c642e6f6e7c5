"""HTTP server of a node's page, metrics and health: GET only, with limits on time, size and connections.

Requests cause no action. A request is refused unless its Host is an address, a name without a dot or the server's own
name: a page of another site may make its name resolve to this server (DNS rebinding). No other origin may read replies.
"""

from __future__ import annotations

import io
import ipaddress
import logging
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from coview_stream.errors import ConfigError
from coview_stream.stream.transport.error_guard import RateLimitedErrors

log = logging.getLogger("coview_stream.web")

# limits for people and scrapers: far above their use, far below any harm
MAX_CONNECTIONS = 32  # from other machines, and the same from this one
_MAX_SECONDS = 2.0  # to receive a request
_MAX_BYTES = 8192  # of a request
_SEND_TIMEOUT = 4.0  # seconds for a reader to take more of a reply
_SEND_BUFFER = 1 << 18  # bytes of a stream in flight
_POLL = 0.2  # seconds between checks of the stop flag

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class Reply:
    """Reply to a request: body, content type and status code."""

    body: bytes
    kind: str = "text/plain"
    code: int = 200


EventStream = Generator[bytes, None, None]
"""Server-sent events; closed when the reader leaves."""

Route = Callable[[str], Reply | EventStream]
"""Handler of a path, or of all paths below one that ends with ``/``; takes the rest of the path."""


class HttpServer:
    """Server of some routes on one address, ``HOST:PORT``; port 0 takes any free port. There is no password.

    ``url`` is the root's, with a final ``/``; ``routes`` are handlers by path; ``option`` is the command-line option
    for the address and a valid value, for messages. ConfigError if the address is malformed or cannot be bound.
    """

    def __init__(self, address: str, routes: Mapping[str, Route], option: tuple[str, str]) -> None:
        host, _, port = address.rpartition(":")
        host = host.strip("[]") or "127.0.0.1"
        name, example = option
        try:
            self._server = _Server((host, int(port)), routes, name.lstrip("-"))
        except (OSError, ValueError, OverflowError) as error:
            raise ConfigError(f"{name} {address!r}: {error}; give HOST:PORT, such as {example}") from error
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.server_port}/"
        self._loopback = is_loopback(host)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self.run, args=(self._stopping,), name="coview-web", daemon=True)

    def start(self) -> None:
        """Serve on a thread until :meth:`close`."""
        if not self._loopback:
            log.warning("%s can be seen by all who reach this address: there is no password", self.url)
        self._thread.start()

    def run(self, stopping: threading.Event) -> None:
        """Serve on this thread until ``stopping`` is set, then stop listening."""
        try:
            while not stopping.is_set():
                self._server.handle_request()  # returns after _POLL without a request
        finally:
            self._server.server_close()

    def close(self) -> None:
        """Stop listening."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        self._server.server_close()


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    host = host.removeprefix("::ffff:")  # of IPv4 on a dual-stack socket
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def known_host(header: str | None, own: str) -> bool:
    """Whether a Host header names this server: by an address, its configured name, or a name without a dot.

    Names without a dot (``localhost``, a host or a service of the local network) cannot be registered by a stranger.
    """
    if not header:
        return False
    name = header.strip().lower()
    if not name.startswith("["):
        name = name.partition(":")[0]
        if name and ("." not in name or name == own.lower()):
            return True
    name = name[1:].partition("]")[0] if name.startswith("[") else name
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class _LimitedRequest(io.RawIOBase):
    """Bytes of a request up to the size and time limits, then end of file."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__()
        self._connection = connection
        self._deadline = time.monotonic() + _MAX_SECONDS
        self._left = _MAX_BYTES

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        seconds = self._deadline - time.monotonic()
        if seconds <= 0 or self._left <= 0:
            return 0
        self._connection.settimeout(seconds)
        try:
            count = self._connection.recv_into(buffer, min(len(buffer), self._left))
        except OSError:
            return 0
        self._left -= count
        return count


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 16
    timeout = _POLL

    def __init__(self, address: tuple[str, int], routes: Mapping[str, Route], name: str) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.routes, self.host = routes, address[0]
        self._name = name
        self._errors = RateLimitedErrors(log)
        # whether from this machine: its health checks must not wait for remote readers
        self._free = {local: threading.BoundedSemaphore(MAX_CONNECTIONS) for local in (True, False)}
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        socketserver.TCPServer.server_bind(self)  # HTTPServer's asks the name service for this host's name
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve on a thread, or hang up if too many connections are open."""
        free = self._free[is_loopback(str(client_address[0]))]
        if free.acquire(blocking=False):
            try:
                super().process_request(request, client_address)
            except BaseException:  # no thread can be started
                free.release()
                raise
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free[is_loopback(str(client_address[0]))].release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report our own errors; a reader that leaves or is cut off is not an error."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            self._errors.report(self._name, error)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    server_version = "coview-stream"
    sys_version = ""

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(_LimitedRequest(self.connection))

    def do_GET(self) -> None:
        if not known_host(self.headers.get("Host"), self.server.host):
            reply: Reply | EventStream = Reply(b"this host goes by another name\n", code=421)
        else:
            reply = Reply(b"there is no such page\n", code=404)
            routes, path = self.server.routes, self.path.partition("?")[0]
            head, slash, rest = path.rpartition("/")
            parent = head + slash
            if path in routes and (path == "/" or not path.endswith("/")):
                reply = routes[path]("")
            elif parent != "/" and parent in routes and rest:
                reply = routes[parent](rest)
        self.connection.settimeout(_SEND_TIMEOUT)
        if isinstance(reply, Reply):
            self._begin(reply.code, reply.kind, len(reply.body))
            self.wfile.write(reply.body)
            return
        try:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            first = next(reply)  # from here on close() runs its end
            self._begin(200, "text/event-stream; charset=utf-8", None)
            self.wfile.write(first)
            for events in reply:
                self.wfile.write(events)
        finally:
            reply.close()

    def _begin(self, code: int, kind: str, length: int | None) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        if length is not None:
            self.send_header("Content-Length", str(length))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Log no requests."""
