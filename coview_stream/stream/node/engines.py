"""The engine of many robots on one map, in two halves: the quick one tracks, the slow one searches.

They share nothing but the map's file, so each can have a process of its own: a search of 0.3 s must delay neither the
frames of other robots nor the pose clock. A third one, :mod:`coview_stream.stream.node.odometry_engine`, needs no map.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Protocol

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.errors import MapError, RunError
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration import gicp
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.localization.tracking.pose_graph import PoseGraph
from coview_stream.odometry.deskew import deskew
from coview_stream.stream.node.jobs import FrameJob, FrameResult, Job, Result, SearchJob

_CROPS = 24  # of the map with their search grids, shared by all robots


class Engine(Protocol):
    """Works through jobs one at a time; an exception concerns the job's robot only."""

    def run(self, job: Job) -> Result:
        """Do one job."""
        ...

    def forget(self, robot: str) -> None:
        """Drop what is known of a robot."""
        ...

    @property
    def kernels(self) -> tuple[str, ...]:
        """Those that its jobs launch, to be compiled before the first."""
        ...

    def prepare(self) -> None:
        """Do what would make the first job slow; called when there may be time."""
        ...


class TrackEngine:
    """Takes in frames: keyframes, deskewing, registration around a known place."""

    kernels = ("transform_unique", "nearest", "align_planes")

    def __init__(self, base_map: BaseMap, config: LocalizerConfig | None = None) -> None:
        self.base_map = base_map
        self.config = config or LocalizerConfig()
        self._local_maps = LocalMaps(base_map, self.config.registration.source_range, _CROPS)
        self._robots: dict[str, tuple[int, Localizer]] = {}
        self._knowledge = SearchIndex.of(
            base_map, self.config, load=False
        )  # what queries have to bring: others search

    def run(self, job: Job) -> FrameResult:
        """Take in one frame.

        Raises:
            CloudError, RunError: the frame is unusable; nothing has changed.
        """
        if not isinstance(job, FrameJob):
            raise TypeError(f"{type(job).__name__} is no frame")
        begin = time.perf_counter()
        localizer = self._localizer(job)
        points = job.points
        if job.times is not None and job.segment is not None:
            points = deskew(points, job.times, job.segment, job.stamp_ns, job.T_odom_body)
        if job.verdict is not None:
            localizer.adopt(job.verdict)
        if job.suspect:
            localizer.suspect()
        if job.suggested is not None:
            with contextlib.suppress(RunError):  # a guess of no use is no reason to drop the frame
                localizer.suggest(job.suggested)
        query = localizer.take(points, job.T_odom_body, job.stamp_ns * 1e-9, job.hurry)
        return FrameResult(localizer.fix(), query, time.perf_counter() - begin)

    def forget(self, robot: str) -> None:
        """Drop a robot's localizer."""
        self._robots.pop(robot, None)

    def prepare(self) -> None:
        """Import what the graph of poses runs on; the map is cropped where robots are."""
        PoseGraph(self.config.graph)

    def _localizer(self, job: FrameJob) -> Localizer:
        epoch, localizer = self._robots.get(job.robot, (None, None))
        if localizer is None:
            localizer = Localizer(self.base_map, self.config, self._local_maps, self._knowledge)
        elif epoch != job.epoch:
            localizer.reset()
        self._robots[job.robot] = job.epoch, localizer
        return localizer


class SearchEngine:
    """Searches the whole map for keyframes; all robots share the map's spectra and networks."""

    kernels = ("transform_unique", "describe_points", "nearest", "align_planes")

    def __init__(self, base_map: BaseMap, config: LocalizerConfig | None = None) -> None:
        self.base_map = base_map
        self.config = config or LocalizerConfig()
        self._local_maps = LocalMaps(base_map, self.config.registration.source_range, _CROPS)
        self._robots: dict[str, tuple[int, GlobalSearch]] = {}
        self._knowledge = SearchIndex.of(base_map, self.config)

    def run(self, job: Job) -> SearchResult:
        """Search for one keyframe."""
        if not isinstance(job, SearchJob):
            raise TypeError(f"{type(job).__name__} is no search")
        epoch, search = self._robots.get(job.robot, (None, None))
        if search is None:
            search = GlobalSearch(self.base_map, self.config, self._local_maps, self._knowledge)
        elif epoch != job.epoch:
            search.clear()
        self._robots[job.robot] = job.epoch, search
        return search.update(job.query)

    def forget(self, robot: str) -> None:
        """Drop a robot's votes."""
        self._robots.pop(robot, None)

    def prepare(self) -> None:
        """Make the stations' spectra, and those of the map's learned features."""
        self._knowledge.prepare()


def open_engine(
    kind: str, map_path: str | Path, sha256: str, config: LocalizerConfig | None = None
) -> Engine:
    """Make the engine ``track``, ``search`` or ``odometry``; the first two load the map.

    Raises:
        MapError: an unusable map, or another one than ``sha256`` says. DependencyError: no kiss-icp, or no small_gicp
            where ``config`` wants it. InputError, DependencyError: it wants learned features, which cannot be used.
    """
    if kind == "odometry":
        from coview_stream.stream.node.odometry_engine import OdometryEngine

        return OdometryEngine()
    if config is not None and config.registration.method == "gicp":
        gicp.library()
    base_map = BaseMap.load(map_path)
    if base_map.sha256 != sha256:
        raise MapError(f"{map_path}: has been replaced by another map; start the node (serve) again")
    return TrackEngine(base_map, config) if kind == "track" else SearchEngine(base_map, config)
