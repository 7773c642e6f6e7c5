"""The engines, each for many robots: one tracks, a slow one searches, a third computes lidar odometry.

They share only the map file, so each can have its own process: a search must not delay the frames of other robots or
the pose clock. The odometry engine needs no map.
"""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path

from coview_kernels.mapped import release
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import Trust
from coview_stream.config import LocalizerConfig
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import InputError, MapError, RunError
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.clouds import LocalMaps
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.advice import AdvisedSearch
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.odometry.deskew import deskew
from coview_stream.odometry.lidar_odometry import KissRegistration, LidarOdometry, ScanRegistration
from coview_stream.stream.node.engine_queue import FrameJob, FrameResult, Job, Result, SearchJob
from coview_stream.stream.node.inputs import OdometryJob, OdometryResult


class Engine(ABC):
    """Works through jobs one at a time; an exception affects the job's robot only.

    Attributes:
        kernels: kernels of its first jobs, loaded (if need be compiled) before these.
        later_kernels: kernels of later jobs only, loaded in the pauses between jobs.
        on_doubt: called during a job if its frame contradicts the robot's place.
    """

    kernels: tuple[str, ...] = ()
    later_kernels: tuple[str, ...] = ()
    on_doubt: Callable[[], None] = staticmethod(lambda: None)

    @abstractmethod
    def run(self, job: Job) -> Result:
        """Do one job."""

    @abstractmethod
    def forget(self, robot: str) -> None:
        """Forget a robot."""

    def prepare(self) -> None:  # noqa: B027 - not every engine has work before its first job
        """Prepare for the first job."""

    def prepare_later(self) -> None:  # noqa: B027 - likewise
        """Prepare for later jobs, in the first pause."""

    def rest(self) -> None:  # noqa: B027 - likewise
        """Free memory that later jobs read or compute again, in a longer pause."""


class TrackEngine(Engine):
    """Localizers of all robots: deskewing, keyframes, registration near a known place."""

    kernels = ("transform_unique",)
    # for robots that have driven a metre, and for those with a place to track from
    later_kernels = ("nearest", "align_planes", "crop_points", "field_scores", "PointGrid")

    def __init__(self, base_map: BaseMap, config: LocalizerConfig | None = None) -> None:
        self.base_map = base_map
        self.config = config or LocalizerConfig()
        self._local_maps = LocalMaps(base_map, self.config.registration.source_range)
        self._robots: dict[str, tuple[int, int, Localizer]] = {}  # first epoch, epoch
        # without network weights: here the index only says what requests for the search engine must contain
        self._index = SearchIndex.of(base_map, self.config, load=False)

    def run(self, job: Job) -> FrameResult:
        """Process one frame; CloudError or RunError: it is unusable and changes nothing.

        Its search result, hint or request to verify the place may have been applied; applying them again with the next
        frame changes nothing.
        """
        if not isinstance(job, FrameJob):
            raise TypeError(f"{type(job).__name__}: the tracking engine does frames")
        begin = time.perf_counter()
        first, epoch, localizer = self._robots.get(job.robot, (None, None, None))
        if localizer is None:
            localizer = Localizer(self.base_map, self.config, self._local_maps, self._index)
        if first != job.first_epoch:
            localizer.reset(job.epoch)
        elif epoch != job.epoch:
            localizer.relocalize(job.epoch)  # and keep the calibration
        self._robots[job.robot] = job.first_epoch, job.epoch, localizer
        if job.search_result is not None:
            localizer.apply_search_result(job.search_result)
        if job.require_verification:
            localizer.require_verification()
        if job.calibration is not None:
            with contextlib.suppress(InputError):  # a useless hint is no reason to drop the frame
                localizer.hint_calibration(job.calibration)
        if job.hint is not None:
            with contextlib.suppress(RunError):
                localizer.hint_pose(job.hint)
        if job.guess is not None:
            localizer.guess_place(job.guess, check=False)  # the node has accepted it
        points = job.points
        if points is None:
            return FrameResult(localizer.fix(), None, time.perf_counter() - begin, localizer.take_events())
        if job.times is not None and job.segment is not None:
            sweep = localizer.calibration.sweep
            points = deskew(points, job.times, job.segment, job.stamp_ns, job.T_odom_body, sweep)
        request = localizer.add_frame(points, job.T_odom_body, job.stamp_ns * 1e-9, job.defer, self.on_doubt)
        return FrameResult(localizer.fix(), request, time.perf_counter() - begin, localizer.take_events())

    def forget(self, robot: str) -> None:
        """Drop a robot's localizer."""
        self._robots.pop(robot, None)

    def prepare_later(self) -> None:
        """Load the likelihood field, which judges a slip of odometry."""
        _ = self.base_map.field.layers


