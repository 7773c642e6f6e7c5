"""Process that reads a window of a COPC file for another, with a limit on memory: ``python -P -m ...copc_child``.

Reads one JSON object from stdin (``source``, ``low``, ``high``, ``target``), writes the points to the LAS file
``target``, and to stdout one JSON object: the fields of :class:`~coview_stream.clouds.copc.Fetched`, or ``error``.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from typing import Any

import numpy as np

from coview_stream.clouds.http_file import HttpFile, is_web_address
from coview_stream.errors import CloudError

_MOST_POINTS = 60_000_000  # of the chunks that meet a window: 5 GB; set by hand
_MOST_BYTES = 6 << 30  # of address space; set by hand


def main() -> None:
    """Answer the one question."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # libraries may print: only the answer goes to the pipe
    task = json.load(sys.stdin)
    with contextlib.suppress(ImportError, ValueError, OSError):  # macOS has no such limit
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    try:
        answer = _fetch(task)
    except CloudError as error:
        answer = {"error": str(error)}
    except MemoryError:
        answer = {"error": f"{task['source']}: too much for the memory; make the window smaller"}
    except Exception as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        answer = {"error": f"{task['source']}: not a COPC file, or damaged ({reason})"}
    out.write(json.dumps(answer))
    out.flush()


def _fetch(task: dict[str, Any]) -> dict[str, Any]:
    import laspy
    from laspy.copc import Bounds, CopcReader, load_octree_for_query

    source: Any = HttpFile(task["source"]) if is_web_address(task["source"]) else open(task["source"], "rb")  # noqa: SIM115, PTH123
    with contextlib.closing(source):
        reader = CopcReader(source)
        header = reader.header
        low, high = np.array(task["low"]), np.array(task["high"])
        if (low > header.maxs[:2]).any() or (high < header.mins[:2]).any():
            raise CloudError(f"{task['source']}: covers {_box(header.mins, header.maxs)}, the window is beside it")
        bounds = Bounds(low, high)
        whole = bounds.ensure_3d(header.mins, header.maxs)
        nodes = load_octree_for_query(source, reader.copc_info, reader.root_page, query_bounds=whole)
        count = sum(node.point_count for node in nodes)
        if count > _MOST_POINTS:
            raise CloudError(f"{task['source']}: {count} points to read; make the window smaller")
        points = reader.query(bounds)
    if not len(points):
        raise CloudError(f"{task['source']}: no point is in the window; it covers {_box(header.mins, header.maxs)}")
    made = laspy.LasHeader(version=header.version, point_format=header.point_format)
    made.scales, made.offsets = header.scales, header.offsets
    made.global_encoding.wkt = header.global_encoding.wkt
    made.vlrs.extend(vlr for vlr in header.vlrs if vlr.user_id == "LASF_Projection")
    with laspy.open(task["target"], "w", header=made) as writer:
        writer.write_points(points)
    web = isinstance(source, HttpFile)
    return {
        "points": len(points), "nodes": len(nodes),
        "received": source.received if web else 0, "requests": source.requests if web else 0,
    }  # fmt: skip


def _box(low: Any, high: Any) -> str:
    return ",".join(f"{value:.0f}" for value in (*low[:2], *high[:2]))


if __name__ == "__main__":
    main()
