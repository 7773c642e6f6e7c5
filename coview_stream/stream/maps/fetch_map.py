"""Fetching of a map: an address in, a path that :meth:`BaseMap.load` takes out."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from coview_stream.basemap.joined import JOINED_SUFFIX
from coview_stream.basemap.signature import VerifyKey, read_verify_key
from coview_stream.basemap.site.fetch import Mirror, ObjectStoreSource, Progress, SiteSource, WebSource
from coview_stream.basemap.site.manifest import PART_SUFFIX, Around
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import ConfigError
from coview_stream.stream.maps.zenoh_source import ZenohSource


def source_of(
    address: str,
    base: str = "coview",
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    config: Path | None = None,
) -> SiteSource:
    """Return the source that an address names.

    Args:
        address: of the site.
        base: first part of zenoh keys.
        connect: zenoh endpoints, for addresses without one.
        listen: likewise.
        config: a zenoh configuration.

    Raises:
        ConfigError: it is no address of a site. DependencyError: a library is missing. TransportError: an object store
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
        return ZenohSource(parts.netloc, base, connect, listen, config)
    if ":" not in parts.netloc:
        raise ConfigError(f"{address}: write zenoh://HOST:PORT/SITE, or zenoh://SITE with --connect")
    return ZenohSource(site, base, [f"tcp/{parts.netloc}"], (), config)


MAP_SERVER_ENDPOINT = "tcp/127.0.0.1:7448"
"""Where ``serve-map`` listens, and where ``zenoh://SITE`` looks for it, unless told otherwise."""


def fetch_map(
    address: str,
    *,
    around: tuple[float, float, float] | None = None,
    verify_key: str | os.PathLike[str] | VerifyKey | None = None,
    connect: Sequence[str] = (),
) -> Path:
    """Fetch a site, or bring what was fetched of it up to date, and return what to load.

    Every layer is compared with its hash before it is used. Where the source cannot be reached, what was fetched before
    is returned, with a warning.

    Args:
        address: ``zenoh://SITE``, ``zenoh://HOST:PORT/SITE``, ``https://...`` or ``s3://...``.
        around: x, y, radius in metres, in the map's coordinates: only the tiles that the circle meets; None for all.
        verify_key: public key, or its PEM file, that the site has to be signed with.
        connect: zenoh endpoints of an address without one (``tcp/127.0.0.1:7448``).

    Raises:
        ConfigError: a malformed address or circle. TransportError: it cannot be reached, and never was.
        MapError: what came is not what it should be, not signed with the key, or nothing is in the circle.
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
    """Return the mirror of a site, fetched if that can be done; the caller closes its source.

    Args:
        address: as :func:`fetch_map` takes it.
        around: only the tiles that it meets.
        verify_key: has to have signed it.
        base: first part of zenoh keys.
        connect: zenoh endpoints of an address without one.
        config: a zenoh configuration.

    Raises:
        As :func:`fetch_map`.
    """
    endpoints = list(connect) or ([] if config is not None else [MAP_SERVER_ENDPOINT])
    mirror = Mirror(source_of(address, base, endpoints, (), config), verify_key, around)
    try:
        with _bar(address) as progress:
            mirror.open(progress)
    except BaseException:
        mirror.source.close()
        raise
    return mirror


@contextmanager
def _bar(name: str) -> Iterator[Progress]:
    from tqdm import tqdm

    with tqdm(desc=name, unit="B", unit_scale=True, disable=not sys.stderr.isatty(), leave=False) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step


log = logging.getLogger("coview_stream.maps")

_NAMES = (PART_SUFFIX, JOINED_SUFFIX)
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
    from coview_stream.basemap.joined import load_map

    with contextlib.suppress(OSError, AttributeError):
        os.nice(_NICE)
    load_map(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
