"""The other libraries, each with the settings that favour it."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np

import coview_kernels
from bench.harness.worlds import Place
from coview_stream import BaseMap
from coview_stream.clouds.filters import open3d
from coview_stream.config import LocalizerConfig
from coview_stream.errors import require_library
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, norms, pose_from, rot_z
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import register
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.tracking.place_evidence import PlaceEvidence

OFF, TURNED = 0.5, float(np.radians(3.0))  # how far from the truth tracking starts, metres and radians


@dataclass(frozen=True)
class Answer:
    """A pose (4, 4) map <- submap, or None, and whether the method itself vouches for it."""

    T_map_submap: Pose | None
    vouched: bool


class Method(Protocol):
    """One way to localize; made for one map, asked many times."""

    def answer(self, place: Place) -> Answer:
        """Say where the submap lies, or that it is not known."""


def started(place: Place) -> Pose:
    """Return ``T_map_submap`` (4, 4) that tracking starts from: the truth, off in a direction of the place's own."""
    rng = np.random.default_rng(int(abs(place.T_map_submap[0, 3]) * 1e3))
    heading, turn = rng.uniform(-np.pi, np.pi), TURNED * rng.choice([-1.0, 1.0])
    off = pose_from(rot_z(turn), [OFF * np.cos(heading), OFF * np.sin(heading), 0.0])
    return np.asarray(place.T_map_submap @ off)


class Keyframes:
    """The search over the keyframes of a drive."""

    def __init__(self, site: BaseMap) -> None:
        coview_kernels.warm_up()
        config = LocalizerConfig()
        self._search = GlobalSearch(site, config, LocalMaps(site, config.registration.source_range))

    def answer(self, place: Place) -> Answer:
        """Search until a keyframe's verdict accepts a place."""
        self._search.clear()
        for query in self._queries(place):
            accepted = self._search.update(query).accepted
            if accepted is not None:
                return Answer(accepted.T_map_odom @ place.T_odom_submap, True)
        return Answer(None, False)

    def _queries(self, place: Place) -> list[SearchRequest]:
        return place.queries


class OneScan(Keyframes):
    """The search from one submap alone: all points of the drive as if they were one scan."""

    def _queries(self, place: Place) -> list[SearchRequest]:
        newest = place.queries[-1]
        return [replace(newest, submap=place.submap + newest.position.astype(np.float32))]


class Tracking:
    """Registration from a pose nearby, believed if the scan speaks for it, as for every registration."""

    def __init__(self, site: BaseMap) -> None:
        coview_kernels.warm_up()
        self._site, self._config = site, LocalizerConfig().registration
        self._maps = LocalMaps(site, self._config.source_range)

    def answer(self, place: Place) -> Answer:
        """Register the submap."""
        start, newest = started(place), place.queries[-1]
        source = prepare_scan(place.submap, np.zeros(3), self._config)
        target = self._maps.around(start[:3, 3])
        if target is None:
            return Answer(None, False)
        found = register(source, start, target, self._config, self._config.track, centre=np.zeros(3))
        if found is None:
            return Answer(None, False)
        T = found.T_map_source
        # the submap's frame takes the place of odometry's
        scan = ObservedScan.of(source, newest.cloud, inverse(place.T_odom_submap) @ newest.T_odom_body)
        return Answer(T, PlaceEvidence(self._site).observe(scan, T).ratio > 0.0)


class KissMatcher:
    """KISS-Matcher 1.0 (MIT): FasterPFH, ROBIN pruning, GNC; the submap against the whole map.

    Settings in its favour: of voxels of 0.7, 1, 1.5 and 2 m (its authors advise one that grows with the map; at 0.5 m
    the whole map takes minutes), each with its default solver and with Quatro, made for level clouds, the pair that
    was right most often on six places of either world; radii, noise bounds and 5,000 correspondences of its defaults.
    Both clouds are its own to thin; nothing can be prepared but the cloud. It vouches by its own example's rule: a
    valid solution with five final inliers or more.
    """

    VOXEL, INLIERS = 1.0, 5

    def __init__(self, site: BaseMap) -> None:
        kiss_matcher = require_library("kiss_matcher", "kiss-matcher>=1.0.2", "the comparison with KISS-Matcher")
        config = kiss_matcher.KISSMatcherConfig(voxel_size=self.VOXEL, use_quatro=True)
        self._matcher: Any = kiss_matcher.KISSMatcher(config)
        self._map = np.array(site.points, dtype=np.float32)

    def answer(self, place: Place) -> Answer:
        """Match, prune and solve."""
        found = self._matcher.estimate(place.submap, self._map)
        inliers = int(self._matcher.get_num_final_inliers())
        T = pose_from(np.asarray(found.rotation), np.asarray(found.translation).ravel())
        return Answer(T, bool(found.valid) and inliers >= self.INLIERS)


