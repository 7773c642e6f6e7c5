"""Kalman filter for the calibration of a robot's sensor and odometry.

The state is x = (roll, pitch, s, w, g, τ, ψ, l): tilt of the sensor against odometry's gravity, scale of odometry's
distances less one, turn of its heading per metre, lean of the odometry frame against the map (2 components), seconds
by which clouds are stamped later than odometry, heading of the sensor on the body and its lever arm (2 components).
These are the systematic errors; :class:`coview_stream.localization.tracking.motion.Drift` has the random ones. Every
believed registration to the map gives two measurements:

* Attitude against odometry's gravity. With u the vertical in the body's axes, by the map and by odometry, the residual
  tilt is u_map x u_odometry (eq. C1). The sensor's tilt turns with the body, the lean of the odometry frame does not;
  the pose graph follows the latter.
* Motion since the previous registration. It differs from odometry's by the systematic errors (eq. C2,
  :func:`motion_jacobian`), by the errors of both registrations and by odometry's random walk.

A motion far outside this model (slipping wheels) counts less, by Student's t distribution. All components walk randomly
with the metres driven. While a place only leads a search, the state is a mixture of two Gaussians: the place is right
and its attitude was measured, or the place is wrong.
"""

from __future__ import annotations

import itertools
import math
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, exp_so3, inverse, log_so3, pose_from
from coview_stream.localization.calibration.calibration import (
    CLOCK_TOLERANCE,
    HEADING_TOLERANCE,
    LEVER_TOLERANCE,
    Calibration,
    lean_prior,
)
from coview_stream.localization.calibration.delay_search import DELAYS, RESOLUTION, DelaySearch, SeenMotion
from coview_stream.localization.calibration.odometry_history import Moment, OdometryHistory

Moments = tuple[Moment | None, Moment | None]
"""Moments of the two clouds of a motion."""


class _Prior(NamedTuple):
    """Prior of a group of components (values set by hand)."""

    axes: slice
    exact: float  # sigma of a correct sensor or odometry
    wide: float  # sigma of a faulty one
    share: float  # probability of a fault
    walk: float  # sigma of the random walk, per square root of a metre
    names: tuple[str, ...] = ()  # of the components in a Calibration
    sigma: str = ""  # name of their sigma there


_TILT = _Prior(
    slice(0, 2), math.radians(0.15), math.radians(4.0), 0.5, math.radians(0.03), ("roll", "pitch"), "sigma_tilt"
)
_SCALE = _Prior(slice(2, 3), 0.003, 0.04, 0.3, 5e-4, ("scale",), "sigma_scale")
_TURN = _Prior(slice(3, 4), math.radians(0.005), math.radians(0.05), 0.3, math.radians(5e-4), ("turn",), "sigma_turn")
GRAVITY = _Prior(slice(4, 6), math.radians(0.25), math.radians(0.25), 1.0, math.radians(0.1))
# Whoever built the robot states its clocks and mounts: a wrong one is a fault, about as rare as the levels' risk.
# Clocks set by PTP or by an edge agree within a millisecond, drawings within 0.1 degrees and half a centimetre; a queue
# is late by up to a second, and a sensor sits within a metre or two
_CLOCK = _Prior(slice(6, 7), CLOCK_TOLERANCE, 0.5, 0.001, 3e-4, ("delay",), "sigma_delay")
_HEADING = _Prior(
    slice(7, 8), HEADING_TOLERANCE, math.radians(10.0), 0.001, math.radians(0.01), ("heading",), "sigma_heading"
)
_LEVER = _Prior(slice(8, 10), LEVER_TOLERANCE, 0.7, 0.0005, 5e-4, ("lever_x", "lever_y"), "sigma_lever")
_GROUPS = (_TILT, _SCALE, _TURN, _CLOCK, _HEADING, _LEVER)  # corrected components
_MOUNT = (_TILT, _HEADING, _LEVER)
_RARE = (_CLOCK, _HEADING, _LEVER)
_OF_SENSOR = (*_MOUNT, _CLOCK)  # fixed where odometry is computed from the sensor's own clouds
SIZE = 10
"""Components of the state."""
_WIDE = np.zeros(SIZE)
for _group in (*_GROUPS, GRAVITY):
    _WIDE[_group.axes] = _group.wide
