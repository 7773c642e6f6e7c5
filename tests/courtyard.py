"""A courtyard with exact normals: ground, four walls of different places, a block; no gaps and no noise."""

import numpy as np

from coview_stream.geometry.transforms import transform
from coview_stream.localization.registration.clouds import LocalMap, RegistrationCloud


def plane(corner, a, b, spacing=0.25):
    """Points (N, 3) on the rectangle of edges ``a`` and ``b`` from ``corner``, and their normals."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    u, v = np.meshgrid(np.arange(0, 1, spacing / np.linalg.norm(a)), np.arange(0, 1, spacing / np.linalg.norm(b)))
    points = np.asarray(corner, float) + u.reshape(-1, 1) * a + v.reshape(-1, 1) * b
    normal = np.cross(a, b)
    return points, np.tile(normal / np.linalg.norm(normal), (len(points), 1))


def parts(*planes):
    points, normals = (np.concatenate(column) for column in zip(*planes, strict=True))
    return points.astype(np.float32), normals.astype(np.float32)


def courtyard():
    return parts(
        plane([-15, -15, 0], [30, 0, 0], [0, 30, 0]),
        plane([-15, -12, 0], [30, 0, 0], [0, 0, 5]),
        plane([13, -15, 0], [0, 30, 0], [0, 0, 4]),
        plane([-14, -15, 0], [3, 29, 0], [0, 0, 6]),
        plane([-6, 10, 0], [14, 0, 0], [0, 0, 3]),
        plane([3, 3, 0], [3, 0, 0], [0, 0, 2.5]),
        plane([3, 3, 0], [0, 3, 0], [0, 0, 2.5]),
    )


def local_map(points, normals) -> LocalMap:
    return LocalMap(points, normals)


def source_of(points, T_map_source, ground=0.0) -> RegistrationCloud:
    """Map points as a local scan sees them from another frame; heights are those above the map's ground."""
    height = (points[:, 2] - ground).astype(np.float32)
    T_source_map = np.linalg.inv(T_map_source)
    return RegistrationCloud(
        transform(T_source_map, points.astype(np.float64)).astype(np.float32), height > 0.5, height
    )
