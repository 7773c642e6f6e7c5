"""Process that decodes LAZ and E57 files for another one, with a limit on its memory: ``python -P -m ...laz_child``.

The decoder is native code that believes sizes in the file: what they ask for may abort the process. Reads one JSON
string (a path) a line from stdin. Writes to stdout, for each, ``points`` and ``end`` lines of JSON; after each
``points`` line come the raw coordinates, (N, 3) float64 metres, and N classes, uint8.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any, BinaryIO

BASE = 1 << 30
"""Bytes that a file may take besides a multiple of its size, set by hand: a chunk of 10^6 points takes a third."""

PER_BYTE = 4
"""Bytes per byte of the file, set by hand: the compressed layers of a chunk, and copies of them."""


def main() -> None:
    """Answer until stdin ends."""
    # laspy and others may print: only answers go to the pipe
    out = os.fdopen(os.dup(1), "wb", buffering=1 << 20)
    os.dup2(2, 1)
    with contextlib.suppress(ImportError):  # E57 does without
        import laspy  # noqa: F401 - before the first limit

    before = _address_space()
    for line in sys.stdin.buffer:
        path = Path(json.loads(line))
        _limit(before + BASE + PER_BYTE * path.stat().st_size)
        _answer(path, out)
        out.flush()


def _answer(path: Path, out: BinaryIO) -> None:
    from coview_stream.clouds import e57, las
    from coview_stream.clouds.cloud import CloudBuilder
    from coview_stream.errors import CloudError

    class Sender(CloudBuilder):
        """Builder that hands the chunks on instead of keeping them."""

        def add(self, raw: Any, classification: Any = None, dropped: int = 0) -> None:
            self.crs, crs = None, self.crs
            _say(out, {"points": len(raw), "dropped": dropped, "crs": crs})
            out.write(raw.tobytes())
            out.write(classification.tobytes())

    end: dict[str, Any] = {"end": True}
    try:
        (e57 if path.suffix.lower() == ".e57" else las).decode(path, Sender)
    except CloudError as error:
        end["error"] = str(error)
    except MemoryError:
        end["memory"] = True
    _say(out, end)


def _say(out: BinaryIO, what: dict[str, Any]) -> None:
    out.write(json.dumps(what).encode() + b"\n")


def _address_space() -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        return 1 << 31


def _limit(size: int) -> None:
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (size, resource.getrlimit(resource.RLIMIT_AS)[1]))
    except (ImportError, ValueError, OSError):  # macOS has none; the process is another one all the same
        pass


if __name__ == "__main__":
    main()
