"""KISS-Matcher 1.0 (MIT): FasterPFH, ROBIN pruning, GNC; the submap against the whole map.

Settings in its favour: of voxels of 0.7, 1, 1.5 and 2 m (its authors advise one that grows with the map; at 0.5 m the
whole map takes minutes), each with its default solver and with Quatro, made for level clouds, the pair that was right
most often on six places of either world; radii, noise bounds and 5,000 correspondences of its defaults. Both clouds
are its own to thin. It vouches by its own example's rule: a valid solution with five final inliers or more.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.harness.places import Place
from bench.peers.method import Answer
from coview_stream import BaseMap
from coview_stream.geometry import pose_from

VOXEL, INLIERS = 1.0, 5


class KissMatcher:
    """Register the submap to the map; nothing can be prepared but the cloud."""

    def __init__(self, site: BaseMap) -> None:
        import kiss_matcher

        config = kiss_matcher.KISSMatcherConfig(voxel_size=VOXEL, use_quatro=True)
        self._matcher: Any = kiss_matcher.KISSMatcher(config)
        self._map = np.array(site.points, dtype=np.float32)

    def answer(self, place: Place) -> Answer:
        """Match, prune and solve."""
        found = self._matcher.estimate(place.submap, self._map)
        inliers = int(self._matcher.get_num_final_inliers())
        T = pose_from(np.asarray(found.rotation), np.asarray(found.translation).ravel())
        return Answer(T, bool(found.valid) and inliers >= INLIERS, inliers)
