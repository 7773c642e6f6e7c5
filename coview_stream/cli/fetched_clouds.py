"""Clouds of web servers, and windows of COPC files, as temporary local files."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path


@contextlib.contextmanager
def local_clouds(given: Sequence[str], window: str | None) -> Iterator[list[str | os.PathLike[str]]]:
    """Fetch clouds of web servers, and windows of COPC files, into a temporary folder, and yield the local files.

    Args:
        given: files, folders, patterns and web addresses, as the command was given them.
        window: ``X0,Y0,X1,Y1`` of all clouds; None takes whole files.

    Raises:
        ConfigError: a malformed window. CloudError: a file cannot be fetched, or is no COPC file and has a window.
    """
    from coview_stream.clouds.fetch import Window, fetch_cloud, is_web_address
    from coview_stream.clouds.files import expand_cloud_paths

    wanted = None if window is None else Window.parse(window)
    if wanted is None and not any(map(is_web_address, given)):
        yield list(given)
        return
    with tempfile.TemporaryDirectory(prefix="coview-clouds-") as folder:
        out: list[str | os.PathLike[str]] = []
        for name in given:
            several = [name] if is_web_address(name) or wanted is None else expand_cloud_paths([name])
            for cloud_name in several:
                if wanted is None and not is_web_address(cloud_name):
                    out.append(cloud_name)
                    continue
                path, cloud = fetch_cloud(cloud_name, Path(folder), wanted)
                out.append(path)
                size = f"{cloud.received / 1e6:.1f} MB"
                if wanted:
                    received = f", {size} in {cloud.requests} requests" if cloud.requests else ""
                    size = f"{cloud.points} points in the window{received}"
                print(f"{cloud_name}: {size}", file=sys.stderr)
        yield out