_MOTION = np.array([2, 3, 6, 7, 8, 9])  # components that affect a motion
_FAULTY = {count: np.array(list(itertools.product([False, True], repeat=count))) for count in (1, 5)}
"""All choices (M, N) of the faulty ones among N groups, by N."""
_DELAY, _BUT_DELAY = (np.arange(SIZE) == 6).astype(float), (np.arange(SIZE) != 6).astype(float)
_FREE = 1e6  # variance, in units of the wide prior's, of a component that is left free
_GUESSED = 0.9  # probability that a mount with only its angles stated is off by more than a drawing's tolerance
_STEPPED = 0.5  # probability of a fault where there is evidence of a step
_FREEDOM = 4.0  # degrees of freedom of Student's distribution


def motion_jacobian(step: Pose, rates: Floats, scale: float = 0.0) -> Floats:
    """Return the derivatives (3, 6) of a motion between clouds, (x, y, heading), by (s, w, τ, ψ, l) (eq. C2).

    With t, R odometry's motion, v, Ω the body's velocity and rotation rate at its ends, z the vertical,

        t' = t + s t + w |t| z x t / 2 - τ (R v2 - v1 - Ω1 x t) - ψ z x t + (R - I) l
        heading' = heading + w |t| - τ (Ω2 - Ω1)

    Args:
        step: (4, 4) odometry's motion, in the body's axes at its start.
        rates: (2, 3) velocities x, y and rotation about z at start and end, in the body's axes there.
        scale: correction already applied to the step.
    """
    t, R = step[:2, 3], step[:2, :2]
    across = np.array([-t[1], t[0]])
    raw = float(np.linalg.norm(step[:3, 3])) / (1.0 + scale)
    (*v1, w1), (*v2, w2) = rates.tolist()
    J = np.zeros((3, 6))
    J[:2, 0] = t / (1.0 + scale)
    J[:, 1] = *(0.5 * raw * across), raw
    J[:, 2] = *(np.array(v1) - R @ v2 + w1 * across), w1 - w2
    J[:2, 3] = -across
    J[:2, 4:] = R - np.eye(2)
    return J


