"""A TCP link on loopback whose mode a test can change; see bench/soak/link.py for the modes."""

from __future__ import annotations

import multiprocessing
from types import TracebackType

from sockets import free_endpoint

from bench.soak.link import forward


class BadLink:
    """Forwards from ``endpoint`` to another one, in a process of its own."""

    def __init__(self, target: str, seed: int = 1) -> None:
        self.endpoint = free_endpoint()
        ports = [int(each.rsplit(":", 1)[1]) for each in (self.endpoint, target)]
        context = multiprocessing.get_context("spawn")
        self._conn, far = context.Pipe()
        self._process = context.Process(target=forward, args=(far, *ports, seed), daemon=True)
        self._process.start()
        assert self._conn.recv() == "ready"

    def mode(self, name: str) -> None:
        self._conn.send(name)

    def __enter__(self) -> BadLink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._conn.send(None)
        self._process.join(10)
        if self._process.is_alive():
            self._process.kill()
