"""Random bytes and almost valid messages, for every input key of a robot."""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection

import numpy as np

from bench.stream.client import open_session
from bench.stream.drive import EPOCH_NS
from bench.stream.wire import CLOUDS, ENCODINGS, ODOMETRY, Message

_LARGE = 1 << 20
_RUBBISH = (
    b"", b"{}", b"null", b"[" * 5000, b'{"stamp_ns": 1e400}', b"\xff\xfe",
    b'{"stamp_ns": 1, "position": [0, 0], "orientation": [0, 0, 0, 1]}',
    b'{"stamp_ns": 1, "position": [NaN, 0, 0], "orientation": [0, 0, 0, 1]}',
    b'{"stamp_ns": 1, "position": [0, 0, 0], "orientation": [0, 0, 0, 0]}',
    b'{"stamp_ns": "x", "position": "y", "orientation": null}',
    b'{"stamp_ns": ' + b"9" * 5000 + b', "position": [0,0,0], "orientation": [0,0,0,1]}',
    b"\0\1\0\0" + b"\xff" * 400, b"\0\0\0\0" + b"\0" * 60,
)  # fmt: skip
_STRANGE = (
    "",
    "text/plain",
    "application/x-unheard-of",
    "application/cdr;some_msgs/msg/Other",
    "a;b;c;d",
    "image/png",
)


def rubbish(seed: int) -> Iterator[Message]:
    """Endless: random bytes, fixed nasties, and valid messages with flipped bytes or a missing end."""
    rng = random.Random(seed)
    points = np.zeros((300, 3), np.float32)
    valid = [make(points, EPOCH_NS) for make in CLOUDS.values()]
    valid += [make(np.eye(4), EPOCH_NS) for make in ODOMETRY.values()]
    while True:
        draw = rng.random()
        encoding = rng.choice((*ENCODINGS, *_STRANGE, f"x{rng.randrange(10**6)}/y"))
        attachment = rng.choice((None, b"", rng.randbytes(8), rng.randbytes(33), struct.pack("<q", EPOCH_NS)))
        if draw < 0.5:
            yield rng.randbytes(rng.randrange(5001)), encoding, attachment
        elif draw < 0.52:
            yield rng.randbytes(_LARGE), encoding, attachment
        elif draw < 0.65:
            yield rng.choice(_RUBBISH), encoding, attachment
        else:
            payload, true, beside = rng.choice(valid)
            broken = bytearray(payload[: rng.randrange(len(payload))] if rng.random() < 0.5 else payload)
            for _ in range(rng.randrange(1, 9)):
                if broken:
                    broken[rng.randrange(len(broken))] = rng.randrange(256)
            yield bytes(broken), true, rng.choice((beside, beside, None, rng.randbytes(8)))


def vandalise(
    conn: Connection, endpoint: str, robots: Sequence[str], rate: float, base: str = "coview"
) -> None:
    """Send rubbish to the robots' inputs, ``rate`` messages a second, until told to stop; sends back how many."""
    source = rubbish(7)
    keys = [f"{base}/{robot}/in/{name}" for robot in robots for name in ("cloud", "odom")]
    with open_session("client", connect=[endpoint]) as session:
        conn.send("ready")
        due, count = float(conn.recv()), 0
        while not conn.poll(max(0.0, due - time.monotonic())):
            payload, encoding, attachment = next(source)
            session.put(keys[count % len(keys)], payload, encoding=encoding or None, attachment=attachment)
            count += 1
            due = max(due + 1.0 / rate, time.monotonic() - 0.5)
    conn.send(count)