class MapClosures:
    """MapClosures 2.2 (MIT): ORB features of density images, a tree of binary words, 2D RANSAC.

    The map is cut into local maps, and the submap is the query that may close a loop with one of them. Settings in its
    favour: local maps of the submap's own reach (60 m about their centre) every 15 m, much denser than its pipeline
    makes them; its own 0.5 m voxels, density threshold, Hamming distance and ground alignment; the best of all closures
    counts. It vouches by its pipeline's rule: more than five inliers.
    """

    SPACING, REACH, VOXEL = 15.0, 60.0, 0.5
    _APART = 10  # between the numbers of queries: neighbours in number are never compared

    def __init__(self, site: BaseMap) -> None:
        require_library("map_closures", "map-closures>=2.2", "the comparison with MapClosures")
        from map_closures.config import MapClosuresConfig
        from map_closures.map_closures import MapClosures as Closures

        config = MapClosuresConfig()
        self._least = config.inliers_threshold
        self._closures: Any = Closures(config)
        stations = site.stations
        low, high = stations.min(axis=0)[:2], stations.max(axis=0)[:2]
        xs, ys = (np.arange(a + self.SPACING / 2, b, self.SPACING) for a, b in zip(low, high, strict=True))
        nearest = {(x, y): np.hypot(stations[:, 0] - x, stations[:, 1] - y).argmin() for x in xs for y in ys}
        centres = [np.array([*at, stations[k, 2]]) for at, k in nearest.items()]
        self._tiles = [c for c in centres if len(site.crop(c, self.REACH)[0]) >= 1000]
        # closures are looked for with earlier numbers only: backwards, no tile is compared with another one
        for number in reversed(range(len(self._tiles))):
            points, _ = site.crop(self._tiles[number], self.REACH)
            self._closures.get_closures(number, self._thinned(points.astype(np.float64) - self._tiles[number]))
        self._asked = len(self._tiles) + self._APART

    def answer(self, place: Place) -> Answer:
        """Find the closure with most inliers among the tiles; those with earlier queries do not count."""
        found = self._closures.get_closures(self._asked, self._thinned(place.submap.astype(np.float64)))
        self._asked += self._APART
        known = [c for c in found if c.source_id < len(self._tiles)]
        best = max(known, key=lambda c: c.number_of_inliers, default=None)
        if best is None:
            return Answer(None, False)
        T = pose_from(np.eye(3), self._tiles[best.source_id]) @ inverse(np.asarray(best.pose))
        return Answer(T, best.number_of_inliers > self._least)

    def _thinned(self, points: Floats) -> Floats:
        """Thin as its pipeline does before it asks."""
        from map_closures.voxel_map import VoxelMap

        voxels = VoxelMap(self.VOXEL, 2.0 * self.REACH)
        voxels.add_points(points)
        return np.asarray(voxels.point_cloud())


