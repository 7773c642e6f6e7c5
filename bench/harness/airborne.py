"""Drives on a real airborne survey: a ground lidar, ray-cast against solid columns that its points make.

The surface is the ground of the survey, and on it a solid column wherever the highest return of a 0.5 m cell stands
out; columns less than a metre wide (wires, lamps) are left out. So walls are straight below the edges of roofs and
trees are solid down to the ground: unlike a survey of the same day, but nothing that was fitted to one.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from bench.harness.files import fingerprint, remembered
from coview_stream.basemap.ground import ground_surface
from coview_stream.clouds import read_cloud, write_cloud, write_tum
from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Floats32, Indices
from coview_stream.geometry.rasters import filled
from coview_stream.geometry.transforms import Points, Poses
from coview_stream.sim import SENSORS, OdometryConfig
from coview_stream.sim.caster import Hits
from coview_stream.sim.layout import arc_lengths, directions
from coview_stream.sim.odometry import drifting_odometry

DATA = Path(os.environ.get("COVIEW_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
SURVEY = DATA / "airborne" / "autzen.laz"

ODOMETRY = OdometryConfig(yaw_walk=float(np.radians(0.1)), scale_error=0.01)

# of the surface, set by hand, metres
_CELL, _STEP = 0.5, 0.2  # of the raster; of a ray's march
_SOLID = 0.5  # above the ground: the least column
_REACH = 110.0  # of the surface beyond the drive
_CLEAR = 1.0  # of the robot from any column

_HEIGHT = 1.6  # of the sensor above the ground, metres
_SPEED, _PERIOD = 5.0, 0.1  # metres per second, seconds between frames
_SWAY = float(np.radians(0.4))  # radians, one sigma from frame to frame
_FIRST_STAMP = 1000.0  # seconds


@dataclass(frozen=True)
class Route:
    """Drive on the survey: the lidar, and the way in metres east and north of the survey's south-west corner."""

    sensor: str
    way: tuple[tuple[float, float], ...]
    seed: int


ROUTES = {
    "offices": Route("os64", ((352, 1284), (438, 1285), (446, 1282), (448, 1276)), 71),
    "fieldhouse": Route("vlp16", ((397, 862), (401, 925), (404, 950), (411, 984)), 72),
}


class Columns:
    """Surface of solid columns on the ground; as a caster, rays are marched over it."""

    def __init__(self, points: Points) -> None:
        """Raster (N, 3) points, metres."""
        ground = ground_surface(points)
        self._corner = np.array([ground.x0, ground.y0])
        self._fine = ground.cell / 2
        top = np.full(ground.z.shape, -np.inf, dtype=np.float32)
        row, column = ((points[:, 1::-1] - self._corner[::-1]) / ground.cell).astype(np.intp).T
        np.maximum.at(top, (row, column), points[:, 2])
        nearest = ndimage.distance_transform_edt(np.isinf(top), return_distances=False, return_indices=True)
        top = top[tuple(nearest)]
        z = filled(ground.z)
        self.solid = ndimage.binary_opening(top - z > _SOLID, np.ones((2, 2)))
        fine = ndimage.zoom(z, 2, order=1, grid_mode=True, mode="nearest")
        self._z: Floats32 = np.where(self.solid.repeat(2, 0).repeat(2, 1), top.repeat(2, 0).repeat(2, 1), fine)
        away = ndimage.distance_transform_edt(~self.solid) * ground.cell
        self._clearance = away.repeat(2, 0).repeat(2, 1)

    def _cell(self, xy: Floats) -> tuple[Indices, Indices]:
        index = ((xy - self._corner) / self._fine).astype(np.intp)
        return np.clip(index[:, 1], 0, self._z.shape[0] - 1), np.clip(index[:, 0], 0, self._z.shape[1] - 1)

    def height(self, xy: Floats) -> Floats:
        """Return the height (N,) of the surface at (N, 2)."""
        return self._z[self._cell(xy)].astype(np.float64)

    def clearance(self, xy: Floats) -> Floats:
        """Return the distance (N,) of (N, 2) from the nearest column, metres."""
        return np.asarray(self._clearance[self._cell(xy)], dtype=np.float64)

    def cast(self, origins: Floats32, rays: Floats32, rng: np.random.Generator, porosity: float) -> Hits:
        """Return the first hits of (N, 3) unit rays, all from one origin; nothing is porous."""
        start, rays = origins[0].astype(np.float64), rays.astype(np.float64)
        distance = np.full(len(rays), np.inf)
        alive = np.arange(len(rays))
        for t in np.arange(_STEP, _REACH, _STEP):
            at = start + t * rays[alive]
            hit = at[:, 2] <= self.height(at[:, :2])
            distance[alive[hit]] = t
            alive = alive[~hit & (at[:, 2] < start[2] + 60.0)]
        found = np.flatnonzero(np.isfinite(distance))
        low, high = distance[found] - _STEP, distance[found]
        for _ in range(8):  # to a millimetre
            middle = 0.5 * (low + high)
            at = start + middle[:, None] * rays[found]
            below = at[:, 2] <= self.height(at[:, :2])
            low, high = np.where(below, low, middle), np.where(below, middle, high)
        distance[found] = high
        return Hits(distance.astype(np.float32), np.ones(len(rays), dtype=np.float32))


