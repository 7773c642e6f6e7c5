"""Publication of poses as places on Earth, beside the poses."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.map_parts import MapParts
from coview_stream.clouds.reference_system import GeoReference
from coview_stream.errors import CoViewError
from coview_stream.geometry.transforms import yaw_of
from coview_stream.messages import encode_location
from coview_stream.messages.types import LocationMessage, PoseMessage
from coview_stream.stream.transport.transport import Publisher

log = logging.getLogger("coview_stream.node")


class MapReference:
    """Reference of the map in force, which may change while a node runs.

    Args:
        files: of the maps that the node has opened, by their hashes.
        sha256: of the map to begin with.

    Raises:
        InputError, DependencyError: as of :class:`GeoReference`.
    """

    def __init__(self, files: Mapping[str, Path], sha256: str) -> None:
        self._files = files
        self._lock = threading.Lock()
        loaded = BaseMap.load(files[sha256], check=False)
        self._sha256 = loaded.sha256
        self._geo = _references(loaded)

    def of(self, sha256: str, name: str = "") -> GeoReference | None:
        """Return the reference of a map by its hash, and of several maps by the name of the one.

        None where the file has none, or is another one by now.
        """
        with self._lock:
            if sha256 != self._sha256:
                try:
                    loaded = BaseMap.load(self._files[sha256], check=False)
                    self._sha256, self._geo = loaded.sha256, _references(loaded)
                except (CoViewError, KeyError) as error:
                    log.warning("no latitude and longitude on the new map: %s", error)
                    self._sha256, self._geo = sha256, {}
            known = self._geo if sha256 == self._sha256 else {}
            return known.get(name, known.get(""))


def _references(base_map: BaseMap) -> dict[str, GeoReference]:
    """Return the references of a map's parts by name; of one map its own, without a name."""
    parts = MapParts.of(base_map.parameters)
    if parts is None:
        return {"": GeoReference(base_map.crs)}
    return {part.name: GeoReference(part.crs) for part in parts}


class LocationPublisher:
    """Publisher of one robot's poses as places on Earth."""

    def __init__(self, publisher: Publisher, reference: MapReference, encoding: str) -> None:
        self._publisher, self._reference, self._encoding = publisher, reference, encoding

    def __call__(self, pose: PoseMessage) -> None:
        """Publish a pose."""
        geo = self._reference.of(pose.map_sha256, pose.frame_id)
        if geo is not None and (message := location_of(pose, geo)) is not None:
            self._publisher.put(encode_location(message, self._encoding))


def location_of(pose: PoseMessage, geo: GeoReference) -> LocationMessage | None:
    """Return where on Earth a pose is; None where it has no place there."""
    position = pose.T_map_body[:3, 3]
    latitude, longitude, height = geo.geodetic(position[None])[0].tolist()
    if not np.isfinite([latitude, longitude, height]).all():
        return None
    heading = geo.heading(position, yaw_of(pose.T_map_body))
    covariance = geo.enu_covariance(position, pose.covariance)
    return LocationMessage(pose.stamp_ns, pose.robot, latitude, longitude, height, heading, covariance, pose.confidence)
