"""What all of ``bench.forest`` shares: progress, which weights are measured, and what its results depend on."""

from __future__ import annotations

import hashlib
import sys
import time
from pathlib import Path
from typing import Any

from bench.harness.worlds import fingerprint

_FRAMES = (
    "coview_stream/clouds",
    "coview_stream/geometry.py",
    "coview_stream/rotation.py",
    "bench/harness/worlds.py",
)
_TRAINING = ("recipe", "worlds", "submaps", "stands", "trees", "crowns", "wood", "parts", "patterns", "paths",
             "terrain", "rotating")  # fmt: skip

WORLDS = (
    *_FRAMES,
    "coview_stream/sim",
    *(f"coview_stream/learn/{part}.py" for part in _TRAINING),
    "bench/forest/worlds.py",
    "bench/forest/drives.py",
)
"""What makes worlds, and the runs and queries in them."""

ANSWERS = (
    *WORLDS,
    *(f"coview_stream/{part}" for part in ("place", "pose", "basemap", "config", "odometry")),
    *(
        f"coview_stream/{part}.py"
        for part in ("refinement", "decision", "query", "sources", "learned_source")
    ),
    "coview_kernels",
    *(f"bench/forest/{part}.py" for part in ("methods", "chains", "canopy", "query")),
)
"""What answers to single queries depend on as well, but for the weights. Whole runs depend on all of the product."""

_PARTS = ("base.laz", "base.las", "truth.tum", "world.json", "run/odometry.tum")


def say(text: str) -> None:
    """Report progress."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def weights() -> str:
    """Say which weights the package has, by both networks' hashes."""
    from coview_stream.place.learned.network import shipped, weights_name

    total = hashlib.sha256()
    for view in ("aerial", "ground"):
        file = shipped() / weights_name(view)
        total.update(file.read_bytes() if file.is_file() else b"")
    return total.hexdigest()[:10]


def code() -> str:
    """Hash of all that answers depend on but the weights."""
    return fingerprint(*ANSWERS)


def on_disk(world: Path) -> dict[str, Any]:
    """Say what lies in a world's folder: a hash of its files' names, sizes and times."""
    files = [world / part for part in _PARTS] + sorted((world / "run" / "frames").glob("*"))
    total = hashlib.sha256()
    for file in files:
        if file.is_file():
            stat = file.stat()
            total.update(f"{file.relative_to(world)} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return {"world": str(world.resolve()), "files": total.hexdigest()[:16]}
