"""Clouds of web servers, and windows of COPC files, in a folder of their own while a command runs."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path


@contextlib.contextmanager
def local_clouds(given: Sequence[str], window: str | None) -> Iterator[list[str | os.PathLike[str]]]:
    """Give the names of clouds with those of web servers, and windows of COPC files, as local files.

    Args:
        given: files, folders, patterns and web addresses, as the command was given them.
        window: ``X0,Y0,X1,Y1``, of all of them; None: the files as they are.

    Raises:
        ConfigError: the window is none. CloudError: a file cannot be fetched, or is no COPC file and a window is given.
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
            for each in several:
                if wanted is None and not is_web_address(each):
                    out.append(each)
                    continue
                path, fetched = fetch_cloud(each, Path(folder), wanted)
                out.append(path)
                came = f", {fetched.received / 1e6:.1f} MB in {fetched.requests} requests" if fetched.requests else ""
                what = f"{fetched.points} points in the window{came}" if wanted else f"{fetched.received / 1e6:.1f} MB"
                print(f"{each}: {what}", file=sys.stderr)
        yield out
