"""Process that fuzzes a target or replays inputs: ``python -m bench.fuzz.child NAME CORPUS FOUND SECONDS WAY SEED``.

Its memory is limited, and an input that takes too long ends it. An exception that is no CoViewError is a finding: the
input is kept in FOUND, once for each place that raised, and the fuzzing goes on. ``FOUND/result.json`` is written now
and then, because an input may end the process. With 0 seconds it replays the corpora of several targets, separated by
commas, once. It imports the product late: atheris instruments modules as they are imported.
"""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import random
import resource
import sys
import time
import traceback
from pathlib import Path
from typing import Any

LIMIT_S = 10  # seconds of one input of a few kB: a hundred times more than any of them needs
MEMORY = 2 << 30  # bytes besides the libraries: LAZ and PCD may unpack to a hundred times
MAX_INPUT = 32_768  # bytes: the largest seed, a database, has 28 kB
_ODD = (bytes(4), b"\xff" * 4, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\xff" * 8, b"-1", b"1e999", b"nan", b"[")


class Watch:
    """A target with its books: executions, accepted inputs, findings by place."""

    def __init__(self, target: Any, found: Path) -> None:
        from coview_stream.errors import CoViewError

        self._expected, self._target, self._found = CoViewError, target, found
        self.books: dict[str, Any] = {"executions": 0, "values": 0, "places": {}}
        self._written = 0.0

    def __call__(self, data: bytes) -> None:
        """Run one input."""
        self.books["executions"] += 1
        try:
            self._target(data)
            self.books["values"] += 1
        except self._expected:
            pass
        except (Exception, RecursionError) as error:
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "coview_" in f.filename]
            where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
            if (place := f"{type(error).__name__} at {where}") not in self.books["places"]:
                self.books["places"][place] = f"{error}"[:200]
                (self._found / f"found-{hashlib.sha256(data).hexdigest()[:12]}").write_bytes(data)
                self.write()
        if time.monotonic() > self._written + 0.5:
            self.write()

    def within_time(self, data: bytes) -> None:
        """Run one input, which is kept as ``current`` in case it ends the process."""
        (self._found / "current").write_bytes(data)
        faulthandler.dump_traceback_later(LIMIT_S, exit=True)
        self(data[:MAX_INPUT])
        faulthandler.cancel_dump_traceback_later()

    def write(self) -> None:
        """Write the books."""
        self._written = time.monotonic()
        (self._found / "result.part").write_text(json.dumps(self.books))
        (self._found / "result.part").replace(self._found / "result.json")

    def end(self) -> None:
        """Note that no input ended the process."""
        (self._found / "current").unlink(missing_ok=True)
        self.books["done"] = True
        self.write()


def limit_memory() -> None:
    """Limit the address space to its present size and :data:`MEMORY`."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))


def mutated(rng: random.Random, seeds: list[bytes]) -> bytes:
    """Return a seed, changed at random, for machines without atheris."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, 6)):
        at, size = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 4, 8, 64))
        match rng.randrange(5):
            case 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            case 1:
                word = rng.choice(_ODD)
                data[at : at + len(word)] = word
            case 2:
                del data[at : at + size]
            case 3:
                other = rng.choice(seeds)
                begin = rng.randrange(len(other) + 1)
                data[at:at] = other[begin : begin + size]
            case _:
                data[at : at + size] = data[at : at + size] * 2
    return bytes(data)


def main(names: str, corpus: Path, found: Path, seconds: float, way: str, seed: int) -> None:
    """Fuzz one target, or replay several."""
    from bench.fuzz.targets import TARGETS

    if way == "atheris" and seconds:
        import atheris

        with atheris.instrument_imports(include=["coview_stream", "rosbags", "laspy"]):
            watch = Watch(TARGETS[names](), found)
        limit_memory()
        options = [
            f"-max_total_time={max(1, round(seconds))}", f"-timeout={LIMIT_S}", "-rss_limit_mb=0", f"-seed={seed}",
            f"-max_len={MAX_INPUT}", f"-artifact_prefix={found}/", "-verbosity=1",
        ]  # fmt: skip
        atheris.Setup([sys.argv[0], *options, str(found / "corpus"), str(corpus)], watch)
        atheris.Fuzz()
        return
    rng, end = random.Random(seed), time.monotonic() + seconds
    for name in names.split(","):
        place, own = (found, corpus) if seconds else (found / name, corpus / name)
        place.mkdir(exist_ok=True)
        seeds = [path.read_bytes() for path in sorted(own.iterdir())]
        watch = Watch(TARGETS[name](), place)
        limit_memory()
        for data in [] if seconds else seeds:
            watch.within_time(data)
        while time.monotonic() < end:
            watch.within_time(mutated(rng, seeds))
        watch.end()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]), sys.argv[5], int(sys.argv[6]))
