"""Web page of a session: its files, the map and the events, on an HTTP server. Read-only, without dependencies."""

from __future__ import annotations

from importlib import resources

from coview_stream.stream.transport.http_server import EventStream, HttpServer, Reply, Route
from coview_stream.viewers.web_sink import WebHub, WebSink

WEB_ADDRESS = "127.0.0.1:8642"
"""Default address of the page."""

_TICK = 1.0  # seconds between signs of life
_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
_FILES = ("index.html", "style.css", "page.js", "state.js", "raster.js", "view.js", "cards.js", "icon.svg")


class WebPage:
    """A page, served once created; add :attr:`sink` to a feed, which closes it. ``url`` is its address.

    Raises:
        ConfigError: ``address`` (``HOST:PORT``) is malformed or cannot be bound.
    """

    def __init__(self, address: str) -> None:
        self._hub = WebHub()
        self.sink = WebSink(self._hub, self.close)
        folder = resources.files("coview_stream.viewers") / "web"
        routes: dict[str, Route] = {f"/{name}": _file((folder / name).read_bytes(), name) for name in _FILES}
        routes |= {"/": routes["/index.html"], "/map/": self._map, "/events": self._events}
        self._server = HttpServer(address, routes, ("--web", WEB_ADDRESS))
        self.url = self._server.url
        self._server.start()

    def close(self) -> None:
        """End all streams and stop listening."""
        self._hub.close()
        self._server.close()

    def _map(self, sha256: str) -> Reply:
        packed = self.sink.maps.get(sha256)
        if packed is None:
            return Reply(b"there is no such map\n", code=404)
        return Reply(packed, "application/octet-stream")

    def _events(self, _: str) -> Reply | EventStream:
        page = self._hub.open_page()
        if page is None:
            return Reply(b"too many pages are open\n", code=503)

        def stream() -> EventStream:
            try:
                yield b"retry: 1000\n\n"
                while not page.closed:
                    yield page.take(_TICK) or b"event: tick\ndata: {}\n\n"
            finally:
                self._hub.close_page(page)

        return stream()


def _file(content: bytes, name: str) -> Route:
    reply = Reply(content, f"{_TYPES[name.rpartition('.')[2]]}; charset=utf-8")
    return lambda _: reply
