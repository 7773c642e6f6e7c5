"""The child process that decodes LAZ, E57 and COPC with limited memory: ``python -P -m ...decode_child``.

Native decoders trust the sizes in a file, and an absurd allocation may abort the process. stdin brings one JSON request
per line:

``{"path"}``
    Decode a LAZ or E57 file. Each chunk is a line ``{"points", "dropped"}``, then raw coordinates, (N, 3) float64
    metres, and N classes, uint8. The last line has ``end`` and ``crs``.
``{"path", "low", "high", "target"}``
    Write a window of a COPC file to the LAS file ``target``; the answer has ``end`` and counts.

An answer with ``error`` is a text for people.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from coview_stream.clouds import e57, las
from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.decode import damaged
from coview_stream.clouds.fetch import RangeFile, is_web_address
from coview_stream.errors import CloudError

_BASE = 1 << 30  # bytes allowed for any file; a chunk of 10^6 points takes a third
_PER_BYTE = 4  # bytes allowed per byte of the file: a chunk's compressed layers, and copies of them
_WINDOW_BYTES = 6 << 30  # allowed for a window of a COPC file
_WINDOW_POINTS = 60_000_000  # in the chunks that meet a window: 5 GB


def main() -> None:
    """Answer requests until stdin ends."""
    out = os.fdopen(os.dup(1), "wb", buffering=1 << 20)
    os.dup2(2, 1)  # libraries may print, but the pipe is for answers only
    with contextlib.suppress(ImportError):  # E57 does not need it
        import laspy  # noqa: F401 - before the first limit

    try:
        before = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # not Linux
        before = 1 << 31
    for line in sys.stdin.buffer:
        request = json.loads(line)
        answer: dict[str, Any] = {"end": True}
        try:
            if "target" in request:
                _limit(before + _WINDOW_BYTES)
                low, high = np.array(request["low"]), np.array(request["high"])
                answer |= _window(request["path"], low, high, request["target"])
            else:
                path = Path(request["path"])
                _limit(before + _BASE + _PER_BYTE * path.stat().st_size)
                sender = _Sender(out)
                (e57 if path.suffix.lower() == ".e57" else las).decode(path, sender)
                answer["crs"] = sender.crs
        except CloudError as error:
            answer["error"] = str(error)
        except MemoryError:
            answer["error"] = damaged(request["path"], "too little memory")
        _write_line(out, answer)
        out.flush()


class _Sender(CloudBuilder):
    """Builder that passes the chunks on instead of storing them."""

    def __init__(self, out: BinaryIO) -> None:
        super().__init__()
        self._out = out

    def add(self, raw: Any, classification: Any = None, dropped: int = 0) -> None:
        _write_line(self._out, {"points": len(raw), "dropped": dropped})
        self._out.write(raw.tobytes())
        self._out.write(classification.tobytes())


def _write_line(out: BinaryIO, answer: dict[str, Any]) -> None:
    out.write(json.dumps(answer).encode() + b"\n")


def _window(name: str, low: Any, high: Any, target: str) -> dict[str, int]:
    import laspy
    from laspy.copc import Bounds, CopcReader, load_octree_for_query

    web = RangeFile(name) if is_web_address(name) else None
    try:
        with contextlib.closing(web or Path(name).open("rb")) as source:
            reader = CopcReader(source)
            header = reader.header
            covered = ",".join(f"{value:.0f}" for value in (*header.mins[:2], *header.maxs[:2]))
            if (low > header.maxs[:2]).any() or (high < header.mins[:2]).any():
                raise CloudError(f"{name}: covers {covered}, the window is beside it")
            bounds = Bounds(low, high)
            whole = bounds.ensure_3d(header.mins, header.maxs)
            nodes = load_octree_for_query(source, reader.copc_info, reader.root_page, query_bounds=whole)
            count = sum(node.point_count for node in nodes)
            if count > _WINDOW_POINTS:
                raise CloudError(f"{name}: {count} points to read; make the window smaller")
            points = reader.query(bounds)
    except CloudError:
        raise
    except MemoryError as error:
        raise CloudError(f"{name}: too much for the memory; make the window smaller") from error
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise CloudError(f"{name}: not a COPC file, or damaged ({reason})") from error
    if not len(points):
        raise CloudError(f"{name}: no point is in the window; it covers {covered}")
    made = laspy.LasHeader(version=header.version, point_format=header.point_format)
    made.scales, made.offsets = header.scales, header.offsets
    made.global_encoding.wkt = header.global_encoding.wkt
    made.vlrs.extend(vlr for vlr in header.vlrs if vlr.user_id == "LASF_Projection")
    try:
        with Path(target).open("wb") as stream, las.las_writer(stream, made, Path(target)) as writer:
            writer.write_points(points)
    except OSError as error:
        raise CloudError(f"{target}: cannot be written ({error.strerror or error}); make room there") from error
    return {"points": len(points), "received": web.received if web else 0, "requests": web.requests if web else 0}


def _limit(size: int) -> None:
    with contextlib.suppress(ImportError, ValueError, OSError):  # macOS has no limit; a separate process still helps
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (size, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    main()
