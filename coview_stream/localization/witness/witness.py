"""The witness of a robot's motion: compares clouds with odometry and map, about once a metre or a second."""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coview_stream.config import RegistrationConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.distributions import chi2_quantile
from coview_stream.geometry.planar import (
    between,
    compose,
    inverted,
    planar_covariance,
    planar_motion,
    planar_pose,
    smoothly_between,
    spatial,
)
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES
from coview_stream.geometry.transforms import Points, Pose, inverse
from coview_stream.localization.calibration.calibration import Calibration, RawScan
from coview_stream.localization.calibration.estimator import CalibrationEstimator
from coview_stream.localization.registration.surfaces import LONGEST
from coview_stream.localization.tracking.map_matching import MapMatch
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.tracking.motion import Drift
from coview_stream.localization.tracking.pose_graph import Estimate
from coview_stream.localization.tracking.tracker import Tracker
from coview_stream.localization.witness.agreement import ALONE, FAILS, Seen, Step, misfits
from coview_stream.localization.witness.cloud_motion import APART, CloudMotion, CloudMotionMeter
from coview_stream.localization.witness.faults import LAGS, Accusation, FaultPosterior
from coview_stream.localization.witness.first_motions import Conventions
from coview_stream.localization.witness.stamps import step_stamps

_METRES, _SECONDS, _TURN = 1.0, 1.0, np.radians(10.0)  # step limits, whichever comes first
_SHORTEST = 0.3  # least seconds of a step shorter than _FAR
_FAR = 5.0  # metres; a step this long is compared at once
_MANY = 5  # frames of a step, to which one more makes little difference
_RECENT = 3  # odometry frames that define the velocity
_SHORT = 0.05  # seconds; closer stamps are of one moment
_HISTORY = 600  # frames of odometry
_HEADING = np.radians(1.0)  # least sigma of the heading of the sensor on the body
_RISK = 1e-3  # of exceeding a protection level
_JITTER = np.array([0.02, 0.02, np.radians(0.3)])  # sigmas of odometry that stands still, metres and radians


class _Frame(NamedTuple):
    stamp: float
    scan: RawScan
    T_odom_raw: Pose
    path: Floats  # (3,) planar pose by odometry, corrected
    copied: bool  # it has the bytes of the previous frame
    number: int  # in order of arrival
    on_map: Estimate | None = None


class _Waiting(NamedTuple):
    """A comparison that waits for the next frame, as the present frame has already been registered to the map."""

    middle: _Frame | None
    now: _Frame
    registered: Estimate | None
    belief: Estimate


