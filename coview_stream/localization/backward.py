"""Backward tracking of a recorded run, from a fix to the frames before it.

Frames before the first fix and within interruptions have no live pose. From a later fix they are tracked in reverse, by
the same registration, verification and loss monitor. So a slip, a carried robot or restarted odometry ends backward
tracking as it ends live tracking.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_kernels import Registration
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, transform
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.registration.register import swap_rotation_translation
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.consensus import Hypothesis
from coview_stream.localization.state import Event, State
from coview_stream.localization.tracking.map_matching import MapMatch
from coview_stream.localization.tracking.monitor import Ruling
from coview_stream.localization.tracking.slip import share_on_map
from coview_stream.recordings.run import Run


@dataclass(frozen=True, eq=False)
class BelievedRegistration:
    """A verified registration of one frame."""

    T_map_cloud: Pose  # (4, 4) of the cloud in the sensor's axes, about the map's origin, without the prior
    covariance: Floats  # (6, 6) over (rx, ry, rz, x, y, z), map axes, of this registration alone
    shared: Floats  # (6, 6) likewise, of the error shared with neighbouring registrations, without mount and clock
    doubt: float  # factor on the usual protection level
    slipped: bool  # odometry has slipped since the previous registration, in the order of tracking
    backward: bool  # whether it comes from backward tracking


@dataclass(eq=False)
class RecordedFrame:
    """One usable frame of a run, with the results of tracking."""

    index: int  # of the frame in the run
    T_odom_body: Pose  # (4, 4) raw odometry
    origin: Floats  # (3,) of its cloud, zero unless a single scan is stored far from its zero
    fix: Fix  # the live fix
    registered: BelievedRegistration | None  # registration of the frame, live or backward; None without one
    backward: Fix | None = None  # fix of the backward pass; None without a pose


class RecordingLocalizer(Localizer):
    """Localizer that keeps the registration of the newest frame and can start at a known place."""

    registered: BelievedRegistration | None = None  # believed registration of the newest frame; None without one
    _slipped = _backward = False

    def step(self, cloud: Points, T_odom_body: Pose, stamp: float) -> Fix:
        """See :meth:`Localizer.step`."""
        self.registered = None
        return super().step(cloud, T_odom_body, stamp)

    def begin_at(
        self, T_map_cloud: Pose, confidence: float, calibration: Calibration, cloud: Points, T_odom_body: Pose,
        stamp: float,
    ) -> None:  # fmt: skip
        """Reset, then track from a frame's registered pose (4, 4); the other arguments as in :meth:`step`."""
        self.reset()
        self._slipped, self._backward = False, True
        calibration = replace(calibration, delay=-calibration.delay)  # time runs backwards
        self._frames.estimator.learn(calibration, same_run=True)
        if not self._tracker.ground.metres:
            self._tracker.ground.restore(calibration.ground)
        frame, _ = self._predict(cloud, T_odom_body, stamp)
        level = self._frames.calibration
        leader = T_map_cloud @ inverse(frame.T_odom_body @ level.T_body_cloud)
        place = Hypothesis(leader, registration=Registration(leader, 1e4 * np.eye(6), 0.0, 0, 0, True))
        evidence = KeyframeEvidence(stamp, State.TRACKING, "a later fix", confidence=confidence)
        self.apply_search_result(
            SearchResult(
                place, evidence, self._tracker.odometry.travelled, self._requests.epoch, leader=leader,
                T_odom_body=frame.T_odom_body, calibration=level,
            )
        )  # fmt: skip
        self._cut_short = False

    def fit(self, cloud: Points, T_map_body: Pose, calibration: Calibration) -> float:
        """Return the share of a frame's structure that lies on the map at a body pose (4, 4); 0 for too few points.

        The pose is about the map's origin, computed with ``calibration``; the cloud (N, 3) is in the sensor's axes.
        """
        target = self._local_maps.around(T_map_body[:3, 3])
        points = transform(pose_from(T_map_body[:3, :3], np.zeros(3)), calibration.level(cloud))
        shift = pose_from(np.eye(3), T_map_body[:3, 3])
        return 0.0 if target is None else share_on_map(points, np.zeros(3), shift, target) or 0.0

    def _update(self, match: MapMatch) -> Ruling:
        T_map_cloud = match.T_map_body @ self._frames.calibration.T_body_cloud  # before the calibration learns
        ruling = super()._update(match)
        self._slipped |= match.moves_place
        if ruling.believed and not (match.moves_place or self._tracker.risen):
            covariance = match.covariance.copy()
            # the height's variance by changed ground at this registration
            covariance[5, 5] += self._tracker.change.others.variance + self._tracker.change.alone
            level = self._tracker.protection_level()
            shared = swap_rotation_translation(self._tracker.reported_covariance(mount_and_clock=False))
            shared -= self._tracker.predicted_covariance()
            self.registered = BelievedRegistration(
                T_map_cloud, covariance, shared, level.doubt, self._slipped, self._backward
            )
            self._slipped = False
        return ruling


def track_backward(
    localizer: RecordingLocalizer, run: Run, frames: Sequence[RecordedFrame], begin: int, stop: int,
    calibration: Calibration,
) -> None:  # fmt: skip
    """Track from the registered frame ``begin`` back to the frame after ``stop``; store poses and registrations.

    Poses of frames before the earliest registration are kept only if tracking arrives at the start of the run (``stop``
    is -1) with a pose: elsewhere it ended in doubt or meets live tracking.
    """
    start = frames[begin]
    assert start.registered is not None
    cloud = run.read(start.index, calibration.sweep).points
    confidence, stamp = start.fix.confidence, start.fix.stamp
    localizer.begin_at(start.registered.T_map_cloud, confidence, calibration, cloud, start.T_odom_body, stamp)
    earliest, fix = begin, None
    for k in range(begin - 1, stop, -1):
        frame = frames[k]
        try:
            cloud = run.read(frame.index, localizer.calibration.sweep).points
            fix = localizer.step(cloud, frame.T_odom_body, 2.0 * stamp - frame.fix.stamp)
        except (CloudError, RunError):
            continue
        if not fix.state.has_place or Event.PLACE_GIVEN_UP in localizer.take_events():
            fix = None
            break
        frame.backward = fix if fix.T_map_body is not None else None
        if localizer.registered is not None:
            frame.registered, earliest = localizer.registered, k
    arrived = stop < 0 and fix is not None and fix.state is State.TRACKING
    for k in range(stop + 1, 0 if arrived else earliest):
        frames[k].backward = None