class Features:
    """Open3D (MIT): FPFH features, then RANSAC or fast global registration; the submap against the whole map.

    Settings as its tutorial on global registration gives them, with a voxel for outdoor clouds: 1 m, normals within
    2 voxels, features within 5, correspondences within 1.5 (RANSAC; 4 points, edge length 0.9, mutual filter off, 10^5
    iterations at confidence 0.999) or half a voxel (FGR). The map's features are made once. It has no rule of its own
    for when to believe a result; the tutorial looks at the fitness (share of points with a partner), so it vouches from
    0.5.
    """

    VOXEL, FITNESS = 1.0, 0.5

    def __init__(self, site: BaseMap, way: Literal["ransac", "fgr"]) -> None:
        self._o3d: Any = open3d()
        self._registration = self._o3d.pipelines.registration
        self._o3d.utility.random.seed(1)
        self._way = way
        self._map = self._described(np.array(site.points))

    def answer(self, place: Place) -> Answer:
        """Describe the submap, match and solve."""
        cloud, feature = self._described(place.submap)
        asked, registration, near = (cloud, self._map[0], feature, self._map[1]), self._registration, 1.5 * self.VOXEL
        if self._way == "ransac":
            found = registration.registration_ransac_based_on_feature_matching(
                *asked, False, near, registration.TransformationEstimationPointToPoint(False), 4,
                [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                 registration.CorrespondenceCheckerBasedOnDistance(near)],
                registration.RANSACConvergenceCriteria(100_000, 0.999),
            )  # fmt: skip
        else:
            option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * self.VOXEL)
            found = registration.registration_fgr_based_on_feature_matching(*asked, option)
        # FGR reports no fitness of its own for all versions: measured alike for both
        fit = registration.evaluate_registration(cloud, self._map[0], near, found.transformation)
        return Answer(np.array(found.transformation), fit.fitness >= self.FITNESS)

    def _described(self, points: Points) -> tuple[Any, Any]:
        o3d, search, voxel = self._o3d, self._o3d.geometry.KDTreeSearchParamHybrid, self.VOXEL
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud = cloud.voxel_down_sample(voxel)
        cloud.estimate_normals(search(radius=2 * voxel, max_nn=30))
        cloud.orient_normals_to_align_with_direction((0.0, 0.0, 1.0))  # a viewpoint is not known for the map
        feature = self._registration.compute_fpfh_feature(cloud, search(radius=5 * voxel, max_nn=100))
        return cloud, feature


def small_gicp() -> Any:
    """Import it, or raise ``DependencyError`` with the remedy."""
    return require_library("small_gicp", "small-gicp>=1.0.1", "the comparison with small_gicp")


class SmallGicp:
    """small_gicp 1.0 (MIT): GICP or VGICP (voxels of 1 m, covariances of 10 points) to a prepared cloud."""

    def __init__(self, points: Points, way: Literal["GICP", "VGICP"], voxel: float, near: float, threads: int) -> None:
        """Prepare the target, thinned to ``voxel`` metres; correspondences count within ``near`` metres."""
        self._library = small_gicp()
        self._threads = threads
        self._target, tree = self.prepared(points, voxel)
        self._about: dict[str, Any] = {"max_correspondence_distance": near, "num_threads": threads}
        if way == "VGICP":
            voxels = self._library.GaussianVoxelMap(1.0)
            voxels.insert(self._target)
            self._target = voxels
        else:
            self._about["target_tree"] = tree

    def prepared(self, points: Points, voxel: float) -> Any:
        """Thin a cloud and estimate its covariances; with its search tree."""
        return self._library.preprocess_points(
            points.astype(np.float64), downsampling_resolution=voxel, num_neighbors=10, num_threads=self._threads
        )

    def align(self, source: Any, start: Pose) -> Any:
        """Align a prepared cloud to the target from a pose nearby."""
        return self._library.align(self._target, source, init_T_target_source=start, **self._about)


class NearbyGicp(SmallGicp):
    """small_gicp: the submap to the map, from a pose nearby.

    Settings of its documentation: correspondences within 1 m. The map is prepared once, at 0.25 m. In its favour, the
    submap is cut to 50 m and thinned to 0.5 m, as our registration does it: at its default of 0.25 m and without a cut
    it is as exact and takes two to four times as long (measured). Thinning and covariances of the submap are part of a
    query, as ours are. All cores. It vouches when it says that it has converged.
    """

    MAP, SUBMAP, REACH, NEAR = 0.25, 0.5, 50.0, 1.0

    def __init__(self, site: BaseMap, way: Literal["GICP", "VGICP"]) -> None:
        super().__init__(np.array(site.points), way, self.MAP, self.NEAR, os.cpu_count() or 1)

    def answer(self, place: Place) -> Answer:
        """Prepare the submap and align it."""
        source, _ = self.prepared(place.submap.compress(norms(place.submap) < self.REACH, axis=0), self.SUBMAP)
        found = self.align(source, started(place))
        return Answer(np.array(found.T_target_source), bool(found.converged))
