"""A proxy on loopback whose TCP link can be spoilt; it runs in a process of its own."""

from __future__ import annotations

import asyncio
import random
import socket
from multiprocessing.connection import Connection

# modes: open; cut; flapping, a cut every 2 s; silent, half-open: nothing passes or ends; slow, 200 ms each way; thin,
# 1 Mbit/s each way; lossy, a fifth of the pieces comes 200 ms later, as TCP's repeats do; corrupt, flipped bits
_PIECE, _WINDOW = 16_384, 65_536  # bytes; of the receive buffer: a thin link must not hold seconds of data
_LATE, _THIN, _LOST, _EVERY, _FLIPS = 0.2, 125_000.0, 0.2, 2.0, 0.05  # s, bytes per s, share of pieces, s, share


class Link:
    """Forwards connections from ``port`` to ``target``, both on loopback."""

    def __init__(self, port: int, target: int, seed: int) -> None:
        self._port, self._target = port, target
        self._rng = random.Random(seed)
        self._mode = "open"
        self._open: set[asyncio.StreamWriter] = set()

    async def run(self, conn: Connection) -> None:
        """Forward until None is received; every other order is a mode."""
        ended = asyncio.Event()

        def order() -> None:
            if (mode := conn.recv()) is None:
                ended.set()
                return
            self._mode = mode
            if mode == "cut":
                self._cut()

        with socket.socket() as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WINDOW)
            listener.bind(("127.0.0.1", self._port))
            server = await asyncio.start_server(self._accept, sock=listener.dup())
        asyncio.get_running_loop().add_reader(conn.fileno(), order)
        flapper = asyncio.create_task(self._flap())
        conn.send("ready")
        async with server:
            await ended.wait()
            flapper.cancel()
            self._cut()

    async def _flap(self) -> None:
        while True:
            await asyncio.sleep(_EVERY)
            if self._mode == "flapping":
                self._cut()

    def _cut(self) -> None:
        for writer in self._open:
            writer.transport.abort()
        self._open.clear()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            if self._mode == "cut":
                raise ConnectionRefusedError
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.transport.abort()
            return
        ends = {writer, far_writer}
        self._open |= ends
        tasks = [asyncio.create_task(self._pass(*way)) for way in ((reader, far_writer), (far_reader, writer))]
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for end in ends:
            end.transport.abort()
        self._open -= ends
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        loop, due = asyncio.get_running_loop(), 0.0
        while piece := await reader.read(_PIECE):
            while self._mode == "silent":
                await asyncio.sleep(0.05)
            late = self._mode == "slow" or (self._mode == "lossy" and self._rng.random() < _LOST)
            if self._mode == "thin":
                await asyncio.sleep(len(piece) / _THIN)
            elif self._mode == "corrupt" and self._rng.random() < _FLIPS:
                broken = bytearray(piece)
                broken[self._rng.randrange(len(broken))] ^= 1 << self._rng.randrange(8)
                piece = bytes(broken)
            due = max(due + 1e-6, loop.time() + _LATE * late)  # pieces keep their order
            loop.call_at(due, writer.write, piece)
            await writer.drain()


def forward(conn: Connection, port: int, target: int, seed: int) -> None:
    """Run a link until None is received."""
    asyncio.run(Link(port, target, seed).run(conn))