class CalibrationBelief:
    """Gaussian over the state x = (roll, pitch, s, w, g, τ, ψ, l), with heavier tails where measurements contradict it.

    Most sensors are mounted straight and most odometry has the right scale. So the prior of a group of components is a
    mixture of two Gaussians, a narrow one about zero or an earlier value and a wide one. The applied value is the mean
    under both, weighted by their probabilities (Savage-Dickey ratio, eq. C3).

    Attributes:
        x: (10,) mean.
        P: (10, 10) covariance.
        shaking: (D,) log-likelihoods of DELAYS by the shaking of the body; see :class:`DelaySearch`.
    """

    def __init__(self, sensor_leans: bool, cloud_delay: float = 0.0, mount_drawn: bool = True) -> None:
        self.P = np.diag(_WIDE**2)
        self._centre = np.zeros(SIZE)  # of the narrow priors
        self._centre[_CLOCK.axes] = self._stated_delay = cloud_delay
        self.x = self._centre.copy()
        self._exact = {group.sigma: group.exact for group in _GROUPS}
        self._shares = {group.sigma: group.share for group in _GROUPS}
        self._sigma_height = 0.0
        if sensor_leans and not mount_drawn:
            self._shares |= {_HEADING.sigma: _GUESSED, _LEVER.sigma: _GUESSED}
            self._sigma_height = _LEVER.wide  # motion in a plane does not show it
        self._sensor_leans = sensor_leans
        self.shaking = np.zeros(len(DELAYS))
        self._stand_straight()

    def learn(self, earlier: Calibration, same_run: bool) -> None:
        """See :meth:`CalibrationEstimator.learn`."""
        present = self.applied()
        for group in _GROUPS:
            if group is _CLOCK and earlier.stated_delay != self._stated_delay:
                continue  # the stated delay has changed since
            sigma, axes = getattr(earlier, group.sigma), np.arange(SIZE)[group.axes]
            values = [getattr(earlier, name) for name in group.names]
            if group in _RARE and sigma**2 < self.P[axes, axes].mean():  # centred at the earlier value
                self.x[group.axes] = self._centre[group.axes] = values
                self._exact[group.sigma] = max(sigma, group.exact)
                if same_run:
                    self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0
                    self.P[axes, axes] = sigma**2
            elif group not in _RARE and sigma < getattr(present, group.sigma):
                self.x[group.axes] = values
                self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0
                self.P[axes, axes] = sigma**2
        self._stand_straight()

    def rescale(self, factor: float, sigma: float) -> None:
        """See :meth:`CalibrationEstimator.rescale`."""
        scale = 1.0 + self.applied().scale
        self.x[_SCALE.axes] = factor * scale - 1.0
        self.P[_SCALE.axes], self.P[:, _SCALE.axes] = 0.0, 0.0
        self.P[_SCALE.axes, _SCALE.axes] = (sigma * scale) ** 2

    def widen(self, groups: tuple[_Prior, ...]) -> None:
        """Widen the groups, as their components may have taken a step from their present values."""
        present = self.applied()
        for group in groups:
            self._centre[group.axes] = [getattr(present, name) for name in group.names]
            self._shares[group.sigma] = _STEPPED
            axes = np.arange(SIZE)[group.axes]
            self.P[axes, axes] += group.wide**2
        self._stand_straight()

    def begin_odometry(self) -> None:
        """See :meth:`CalibrationEstimator.begin_odometry`."""
        self.x[GRAVITY.axes] = 0.0
        self.P[GRAVITY.axes], self.P[:, GRAVITY.axes] = 0.0, 0.0
        self.P[GRAVITY.axes, GRAVITY.axes] = np.eye(2) * GRAVITY.wide**2

    def forget_tilt(self) -> None:
        """See :meth:`CalibrationEstimator.forget_tilt`."""
        self.x[_TILT.axes] = 0.0
        self.P[_TILT.axes], self.P[:, _TILT.axes] = 0.0, 0.0
        self.P[_TILT.axes, _TILT.axes] = np.eye(2) * _TILT.wide**2
        self._stand_straight()

    def begin_at(self, delay: float, sigma: float) -> None:
        """Restart at a delay; reset scale and turn, which may have absorbed it."""
        for group, mean, spread in ((_CLOCK, delay, sigma), (_SCALE, 0.0, _SCALE.wide), (_TURN, 0.0, _TURN.wide)):
            self.x[group.axes] = mean
            self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0
            self.P[group.axes, group.axes] = spread**2
        self._centre[_CLOCK.axes] = delay
        self._exact[_CLOCK.sigma] = max(sigma, _CLOCK.exact) if delay else _CLOCK.exact
        self._shares[_CLOCK.sigma] = _STEPPED if delay else _CLOCK.share
        self._stand_straight()

    def walk(self, driven: float) -> None:
        """Widen all components by their random walks over ``driven`` metres."""
        for group in (*_GROUPS, GRAVITY):
            axes = np.arange(SIZE)[group.axes]
            self.P[axes, axes] = np.minimum(self.P[axes, axes] + group.walk**2 * driven, group.wide**2)
        self._stand_straight()

    def doubt_tilt(self, measured: Floats, H: Floats, R: Floats) -> None:
        """Widen the tilt's covariance where a measurement strongly contradicts it."""
        gap, spread = measured - H @ self.x, H @ self.P @ H.T + R
        factor = heavier(float(gap @ np.linalg.solve(spread, gap)), len(gap))
        widest = _TILT.wide**2 / max(float(self.P[0, 0]), float(self.P[1, 1]), 1e-30)
        wider = math.sqrt(min(factor, max(widest, 1.0)))
        self.P[:2] *= wider
        self.P[:, :2] *= wider

    def update(self, measured: Floats, H: Floats, R: Floats, right: float = 1.0, part: Floats | None = None) -> float:
        """Add a measurement ``measured`` = H x + noise of covariance R; return its prior log-likelihood.

        ``right`` is the probability that the measurement is valid; it reduces the gain accordingly. ``part`` (10,), 0
        or 1, masks the components that are corrected, default all; the others add their errors (Schmidt's filter).
        """
        R = R / right + (1.0 / right - 1.0) * H @ self.P @ H.T
        gap = measured - H @ self.x
        distance = float(gap @ np.linalg.solve(H @ self.P @ H.T + R, gap))
        R = R * heavier(distance, len(gap))
        spread = H @ self.P @ H.T + R
        gain = np.linalg.solve(spread, H @ self.P).T
        if part is not None:
            gain *= part[:, None]
        self.x = self.x + gain @ gap
        rest = np.eye(SIZE) - gain @ H
        self.P = rest @ self.P @ rest.T + gain @ R @ gain.T
        return -0.5 * float(gap @ np.linalg.solve(spread, gap) + np.linalg.slogdet(spread)[1])

    def applied(self) -> Calibration:
        """Return the mean and sigmas of the mixture over all choices of faulty groups (eq. C3)."""
        values: dict[str, float] = {}
        for groups, faulty in ((_GROUPS[:1], _FAULTY[1]), (_GROUPS[1:], _FAULTY[len(_GROUPS) - 1])):
            axes = np.concatenate([np.arange(SIZE)[group.axes] for group in groups])
            sizes = [group.axes.stop - group.axes.start for group in groups]
            x, P = self.x[axes] - self._centre[axes], self.P[np.ix_(axes, axes)]
            exact = np.repeat([self._exact[group.sigma] for group in groups], sizes)
            wide = np.repeat([group.wide for group in groups], sizes)
            shares = np.array([self._shares[group.sigma] for group in groups])
            free = np.repeat(faulty, sizes, axis=1)  # (M, K): whether the component may be arbitrary
            # a nominal component acts as a measurement of zero, in units of its wide prior
            noise = np.where(free, _FREE, (exact / wide) ** 2)
            spread = P / np.outer(wide, wide) + noise[:, :, None] * np.eye(len(axes))
            pull = np.linalg.solve(spread, np.column_stack([x / wide, P / np.outer(wide, wide)])[None])
            fit = np.linalg.slogdet(spread)[1] - (free * math.log(_FREE)).sum(axis=1) + pull[:, :, 0] @ (x / wide)
            prior = np.where(faulty, np.log(shares), np.log1p(-shares)).sum(axis=1)
            if _CLOCK in groups:
                prior += self._by_shaking() * faulty[:, groups.index(_CLOCK)]
            weights = np.exp(prior - 0.5 * fit - (prior - 0.5 * fit).max())
            weights /= weights.sum()
            means = x - pull[:, :, 0] @ (P / wide).T  # (M, K)
            if groups == (_TILT,):  # a small lean is attributed to odometry's gravity
                means = np.where(free, means, 0.0)
            variances = np.diag(P) - wide * np.einsum("ij,mji->mi", P / np.outer(wide, wide), pull[:, :, 1:]) * wide
            mean = weights @ means
            variance = weights @ (variances + means**2) - mean**2
            at = 0
            for group, size in zip(groups, sizes, strict=True):
                own = slice(at, at + size)
                at += size
                values |= dict(zip(group.names, (self._centre[group.axes] + mean[own]).tolist(), strict=True))
                values[group.sigma] = math.sqrt(max(float(variance[own].mean()), 0.0))
        return Calibration(**values, stated_delay=self._stated_delay, sigma_height=self._sigma_height)

    def _by_shaking(self) -> float:
        """Return the log-odds of the filter's delay against the expected one, by the shaking of the body.

        The filter itself uses x, y and heading, where an error of odometry in a turn looks like a delay.
        """
        sigma = math.sqrt(float(self.P[_CLOCK.axes, _CLOCK.axes][0, 0]))
        likely = np.exp(np.interp(self.x[_CLOCK.axes] + sigma * np.array([-1.0, 0.0, 1.0]), DELAYS, self.shaking))
        return math.log(max(float(likely @ [0.25, 0.5, 0.25]), 1e-300)) - float(
            np.interp(self._centre[_CLOCK.axes], DELAYS, self.shaking)[0]
        )

    def _stand_straight(self) -> None:
        """Fix mount and clock at zero where odometry is computed from the clouds: odometry's gravity takes the lean."""
        if not self._sensor_leans:
            for group in _OF_SENSOR:
                self.x[group.axes] = self._centre[group.axes] = 0.0
                self.P[group.axes], self.P[:, group.axes] = 0.0, 0.0