class Witness:
    """Check of one robot's clouds and odometry.

    Attributes:
        faults: probabilities of the faults.
    """

    def __init__(self, config: RegistrationConfig, estimator: CalibrationEstimator) -> None:
        """Use the calibration of ``estimator``, which is asked to look for faults of mount and clock."""
        self._estimator = estimator
        # cause of a constant fault more probable than a slip, which it resembles
        self._decided: RejectionReason | None = None
        self._right_until: float | None = None  # newest stamp without a probable fault of the clouds
        self._meter = CloudMotionMeter(config)
        self.faults = FaultPosterior()
        self._path: deque[tuple[float, Floats]] = deque(maxlen=_HISTORY)  # stamp, planar pose by odometry, corrected
        self._odometry: Pose | None = None
        self._numbers = itertools.count()
        self._newest: _Frame | None = None
        self._previous: _Frame | None = None
        self._reference: _Frame | None = None
        self._waiting: _Waiting | None = None
        self._tilting = 0.0  # recent rotation of the body about its x and y, radians per second
        self._calibration = Calibration()
        self._cloud: Points | None = None  # the newest

    def forget_scan(self) -> None:
        """Keep the next frame from comparison with earlier ones, as its scan is about another origin."""
        if self._reference is not None and self._newest is not None:
            self.faults.unseen(float(np.linalg.norm((self._newest.path - self._reference.path)[:2])))
        self._reference = self._previous = self._newest = self._waiting = self._cloud = None

    def begin_odometry(self) -> None:
        """Compare nothing across a jump of odometry."""
        self.forget_scan()
        self.faults.forget_speed()
        self._path.clear()
        self._odometry, self._tilting = None, 0.0

    def add(self, stamp: float, cloud: Points, scan: RawScan, T_odom_raw: Pose) -> None:
        """Add a frame: its raw cloud (N, 3), whose array may be reused, scan, and odometry (4, 4)."""
        calibration = self._calibration  # the path is rescaled with each newer one
        pose = np.zeros(3)
        if self._odometry is not None:
            seconds = stamp - self._path[-1][0]
            if seconds > 0.0:
                tilted = float(np.arccos(np.clip(self._odometry[2, :3] @ T_odom_raw[2, :3], -1.0, 1.0)))
                self._tilting += (tilted / max(seconds, _SHORT) - self._tilting) / _RECENT
            step = planar_motion(self._odometry, T_odom_raw)
            step[:2] *= 1.0 + calibration.scale
            step[2] += calibration.turn * float(np.linalg.norm(step[:2]))
            before = self._path[-1][1]
            pose = compose(before, step)
            pose[2] = before[2] + step[2]  # not wrapped, as it is interpolated
        self._odometry = T_odom_raw
        self._path.append((stamp, pose))
        copied = self._cloud is not None and np.array_equal(self._cloud, cloud)
        self._cloud = cloud.copy()
        newest = _Frame(stamp, scan, T_odom_raw, pose, copied, next(self._numbers))
        self._previous, self._newest = self._newest, newest
        if self._reference is None:
            self._reference = self._newest

    def while_searching(self, drift: Drift, conventions: Conventions | None = None) -> Accusation | None:
        """Compare the newest frame if due; return the fault that would make a place wrong, if any.

        ``conventions`` learn the motion too.
        """
        self._compare_waiting(drift)
        before, now = self._reference, self._newest
        if before is not None and now is not None and self._is_due() and not self._may_hide_turns():
            seen = self._compare(now, self._previous, drift, tracking=False)
            if conventions is not None and seen is not None and seen.T is not None:
                variance = float(seen.covariance.diagonal()[:2].max())
                conventions.add_motion(seen.T, variance, before.T_odom_raw, now.T_odom_raw)
        return self._accusation(0.5 * ALERT_METRES, 0.5 * ALERT_DEGREES)

    def between_registrations(self, tracker: Tracker) -> bool:
        """Make the comparison left by the last registration; return whether a fault makes poses wrong."""
        return self._compare_waiting(tracker.odometry.drift) and self._accused(tracker) is not None

    def while_tracking(self, match: MapMatch, belief: Estimate | None, tracker: Tracker) -> MapMatch:
        """Compare the newest frame if due; return its match, rejected if a fault makes poses wrong.

        If the match agrees with the pose, the comparison waits for the next frame (:meth:`between_registrations`).
        ``belief`` is the belief about the frame's pose without the match, if there is a pose.
        """
        fits = match.scan is not None and match.verdict.cause in (RejectionReason.VERIFIED, RejectionReason.ODOMETRY)
        registered = Estimate(match.T_map_body, match.covariance) if fits else None
        contradicted = belief is not None and (match.moves_place or not match.verdict.verified)
        due, now = self._is_due(), self._newest
        at_once = contradicted or self.faults.stopped > _RISK  # the robot may have been set down
        if now is not None and due and belief is not None and not at_once:
            self._waiting = _Waiting(self._previous, now, registered, belief)
        elif now is not None and (due or at_once):
            self._compare(now, self._previous, tracker.odometry.drift, registered, belief, contradicted)
        accused = self._accused(tracker)
        if accused is None:
            return match
        verdict = replace(match.verdict, cause=accused.cause, reason=accused.sentence)
        follows = match.moves_place and accused.cause is RejectionReason.STOPPED  # the lidar is right
        return replace(match, verdict=verdict, moves_place=follows)

    def _accused(self, tracker: Tracker) -> Accusation | None:
        """Return the fault that puts the tracker's poses off by more than their level, if any."""
        level, decided = tracker.protection_level(), self._decided
        accused = self._accusation(min(level.horizontal, ALERT_METRES), min(level.degrees, ALERT_DEGREES))
        if self._decided is not decided:
            tracker.odometry.forget_registration()  # it is of another mount or clock
        return accused

    def _accusation(self, metres: float, degrees: float) -> Accusation | None:
        """Return the fault that probably puts poses off by more than a level; have the calibration look for it."""
        accused, before = self.faults.accusation(metres, np.radians(degrees), _RISK), self._decided
        decided = accused is not None and accused.constant and accused.probability >= self.faults.odometry
        self._decided = accused.cause if decided and accused is not None else None
        if self._decided is not before:
            if self._decided is RejectionReason.MOUNT:
                self._estimator.widen_mount()
            elif self._decided is RejectionReason.CLOCK:
                self._estimator.widen_clock()
        if accused is None or self._right_until is None:
            return accused
        return accused._replace(sentence=f"{accused.sentence} (since stamp {self._right_until:.1f})")

    def _is_due(self) -> bool:
        if self._reference is None or self._newest is None:
            return False
        seconds = self._newest.stamp - self._reference.stamp
        step = self._newest.path - self._reference.path
        far = float(np.linalg.norm(step[:2]))
        moved = far >= _METRES or abs(step[2]) >= _TURN
        return seconds >= _SECONDS or far >= _FAR or (moved and seconds >= _SHORTEST)

    def _may_hide_turns(self) -> bool:
        """Return whether the step has many frames, an even number: if two drivers alternate, both ends are of one."""
        assert self._newest is not None
        assert self._reference is not None
        frames = self._newest.number - self._reference.number
        return frames > _MANY and frames % 2 == 0

    def _compare_waiting(self, drift: Drift) -> bool:
        """Make the comparison that waits; return whether there was one."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._compare(waiting.now, waiting.middle, drift, waiting.registered, waiting.belief)
            if waiting.registered is not None:
                self.faults.trusted()  # the map had verified the pose at the step's end
        return waiting is not None

    def _compare(
        self,
        now: _Frame,
        middle: _Frame | None,
        drift: Drift,
        registered: Estimate | None = None,
        belief: Estimate | None = None,
        contradicted: bool = False,
        tracking: bool = True,
    ) -> CloudMotion | None:
        """Compare a frame with the one of the last comparison; return the clouds' motion, if they show one.

        Args:
            now: the frame.
            middle: the frame before it.
            drift: of odometry.
            registered: the frame's registration to the map, without the prior, if it fits.
            belief: about the frame's pose without the registration, if there is a pose.
            contradicted: by the map, so the frame just before is compared, too: bodies do not jump.
            tracking: a place is known; a search has its own measurements between clouds for the calibration.
        """
        before = self._reference
        if before is None or now.stamp <= before.stamp:
            return None
        now = now._replace(on_map=registered or belief)
        calibration = self._follow()
        delay = calibration.delay
        past, present = self._by_lags(before.stamp - delay), self._by_lags(now.stamp - delay)
        o = between(past[0], present[0])
        driven, turned = float(np.linalg.norm(o[:2])), abs(float(o[2]))
        x, y, yaw = drift.variances(driven, turned)[[3, 4, 2]]
        along, across = calibration.sigma_scale * driven, max(calibration.sigma_heading, _HEADING) * driven
        swung = 2.0 * (1.0 - np.cos(turned)) * calibration.sigma_lever**2
        of_mount = np.array([along**2 + swung, across**2 + swung, (calibration.sigma_turn * driven) ** 2])
        noise = np.diag(_JITTER**2 + [x, y, yaw] + of_mount)
        on_map = None if registered is None else _on_map(before.on_map, registered)
        stamps = step_stamps(np.array([at for at, _ in self._path]), before.stamp, now.stamp)
        seen: CloudMotion | None = None
        guess = on_map.motion if contradicted and on_map is not None else None
        if stamps.hole and guess is None:  # the cloud may be from before the hole
            guess = between(past[0], self._by_lags(now.stamp - delay - stamps.hole)[0])
        if driven <= LONGEST or (guess is not None and float(np.linalg.norm(guess[:2])) <= LONGEST):
            seen = self._meter.measure(before.scan, now.scan, calibration, guess)
        clouds = None if seen is None else Seen(seen.motion, seen.covariance)
        misfit = 1.0 if seen is None else seen.misfit
        parts: tuple[tuple[float, Floats, Floats], ...] = ()
        if seen is not None and (contradicted or _contradicts(o, noise, seen)):
            parts = self._parts(seen, before, middle, now, calibration)
        fails = min(0.9, FAILS * max(1.0, misfit) ** 4)
        step = Step(
            now.stamp - before.stamp, Seen(o, noise), clouds, on_map, past, present,
            fails=fails, apart=misfit > APART, alone=ALONE if seen is None else misfits(seen.surfaces),
            copied=now.copied, parts=parts,
            same=None if seen is None else seen.same,
            unsure=np.array([self._unsure(before.stamp - delay), self._unsure(now.stamp - delay)]), stamps=stamps,
            start=guess, tilting=self._tilting,
        )  # fmt: skip
        self.faults.add(step)
        if self.faults.good + self.faults.odometry > 0.5:
            self._right_until = now.stamp
        if self._decided in (RejectionReason.MOUNT, RejectionReason.CLOCK) and seen is not None and tracking:
            # only this shows the new mount or clock, as registrations to the map are not believed meanwhile
            spread = seen.covariance + np.diag(_JITTER**2 + [x, y, yaw])
            moments = before.scan.moment, now.scan.moment
            self._estimator.measure_motion(np.eye(4), spatial(seen.motion), spatial(o), spread, moments)
        if (rescaled := self.faults.rescaled(_RISK)) is not None:
            learned = (1.0 + self._estimator.calibration.scale) / (1.0 + calibration.scale)  # already in this step
            self._estimator.rescale(rescaled[0] / learned, rescaled[1] / learned)
        self._reference = now
        return seen

    def _parts(
        self, seen: CloudMotion, before: _Frame, middle: _Frame | None, now: _Frame, calibration: Calibration
    ) -> tuple[tuple[float, Floats, Floats], ...]:
        """Return a step's motions up to and since its last frame but one: seconds, odometry, clouds."""
        if middle is None or not before.stamp < middle.stamp < now.stamp:
            return ()
        last = self._meter.measure(middle.scan, now.scan, calibration)
        if last is None:
            return ()
        poses = [self._by_lags(frame.stamp - calibration.delay)[0] for frame in (before, middle, now)]
        return (
            (middle.stamp - before.stamp, between(*poses[:2]), compose(seen.motion, inverted(last.motion))),
            (now.stamp - middle.stamp, between(*poses[1:]), last.motion),
        )

    def _follow(self) -> Calibration:
        """Adopt a changed calibration; return it."""
        calibration = self._estimator.calibration
        moved = calibration.T_body_cloud @ inverse(self._calibration.T_body_cloud)
        factor = (1.0 + calibration.scale) / (1.0 + self._calibration.scale)
        self.faults.corrected(planar_pose(moved), calibration.delay - self._calibration.delay, factor)
        if factor != 1.0:  # all steps of odometry share one scale
            here, resized = self._path[-1][1], np.array([factor, factor, 1.0])
            self._path = deque(((at, here + resized * (pose - here)) for at, pose in self._path), maxlen=_HISTORY)
        self._calibration = calibration
        return calibration

    def _by_lags(self, stamp: float) -> Floats:
        """Return odometry's planar poses (L, 3) by LAGS before a stamp.

        Odometry stands still before the first frame and continues at its velocity for a second after the newest. Within
        holes its speed changes from the one before to the one after.
        """
        stamps = np.array([at for at, _ in self._path])
        poses = np.stack([pose for _, pose in self._path])
        if len(stamps) > _RECENT:
            velocity = (poses[-1] - poses[-1 - _RECENT]) / (stamps[-1] - stamps[-1 - _RECENT])
            stamps, poses = np.append(stamps, stamps[-1] + 1.0), np.vstack([poses, poses[-1] + velocity])
        at = np.clip(stamp - LAGS, stamps[0], stamps[-1])
        if len(stamps) <= _RECENT:
            return np.stack([np.interp(at, stamps, column) for column in poses.T], axis=1)
        first = max(0, int(np.searchsorted(stamps, at[-1])) - _RECENT)
        stamps, poses = stamps[first:], poses[first:]
        return smoothly_between(at, stamps, poses)

    def _unsure(self, stamp: float) -> Floats:
        """Return half the products (L,) of the seconds to the odometry frames before and after, by LAGS."""
        stamps = np.array([at for at, _ in self._path])
        at = np.clip(stamp - LAGS, stamps[0], stamps[-1])
        after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
        return np.asarray(0.5 * (at - stamps[after - 1]) * (stamps[after] - at))


def _contradicts(o: Floats, noise: Floats, seen: CloudMotion) -> bool:
    """Return whether odometry's errors explain the clouds' motion only once in a thousand."""
    gap = between(o, seen.motion)
    return float(gap @ np.linalg.solve(noise + seen.covariance, gap)) > chi2_quantile(3, _RISK)


def _on_map(before: Estimate | None, now: Estimate | None) -> Seen | None:
    """Return the motion between two poses on the map; None without either."""
    if before is None or now is None:
        return None
    motion = planar_motion(before.T_map_body, now.T_map_body)
    both = planar_covariance(before.covariance + now.covariance, before.T_map_body)
    lever = np.array([0.0, float(np.linalg.norm(motion[:2])), 0.0]) * np.sqrt(before.covariance[2, 2])
    return Seen(motion, both + np.diag(lever**2 + 1e-6))
