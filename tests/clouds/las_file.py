"""LAS and LAZ files of a version, a point format and variable records."""

import laspy
import numpy as np


def written(path, points, version="1.2", point_format=1, vlrs=()):
    """Write points (N, 3), in millimetres of their unit; returns the path."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points.min(axis=0))
    header.vlrs.extend(vlrs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))
    return path
