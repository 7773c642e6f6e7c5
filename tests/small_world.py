"""A world of boxes on a plane, made with NumPy only: scans by casting rays, a base map by sampling surfaces.

The tests of the engine, of the offline path and of the commands all use it; ``conftest.py`` builds it once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coview_stream.clouds.files import write_cloud
from coview_stream.clouds.trajectory import write_tum
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform, yaw_of

SENSOR_HEIGHT = 1.7
HALF = 34.0  # metres: half the side of the map
ODOM_FAR = pose_from(rot_z(np.radians(110.0)), [5230.0, -7710.0, 93.0])
"""odometry <- map of the tests' runs: another heading and a far-away origin."""
FRAMES = 10


@dataclass(frozen=True)
class Box:
    """A box on the ground: centre (2,), length, width and height, heading in radians."""

    centre: np.ndarray
    size: np.ndarray
    yaw: float


def drive(frames: int = FRAMES) -> list[np.ndarray]:
    """``T_map_body`` of frames 2.1 m apart: straight on, then a bend to the left; the sensor stands level."""
    yaw = np.radians(np.r_[np.zeros(4), 12.0 * np.arange(1, 40)])[:frames]
    steps = 2.1 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    xy = np.array([-12.0, -4.0]) + np.cumsum(steps, axis=0)
    return [pose_from(rot_z(a), [x, y, SENSOR_HEIGHT]) for a, (x, y) in zip(yaw, xy, strict=True)]


def boxes(seed: int, count: int = 18) -> list[Box]:
    """Draw ``count`` boxes that leave the drive free and do not meet."""
    rng = np.random.default_rng(seed)
    path = np.array([T[:2, 3] for T in drive()])
    found: list[Box] = []
    while len(found) < count:
        centre = rng.uniform(-HALF + 5, HALF - 5, 2)
        size = rng.uniform([3.0, 3.0, 2.0], [10.0, 7.0, 9.0])
        reach = 0.5 * np.hypot(*size[:2])
        apart = all(np.hypot(*(centre - b.centre)) > reach + 0.5 * np.hypot(*b.size[:2]) for b in found)
        if apart and np.hypot(*(path - centre).T).min() > reach + 2.0:
            found.append(Box(centre, size, rng.uniform(0, np.pi)))
    return found


def in_box_frame(box: Box, points: np.ndarray) -> np.ndarray:
    return (points - box.centre) @ rot_z(box.yaw)[:2, :2]


