"""Targets of the fuzzing: functions of bytes that return a value or raise a CoViewError, whatever the bytes are."""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

Target = Callable[[bytes], object]


def _file(name: str, read: Callable[[Path], object]) -> Target:
    """Return a target that reads its bytes from a file of that name, in memory where the machine has such a place."""
    place = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="coview-fuzz-", dir=place if os.access(place, os.W_OK) else None))
    path = folder / name

    def run(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return run


def _cloud(name: str) -> Target:
    import laspy  # noqa: F401 - now, so its coverage is seen

    from coview_stream.clouds import read_cloud

    return _file(name, read_cloud)


def _message(kind: str, codec: str) -> Target:
    from coview_stream import messages
    from coview_stream.messages.types import Sample

    decode: Any = getattr(messages, f"decode_{kind}")

    def run(data: bytes) -> object:
        # the first byte says how much of the rest stands beside the payload
        beside = data[0] % 41 if data else 0
        return decode(Sample("coview/r1/in", data[1 + beside :], "", data[1 : 1 + beside] or None), codec)

    return run


def _encoding() -> Target:
    from coview_stream import messages
    from coview_stream.errors import CoViewError
    from coview_stream.messages.types import Sample

    def run(data: bytes) -> object:
        encoding, _, rest = data.partition(b"\n")
        key, _, payload = rest.partition(b"\n")
        sample = Sample(key.decode("utf-8", "replace"), payload, encoding.decode("utf-8", "replace"))
        for decode in (messages.decode_cloud, messages.decode_odometry, messages.decode_pose):
            try:
                decode(sample)
            except CoViewError:
                continue
        return None

    return run


def _trajectory() -> Target:
    from coview_stream.clouds.trajectory import read_kitti_poses, read_times, read_tum

    readers = [_file("a.txt", reader) for reader in (read_tum, read_kitti_poses, read_times)]
    return lambda data: readers[data[0] % 3](data[1:]) if data else None


def _map() -> Target:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.errors import MapError

    def use(path: Path) -> object:
        with contextlib.suppress(MapError):  # nearly always the checksum: an attacker would have it right
            BaseMap.load(path)
        loaded = BaseMap.load(path, check=False)
        if loaded.learned is not None:
            loaded.learned.check()
        loaded.surveyed(np.zeros((1, 2)))
        return loaded.crop(np.zeros(3), 5.0)

    return _file("a.coview", use)


def _state() -> Target:
    from coview_stream.stream.node import last_place

    logging.getLogger("coview_stream").setLevel(logging.CRITICAL)
    name = last_place.file_of(Path(), "r1", "0" * 64).name
    return _file(name, lambda path: last_place.load(path.parent, "r1", "0" * 64))


def _bag(name: str) -> Target:
    import rosbags.rosbag1
    import rosbags.rosbag2  # noqa: F401 - as above

    from coview_stream.recordings.open_run import open_run

    def use(path: Path) -> object:
        run = open_run(path)
        return run.read(0) if len(run) else None

    return _file(name, use)


def _ignore(*said: object, **more: object) -> None:
    """Take a reply."""


def _rpc() -> Target:
    from coview_stream.errors import CoViewError
    from coview_stream.messages.json_messages import read_object
    from coview_stream.stream.client.fleet_table import FleetTable
    from coview_stream.stream.node.status import NodeIdentity
    from coview_stream.stream.transport import zenoh_io
    from coview_stream.stream.transport.error_guard import RateLimitedErrors
    from coview_stream.stream.transport.transport import MAX_REPLY

    log = logging.getLogger("coview_stream")
    log.setLevel(logging.CRITICAL)

    def run(data: bytes) -> object:
        text = data.decode("utf-8", "replace")
        pairs = [(name, value) for name, _, value in (part.partition("=") for part in text.split(";"))]
        answers = zenoh_io.Answers(RateLimitedErrors(log))
        query = SimpleNamespace(parameters=pairs, key_expr="k", reply=_ignore, reply_err=_ignore)
        answers.callback("k", dict)(query)
        answers.end()
        answers.run()
        zenoh_io._error_of(data)
        NodeIdentity.read(data)
        with contextlib.suppress(CoViewError):
            table = FleetTable()
            table.add_status("r1", read_object(data), 1.0)
            table.table(2.0)
        return zenoh_io._json_object("k", data, MAX_REPLY)

    return run


TARGETS: dict[str, Callable[[], Target]] = {
    **{
        f"{kind}-{codec}": (lambda kind=kind, codec=codec: _message(kind, codec))  # type: ignore[misc]
        for kind, codecs in {
            "cloud": ("xyz", "xyzi", "foxglove", "cdr", "keelson"),
            "odometry": ("json", "foxglove", "cdr", "keelson"),
            "pose": ("json", "foxglove", "cdr", "keelson"),
        }.items()
        for codec in codecs
    },
    "encoding": _encoding,
    **{suffix: (lambda suffix=suffix: _cloud(f"a.{suffix}")) for suffix in ("las", "laz", "ply", "pcd", "npy", "bin")},  # type: ignore[misc]
    "trajectory": _trajectory,
    "map": _map,
    "state": _state,
    "mcap": lambda: _bag("a.mcap"),
    "db3": lambda: _bag("a.db3"),
    "bag": lambda: _bag("a.bag"),
    "rpc": _rpc,
}
"""By name: makes the target, with all imports that it needs."""
