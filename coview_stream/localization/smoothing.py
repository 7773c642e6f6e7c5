"""Offline smoothing: all poses of a run at once, from the registrations before and after each frame.

The graph has a node per usable frame: the body's pose X_k. With e(A, B) = log(A^-1 B) the poses are the most probable
given

* odometry:       e(Z_k, X_(k-1)^-1 X_k) ~ N(0, Q_k), corrected by the calibration at the end of the run
* registrations:  e(Y_k, X_k) ~ N(0, R_k), live and backward, under Huber's kernel

Where odometry is broken there is no factor, and nothing is smoothed across: tracking noticed a slip, or the
registrations on both sides contradict odometry (a carried robot, odometry that jumped or restarted). Q contains the
measured drift, and the uncertainty of scale and heading rate over the path between two registrations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from itertools import pairwise

import numpy as np

from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES, NO_OTHER, ProtectionLevel, protection_level
from coview_stream.geometry.transforms import (
    Pose,
    Poses,
    along_body,
    along_map,
    boxminus,
    inverse,
    pose_from,
    skew,
    yaw_of,
)
from coview_stream.localization.backward import BelievedRegistration, RecordedFrame, RecordingLocalizer, track_backward
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.odometry_history import OdometryHistory
from coview_stream.localization.frame import OdometryCorrection
from coview_stream.localization.registration.register import swap_rotation_translation
from coview_stream.localization.tracking.batch_graph import BatchGraph, Constraint
from coview_stream.localization.tracking.motion import Drift
from coview_stream.localization.tracking.pose_graph import HUBER
from coview_stream.recordings.run import Run


class PoseKind(StrEnum):
    """Kind of a smoothed pose; only frames of kind SMOOTHED had a live pose."""

    SMOOTHED = "smoothed"
    """The frame had a live pose, which the registrations around it correct; without any it is unchanged."""
    BACKWARD = "backward"
    """Tracked backwards from a later fix: registered to the map and verified like live poses."""
    BRIDGED = "bridged"
    """By odometry alone, between registrations on both sides that agree with it."""


@dataclass(frozen=True, eq=False)
class SmoothedPose:
    """Pose of one frame by the whole run; as it exists offline only, it is no :class:`coview_stream.Fix`.

    Attributes:
        stamp: of the frame, seconds.
        kind: origin of the pose.
        T_map_body: (4, 4) float64 in the frame of the map's sources.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), m2 and rad2, as in a Fix.
        protection: metres and degrees that the error exceeds at most once in a thousand poses.
        confidence: probability that the robot is at this place, by the fix from which the pose derives.
    """

    stamp: float
    kind: PoseKind
    T_map_body: Pose
    covariance: Floats
    protection: ProtectionLevel
    confidence: float


def smooth_run(localizer: RecordingLocalizer, run: Run, frames: Sequence[RecordedFrame]) -> list[SmoothedPose]:
    """Return the smoothed poses of a recorded run, in order; none without a live pose.

    ``localizer``, which has localized the run, is reused to track backwards through frames of ``run`` without a live
    pose. ``frames`` are all usable ones; registrations of the backward pass are added to them.
    """
    live = [k for k, frame in enumerate(frames) if frame.registered is not None]
    if not live:
        return [_as_live(frame) for frame in frames if frame.fix.T_map_body is not None]
    calibration = frames[-1].fix.calibration or Calibration()
    for before, after in pairwise([-1, *live]):
        registered, between = frames[after].registered, frames[before + 1 : after]
        assert registered is not None
        if registered.slipped or any(frame.fix.T_map_body is None for frame in between):
            track_backward(localizer, run, frames, after, before, calibration)
    drift = next((f.fix.drift for f in reversed(frames) if f.fix.drift), Drift.of(localizer.config.tracking))
    chain = _Chain.of(frames, calibration, drift, localizer.config.acceptance.max_innovation)

    def fit(k: int, T_map_body: Pose) -> float:
        return localizer.fit(run.read(frames[k].index, calibration.sweep).points, T_map_body, calibration)

    chain.settle_breaks(fit)
    return chain.solved(localizer.base_map.origin)


@dataclass(eq=False)
class _Chain:
    """All frames of a run, in order (N), the odometry between them, and their registrations."""

    frames: Sequence[RecordedFrame]
    odometry: Poses  # (N, 4, 4) corrected
    registered: dict[int, BelievedRegistration]  # by frame, in order
    keys: Ints  # (M,) frames with a registration
    measured: dict[int, Pose]  # (4, 4) registered body poses, about the map's origin, by frame
    driven: Floats  # (N,) metres up to each frame
    spread: Floats  # (N, 6, 6) covariances of the motions from the previous frame, (rx, ry, rz, x, y, z), map axes
    # (N, 4, 4) motion of the body from the moment of the cloud, which may be late, to the stamp
    since_cloud: Poses = field(kw_only=True)
    rates: Floats = field(kw_only=True)  # (N, 3) rates of the body, as in a Moment
    calibration: Calibration = field(kw_only=True)
    broken: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Frames whose motion from the previous frame is unknown, with the registered frames before and after."""
    unknown: set[int] = field(default_factory=set)  # frames at a break that may belong to either side
    refuted: set[int] = field(default_factory=set)  # frames whose scan contradicts the live pose

    @classmethod
    def of(
        cls, frames: Sequence[RecordedFrame], calibration: Calibration, drift: Drift, max_innovation: float
    ) -> _Chain:
        """Correct the odometry, and find where it is broken."""
        correction, level = OdometryCorrection(), inverse(calibration.T_body_cloud)
        stamps, poses = np.array([frame.fix.stamp for frame in frames]), np.array([f.T_odom_body for f in frames])
        history, late = OdometryHistory.of(stamps, poses), calibration.delay
        if late and len(frames) > 1:
            poses = history.all_at(stamps - late)
        odometry = np.array([correction.correct(T, calibration) for T in poses])
        registered = {k: frame.registered for k, frame in enumerate(frames) if frame.registered is not None}
        measured = {k: kept.T_map_cloud @ level for k, kept in registered.items()}
        steps = np.linalg.norm(np.diff(odometry[:, :3, 3], axis=0), axis=1)
        driven, spread = np.append(0.0, np.cumsum(steps)), np.zeros((len(frames), 6, 6))
        for k, (a, b) in enumerate(pairwise(odometry), start=1):
            spread[k] = drift.covariance(float(steps[k - 1]), abs(yaw_of(inverse(a) @ b)))
        keys = np.array(list(registered))
        since = history.since_clouds(stamps, late, calibration.scale)
        rates = np.nan_to_num([history.rates(stamp - late) for stamp in stamps.tolist()])
        chain = cls(
            frames,
            odometry,
            registered,
            keys,
            measured,
            driven,
            spread,
            since_cloud=since,
            rates=rates,
            calibration=calibration,
        )
        chain._spread_calibration(calibration)
        live = [at for at, kept in enumerate(registered.values()) if not kept.backward]
        for before, after in pairwise([0, *live]):
            chain._break(keys[before : after + 1].tolist(), max_innovation)
        return chain

    def _predicted(self, known: int, k: int) -> Pose:
        """Return frame ``k``'s pose (4, 4) by odometry from a registered frame."""
        return np.asarray(self.measured[known] @ inverse(self.odometry[known]) @ self.odometry[k])

    def _spread_calibration(self, calibration: Calibration) -> None:
        """Add the calibration's error over the path between two registrations, distributed by the metres driven."""
        ends = sorted({0, *self.registered, len(self.frames) - 1})
        for before, after in pairwise(ends):
            metres = self.driven[after] - self.driven[before]
            if metres > 0.0:
                known = before if before in self.measured else int(self.keys[0])
                way = self._predicted(known, after)[:3, 3] - self._predicted(known, before)[:3, 3]
                shares = np.diff(self.driven[before : after + 1]) / metres
                self.spread[before + 1 : after + 1] += shares[:, None, None] * calibration.motion_covariance(way)

    def _break(self, registered: Sequence[int], max_innovation: float) -> None:
        """Find the breaks between the successive registered frames ``registered``.

        The last one has a live registration, the first the previous live one, if any; all between have backward ones.
        """
        slipped_back = [self.registered[k].backward and self.registered[k].slipped for k in registered]
        slipped = self.registered[registered[-1]].slipped and not any(slipped_back)
        for number, (before, after) in enumerate(pairwise(registered)):
            if (number == 0 and slipped) or slipped_back[number] or self._innovation(before, after) > max_innovation:
                at = after
                while at - 1 > before and self.frames[at - 1].backward is not None:
                    at -= 1
                self.broken[at] = before, after
                self.unknown.update(range(before + 1, after if slipped_back[number] else at))

    def _innovation(self, before: int, after: int) -> float:
        """Squared Mahalanobis distance of a registration from odometry since an earlier one, 6 degrees of freedom."""
        first, second = self.registered[before], self.registered[after]
        R_map_odom = self.measured[before][:3, :3] @ self.odometry[before, :3, :3].T
        left = (self.odometry[after, :3, 3] - self.odometry[before : after + 1, :3, 3]) @ R_map_odom.T
        J = np.tile(np.eye(6), (len(left), 1, 1))
        J[:, 3:, :3] = -skew(left)
        parts = np.concatenate([(first.covariance + first.shared)[None], self.spread[before + 1 : after + 1]])
        spread = np.einsum("kij,kjl,kml->im", J, parts, J) + second.covariance + second.shared
        gap = boxminus(self.measured[after], self._predicted(before, after))
        return float(gap @ np.linalg.solve(spread, gap))

    def settle_breaks(self, fit: Callable[[int, Pose], float]) -> None:
        """Compare the last live poses before each break with the poses predicted from the registration after it.

        Where the latter fit the map better, the break moves to before the frame. A frame that fits better there, but is
        not next to the break, or that fits at neither pose, gets no pose. ``fit`` returns the fit at a pose (4, 4).
        """
        for at, (before, after) in list(self.broken.items()):
            first = at
            for k in range(at - 1, before, -1):
                if self.frames[k].fix.T_map_body is None:
                    continue
                here, there = fit(k, self._predicted(before, k)), fit(k, self._predicted(after, k))
                if here > 0.0 and here >= there:
                    break
                if here < there and k == first - 1:
                    first = k
                else:
                    self.refuted.add(k)
            self.broken[first] = self.broken.pop(at)
            self.unknown.difference_update(range(first, at))

    def solved(self, origin: Floats) -> list[SmoothedPose]:
        """Solve the graph; return the poses in the frame of the map's sources, whose origin is ``origin`` (3,)."""
        nodes, start = self._nodes()
        number = {k: at for at, k in enumerate(nodes)}
        graph = BatchGraph(start)
        graph.add([
            Constraint(at, at - 1, inverse(self.odometry[k - 1]) @ self.odometry[k], along_body(self.spread[k], T))
            for at, (k, T) in enumerate(zip(nodes, start, strict=True))
            if k - 1 in number and k not in self.broken
        ])  # fmt: skip
        registrations = [
            Constraint(number[k], -1, self.measured[k], along_body(kept.covariance, self.measured[k]))
            for k, kept in self.registered.items()
            if k in number
        ]
        graph.add(registrations, ("Huber", HUBER))
        solved = zip(nodes, graph.solve(), graph.covariances(), strict=True)
        found = {k: self._pose(k, T, along_map(covariance, T), origin) for k, T, covariance in solved}
        for k, frame in enumerate(self.frames):
            if self._kind(k) is PoseKind.SMOOTHED and (k not in number or k in self._beside_breaks):
                found[k] = _as_live(frame)
        poses = [found[k] for k in sorted(found)]
        return [pose for pose in poses if pose.kind is PoseKind.SMOOTHED or _within_alert_limit(pose.protection)]

    @cached_property
    def _beside_breaks(self) -> set[int]:
        """Frames between the live registrations on both sides of a break, where odometry's motion is unknown.

        They keep their live poses: a backward registration next to a break is no better.
        """
        live, out = [k for k in self.keys.tolist() if not self.registered[k].backward], set[int]()
        for before, after in self.broken.values():
            first = max((k for k in live if k <= before), default=-1)
            out.update(range(first + 1, min((k for k in live if k >= after), default=len(self.frames))))
        return out

    def _nodes(self) -> tuple[list[int], Poses]:
        """Return the frames (M) in the graph, and start poses (M, 4, 4) by odometry from a registration nearby."""
        parts: list[list[int]] = []
        for k in range(len(self.frames)):
            if self._kind(k) is not None:
                if not parts or parts[-1][-1] != k - 1 or k in self.broken:
                    parts.append([])
                parts[-1].append(k)
        nodes, poses = [], []
        for part in parts:
            keys = [k for k in part if k in self.registered]
            # without a live pose, a single registration that contradicts odometry on both sides is no evidence
            if len(keys) > 1 or (keys and any(self._kind(k) is PoseKind.SMOOTHED for k in part)):
                nodes += part
                near = np.clip(np.searchsorted(keys, part, "right") - 1, 0, None)
                poses += [self._predicted(keys[at], k) for at, k in zip(near.tolist(), part, strict=True)]
        return nodes, np.array(poses)

    def _kind(self, k: int) -> PoseKind | None:
        """Return the kind of a frame's pose; None if it has none."""
        if self.frames[k].fix.T_map_body is not None:
            return None if k in self.refuted else PoseKind.SMOOTHED
        if k in self.unknown:
            return None
        if self.frames[k].backward is not None:
            return PoseKind.BACKWARD
        return PoseKind.BRIDGED if self.keys[0] < k < self.keys[-1] else None

    def _pose(self, k: int, T: Pose, covariance: Floats, origin: Floats) -> SmoothedPose:
        """Return a frame's pose; the error shared by registrations is taken from the nearest one."""
        frame, kind = self.frames[k], self._kind(k)
        assert kind is not None
        at = int(np.searchsorted(self.keys, k))
        around = self.keys[max(at - 1, 0) : at + 1].tolist()
        nearest = min(around, key=lambda key: abs(self.driven[key] - self.driven[k]))
        kept = self.registered[nearest]
        fix = frame.backward if frame.fix.T_map_body is None else frame.fix
        fix = fix or self.frames[nearest].backward or self.frames[nearest].fix
        mount_and_clock = self.calibration.pose_covariance(T[:3, :3], self.rates[k])
        reported = swap_rotation_translation(covariance + kept.shared + mount_and_clock)
        T = T @ self.since_cloud[k]
        T_map_body = pose_from(T[:3, :3], T[:3, 3] + origin) @ pose_from(np.eye(3), -frame.origin)
        level = protection_level(reported, kept.doubt, others=self.calibration.heights(NO_OTHER))
        return SmoothedPose(frame.fix.stamp, kind, T_map_body, reported, level, fix.confidence)


def _as_live(frame: RecordedFrame) -> SmoothedPose:
    """Return the live pose of a frame that no registration can correct with certainty."""
    fix = frame.fix
    assert fix.T_map_body is not None
    assert fix.covariance is not None
    assert fix.protection is not None
    T_map_body = fix.T_map_body @ pose_from(np.eye(3), -frame.origin)
    return SmoothedPose(fix.stamp, PoseKind.SMOOTHED, T_map_body, fix.covariance, fix.protection, fix.confidence)


def _within_alert_limit(level: ProtectionLevel) -> bool:
    return level.horizontal <= ALERT_METRES and level.degrees <= ALERT_DEGREES  # the height may be unknown by metres