def sample_map(scene: list[Box], seed: int = 5, spacing: float = 0.25) -> np.ndarray:
    """Points (N, 3) float64 on the ground, walls and roofs, with 1 cm noise."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-HALF, HALF, spacing)
    ground = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    parts = []
    free = np.ones(len(ground), dtype=bool)
    for box in scene:
        free &= (np.abs(in_box_frame(box, ground)) > 0.5 * box.size[:2]).any(axis=1)
        length, width, height = box.size
        for a, b, normal_axis, side in ((width, height, 0, length), (length, height, 1, width)):
            for sign in (-1.0, 1.0):
                n = int(a * b / spacing**2)
                wall = np.empty((n, 3))
                wall[:, normal_axis] = sign * 0.5 * side
                wall[:, 1 - normal_axis] = rng.uniform(-0.5 * a, 0.5 * a, n)
                wall[:, 2] = rng.uniform(0.0, b, n)
                parts.append((wall, box))
        roof = rng.uniform(-0.5, 0.5, (int(length * width / spacing**2), 3)) * [length, width, 0.0]
        roof[:, 2] = height
        parts.append((roof, box))
    ground = ground[free]
    points = [np.column_stack([ground, np.zeros(len(ground))])]
    points += [p @ rot_z(b.yaw).T + [*b.centre, 0.0] for p, b in parts]
    cloud = np.concatenate(points)
    return cloud + rng.normal(0.0, 0.01, cloud.shape)


def scan(scene: list[Box], T_map_body: np.ndarray, seed: int = 0) -> np.ndarray:
    """One lidar frame (N, 3) float32 in the body frame: 24 beams, 450 azimuths, 45 m, 1 cm noise."""
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-22, 16, 24)), np.arange(450) * 2 * np.pi / 450)
    level = np.cos(elevation.ravel())
    rays = np.column_stack(
        [level * np.cos(azimuth.ravel()), level * np.sin(azimuth.ravel()), np.sin(elevation.ravel())]
    )
    ranges = _cast(scene, T_map_body[:3, 3], rays @ T_map_body[:3, :3].T)
    hit = ranges < 45.0
    noise = np.random.default_rng(seed).normal(0.0, 0.01, len(rays))
    return (rays[hit] * (ranges + noise)[hit, None]).astype(np.float32)


def _cast(scene: list[Box], eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(rays[:, 2] < 0, -eye[2] / rays[:, 2], np.inf)
        for box in scene:
            turn = rot_z(box.yaw)
            start = (eye - [*box.centre, 0.5 * box.size[2]]) @ turn
            way = rays @ turn
            t = np.stack([(-0.5 * box.size - start) / way, (0.5 * box.size - start) / way])
            enter, leave = t.min(axis=0).max(axis=1), t.max(axis=0).min(axis=1)
            nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    return nearest


@dataclass(frozen=True)
class Drive:
    """A run through the world: body-frame clouds, odometry and truth (map <- body, map origin at zero)."""

    clouds: list[np.ndarray]
    T_odom_body: list[np.ndarray]
    T_map_body: list[np.ndarray]

    def seen_from(self, T_odom_map: np.ndarray) -> Drive:
        """Return the same run with another odometry frame."""
        return Drive(self.clouds, [T_odom_map @ T for T in self.T_map_body], self.T_map_body)


def record(scene: list[Box], T_odom_map: np.ndarray = ODOM_FAR, frames: int = FRAMES) -> Drive:
    truth = drive(frames)
    clouds = [scan(scene, T, seed) for seed, T in enumerate(truth)]
    return Drive(clouds, [T_odom_map @ T for T in truth], truth)


def along(poses: list[np.ndarray], spacing: float) -> list[np.ndarray]:
    """Poses ``spacing`` metres apart on straight lines between the given ones; headings turn evenly."""
    places = np.array([T[:3, 3] for T in poses])
    headings = np.unwrap([yaw_of(T) for T in poses])
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))]
    at = np.arange(0.0, way[-1], spacing)
    xyz = np.column_stack([np.interp(at, way, places[:, axis]) for axis in range(3)])
    yaws = np.interp(at, way, headings)
    return [pose_from(rot_z(yaw), place) for yaw, place in zip(yaws, xyz, strict=True)]


def record_along(scene: list[Box], poses: list[np.ndarray], spacing: float) -> Drive:
    """Scan a frame every ``spacing`` metres on the way through the poses."""
    truth = along(poses, spacing)
    clouds = [scan(scene, T, seed) for seed, T in enumerate(truth, start=100)]
    return Drive(clouds, [ODOM_FAR @ T for T in truth], truth)


def pose_error(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return metres and degrees between two poses."""
    gap = inverse(truth) @ T
    angle = np.degrees(np.arccos(np.clip((np.trace(gap[:3, :3]) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(gap[:3, 3])), float(angle)


def assert_pose(T: np.ndarray, truth: np.ndarray, metres: float, degrees: float = 180.1) -> None:
    """Fail unless the pose is within so many metres and degrees of the true one."""
    off = pose_error(T, truth)
    assert off[0] < metres, off
    assert off[1] < degrees, off


def in_map(drive: Drive, count: int) -> np.ndarray:
    """Return the first frames' points (N, 3) float32 where they truly are."""
    pairs = zip(drive.clouds[:count], drive.T_map_body, strict=False)
    return np.concatenate([transform(T, c) for c, T in pairs]).astype(np.float32)


def write_run(folder: Path, drive: Drive, frames: int = FRAMES) -> Path:
    (folder / "frames").mkdir(parents=True)
    for k in range(frames):
        write_cloud(folder / "frames" / f"{k:06d}.ply", drive.clouds[k])
    write_tum(folder / "odometry.tum", 100.0 + 0.5 * np.arange(frames), drive.T_odom_body[:frames])
    return folder
