"""A walk through the real plot: what a virtual robot sees of the mobile scan, frame after frame, hidden points removed.

The points, their leaves and their ground are real; way, sensor and odometry are made up. See docs/forest.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from coview_stream import BaseMap, Localizer
from coview_stream.config import LocalizerConfig, Reloc
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, inverse, pose_from, rot_z, rotation_angle, transform
from coview_stream.sim.config import OdometryConfig
from coview_stream.sim.odometry import drifting_odometry

FALSE_METRES, FALSE_DEGREES = 2.0, 5.0  # as in the other whole runs of docs/forest.md
_RADIUS = 6.0  # metres of the round that is walked about the plot's middle: 38 m
_STEP = 0.5  # metres between frames
_PERIOD = 0.5  # seconds between them
_EYE = 1.2  # metres above the ground
_FLOOR = 1.5  # metres around the robot in which its ground is looked for
_SMOOTH = 2.0  # metres of the way over which its height is smoothed
_CELL = np.radians(1.5)  # of direction, of which the nearest return alone is seen
_THICK = 0.3  # metres behind it that are seen as well: bark and twigs are no surface
_REACH, _NEAREST = 40.0, 0.7  # metres
_NOISE = 0.02  # metres of range


@dataclass(frozen=True)
class Walk:
    """What a virtual robot was told, and where it was.

    Attributes:
        clouds: (N, 3) float32 of each frame, body frame, metres.
        odometry: (F, 4, 4) odometry <- body.
        truth: (F, 4, 4) map <- body.
    """

    clouds: list[Points]
    odometry: Floats
    truth: Floats

    @property
    def driven(self) -> Floats:
        """(F,) metres driven up to each frame."""
        steps = np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def walk(scan: Floats, seed: int, field_of_view: float) -> Walk:
    """Walk a round through a scan (N, 3) in the map's frame, by a lidar that sees so many radians up and down."""
    rng = np.random.default_rng([seed, 8731])
    middle = 0.5 * (scan[:, :2].min(axis=0) + scan[:, :2].max(axis=0))
    count = round(2 * np.pi * _RADIUS / _STEP) + 1
    angle = rng.uniform(0.0, 2 * np.pi) + rng.choice([-1.0, 1.0]) * np.linspace(0.0, 2 * np.pi, count)
    at = middle + _RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
    floor = np.array([np.percentile(scan[np.hypot(*(scan[:, :2] - p).T) < _FLOOR, 2], 1.0) for p in at])
    floor = gaussian_filter1d(floor, _SMOOTH / _STEP, mode="nearest")
    ahead = np.arctan2(*np.gradient(at, axis=0).T[::-1])
    truth = np.array([pose_from(rot_z(h), np.array([*p, z + _EYE])) for p, z, h in zip(at, floor, ahead, strict=True)])
    clouds = [_seen(scan, T, field_of_view, rng) for T in truth]
    return Walk(clouds, drifting_odometry(truth, OdometryConfig(), rng), truth)


def _seen(scan: Floats, T_map_body: Floats, field_of_view: float, rng: np.random.Generator) -> Points:
    """Return what of a scan (N, 3) is seen from a pose: the nearest returns of each direction, body frame."""
    points = transform(inverse(T_map_body), scan)
    flat, ranges = np.hypot(points[:, 0], points[:, 1]), np.linalg.norm(points, axis=1)
    up = np.arctan2(points[:, 2], flat)
    some = (ranges > _NEAREST) & (ranges < _REACH) & (np.abs(up) < field_of_view)
    points, ranges, up = points[some], ranges[some], up[some]
    row, column = np.floor(up / _CELL), np.floor(np.arctan2(points[:, 1], points[:, 0]) / _CELL)
    _, cell = np.unique(row * 10_000 + column, return_inverse=True)
    nearest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest, cell, ranges)
    visible = ranges < nearest[cell] + _THICK
    longer = 1.0 + _NOISE * rng.normal(size=visible.sum()) / ranges[visible]
    return np.asarray(points[visible] * longer[:, None], dtype=np.float32)


def followed(base: BaseMap, way: Walk, reloc: Reloc) -> dict[str, Any]:
    """Localize a walk (in the frame of the map's source); metres to the first fix, its errors, and those of all."""
    localizer = Localizer(base, LocalizerConfig(reloc=reloc))
    localizer.prepare()
    rows = []
    for k, cloud in enumerate(way.clouds):
        fix = localizer.step(cloud, way.odometry[k], _PERIOD * k)
        if fix.T_map_body is not None:
            off = inverse(way.truth[k]) @ fix.T_map_body
            shift = fix.T_map_body[:3, 3] - way.truth[k][:3, 3]
            metres = float(np.linalg.norm(shift))
            rows.append((k, metres, float(np.degrees(rotation_angle(off))), float(shift[2])))
    out = {"reloc": reloc, "driven_m": float(way.driven[-1]), "posed": len(rows) / len(way.clouds)}
    if not rows:
        return out | {"first_fix_m": None, "false": 0}
    frame, error, degrees, up = np.array(rows).T
    first = int(frame[0])
    wrong = (error > FALSE_METRES) | (degrees > FALSE_DEGREES)
    return out | {
        "first_fix_m": float(way.driven[first]), "posed_after": len(rows) / (len(way.clouds) - first),
        "first_off_m": float(error[0]), "first_off_deg": float(degrees[0]),
        "false": int(wrong.sum()), "median_m": float(np.median(error)), "median_deg": float(np.median(degrees)),
        "worst_m": float(error.max()), "worst_deg": float(degrees.max()), "median_up_m": float(np.median(up)),
    }  # fmt: skip