def mixed(one: Calibration, other: Calibration, share: float) -> Calibration:
    """Return the mixture of two calibrations, with probability ``share`` of ``other``."""

    def mean(a: float, b: float) -> float:
        return (1.0 - share) * a + share * b

    values: dict[str, float] = {}
    for group in _GROUPS:
        pairs = [(getattr(one, name), getattr(other, name)) for name in group.names]
        apart = sum((a - b) ** 2 for a, b in pairs) / len(pairs)  # per component
        within = mean(getattr(one, group.sigma) ** 2, getattr(other, group.sigma) ** 2)
        values |= {name: mean(*pair) for name, pair in zip(group.names, pairs, strict=True)}
        values[group.sigma] = math.sqrt(within + share * (1.0 - share) * apart)
    return replace(one, **values)


def heavier(distance: float, size: int) -> float:
    """Return Student's t factor on a measurement's variance, by its squared Mahalanobis distance and dimension."""
    return max(1.0, (_FREEDOM + distance) / (_FREEDOM + size))


_ATTITUDE = math.radians(0.1)  # sigma of a registration's roll and pitch, added to its covariance
_LEAN = 3.0  # ratio of the roll and pitch errors of a frame-to-frame motion to its heading error
_HEIGHT = 2.0  # metres, largest height of a lidar above the ground: a wrong attitude shifts it by that arm
_MIN_STEP = 0.2  # metres; on shorter steps the registrations' noise hides the motion's errors
_MIN_TURN = math.radians(5.0)  # likewise


