"""Process that fuzzes one target, or replays inputs: ``python -m bench.fuzz.child TARGET CORPUS FOUND SECONDS``.

Its memory is limited, and an input that takes too long ends it. What a target raises that is no CoViewError is a
finding: the input is kept in FOUND, once for each place that raised, and the fuzzing goes on. Writes a line of JSON to
``FOUND/result.json`` now and then, for it may be ended at any time. With 0 seconds it replays CORPUS once; TARGET may
then be several, with commas between them, whose corpora and findings are in folders of their names.
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

LIMIT_S = 10
"""Seconds that one input of a few kB may take, set by hand: a hundred times what any of them needs."""

MEMORY = 2 << 30
"""Bytes that a target may take besides its libraries, set by hand: LAZ and PCD may unpack to a hundred times."""

MAX_INPUT = 32_768  # bytes, set by hand: the largest seed, a database, has 28 kB


class Watch:
    """A target with its books: executions, values that came of them, findings."""

    def __init__(self, target: Any, found: Path) -> None:
        from coview_stream.errors import CoViewError

        self._expected = CoViewError
        self._target, self._found = target, found
        self.executions = self.values = 0
        self.places: dict[str, str] = {}
        self.extra: dict[str, Any] = {}
        self._written = 0.0

    def __call__(self, data: bytes) -> None:
        """Run one input."""
        self.executions += 1
        try:
            self._target(data)
            self.values += 1
        except self._expected:
            pass
        except (Exception, RecursionError) as error:
            self._note(error, data)
        if time.monotonic() > self._written + 0.5:
            self.write()

    def _note(self, error: Exception, data: bytes) -> None:
        frames = [f for f in traceback.extract_tb(error.__traceback__) if "coview_" in f.filename]
        where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
        place = f"{type(error).__name__} at {where}"
        if place not in self.places:
            self.places[place] = f"{error}"[:200]
            (self._found / f"found-{hashlib.sha256(data).hexdigest()[:12]}").write_bytes(data)
            print(place, self.places[place], flush=True)
            self.write()

    def write(self) -> None:
        """Write the books."""
        self._written = time.monotonic()
        part = self._found / "result.part"
        part.write_text(
            json.dumps({"executions": self.executions, "values": self.values, "places": self.places} | self.extra)
        )
        part.replace(self._found / "result.json")


def limit_memory() -> None:
    """Limit the address space to what it is now and :data:`MEMORY`."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))


def replay(watch: Watch, corpus: Path, found: Path) -> None:
    """Run each file of a corpus once."""
    for path in sorted(corpus.iterdir()):
        data = path.read_bytes()
        (found / "current").write_bytes(data)
        faulthandler.dump_traceback_later(LIMIT_S, exit=True)
        watch(data)
        faulthandler.cancel_dump_traceback_later()
    (found / "current").unlink(missing_ok=True)


def mutate(watch: Watch, corpus: Path, found: Path, seconds: float, seed: int) -> None:
    """Fuzz without a look at what is covered: the seeds, changed at random."""
    rng = random.Random(seed)
    seeds = [path.read_bytes() for path in sorted(corpus.iterdir())]
    odd = [bytes(4), b"\xff" * 4, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\xff" * 8, b"-1", b"1e999", b"nan", b"["]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        data = bytearray(rng.choice(seeds))
        for _ in range(rng.randint(1, 6)):
            at, size = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 4, 8, 64))
            match rng.randrange(5):
                case 0:
                    data[at : at + 1] = bytes([rng.randrange(256)])
                case 1:
                    word = rng.choice(odd)
                    data[at : at + len(word)] = word
                case 2:
                    del data[at : at + size]
                case 3:
                    other = rng.choice(seeds)
                    begin = rng.randrange(len(other) + 1)
                    data[at:at] = other[begin : begin + size]
                case _:
                    data[at : at + size] = data[at : at + size] * 2
        (found / "current").write_bytes(data)
        faulthandler.dump_traceback_later(LIMIT_S, exit=True)
        watch(bytes(data[:MAX_INPUT]))
        faulthandler.cancel_dump_traceback_later()
    (found / "current").unlink(missing_ok=True)


def main(name: str, corpus: Path, found: Path, seconds: float, way: str, seed: int) -> None:
    """Fuzz one target; see the module."""
    from bench.fuzz.targets import TARGETS

    if way == "atheris" and seconds:
        import atheris

        with atheris.instrument_imports(include=["coview_stream", "rosbags", "laspy"]):
            watch = Watch(TARGETS[name](), found)
        limit_memory()
        options = [
            f"-max_total_time={max(1, round(seconds))}", f"-timeout={LIMIT_S}", "-rss_limit_mb=0", f"-seed={seed}",
            f"-max_len={MAX_INPUT}", f"-artifact_prefix={found}/", "-verbosity=1",
        ]  # fmt: skip
        atheris.Setup([sys.argv[0], *options, str(found / "corpus"), str(corpus)], watch)
        atheris.Fuzz()
        return
    for each in name.split(","):
        folder = found / each if "," in name else found
        folder.mkdir(exist_ok=True)
        watch = Watch(TARGETS[each](), folder)
        limit_memory()
        if seconds:
            mutate(watch, corpus, folder, seconds, seed)
        else:
            replay(watch, corpus / each if "," in name else corpus, folder)
        watch.extra["done"] = True
        watch.write()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]), sys.argv[5], int(sys.argv[6]))
