"""small_gicp in a few lines of NumPy: what our part of GICP does is tested without the library.

As the library, it perturbs on the right, T exp(d) with d = (turn, shift), and its answer holds Hessian and gradient at
the pose that it was given. Unlike it, the scan's covariances are those of the map's points and do not turn.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial import cKDTree

from coview_stream.geometry.transforms import skew

_FLAT = 2e-3  # variance along the normal of two clouds' covariances


class PointCloud:
    def __init__(self, points):
        assert points.dtype == np.float64
        assert len(points) > 0, "the library aborts the interpreter here"
        assert np.isfinite(points).all(), "and here"
        self.points = points
        self.normals = None


class KdTree:
    def __init__(self, cloud, num_threads):
        assert num_threads == 1
        self.tree = cKDTree(cloud.points)


def estimate_covariances(cloud, tree, num_neighbors, num_threads):
    assert num_threads == 1
    _, near = tree.tree.query(cloud.points, num_neighbors)
    gaps = cloud.points[near] - cloud.points[near].mean(axis=1, keepdims=True)
    cloud.normals = np.linalg.eigh(np.einsum("nki,nkj->nij", gaps, gaps))[1][:, :, 0]


def align(target, source, tree, T, registration_type, max_correspondence_distance, num_threads, max_iterations):
    assert (registration_type, num_threads, max_iterations) == ("GICP", 1, 1)
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    distance, partner = tree.tree.query(moved, distance_upper_bound=max_correspondence_distance)
    found = np.isfinite(distance)
    p, q, n = source.points[found], target.points[partner[found]], target.normals[partner[found]]
    residual = np.einsum("ij,ij->i", moved[found] - q, n)
    along = n @ T[:3, :3]
    off = np.concatenate([-np.einsum("ni,nij->nj", along, skew(p)), along], axis=1)
    # along the surfaces two variances of 1 add up as well
    whole = np.concatenate([-T[:3, :3] @ skew(p), np.tile(T[:3, :3], (len(p), 1, 1))], axis=2)
    sharp = 1 / _FLAT - 0.5
    H = sharp * off.T @ off + 0.5 * np.einsum("nki,nkj->ij", whole, whole)
    b = sharp * off.T @ residual + 0.5 * np.einsum("nki,nk->i", whole, moved[found] - q)
    return SimpleNamespace(H=H, b=b)