class CalibrationEstimator:
    """Estimator of the calibration, from registrations.

    Attributes:
        calibration: the applied calibration.
        history: raw odometry.
    """

    def __init__(self, sensor_leans: bool = True, cloud_delay: float = 0.0, mount_drawn: bool = True) -> None:
        """Start from the priors; the arguments are those of ``LocalizerConfig``."""
        self._known = CalibrationBelief(sensor_leans, cloud_delay, mount_drawn)
        self.history, self._delays = OdometryHistory(), DelaySearch()
        self._supposed: CalibrationBelief | None = None  # belief if the leading place of a search is right
        self._probability = 0.0  # that the leading place is right
        self._apply()

    @property
    def lean_prior(self) -> float:
        """Log-probability of the applied lean if only a leading place of a search has shown it, else 0."""
        if self._supposed is None:
            return 0.0
        known = self._known.applied()
        return lean_prior(self.calibration.leans_from(known), known.sigma_tilt)

    def learn(self, earlier: Calibration, same_run: bool = False) -> None:
        """Adopt the components of an earlier calibration whose sigma is below the present one.

        Mount and clock may have changed since, unless it is of the ``same_run``.
        """
        self._supposed = None
        self._known.learn(earlier, same_run)
        self._apply()

    def forget_leader(self) -> None:
        """Forget the measurement at the place that led a search."""
        self._supposed = None
        self._apply()

    def forget_tilt(self) -> None:
        """Forget the lean of the sensor, which was measured on changed ground."""
        self._supposed = None
        self._known.forget_tilt()
        self._apply()

    def begin_odometry(self) -> None:
        """Forget the lean of the odometry frame, as a new one starts; the robot's constants stay."""
        self.history, self._delays = OdometryHistory(), DelaySearch()
        self._supposed = None
        self._known.begin_odometry()
        self._apply()

    def measure_attitude(self, T_map_cloud: Pose, T_odom_body: Pose, variance: float) -> None:
        """Add the attitude of a registration at the tracked place (eq. C1).

        ``T_map_cloud`` (4, 4) is of the cloud in the sensor's axes, without the prior, ``T_odom_body`` (4, 4) of the
        same frame, ``variance`` of the registration's roll and pitch, rad^2.
        """
        self._supposed = None
        _measure_attitude(self._known, T_map_cloud, T_odom_body, variance)
        self._apply()

    def suppose_attitude(self, T_map_cloud: Pose, T_odom_body: Pose, variance: float, probability: float) -> None:
        """Add the attitude at a place that is right with a ``probability``, replacing the previous supposition.

        A search registers the same scans again, so suppositions do not accumulate. Args as :meth:`measure_attitude`.
        """
        self._supposed, self._probability = deepcopy(self._known), probability
        _measure_attitude(self._supposed, T_map_cloud, T_odom_body, variance)
        self._apply()

    def widen_mount(self) -> None:
        """Widen the sigmas of the mount, as the sensor may have been turned or shifted on the body."""
        self._delays.forget_motions()
        self._widen(_MOUNT)

    def widen_clock(self) -> None:
        """Widen the sigma of the delay, as the clock of clouds or odometry may have taken a step."""
        self._delays = DelaySearch()
        self._widen((_CLOCK,))

    def rescale(self, factor: float, sigma: float) -> None:
        """Apply a step of odometry's scale by a factor with relative ``sigma``: the random walk is too slow for it."""
        self._supposed = None
        self._delays.forget_motions()
        self._known.rescale(factor, sigma)
        self._apply()

    def _widen(self, groups: tuple[_Prior, ...]) -> None:
        self._supposed = None
        self._known.widen(groups)
        self._apply()

    def search_delay(self) -> None:
        """Judge the motions after which odometry has gone on for a second; call it at each frame.

        If they favour another delay, the state restarts there. The filter learns the delay only here: just after a
        motion, the rate at its end contains the noise of odometry's last step, which would look like a delay of half a
        step; later the rate spans both sides of that moment. If odometry is late, the filter learns all else here, too.
        """
        judged = self._delays.judge(self.history)
        for belief in filter(None, (self._known, self._supposed)):
            belief.shaking = self._delays.shaking
        for seen, step, rates in judged:
            step[:3, 3] *= 1.0 + seen.applied.scale
            J = motion_jacobian(step, rates, seen.applied.scale)
            part = None if _waits(seen.applied) else _DELAY
            scaled = replace(seen.applied, turn=0.0)  # the step is raw odometry but for its scale
            self._learn_motion(seen.motion, step, J, seen.noise, scaled, part)
        if judged:
            now, surprise = self.calibration, math.log((1.0 - _CLOCK.share) / _CLOCK.share)
            delay = self._delays.better_than(now.delay, now.sigma_delay, surprise)
            if delay is not None:
                self._known.begin_at(delay, RESOLUTION)
                self._delays.forget_motions()  # they were measured at the old delay
                self._apply()

    def measure_motion(
        self,
        T_map_before: Pose,
        T_map_body: Pose,
        step: Pose,
        noise: Floats,
        moments: Moments = (None, None),
        contradicts: bool = False,
    ) -> Pose:
        """Add the motion between two registrations (eq. C2); return ``step`` corrected by the new calibration.

        Args:
            T_map_before: (4, 4) earlier pose, without the prior.
            T_map_body: (4, 4) later pose, likewise.
            step: (4, 4) odometry between them, corrected by the calibration of its time; below 0.2 m and 5 degrees it
                shows nothing.
            noise: (3, 3) covariance of the motion's (x, y, heading), body's axes at its start, without the
                calibration's errors.
            moments: of both poses; without them the motion shows no delay. A motion with unknown rates (NaN) is not
                used: a robot that starts to move looks as if its clouds were late.
            contradicts: the motion contradicts odometry, perhaps by a slip, so it shows nothing of mount and clock.
        """
        driven = float(np.linalg.norm(step[:3, 3]))
        turned = abs(float(log_so3(step[:3, :3])[2]))
        first, last = (None, None) if contradicts else moments
        rates = np.zeros((2, 3)) if first is None or last is None else np.array([first.rates, last.rates])
        if (driven < _MIN_STEP and turned < _MIN_TURN) or not np.isfinite(rates).all():
            return step
        for belief in filter(None, (self._known, self._supposed)):
            belief.walk(driven)
        motion, before = inverse(T_map_before) @ T_map_body, self.calibration
        J = motion_jacobian(step, rates, before.scale)
        if contradicts:
            J[:, 2:] = 0.0
        if first is not None and last is not None:
            self._delays.add(SeenMotion(motion, first.stamp, last.stamp, before, noise, J))
        if first is None or last is None or not _waits(before):
            self._learn_motion(motion, step, J, noise, before, _BUT_DELAY)
        now = self.calibration
        moved = J @ (_motion_part(now) - _motion_part(before))
        t = np.append(step[:2, 3] + moved[:2], (1.0 + now.scale) / (1.0 + before.scale) * step[2, 3])
        return pose_from(exp_so3(np.array([0.0, 0.0, moved[2]])) @ step[:3, :3], t)

    def _learn_motion(
        self, motion: Pose, step: Pose, J: Floats, noise: Floats, applied: Calibration, part: Floats | None
    ) -> None:
        """Correct the components ``part`` of the beliefs by a motion; ``applied`` has corrected it and ``step``."""
        turned = log_so3(motion[:3, :3] @ step[:3, :3].T)
        gap = np.append(motion[:2, 3] - step[:2, 3], turned[2])
        H = np.zeros((3, SIZE))
        H[:, _MOTION] = J
        # clouds levelled by the attitude of another moment are bent: at a lidar's height they are shifted by this much
        bent = np.diag([turned[1], turned[0], 0.0]) * _HEIGHT
        self._update(gap + J @ _motion_part(applied), H, noise + bent**2, part=part)

    def measure_frames(
        self, motion: Pose, step: Pose, variances: Floats, sigmas: Floats, moments: Moments = (None, None),
        right: float = 1.0,
    ) -> Pose:  # fmt: skip
        """Add a motion between frames measured by the lidar alone (eq. C4); return ``step``, newly corrected.

        ``motion`` (4, 4) is the levelled body's, ``step`` (4, 4) odometry's with the calibration of its time.
        ``variances`` (6,) of odometry's random walk and ``sigmas`` (6,) of ``motion`` are over (rx, ry, rz, x, y, z).
        ``moments`` are as in :meth:`measure_motion`; ``right`` is the probability that the registration has not failed.
        """
        t, before = step[:3, 3], self.calibration
        applied = np.array([before.roll, before.pitch])
        turned = log_so3(motion[:3, :3] @ step[:3, :3].T)
        # a tilted sensor sees a climb
        H = np.zeros((1, SIZE))
        H[0, :2] = -t[1], t[0]
        rise = np.array([motion[2, 3] - t[2] + H[0, :2] @ applied])
        self._update(rise, H, np.array([[variances[5] + sigmas[5] ** 2]]), right)
        H = np.zeros((2, SIZE))
        H[:, :2] = (motion[:3, :3] - np.eye(3))[:2, :2]  # by the lidar's heading, which is better than odometry's
        self._update(turned[:2] + H[:, :2] @ applied, H, np.diag(variances[:2] + (_LEAN * sigmas[:2]) ** 2), right)
        noise = np.diag(variances[[3, 4, 2]] + sigmas[[3, 4, 2]] ** 2 / right)
        level = self.calibration.T_body_cloud @ inverse(before.T_body_cloud)
        return self.measure_motion(np.eye(4), level @ motion @ inverse(level), step, noise, moments)

    def _update(self, measured: Floats, H: Floats, R: Floats, right: float = 1.0, part: Floats | None = None) -> None:
        """Add a measurement to both beliefs, as in :meth:`CalibrationBelief.update`."""
        likelihood = self._known.update(measured, H, R, right, part)
        if self._supposed is not None:
            ratio = self._supposed.update(measured, H, R, right, part) - likelihood
            odds = self._probability * math.exp(min(ratio, 50.0))
            self._probability = odds / (odds + 1.0 - self._probability)
        self._apply()

    def _apply(self) -> None:
        self.calibration = self._known.applied()
        if self._supposed is not None:
            self.calibration = mixed(self.calibration, self._supposed.applied(), self._probability)


