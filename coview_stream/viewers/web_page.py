"""The web page of a session: hub, sink and server put together."""

from __future__ import annotations

from coview_stream.viewers.scene import Sink
from coview_stream.viewers.web_hub import WebHub
from coview_stream.viewers.web_server import WebServer
from coview_stream.viewers.web_sink import WebSink


class WebPage:
    """A page that is served from its creation on; add :attr:`sink` to a feed, which closes it.

    Args:
        address: ``HOST:PORT``.

    Attributes:
        url: of the page.
        sink: takes in what there is to see.

    Raises:
        ConfigError: ``address`` is none, or cannot be listened on.
    """

    def __init__(self, address: str) -> None:
        hub = WebHub()
        sink = _ClosingSink(hub)
        self._server = WebServer(address, hub, sink.maps)
        sink.server = self._server
        self.sink: Sink = sink
        self.url = self._server.url
        self._server.start()

    def close(self) -> None:
        """End all pages and stop listening."""
        self._server.close()


class _ClosingSink(WebSink):
    server: WebServer | None = None

    def close(self) -> None:
        if self.server is not None:
            self.server.close()
