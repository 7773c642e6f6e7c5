"""What benchmarks keep on disk: results that are found again, as long as the code that made them is the same."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import coview_kernels
import coview_stream
from coview_stream.clouds.atomic_file import atomic_path

_ROOTS = {
    "coview_stream": Path(coview_stream.__file__).parent,
    "coview_kernels": Path(coview_kernels.__file__).parent,
    "bench": Path(__file__).parents[1],
}

Result = TypeVar("Result")


def folder() -> Path:
    """Where worlds and answers are kept: ``--work``, the environment's ``COVIEW_BENCH``, or a temporary place."""
    return Path(os.environ.get("COVIEW_BENCH") or Path(tempfile.gettempdir()) / "coview-bench")


def remembered(file: Path, spec: dict[str, Any], make: Callable[[], Any]) -> dict[str, Any]:
    """Return the result in ``file`` if it was made for an equal ``spec``; else make it and keep it there.

    This is what lets an interrupted benchmark resume, yet never on the results of other code: ``spec`` holds
    a :func:`fingerprint`. What ``make`` returns besides a dictionary is not kept: it has written files of its own.
    """
    spec = json.loads(json.dumps(spec))
    if file.is_file():
        known = json.loads(file.read_text())
        if known["spec"] == spec:
            return dict(known["result"])
    made = make()
    result = json.loads(json.dumps(made if isinstance(made, dict) else {}))
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(file) as part:
        part.write_text(json.dumps({"spec": spec, "result": result}, indent=1) + "\n")
    return dict(result)


def fingerprint(*parts: str) -> str:
    """Short hash of the Python sources below ``parts``, e.g. ``coview_stream/sim`` (none: of the whole product)."""
    total = hashlib.sha256()
    for part in parts or ("coview_stream", "coview_kernels"):
        root, _, below = part.partition("/")
        path = _ROOTS[root] / below
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        for file in files:
            total.update(str(file.relative_to(_ROOTS[root])).encode() + file.read_bytes())
    return total.hexdigest()[:10]


def isolated(work: Callable[..., Result], *args: Any) -> Result:
    """Call ``work`` in a fresh process: its memory is its own, and given back."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *args).result()


def peak_megabytes() -> float:
    """Largest resident memory of this process so far, MB (Linux counts in KiB)."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def code_line() -> str:
    """Say which code was measured, and when."""
    return f"Code {fingerprint()}, {time.strftime('%Y-%m-%d')}."
