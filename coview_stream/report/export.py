"""Trajectories for other programs: CSV, KITTI, GeoJSON and GPX."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.reference_system import GeoReference
from coview_stream.errors import ConfigError, InputError, counted
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Poses, pose_to_tum

_LATEST = 4e9  # seconds since 1970: later stamps, or stamps within the first year, are not Unix times
_EARLIEST = 3.2e7


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a run."""

    name: str
    stamps: Floats
    """(N,) seconds."""
    poses: Poses
    """(N, 4, 4) map <- body, metres."""
    geodetic: Floats | None = None
    """(N, 3) latitude, longitude (degrees) and height (metres); None if the map has no reference system."""
    kinds: Sequence[str] | None = None
    """(N,) kinds of the poses; None unless they are smoothed."""


def csv(trajectory: Trajectory) -> str:
    """Return one line per pose: stamp, position, quaternion; if known, latitude, longitude, height and kind."""
    titles = "stamp,x,y,z,qx,qy,qz,qw" + ("" if trajectory.geodetic is None else ",latitude,longitude,height")
    titles += "" if trajectory.kinds is None else ",kind"
    lines = [titles]
    for k, (stamp, T) in enumerate(zip(trajectory.stamps, trajectory.poses, strict=True)):
        row = pose_to_tum(T)
        text = f"{stamp:.6f}," + ",".join(f"{v:.6f}" for v in row[:3]) + "," + ",".join(f"{v:.9f}" for v in row[3:])
        if trajectory.geodetic is not None:
            latitude, longitude, height = trajectory.geodetic[k]
            text += f",{latitude:.9f},{longitude:.9f},{height:.3f}"
        text += "" if trajectory.kinds is None else f",{trajectory.kinds[k]}"
        lines.append(text)
    return "\n".join(lines) + "\n"


def kitti(trajectory: Trajectory) -> str:
    """Return one line per pose: the first three rows of map <- body."""
    return "".join(" ".join(f"{v:.9e}" for v in T[:3].ravel()) + "\n" for T in trajectory.poses)


def geojson(trajectory: Trajectory) -> str:
    """Return a line and a point for each pose, longitude first (RFC 7946)."""
    places = _geodetic(trajectory)
    coordinates = [[round(lon, 9), round(lat, 9), round(height, 3)] for lat, lon, height in places.tolist()]
    kinds = [{} for _ in coordinates] if trajectory.kinds is None else [{"kind": kind} for kind in trajectory.kinds]
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": place},
            "properties": {"stamp": round(float(stamp), 6)} | _time(float(stamp)) | kind,
        }
        for stamp, place, kind in zip(trajectory.stamps, coordinates, kinds, strict=True)
    ]
    if len(coordinates) > 1:
        line = {"type": "LineString", "coordinates": coordinates}
        features.insert(0, {"type": "Feature", "geometry": line, "properties": {"name": trajectory.name}})
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"


def gpx(trajectory: Trajectory) -> str:
    """Return a track; a point has a time if its stamp is a Unix time."""
    points = []
    for stamp, (latitude, longitude, height) in zip(trajectory.stamps, _geodetic(trajectory).tolist(), strict=True):
        time = "".join(f"<time>{value}</time>" for value in _time(float(stamp)).values())
        points.append(f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{height:.3f}</ele>{time}</trkpt>')
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="coview_stream" '
    head += 'xmlns="http://www.topografix.com/GPX/1/1">\n'
    name = quoteattr(trajectory.name)[1:-1]
    return head + f"<trk><name>{name}</name><trkseg>\n" + "\n".join(points) + "\n</trkseg></trk>\n</gpx>\n"


FORMATS: Mapping[str, tuple[str, Callable[[Trajectory], str]]] = {
    "csv": ("trajectory.csv", csv),
    "kitti": ("trajectory.kitti", kitti),
    "geojson": ("trajectory.geojson", geojson),
    "gpx": ("trajectory.gpx", gpx),
}
"""File and writer of each format."""

ON_EARTH = ("geojson", "gpx")
"""Formats that need a reference system."""


def chosen_formats(text: str) -> tuple[str, ...]:
    """Return the formats of ``csv,geojson``; ConfigError for others."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        raise ConfigError(f"--export {text!r}: give {', '.join(FORMATS)}, or several with commas between")
    return names


def reference_for(crs: str | None, names: Sequence[str]) -> GeoReference | None:
    """Return the reference for formats, None if the map has none and no format needs it.

    Raises:
        InputError, DependencyError: see :class:`GeoReference`; only if a format needs the reference.
    """
    if any(name in ON_EARTH for name in names):
        return GeoReference(crs)
    try:
        return GeoReference(crs)
    except (InputError, ImportError):
        return None


def export(trajectory: Trajectory, folder: Path, names: Sequence[str]) -> list[Path]:
    """Write a trajectory into an existing folder, a file per format, and return the files; OSError if that fails."""
    written = []
    for name in names:
        file, write = FORMATS[name]
        with atomic_file(folder / file) as stream:
            stream.write(write(trajectory).encode())
        written.append(folder / file)
    return written


def trajectory_of(
    name: str, stamps: npt.ArrayLike, poses: npt.ArrayLike, geo: GeoReference | None, kinds: Sequence[str] | None = None
) -> Trajectory:
    """Return the trajectory of poses (N, 4, 4), with latitude and longitude if there is a reference."""
    stack = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    places = None if geo is None else geo.geodetic(stack[:, :3, 3])
    return Trajectory(name, np.asarray(stamps, dtype=np.float64), stack, places, kinds)


def _geodetic(trajectory: Trajectory) -> Floats:
    if trajectory.geodetic is None:
        raise InputError("the map states no reference system: no latitude and longitude; build it with --crs EPSG:N")
    if lost := int((~np.isfinite(trajectory.geodetic).all(axis=1)).sum()):
        raise InputError(
            f"{trajectory.name}: {lost} of {counted(len(trajectory.poses), 'pose')} lie nowhere on Earth in the map's "
            "reference system: export csv or kitti, or build the map with the right --crs EPSG:N"
        )
    return trajectory.geodetic


def _time(stamp: float) -> dict[str, str]:
    """Return the time of a stamp, if it is a Unix time."""
    if not _EARLIEST < stamp < _LATEST:
        return {}
    moment = datetime.fromtimestamp(stamp, UTC)
    return {"time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")}
