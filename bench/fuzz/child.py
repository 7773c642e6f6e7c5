"""Fuzzing targets, and the process that runs them: ``python -m bench.fuzz.child NAMES CORPUS FOUND SECONDS SEED``.

A target is a function of bytes that returns a value or raises a CoViewError. Another exception is a finding, and FOUND
gets its input, once per place in the code. Memory is limited, and an input that takes too long ends the process, so
``FOUND/result.json`` is written often. With 0 seconds the process replays the corpora of all targets in NAMES
(separated by commas).
"""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import functools
import hashlib
import json
import logging
import os
import random
import resource
import shutil
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np

GUIDED = find_spec("atheris") is not None  # it instruments modules on import
if GUIDED:
    import atheris
with atheris.instrument_imports(include=["coview_stream", "rosbags", "laspy"]) if GUIDED else contextlib.nullcontext():
    import laspy  # noqa: F401 - here, so its coverage is seen
    import rosbags.rosbag1
    import rosbags.rosbag2  # noqa: F401 - likewise

    from bench.fuzz import wrong
    from coview_kernels import warm_up
    from coview_stream import messages
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.site.manifest import Manifest
    from coview_stream.clouds import read_cloud
    from coview_stream.clouds.trajectory import read_kitti_poses, read_times, read_tum
    from coview_stream.errors import CoViewError, MapError
    from coview_stream.messages.json_messages import read_object
    from coview_stream.messages.types import Sample
    from coview_stream.recordings.open_run import open_run
    from coview_stream.stream.client.fleet_table import FleetTable
    from coview_stream.stream.node import last_place
    from coview_stream.stream.transport import zenoh_io
    from coview_stream.stream.transport.error_guard import RateLimitedErrors
    from coview_stream.stream.transport.keys import NodeIdentity
    from coview_stream.stream.transport.transport import MAX_REPLY

Target = Callable[[bytes], object]
LOG = logging.getLogger("coview_stream")


@functools.cache
def _folder() -> Path:
    """Create a folder, in memory if the machine has /dev/shm."""
    memory = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="coview-fuzz-", dir=memory if os.access(memory, os.W_OK) else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _file(name: str, read: Callable[[Path], object], data: bytes) -> object:
    path = _folder() / name
    path.write_bytes(data)
    return read(path)


def _in_folder(whole: Callable[[Path, bytes], object], data: bytes) -> object:
    os.environ["COVIEW_CACHE"] = str(_folder() / "cache")
    return whole(_folder(), data)


def _message(decode: Callable[[Sample, str], object], codec: str, data: bytes) -> object:
    size = data[0] % 41 if data else 0  # of the attachment
    return decode(Sample("coview/r1/in", data[1 + size :], "", data[1 : 1 + size] or None), codec)


def _encoding(data: bytes) -> None:
    encoding, key, payload = (*data.split(b"\n", 2), b"", b"")[:3]
    sample = Sample(key.decode("utf-8", "replace"), payload, encoding.decode("utf-8", "replace"))
    for decode in (messages.decode_cloud, messages.decode_odometry, messages.decode_pose):
        with contextlib.suppress(CoViewError):
            decode(sample)


def _trajectory(data: bytes) -> object:
    readers: tuple[Callable[[Path], object], ...] = (read_tum, read_kitti_poses, read_times)
    return _file("a.txt", readers[data[0] % 3], data[1:]) if data else None


def _map(path: Path) -> object:
    with contextlib.suppress(MapError):  # nearly always the checksum: an attacker would have it right
        BaseMap.load(path)
    loaded = BaseMap.load(path, check=False)
    if loaded.learned is not None:
        loaded.learned.check()
    loaded.surveyed(np.zeros((1, 2)))
    return loaded.crop(np.zeros(3), 5.0)


def _state(data: bytes) -> object:
    name = last_place.file_of(Path(), "r1", "0" * 64).name
    return _file(name, lambda path: last_place.load(path.parent, "r1", "0" * 64), data)


def _bag(path: Path) -> object:
    run = open_run(path)
    return run.read(0) if len(run) else None


def _rpc(data: bytes) -> object:
    pairs = [tuple(part.partition("=")[::2]) for part in data.decode("utf-8", "replace").split(";")]
    answers = zenoh_io.Answers(RateLimitedErrors(LOG))
    query = SimpleNamespace(parameters=pairs, key_expr="k", reply=Mock(), reply_err=Mock())
    answers.callback("k", dict, threading.Event())(query)
    answers.end()
    answers.run()
    zenoh_io._error_of(data)
    NodeIdentity.read(data)
    with contextlib.suppress(CoViewError):
        table = FleetTable()
        table.add_status("r1", read_object(data), 1.0)
        table.table(2.0)
    return zenoh_io._json_object("k", data, MAX_REPLY)


