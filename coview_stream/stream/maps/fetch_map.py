"""Fetching of a map: an address in, a path that :meth:`BaseMap.load` takes out."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from coview_stream.basemap.signature import VerifyKey, read_verify_key
from coview_stream.basemap.site.mirror import Mirror, Progress
from coview_stream.basemap.site.part import Around
from coview_stream.stream.maps.map_address import source_of

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
