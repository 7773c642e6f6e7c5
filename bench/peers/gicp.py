"""small_gicp 1.0 (MIT): GICP and VGICP of the submap to the map, from a pose nearby.

Settings of its documentation: covariances of 10 neighbours, voxels of 1 m for VGICP, correspondences within 1 m. The
map is prepared once, at 0.25 m. In its favour, the submap is cut to 50 m and thinned to 0.5 m, as our registration
does it: at its default of 0.25 m and without a cut it is as exact and takes two to four times as long (measured).
Thinning and covariances of the submap are part of a query, as ours are. All cores. It vouches when it says that it
has converged.
"""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np

from bench.harness.places import Place
from bench.peers.method import Answer
from bench.peers.start import started
from coview_stream import BaseMap
from coview_stream.geometry import lengths

MAP, SUBMAP, REACH, VOXEL, NEAR = 0.25, 0.5, 50.0, 1.0, 1.0
_NEIGHBOURS = 10


class SmallGicp:
    """Scan to map, the map prepared."""

    def __init__(self, site: BaseMap, way: Literal["GICP", "VGICP"]) -> None:
        import small_gicp

        self._library: Any = small_gicp
        self._threads = os.cpu_count() or 1
        points = np.array(site.points, dtype=np.float64)
        self._map, self._tree = small_gicp.preprocess_points(
            points, downsampling_resolution=MAP, num_neighbors=_NEIGHBOURS, num_threads=self._threads
        )
        self._voxels: Any = None
        if way == "VGICP":
            self._voxels = small_gicp.GaussianVoxelMap(VOXEL)
            self._voxels.insert(self._map)

    def answer(self, place: Place) -> Answer:
        """Prepare the submap and align it."""
        near = place.submap.compress(lengths(place.submap) < REACH, axis=0).astype(np.float64)
        source, _ = self._library.preprocess_points(
            near, downsampling_resolution=SUBMAP, num_neighbors=_NEIGHBOURS, num_threads=self._threads
        )
        about = {"num_threads": self._threads, "max_correspondence_distance": NEAR}
        if self._voxels is not None:
            found = self._library.align(self._voxels, source, started(place), **about)
        else:
            found = self._library.align(self._map, source, self._tree, started(place), **about)
        return Answer(np.array(found.T_target_source), bool(found.converged), float(found.num_inliers))