class SearchEngine(Engine):
    """Global searches for all robots, which share the map's spectra and networks."""

    kernels = GlobalSearch.KERNELS
    # for learned features, and for an accepted place
    later_kernels = ("height_columns", "window_products", "PointGrid")

    def __init__(self, base_map: BaseMap, config: LocalizerConfig | None = None) -> None:
        self.base_map = base_map
        self.config = config or LocalizerConfig()
        self._local_maps = LocalMaps(base_map, self.config.registration.source_range)
        self._searches: dict[str, AdvisedSearch] = {}
        self._index = SearchIndex.of(base_map, self.config)

    def run(self, job: Job) -> SearchResult:
        """Search the map for one keyframe."""
        if not isinstance(job, SearchJob):
            raise TypeError(f"{type(job).__name__}: the search engine does searches")
        search = self._searches.get(job.robot)
        if search is None:
            search = AdvisedSearch(self.base_map, self.config, self._local_maps, self._index)
            self._searches[job.robot] = search
        return search.update(job.request)

    def forget(self, robot: str) -> None:
        """Drop a robot's votes."""
        self._searches.pop(robot, None)

    def prepare(self) -> None:
        """Prepare the station index, the learned features and the field for the first query."""
        GlobalSearch(self.base_map, self.config, self._local_maps, self._index).prepare()
        self.rest()

    def rest(self) -> None:
        """Drop crops of the map and mapped pages of its file, which searches have read; tracked robots need no search.

        The system still caches the pages: a later search maps them again in 1/8 s per gigabyte.
        """
        self._local_maps.clear()
        for array in self.base_map.arrays.values():
            release(array)


class OdometryEngine(Engine):
    """Lidar odometry: each robot has its own, with its own ``registration``; DependencyError without kiss-icp."""

    def __init__(self, registration: Callable[[LidarOdometryConfig], ScanRegistration] = KissRegistration) -> None:
        self._registration = registration
        self._robots: dict[str, tuple[int, LidarOdometry]] = {}
        self._trajectories: dict[str, tuple[int, int]] = {}  # epoch and restarts at the newest pose
        registration(LidarOdometryConfig())  # reports a missing library now, not at the first frame

    def run(self, job: Job) -> OdometryResult:
        """Return the odometry of one frame; CloudError or RunError: it cannot be placed, the next one may be."""
        if not isinstance(job, OdometryJob):
            raise TypeError(f"{type(job).__name__}: the odometry engine makes odometry")
        begin = time.perf_counter()
        epoch, lidar = self._robots.get(job.robot, (None, None))
        if lidar is None:
            lidar = LidarOdometry(job.config, self._registration(job.config))
        elif epoch != job.epoch:
            lidar.reset()
        self._robots[job.robot] = job.epoch, lidar
        pose = lidar.step(job.points, job.times, job.stamp_ns * 1e-9)
        trajectory = job.epoch, lidar.restarts
        restarted = self._trajectories.get(job.robot) != trajectory
        self._trajectories[job.robot] = trajectory
        points = None if job.times is None else lidar.points
        return OdometryResult(pose, points, restarted, time.perf_counter() - begin)

    def forget(self, robot: str) -> None:
        """Drop a robot's odometry."""
        self._robots.pop(robot, None)
        self._trajectories.pop(robot, None)


KINDS: dict[str, type[Engine]] = {"odometry": OdometryEngine, "track": TrackEngine, "search": SearchEngine}
"""Engines by name."""


def open_engine(
    kind: str, map_path: str | Path, sha256: str, config: LocalizerConfig | None = None, trust: Trust | None = None
) -> Engine:
    """Return a new engine of a kind in :data:`KINDS`; the tracking and search engines load the map file.

    The node has checked the file, but it may have been replaced since, so its hash must still be ``sha256``. With
    ``trust`` its signature is verified again, unless the file that the node has verified is unchanged.

    Raises:
        MapError: the map is unusable, unsigned, or not the one of ``sha256``. DependencyError: no kiss-icp or no
            ``cryptography``. InputError, DependencyError: ``config`` needs learned features, which cannot be used.
    """
    if kind == "odometry":
        return OdometryEngine()
    base_map = BaseMap.load(map_path, check=False, verify_key=trust)
    if base_map.sha256 != sha256:
        raise MapError(f"{map_path}: has been replaced by another map; start the node (serve) again")
    base_map.shared = True
    return TrackEngine(base_map, config) if kind == "track" else SearchEngine(base_map, config)
