"""Preparation of a map for a node that is running: what is made of it is made by a process of its own, which gives way.

Made by the node itself, it would take the time in which poses are due.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from coview_stream.basemap.joined.joined_names import SUFFIX as JOINED
from coview_stream.basemap.site.part import SUFFIX as PART
from coview_stream.clouds.python_child import python_command, python_environment

log = logging.getLogger("coview_stream.maps")

_NAMES = (PART, JOINED)
_NICE = 10  # set by hand
_LOOK = 0.1  # seconds


def prepare_map(place: Path, cancelled: Callable[[], bool]) -> None:
    """Have made what a map is opened from, if that is made of something else: a site, a part of one, several maps.

    An error here is not raised: opening the map afterwards meets the same one and says it.

    Args:
        place: of a map.
        cancelled: asked now and then; True ends it.
    """
    if not (place.is_dir() or place.suffix in _NAMES):
        return
    with subprocess.Popen(
        python_command(__name__, str(place)), env=python_environment(),
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    ) as child:  # fmt: skip
        while True:
            try:
                _, said = child.communicate(timeout=_LOOK)
                break
            except subprocess.TimeoutExpired:
                if cancelled():
                    child.kill()
        if child.returncode and not cancelled():
            log.debug("%s: preparing it failed: %s", place, said.decode(errors="replace").strip()[-500:])


def main() -> None:
    """Open the map that the command line names."""
    from coview_stream.basemap.joined.load_map import load_map

    with contextlib.suppress(OSError, AttributeError):
        os.nice(_NICE)
    load_map(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
