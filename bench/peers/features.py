"""Open3D (MIT): FPFH features, then RANSAC or fast global registration; the submap against the whole map.

Settings as its tutorial on global registration gives them, with a voxel for outdoor clouds: 1 m, normals within
2 voxels, features within 5, correspondences within 1.5 (RANSAC; 4 points, edge length 0.9, mutual filter off, 10^5
iterations at confidence 0.999) or half a voxel (FGR). The map's features are made once. It has no rule of its own for
when to believe a result; the tutorial looks at the fitness (share of points with a partner), so it vouches from 0.5.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from bench.harness.places import Place
from bench.peers.method import Answer
from coview_stream import BaseMap
from coview_stream.clouds.open3d_loader import open3d
from coview_stream.geometry import Points

VOXEL, FITNESS = 1.0, 0.5


class Features:
    """FPFH features of map and submap, matched in one of two ways."""

    def __init__(self, site: BaseMap, way: Literal["ransac", "fgr"]) -> None:
        self._o3d: Any = open3d()
        self._o3d.utility.random.seed(1)
        self._way = way
        self._map = self._described(np.array(site.points))

    def answer(self, place: Place) -> Answer:
        """Describe the submap, match and solve."""
        cloud, feature = self._described(place.submap)
        found = self._ransac(cloud, feature) if self._way == "ransac" else self._fast(cloud, feature)
        T = np.array(found.transformation)
        # FGR reports no fitness of its own for all versions: measured alike for both
        fit = self._o3d.pipelines.registration.evaluate_registration(cloud, self._map[0], 1.5 * VOXEL, T)
        return Answer(T, fit.fitness >= FITNESS, float(fit.fitness))

    def _described(self, points: Points) -> tuple[Any, Any]:
        o3d, search = self._o3d, self._o3d.geometry.KDTreeSearchParamHybrid
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud = cloud.voxel_down_sample(VOXEL)
        cloud.estimate_normals(search(radius=2 * VOXEL, max_nn=30))
        cloud.orient_normals_to_align_with_direction((0.0, 0.0, 1.0))  # a viewpoint is not known for the map
        feature = o3d.pipelines.registration.compute_fpfh_feature(cloud, search(radius=5 * VOXEL, max_nn=100))
        return cloud, feature

    def _ransac(self, cloud: Any, feature: Any) -> Any:
        registration = self._o3d.pipelines.registration
        near = 1.5 * VOXEL
        return registration.registration_ransac_based_on_feature_matching(
            cloud, self._map[0], feature, self._map[1], False, near,
            registration.TransformationEstimationPointToPoint(False), 4,
            [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
             registration.CorrespondenceCheckerBasedOnDistance(near)],
            registration.RANSACConvergenceCriteria(100_000, 0.999),
        )  # fmt: skip

    def _fast(self, cloud: Any, feature: Any) -> Any:
        registration = self._o3d.pipelines.registration
        option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * VOXEL)
        return registration.registration_fgr_based_on_feature_matching(
            cloud, self._map[0], feature, self._map[1], option
        )
