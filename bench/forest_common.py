"""What all of ``bench.forest`` shares: progress, and which weights are measured."""

from __future__ import annotations

import hashlib
import sys
import time


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
