"""Results of runs: one JSON object a line, appended as they come, by several processes."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

Result = dict[str, Any]

ANY = "any"
"""Fingerprint that takes the results of all code."""


def append(file: Path, result: Result) -> None:
    """Add a line; others may do so at the same time."""
    file.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(result, allow_nan=False) + "\n"
    with file.open("a") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        stream.write(line)
        stream.flush()


def read(files: Iterable[Path], code: str) -> dict[str, Result]:
    """Return results by their key, the newest of each, of the code with that fingerprint, or of :data:`ANY`.

    A line that a killed process has left half-written is passed over.
    """
    found: dict[str, Result] = {}
    for file in files:
        for line in file.read_text().splitlines() if file.is_file() else ():
            try:
                result = json.loads(line)
            except ValueError:
                continue
            if code in (ANY, result["code"]):
                found[result["key"]] = result
    return found
