"""Addresses of maps: ``zenoh://SITE``, ``zenoh://HOST:PORT/SITE``, ``https://...``, ``s3://...``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from coview_stream.basemap.site.site_source import ObjectStoreSource, SiteSource, WebSource
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