_P = functools.partial
_CODECS: dict[str, tuple[Callable[..., object], tuple[str, ...]]] = {
    "cloud": (messages.decode_cloud, ("xyz", "xyzi", "foxglove", "cdr", "keelson")),
    "odometry": (messages.decode_odometry, ("json", "foxglove", "cdr", "keelson")),
    "pose": (messages.decode_pose, ("json", "foxglove", "cdr", "keelson")),
}
TARGETS: dict[str, Target] = {
    **{f"{kind}-{c}": _P(_message, decode, c) for kind, (decode, codecs) in _CODECS.items() for c in codecs},
    "encoding": _encoding,
    **{end: _P(_file, f"a.{end}", read_cloud) for end in ("las", "laz", "ply", "pcd", "npy", "bin")},
    "trajectory": _trajectory,
    "map": _P(_file, "a.coview", _map),
    "manifest": lambda data: Manifest.from_bytes(data, "manifest.json"),
    **{name: _P(_in_folder, whole) for name, whole in wrong.TARGETS.items()},
    "state": _state,
    **{end: _P(_file, f"a.{end}", _bag) for end in ("mcap", "db3", "bag")},
    "rpc": _rpc,
}

LIMIT_S = 10  # seconds of one input of a few kB: a hundred times more than any of them needs
LIMIT_WHOLE_S = 60  # of a whole map, which is built
MEMORY = 2 << 30  # bytes besides the libraries: LAZ and PCD may unpack to a hundred times
MAX_INPUT = 32_768  # bytes: the largest seed, a database, has 28 kB
_ODD = (bytes(4), b"\xff" * 4, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\xff" * 8, b"-1", b"1e999", b"nan", b"[")


class Watch:
    """A target and its counts: executions, accepted inputs, findings by place."""

    def __init__(self, name: str, found: Path) -> None:
        self._target, self._found, self._written = TARGETS[name], found, 0.0
        self._limit = LIMIT_WHOLE_S if name in wrong.TARGETS else LIMIT_S
        self.books: dict[str, Any] = {"executions": 0, "values": 0, "honest_mb": 0.0, "peak_mb": 0.0, "places": {}}

    def __call__(self, data: bytes) -> None:
        """Run one input."""
        self.books["executions"] += 1
        try:
            self._target(data)
            self.books["values"] += 1
        except CoViewError:
            pass
        except Exception as error:
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "coview_" in f.filename]
            where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
            if (place := f"{type(error).__name__} at {where}") not in self.books["places"]:
                self.books["places"][place] = f"{error}"[:200]
                (self._found / f"found-{hashlib.sha256(data).hexdigest()[:12]}").write_bytes(data)
                self.write()
        if time.monotonic() > self._written + 0.5:
            self.write()

    def within_time(self, data: bytes) -> None:
        """Run one input; keep it as ``current`` in case it ends the process."""
        (self._found / "current").write_bytes(data)
        faulthandler.dump_traceback_later(self._limit, exit=True)
        self(data[:MAX_INPUT])
        faulthandler.cancel_dump_traceback_later()

    def write(self, done: bool = False) -> None:
        """Write the counts; ``done`` states that no input ended the process."""
        self._written = time.monotonic()
        self.books["peak_mb"] = _peak_mb()
        (self._found / "result.part").write_text(json.dumps(self.books | {"done": done}))
        (self._found / "result.part").replace(self._found / "result.json")


def _peak_mb() -> float:
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def mutated(rng: random.Random, seeds: list[bytes]) -> bytes:
    """Return a seed, changed at random, for machines without atheris."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, 6)):
        at, size = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 4, 8, 64))
        other = rng.choice(seeds)
        begin = rng.randrange(len(other) + 1)
        piece, odd = other[begin : begin + size], rng.choice(_ODD)
        cut, new = rng.choice(
            ((1, rng.randbytes(1)), (len(odd), odd), (size, b""), (0, piece), (0, data[at : at + size]))
        )
        data[at : at + cut] = new
    return bytes(data)


def main(names: str, corpus: Path, found: Path, seconds: float, seed: int) -> None:
    """Fuzz one target, or replay several."""
    LOG.setLevel(logging.CRITICAL)
    if set(names.split(",")) & set(wrong.TARGETS):
        warm_up("nearest")  # the kernels' library reserves a gigabyte of addresses at its start
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    if GUIDED and seconds:
        options = [
            f"-max_total_time={max(1, round(seconds))}", f"-timeout={LIMIT_S}", "-rss_limit_mb=0", f"-seed={seed}",
            f"-max_len={MAX_INPUT}", f"-artifact_prefix={found}/",
        ]  # fmt: skip
        watch = Watch(names, found)
        atheris.Setup([sys.argv[0], *options, str(found / "corpus"), str(corpus)], watch)
        atheris.Fuzz()
        return
    if os.environ.get("TI_DEBUG"):  # bounds checks of kernels; it also tells each overflow of a hash
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    rng = random.Random(seed)
    for name in names.split(","):
        place, own = (found, corpus) if seconds else (found / name, corpus / name)
        place.mkdir(exist_ok=True)
        files = sorted(own.iterdir(), key=lambda path: (not path.name.startswith("seed"), path.name))
        seeds, watch = [path.read_bytes() for path in files], Watch(name, place)
        end = time.monotonic() + seconds
        for file, data in zip(files, seeds, strict=True):
            (watch if seconds else watch.within_time)(data)  # the first one may build a map, and compile kernels
            if file.name.startswith("seed"):
                watch.books["honest_mb"] = _peak_mb()
        while time.monotonic() < end:
            watch.within_time(rng.randbytes(8) if name in wrong.TARGETS else mutated(rng, seeds))
        watch.write(done=True)
        (place / "current").unlink(missing_ok=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]))