def drive(route: Route, surface: Columns, rng: np.random.Generator) -> Poses:
    """Return poses (N, 4, 4) of the sensor along the way; InputError where a column stands in it."""
    way = np.array(route.way, dtype=np.float64)
    for _ in range(3):  # Chaikin's corners, so that no turn is sharp
        ahead, behind = 0.25 * way[:-1] + 0.75 * way[1:], 0.75 * way[:-1] + 0.25 * way[1:]
        way = np.concatenate([way[:1], np.stack([behind, ahead], axis=1).reshape(-1, 2), way[-1:]])
    arc = arc_lengths(way)
    at = np.arange(0.0, arc[-1], _SPEED * _PERIOD)
    xy = np.column_stack([np.interp(at, arc, way[:, k]) for k in range(2)])
    clear = surface.clearance(xy)
    if clear.min() < _CLEAR:
        raise InputError(f"the way leads {clear.min():.1f} m beside a column at {xy[clear.argmin()].tolist()}")
    heading = np.interp(at, arc, np.unwrap(directions(way)))
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    left = ahead[:, ::-1] * [-1, 1]
    height = ndimage.gaussian_filter1d(surface.height(xy), 2.0)
    pitch = -np.arctan2(surface.height(xy + ahead) - surface.height(xy - ahead), 2.0)
    roll = np.arctan2(surface.height(xy + left) - surface.height(xy - left), 2.0)
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, :3] = _level(heading, pitch, roll, rng)
    poses[:, :3, 3] = np.column_stack([xy, height + _HEIGHT])
    return poses


def _level(heading: Floats, pitch: Floats, roll: Floats, rng: np.random.Generator) -> Floats:
    from scipy.spatial.transform import Rotation

    sway = rng.normal(0.0, _SWAY, (len(heading), 2))
    smooth = ndimage.gaussian_filter1d(np.column_stack([pitch, roll]), 2.0, axis=0) + sway
    return np.asarray(Rotation.from_euler("ZYX", np.column_stack([heading, smooth])).as_matrix())


def survey() -> Path:
    """Return the survey's file; InputError without it."""
    if not SURVEY.is_file():
        raise InputError(f"{SURVEY.name} is not there; set COVIEW_DATA to the folder of real scans")
    return SURVEY


def recorded(name: str, below: Path) -> Path:
    """Return the directory with ``run/`` and ``truth.tum`` of one of :data:`ROUTES`, made now unless it is there."""
    survey()
    out, route = below / name, ROUTES[name]
    code = fingerprint("bench/harness/airborne.py", "coview_stream/sim")
    remembered(out / "drive.json", {"route": asdict(route), "code": code}, lambda: _write(route, out))
    return out


def _write(route: Route, out: Path) -> dict[str, Any]:
    """Write a run and its truth by the file contract."""
    cloud = read_cloud(SURVEY)
    corner = cloud.points.min(axis=0).astype(np.float64) * [1, 1, 0]
    way = np.array(route.way)
    local = cloud.points - corner.astype(np.float32)
    near = ((local[:, :2] > way.min(axis=0) - _REACH) & (local[:, :2] < way.max(axis=0) + _REACH)).all(axis=1)
    surface = Columns(np.ascontiguousarray(local[near]))
    rng = np.random.default_rng(route.seed)
    poses, sensor = drive(route, surface, rng), SENSORS[route.sensor]()
    caster: Any = surface
    (out / "run" / "frames").mkdir(parents=True, exist_ok=True)
    returns = 0
    for k, T in enumerate(poses):
        points = sensor.scan(caster, T, k, rng)
        returns += len(points)
        write_cloud(out / "run" / "frames" / f"{k:06d}.pcd", points)
    stamps = _FIRST_STAMP + _PERIOD * np.arange(len(poses), dtype=np.float64)
    write_tum(out / "run" / "odometry.tum", stamps, drifting_odometry(poses, ODOMETRY, rng))
    poses = poses.copy()
    poses[:, :3, 3] += corner + cloud.origin
    write_tum(out / "truth.tum", stamps, poses)
    return {"frames": len(poses), "metres": _SPEED * _PERIOD * len(poses), "returns": returns / len(poses)}
