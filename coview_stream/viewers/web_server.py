"""HTTP server of the web page: files of this package, the map, and events as they come. Read only, no dependency.

Only GET; nothing that comes in is acted upon. A request with a Host that is a stranger's name is refused, for a page of
another site may have had its name point here (DNS rebinding). No other origin may read what is served.
"""

from __future__ import annotations

import io
import ipaddress
import logging
import socket
import socketserver
import sys
import threading
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

from coview_stream.errors import ConfigError
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.limited_request import LimitedRequest
from coview_stream.viewers.web_hub import WebHub

log = logging.getLogger("coview_stream.web")

WEB_ADDRESS = "127.0.0.1:8642"
"""Where the page is served unless something else is said."""

# set by hand
_MAX_CONNECTIONS = 32
_SEND_TIMEOUT = 4.0  # seconds that a page may take none of its events before it is dropped
_SEND_BUFFER = 1 << 18  # bytes that may be on their way to a page
_TICK = 1.0  # seconds between signs of life
_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
_FILES = ("index.html", "style.css", "page.js", "state.js", "raster.js", "view.js", "cards.js", "icon.svg")
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class WebServer:
    """Server of the page of one hub.

    Args:
        address: ``HOST:PORT``; port 0 takes any that is free. Other hosts reach it only if ``HOST`` is an address of
            this one that they reach; there is no password.
        hub: has the events.
        maps: by hash, as :func:`coview_stream.viewers.web_sink.packed_map` makes them.

    Attributes:
        url: of the page.

    Raises:
        ConfigError: ``address`` is none, or cannot be listened on.
    """

    def __init__(self, address: str, hub: WebHub, maps: Mapping[str, bytes]) -> None:
        host, _, port = address.rpartition(":")
        host = host.strip("[]") or "127.0.0.1"
        try:
            self._server = _Server((host, int(port)), hub, maps)
        except (OSError, ValueError, OverflowError) as error:
            raise ConfigError(f"--web {address!r}: {error}; give HOST:PORT, such as {WEB_ADDRESS}") from error
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.server_port}/"
        self._loopback = is_loopback(host)
        self._hub = hub
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="coview-web", daemon=True)

    def start(self) -> None:
        """Serve on threads of its own."""
        if not self._loopback:
            log.warning("%s can be seen by all who reach this address: there is no password", self.url)
        self._thread.start()

    def close(self) -> None:
        """End all pages and stop listening."""
        self._hub.close()
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join(1.0)
        self._server.server_close()


def is_loopback(host: str) -> bool:
    """Tell whether only this machine reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def known_host(header: str | None, own: str) -> bool:
    """Tell whether a Host header names this server: by an address, by ``localhost`` or by the name it was given."""
    if not header:
        return False
    name = header.strip().lower()
    name = name[1:].partition("]")[0] if name.startswith("[") else name.partition(":")[0]
    if name in ("localhost", own.lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 16

    def __init__(self, address: tuple[str, int], hub: WebHub, maps: Mapping[str, bytes]) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.hub, self.maps, self.host = hub, maps, address[0]
        self.errors = RateLimitedErrors(log)
        self._free = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        folder = resources.files("coview_stream.viewers") / "web"
        self.files = {name: (folder / name).read_bytes() for name in _FILES}
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        socketserver.TCPServer.server_bind(self)  # HTTPServer's asks the name service for this host's name
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve on a thread, unless too many are: who comes then is hung up on."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report what is not a reader's own business, as it is to go away or to be cut off."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            self.errors.report("web", error)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    server_version = "coview-stream"
    sys_version = ""

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(LimitedRequest(self.connection))

    def do_GET(self) -> None:
        if not known_host(self.headers.get("Host"), self.server.host):
            self._reply(421, "text/plain", b"this host goes by another name\n")
            return
        path = self.path.partition("?")[0]
        name = path.strip("/") or "index.html"
        if path == "/events":
            self._events()
        elif path.startswith("/map/"):
            packed = self.server.maps.get(path[len("/map/") :])
            if packed is None:
                self._reply(404, "text/plain", b"there is no such map\n")
            else:
                self._reply(200, "application/octet-stream", packed)
        elif name in self.server.files:
            kind = _TYPES[name.rpartition(".")[2]]
            self._reply(200, f"{kind}; charset=utf-8", self.server.files[name])
        else:
            self._reply(404, "text/plain", b"there is no such page\n")

    def _events(self) -> None:
        page = self.server.hub.open_page()
        if page is None:
            self._reply(503, "text/plain", b"too many pages are open\n")
            return
        try:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            self.connection.settimeout(_SEND_TIMEOUT)
            self._begin(200, "text/event-stream; charset=utf-8", None)
            self.wfile.write(b"retry: 1000\n\n")
            while not page.closed:
                self.wfile.write(page.take(_TICK) or b"event: tick\ndata: {}\n\n")
        finally:
            self.server.hub.close_page(page)

    def _reply(self, code: int, kind: str, body: bytes) -> None:
        self.connection.settimeout(_SEND_TIMEOUT)
        self._begin(code, kind, len(body))
        self.wfile.write(body)

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
