"""Search requests: keyframes, hints and the odometry check, while no place is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import Pose
from coview_stream.localization.evidence.observation import RangeImage
from coview_stream.localization.frame import FramePreparation, PreparedFrame
from coview_stream.localization.registration.clouds import thinned
from coview_stream.localization.search.hints import PlaceGuess, PoseHints, robot_position
from coview_stream.localization.search.keyframes import KeyframeBuffer, OdometryCheck
from coview_stream.localization.search.request import Epoch, RequestSpec, SearchRequest
from coview_stream.localization.tracking.monitor import RejectionReason


class NoSearch(NamedTuple):
    """Reason why a frame starts no search; ``cause`` is ODOMETRY if the frames contradict odometry."""

    reason: str
    cause: RejectionReason | None = None


class SearchRequests:
    """Source of one robot's search requests.

    Attributes:
        epoch: of the next request; results of other epochs are out of date.
        hints: poses for the search to try.
    """

    def __init__(
        self, base_map: BaseMap, config: LocalizerConfig, spec: RequestSpec, frames: FramePreparation, odometry: int,
        restarts: Iterator[int],
    ) -> None:  # fmt: skip
        """Start without keyframes, in odometry frame number ``odometry``; ``restarts`` numbers the epochs."""
        self.epoch = Epoch(odometry, next(restarts))
        self._restarts = restarts
        self.hints = PoseHints()
        self._base_map = base_map
        self._config = config
        self._spec = spec
        self._frames = frames
        radius = 0.0 if spec.descriptor is None else spec.descriptor.radius
        self._buffer = KeyframeBuffer(config.keyframe, max(radius, spec.reach or 0.0))
        self._odometry_check = OdometryCheck()

    def add(self, frame: PreparedFrame, travelled: float) -> SearchRequest | NoSearch | None:
        """Add a frame after ``travelled`` metres; return the request of a keyframe that is complete, or why none is."""
        anchor, calibration = self._frames.anchor, self._frames.calibration
        assert anchor is not None  # a frame has been prepared
        keyframe = self._buffer.add(frame.scan, frame.stamp, rays := RangeImage.rays(frame.cloud))
        if keyframe is not None and keyframe.begins_anew:
            self.next_epoch()
            self.hints.search_begins_anew()
        hints = self.hints.about(anchor, frame.T_odom_body)
        guesses = self.hints.guessed(self._base_map.origin, anchor, frame.T_odom_body)
        area = self.hints.area(anchor, frame.T_odom_body)
        if area is not None:
            hints = tuple(T for T in hints if area.holds(robot_position(T, frame.T_odom_body)).all())
        if self._odometry_check.contradicts(frame.scan.levelled(calibration), frame.scan.position):
            self._restart()
            self.hints.forget_lost()
            reason = "searching anew: frames do not fit together where odometry puts them"
            return NoSearch(reason, RejectionReason.ODOMETRY)
        if keyframe is None:
            return None
        if area is not None and not area.holds(self._base_map.stations).any():
            return NoSearch("nothing is searched: the map has no ground in the circle that the robot is said to be in")
        request = SearchRequest.of(
            self._buffer, keyframe, cloud=calibration.level(rays), spec=self._spec,
            travelled=travelled, epoch=self.epoch, hints=hints, guesses=guesses, area=area,
        )  # fmt: skip
        # the search would thin it too, but requests travel through pipes, and thinning leaves a tenth of the points
        config = self._config.registration
        earlier = (
            each._replace(submap=thinned(each.submap, each.T_odom_body[:3, 3], config)) for each in request.earlier
        )
        submap = thinned(request.submap, request.position, config)
        prior = self._frames.estimator.lean_prior
        return replace(request, submap=submap, earlier=tuple(earlier), lean_prior=prior)

    def guess(self, guess: PlaceGuess) -> None:
        """Try a guess of the place; a circle that is added, removed or changed starts an epoch."""
        if guess.within is not None or self.hints.circle is not None:
            self.next_epoch()
        self.hints.guess(guess)

    def place_accepted(self) -> None:
        """Forget keyframes and hints."""
        self.hints.clear()
        self._buffer.clear()

    def place_lost(self, T_map_odom: Pose) -> None:
        """Restart, as odometry may have jumped; that it continues from ``T_map_odom`` (4, 4) is a hint."""
        if self._frames.anchor is not None:
            self.hints.odometry_continues(T_map_odom, self._frames.anchor)
        self.begin_anew()

    def odometry_jumped(self, T_odom_body: Pose | None) -> None:
        """Restart after a jump of odometry from a pose (4, 4); the hints stay at the places that they named there."""
        if self._frames.anchor is not None and T_odom_body is not None:
            self.hints.odometry_jumped(self._frames.anchor, T_odom_body)
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget the keyframes; the hints stay."""
        self._odometry_check.clear()
        self._restart()

    def next_epoch(self) -> None:
        """Start another epoch: results of earlier requests are out of date."""
        self.epoch = self.epoch._replace(restart=next(self._restarts))

    def _restart(self) -> None:
        self._buffer.clear()
        self.hints.forget_leader()
        self.next_epoch()