def _waits(applied: Calibration) -> bool:
    """Return whether odometry is so late that a motion has to wait for it."""
    return applied.delay <= -RESOLUTION


def _motion_part(calibration: Calibration) -> Floats:
    """Return the values (6,) of the components that affect a motion."""
    c = calibration
    return np.array([c.scale, c.turn, c.delay, c.heading, c.lever_x, c.lever_y])


def _measure_attitude(belief: CalibrationBelief, T_map_cloud: Pose, T_odom_body: Pose, variance: float) -> None:
    applied = belief.applied()
    residual = np.cross((T_map_cloud[:3, :3] @ applied.R_body_cloud.T)[2], T_odom_body[2, :3])
    residual[2] = 0.0
    measured = log_so3(exp_so3(residual) @ applied.R_tilt)[:2]
    H = np.eye(2, SIZE)
    H[:, GRAVITY.axes] = T_odom_body[:2, :2].T  # the lean of odometry's frame turns with the body
    R = np.eye(2) * (variance + _ATTITUDE**2)
    belief.doubt_tilt(measured, H, R)
    belief.update(measured, H, R)


def tilt_variance(covariance: Floats) -> float:
    """Return the mean variance of roll and pitch, rad^2, in a covariance (6, 6) over (rx, ry, rz, x, y, z)."""
    return 0.5 * float(covariance[0, 0] + covariance[1, 1])
