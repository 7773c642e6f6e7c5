"""MapClosures 2.2 (MIT): ORB features of density images, a tree of binary words, 2D RANSAC.

The map is cut into local maps, and the submap is the query that may close a loop with one of them. Settings in its
favour: local maps of the submap's own reach (60 m about their centre) every 15 m, much denser than its pipeline
makes them; its own 0.5 m voxels, density threshold, Hamming distance and ground alignment; the best of all closures
counts. It vouches by its pipeline's rule: more than five inliers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from bench.harness.places import Place
from bench.peers.method import Answer
from coview_stream import BaseMap
from coview_stream.geometry import inverse, pose_from

SPACING, REACH, VOXEL = 15.0, 60.0, 0.5
_LEAST_POINTS = 1000
_APART = 10  # between the numbers of queries: neighbours in number are never compared


class MapClosures:
    """Tiles of the map as the local maps of an earlier drive."""

    def __init__(self, site: BaseMap) -> None:
        from map_closures.config import MapClosuresConfig
        from map_closures.map_closures import MapClosures as Closures

        config = MapClosuresConfig()
        self._least = config.inliers_threshold
        self._closures: Any = Closures(config)
        low, high = site.stations.min(axis=0)[:2], site.stations.max(axis=0)[:2]
        centres = [
            np.array([x, y, site.stations[_nearest(site.stations, x, y), 2]])
            for x in np.arange(low[0] + SPACING / 2, high[0], SPACING)
            for y in np.arange(low[1] + SPACING / 2, high[1], SPACING)
        ]
        self._tiles = [centre for centre in centres if len(site.crop(centre, REACH)[0]) >= _LEAST_POINTS]
        # closures are looked for with earlier numbers only: backwards, no tile is compared with another one
        for number in reversed(range(len(self._tiles))):
            points, _ = site.crop(self._tiles[number], REACH)
            self._closures.get_closures(number, _thinned(points.astype(np.float64) - self._tiles[number]))
        self._asked = len(self._tiles) + _APART

    def answer(self, place: Place) -> Answer:
        """Find the closure with most inliers among the tiles; those with earlier queries do not count."""
        cloud = _thinned(place.submap.astype(np.float64))
        found = self._closures.get_closures(self._asked, cloud)
        self._asked += _APART
        known = [c for c in found if c.source_id < len(self._tiles)]
        best = max(known, key=lambda c: c.number_of_inliers, default=None)
        if best is None:
            return Answer(None, False)
        T_submap_tile = np.asarray(best.pose)
        T = pose_from(np.eye(3), self._tiles[best.source_id]) @ inverse(T_submap_tile)
        return Answer(T, best.number_of_inliers > self._least, best.number_of_inliers)


def _nearest(stations: npt.NDArray[np.float32], x: float, y: float) -> int:
    return int(np.hypot(stations[:, 0] - x, stations[:, 1] - y).argmin())


def _thinned(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Thin as its pipeline does before it asks."""
    from map_closures.voxel_map import VoxelMap

    voxels = VoxelMap(VOXEL, 2.0 * REACH)
    voxels.add_points(points)
    return np.asarray(voxels.point_cloud())
