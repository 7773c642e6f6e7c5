"""Fetch a map from its address to a path that :meth:`BaseMap.load` accepts, and prepare it for a node."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

from coview_stream.basemap.joined import JOINED_SUFFIX
from coview_stream.basemap.signature import VerifyKey, read_verify_key
from coview_stream.basemap.site.fetch import Mirror, ObjectStoreSource, SiteSource, WebSource
from coview_stream.basemap.site.site_grid import PART_SUFFIX, Around
from coview_stream.clouds.progress import progress_bar
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import ConfigError
from coview_stream.stream.maps.zenoh_source import ZenohSource

log = logging.getLogger("coview_stream.maps")

MAP_SERVER_ENDPOINT = "tcp/127.0.0.1:7448"
"""Default endpoint of ``serve-map`` and ``zenoh://SITE``."""

_NICE = 10  # niceness of the process that prepares a map
_LOOK = 0.1  # seconds between checks whether it is still wanted


def source_of(
    address: str, base: str = "coview", connect: Sequence[str] = (), config: Path | None = None
) -> SiteSource:
    """Return the source for a site's address; ``base``, ``connect`` and ``config`` apply to ``zenoh://SITE``.

    Raises:
        ConfigError: not the address of a site. DependencyError: a library is missing. TransportError: an object store
            cannot be used.
    """
    parts = urlsplit(address)
    if parts.scheme in ("http", "https"):
        return WebSource(address)
    if parts.scheme in ("s3", "gs", "az"):
        return ObjectStoreSource(address)
    if parts.scheme != "zenoh":
        raise ConfigError(f"{address}: give zenoh://SITE, zenoh://HOST:PORT/SITE, https://... or s3://...")
    site = parts.path.strip("/")
    if not site:
        return ZenohSource(parts.netloc, base, connect, config)
    if ":" not in parts.netloc:
        raise ConfigError(f"{address}: write zenoh://HOST:PORT/SITE, or zenoh://SITE with --connect")
    return ZenohSource(site, base, [f"tcp/{parts.netloc}"], config)


def fetch_map(
    address: str,
    *,
    around: tuple[float, float, float] | None = None,
    verify_key: str | os.PathLike[str] | VerifyKey | None = None,
    connect: Sequence[str] = (),
) -> Path:
    """Fetch a site, or update its cached copy, and return the path to load.

    Every layer's hash is checked before use. If the source cannot be reached, the cached copy is used with a warning.

    Args:
        address: ``zenoh://SITE``, ``zenoh://HOST:PORT/SITE``, ``https://...`` or ``s3://...``.
        around: x, y, radius in metres, in map coordinates: fetch only the tiles in this circle; None: all.
        verify_key: public key, or its PEM file, that must have signed the site.
        connect: zenoh endpoints for an address without one (``tcp/127.0.0.1:7448``).

    Raises:
        ConfigError: the address or circle is malformed. TransportError: no source, and nothing in the cache.
        MapError: the site is damaged or not signed with the key, or no tile is in the circle.
        InputError: the key cannot be read. DependencyError: a library is missing.
    """
    key = read_verify_key(verify_key) if isinstance(verify_key, str | os.PathLike) else verify_key
    mirror = open_mirror(address, None if around is None else Around(*around), key, connect=connect)
    try:
        return mirror.map_path
    finally:
        mirror.source.close()


def open_mirror(
    address: str,
    around: Around | None = None,
    verify_key: VerifyKey | None = None,
    base: str = "coview",
    connect: Sequence[str] = (),
    config: Path | None = None,
) -> Mirror:
    """Open the mirror of a site, updated if the source can be reached; the caller closes its source.

    Arguments and errors as in :func:`fetch_map`; ``base`` and ``config`` apply to ``zenoh://SITE``.
    """
    endpoints = list(connect) or ([] if config is not None else [MAP_SERVER_ENDPOINT])
    mirror = Mirror(source_of(address, base, endpoints, config), verify_key, around)
    try:
        with progress_bar(address, unit="B", scale=True) as progress:
            mirror.open(progress)
    except BaseException:
        mirror.source.close()
        raise
    return mirror


def prepare_map(place: Path, cancelled: Callable[[], bool]) -> None:
    """Write the working file of a site, a part of a site or several maps, in a low-priority process.

    The node would miss poses if it did this itself. Errors are not raised: opening the map afterwards raises them.
    ``cancelled`` is polled; True ends the process.
    """
    if not (place.is_dir() or place.suffix in (PART_SUFFIX, JOINED_SUFFIX)):
        return
    with subprocess.Popen(
        python_command(__name__, str(place)), env=python_environment(),
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    ) as child:  # fmt: skip
        while True:
            try:
                _, output = child.communicate(timeout=_LOOK)
                break
            except subprocess.TimeoutExpired:
                if cancelled():
                    child.kill()
        if child.returncode and not cancelled():
            log.debug("%s: preparing it failed: %s", place, output.decode(errors="replace").strip()[-500:])


def main() -> None:
    """Load the map named on the command line, which writes its working file."""
    from coview_stream.basemap.joined import load_map

    with contextlib.suppress(OSError, AttributeError):
        os.nice(_NICE)
    load_map(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
