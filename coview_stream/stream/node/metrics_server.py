"""HTTP server for health and metrics: two pages, read only, one reader at a time, on a thread of its own."""

from __future__ import annotations

import io
import json
import logging
import socket
import socketserver
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from coview_stream.config.node import METRICS_ADDRESS
from coview_stream.errors import ConfigError
from coview_stream.stream.node.health import prometheus_text
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.limited_request import MAX_SECONDS, LimitedRequest

log = logging.getLogger("coview_stream.node")


class MetricsServer:
    """Answers ``GET /metrics`` (Prometheus) and ``GET /health`` (JSON; 200 if the node is ready, 503 if not).

    A reader that sends or reads slowly is cut off after two seconds, and holds up other readers only.

    Args:
        address: ``HOST:PORT``; other hosts reach it only if ``HOST`` is an address of this one that they reach.
        document: gives the document of :class:`~coview_stream.stream.node.health.NodeHealth`.

    Raises:
        ConfigError: ``address`` is none, or cannot be listened on.
    """

    def __init__(self, address: str, document: Callable[[], dict[str, Any]]) -> None:
        host, _, port = address.rpartition(":")
        try:
            self._server = _Server((host.strip("[]") or "127.0.0.1", int(port)), document)
        except (OSError, ValueError, OverflowError) as error:
            raise ConfigError(f"--metrics {address!r}: {error}; give HOST:PORT, such as {METRICS_ADDRESS}") from error
        self.address = f"{host or '127.0.0.1'}:{self._server.server_port}"

    def run(self, stopping: threading.Event) -> None:
        """Serve until ``stopping`` is set."""
        log.info("metrics at http://%s/metrics", self.address)
        try:
            while not stopping.is_set():
                self._server.handle_request()  # comes back after a while without one
        finally:
            self.close()

    def close(self) -> None:
        """Stop listening."""
        self._server.server_close()


class _Server(HTTPServer):
    timeout = 0.2  # seconds of handle_request without a request
    request_queue_size = 5

    def __init__(self, address: tuple[str, int], document: Callable[[], dict[str, Any]]) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.document = document
        self.errors = RateLimitedErrors(log)
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        socketserver.TCPServer.server_bind(self)  # HTTPServer's asks the name service for this host's name
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report what is not a reader's own business, as it is to go away or to be cut off."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            self.errors.report("metrics", error)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    server_version = "coview-stream"
    sys_version = ""

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(LimitedRequest(self.connection))

    def do_GET(self) -> None:
        page = self.path.partition("?")[0]
        if page not in ("/metrics", "/health"):
            self._reply(404, "text/plain", "there is /metrics and /health\n")
            return
        document = self.server.document()
        if page == "/metrics":
            self._reply(200, "text/plain; version=0.0.4; charset=utf-8", prometheus_text(document))
        else:
            self._reply(200 if document["ready"]["ok"] else 503, "application/json", json.dumps(document) + "\n")

    def _reply(self, code: int, kind: str, text: str) -> None:
        body = text.encode()
        self.connection.settimeout(MAX_SECONDS)
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Log no requests."""
