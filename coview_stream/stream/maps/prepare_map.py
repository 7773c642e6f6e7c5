"""Preparation of a site for a node that is running: its working file is made by a process of its own, which gives way.

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

from coview_stream.clouds.python_child import python_command, python_environment

log = logging.getLogger("coview_stream.maps")

_NICE = 10  # set by hand
_LOOK = 0.1  # seconds


def prepare_map(place: Path, cancelled: Callable[[], bool]) -> None:
    """Have the working file of a site made, if ``place`` is a site or a part of one, and wait for it.

    What goes wrong is left to whoever opens the map.

    Args:
        place: of a map.
        cancelled: asked now and then; True ends it.
    """
    from coview_stream.basemap.site.part import site_directory

    if site_directory(place) is None:
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
    """Make the working file of the map that the command line names."""
    from coview_stream.basemap.site.part import SUFFIX, read_part
    from coview_stream.basemap.site.working_file import working_file

    with contextlib.suppress(OSError, AttributeError):
        os.nice(_NICE)
    place = Path(sys.argv[1])
    directory, keys = read_part(place) if place.suffix == SUFFIX else (place, None)
    working_file(directory, progress=False, keys=keys)


if __name__ == "__main__":
    main()
