"""The first motions of a robot by its clouds alone, and its conventions from them.

Clouds some metres apart are registered to each other, without a map and from many starts, so that odometry cannot hide
a motion that it lacks.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from coview_stream.clouds.reference_system import FOOT
from coview_stream.config import KeyframeConfig, RegistrationConfig
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, wrap_angle, yaw_of
from coview_stream.localization.registration.clouds import LocalMap, prepare_scan, voxelized
from coview_stream.localization.registration.register import registration_covariance
from coview_stream.localization.registration.surfaces import register_to_cloud, surface_points
from coview_stream.localization.witness.cloud_motion import ALIKE, fit_of
from coview_stream.localization.witness.conventions import (
    AS_SENT,
    AXES,
    AXIS_NAMES,
    BASELINE,
    BOTH_CAMERA,
    FEET,
    HEADING,
    METRES_PER_RADIAN,
    MILLIMETRES,
    MIRRORED,
    ODOMETRY,
    RIVALS,
    SURE,
    SWAPPED,
    UP,
    Pair,
    Reading,
    axis_up,
    fit,
    turned_clouds,
    turning,
    unit_of,
)  # fmt: skip

DOUBT = "odometry does not follow the first clouds: do both come in metres, x forward, y left, z up?"
"""Reason while :attr:`Conventions.doubtful`."""

_LONGEST_CHAIN = 8  # clouds, where the robot hardly moves
_STUCK = 0.05  # metres, largest apparent motion of clouds of one place
_NEW_START = 1.0  # metres, spacing of starts; a registration reaches three times as far
_POINTS = 4000  # registered per cloud
_ENOUGH, _SAME = 3, 0.2  # starts that have to reach the same motion, and metres within which motions are the same
_PAIRS = 6  # newest pairs, which the localizer judges
_ODD = math.log(1e-2)  # log prior of a reading: one of a hundred first set-ups is wrong in one of these ways
_ANY_HEADING = math.log(HEADING / math.pi)  # log prior of a fitted heading, as one among all


class _Reached(NamedTuple):
    """A motion (4, 4), its variance in m2, and the share of structure that fits."""

    variance: float
    motion: Pose
    fit: float

    def apart(self, other: _Reached) -> float:
        """Return the metres to another motion."""
        return float(np.linalg.norm(self.motion[:3, 3] - other.motion[:3, 3]))


def _likeliest(found: list[_Reached], odometry: _Reached) -> tuple[float, Pose]:
    """Return the variance of the best determined motion, m2, and the motion (4, 4).

    Other motions, including odometry's, widen it as far as the clouds fit equally well, within counting errors.
    """
    chosen = min(found, key=lambda each: each.variance)
    weights = ((each, math.exp(-0.5 * (max(chosen.fit - each.fit, 0.0) / ALIKE) ** 2)) for each in (*found, odometry))
    return chosen.variance + max(weight * each.apart(chosen) ** 2 for each, weight in weights), chosen.motion


class CloudPairs:
    """Motions of successive clouds, registered from many starts.

    Of the motions that a registration reaches from all starts, the one that the clouds determine best counts: in 34 of
    35 steps of riverside_a, kitti04 and handheld_livox it is the true one, with or without odometry's start. Others
    that fit equally well, as along a corridor, widen its sigma.
    """

    def __init__(self, up: Floats) -> None:
        """Level clouds whose ``up`` (3,) points up."""
        self._config = RegistrationConfig()
        self._level = pose_from(turning(up, UP), np.zeros(3))
        self._target: LocalMap | None = None
        self._begin(np.eye(4))
        self._step = np.eye(4)  # the newest motion

    def _begin(self, T_odom_body: Pose) -> None:
        self._first = self._newest = T_odom_body  # odometry of the first cloud and of the newest
        self._clouds, self._motion, self._variance = 0, np.eye(4), 0.0

    def add(self, points: Points, T_odom_body: Pose) -> Pair | None:
        """Add a cloud (N, 3), metres, and its odometry (4, 4); return the pair that it completes, if any.

        Motions are joined until they exceed a metre, over eight clouds at most, or until odometry drives while the
        clouds stand still.
        """
        cloud, pair = voxelized(points, self._level, KeyframeConfig()), None
        found = None if self._target is None else self._registered(cloud, T_odom_body, self._target)
        if found is not None:
            variance, self._step = found
            pair = self.add_step(self._step, variance, self._newest, T_odom_body)
        else:
            self._begin(T_odom_body)
            self._step = np.eye(4)
        self._target = LocalMap(*surface_points(cloud))
        return pair

    def add_step(self, step: Pose, variance: float, T_before: Pose, T_odom_body: Pose) -> Pair | None:
        """Add a motion (4, 4) between two clouds, its variance in m2, and odometry (4, 4) at both; as :meth:`add`."""
        if T_before is not self._newest:
            self._begin(T_before)
        self._target, self._newest = None, T_odom_body
        self._motion, self._variance = self._motion @ step, self._variance + variance
        self._clouds += 1
        moved, odometry = (float(np.linalg.norm(T[:3, 3])) for T in (self._motion, inverse(self._first) @ T_odom_body))
        stuck = moved < _STUCK and odometry > BASELINE
        if moved <= BASELINE and self._clouds < _LONGEST_CHAIN and not stuck:
            return None
        pair = Pair(self._motion, math.sqrt(self._variance), self._first, T_odom_body)
        self._begin(T_odom_body)
        return pair

    def _registered(self, cloud: Points, T_odom_body: Pose, target: LocalMap) -> tuple[float, Pose] | None:
        """Return a motion's variance, m2, and the motion (4, 4); None if none is reached."""
        here = np.zeros(3)
        scan = prepare_scan(cloud[:: 1 + len(cloud) // _POINTS], here, self._config)
        motions = list[_Reached]()
        for start in starts(self._newest, T_odom_body, self._step):
            match = register_to_cloud(scan, target, start, self._config, here)
            if match is None or not match.converged:
                continue
            covariance = registration_covariance(match.information, self._config)  # wide along a corridor
            fit = fit_of(scan, target, match.T_map_source)
            motions.append(_Reached(float(np.diag(covariance)[3:5].max()), match.T_map_source, fit))
            if sum(motions[-1].apart(other) < _SAME for other in motions) == _ENOUGH:
                break  # enough starts agree
        if not motions:
            return None
        odometry = inverse(self._newest) @ T_odom_body
        return _likeliest(motions, _Reached(math.inf, odometry, fit_of(scan, target, odometry)))


def starts(before: Pose, after: Pose, step: Pose) -> Iterator[Pose]:
    """Yield motions (4, 4) to start a registration from, a metre or more apart.

    They are odometry's motion as sent and corrected, the previous motion ``step``, none, and odometry's distance in six
    directions, for a lidar of any heading.
    """
    odometry = inverse(before) @ after
    tried = [odometry, step, np.eye(4)]
    tried += [inverse(change(before)) @ change(after) for change in RIVALS.values()]
    far = float(np.linalg.norm(odometry[:3, 3]))
    tried += [
        pose_from(odometry[:3, :3], [far * math.cos(heading), far * math.sin(heading), 0.0])
        for heading in np.arange(0.0, 2.0 * np.pi, np.pi / 3)
    ]
    seen: list[Floats] = []
    for start in tried:
        at = np.append(start[:3, 3], METRES_PER_RADIAN * yaw_of(start))
        if all(np.linalg.norm(at - other) >= _NEW_START for other in seen):
            seen.append(at)
            yield start


class Conventions:
    """Check of a robot's conventions by its first motions.

    Attributes:
        finding: why clouds and odometry are unusable as sent, and the remedy; None while nothing is found.
        plausible: clouds and odometry surely fit as sent; a straight drive may hide a mirror or odometry's wrong turns.
        settled: clouds and odometry surely are correct.
        doubtful: not plausible yet, and odometry more probably does not follow the clouds.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Reset, as another sender may start."""
        self.finding: str | None = None
        self.plausible = self.settled = self.doubtful = False
        self._at: Floats | None = None  # position by odometry at the newest cloud
        self._ups = Counter[int]()  # axes of the clouds below which ground was seen
        self._axis, self._unit = 0, 1.0
        self._motions: CloudPairs | None = None
        self._pairs: deque[Pair] = deque(maxlen=_PAIRS)
        self._pairs_in_feet: deque[Pair] = deque(maxlen=_PAIRS)

    def add(self, points: Points, T_odom_body: Pose) -> None:
        """Judge one more cloud (N, 3) as sent, with its odometry (4, 4)."""
        position = T_odom_body[:3, 3]
        if self.settled or (self._at is not None and float(np.linalg.norm(position - self._at)) < BASELINE):
            return
        self._at = position.copy()
        unit = unit_of(points)
        points = points if unit == 1.0 else points * np.float32(unit)
        if not self.plausible and (up := axis_up(points)) is not None:
            self._ups[up] += 1
        axis = self._ups.most_common(1)[0][0] if self._ups else 0
        if self._motions is None or (unit, axis) != (self._unit, self._axis):
            self._unit, self._axis, self._motions = unit, axis, CloudPairs(AXES[axis])
            self._pairs.clear()
            self._pairs_in_feet.clear()
            self.doubtful = False
            self._motions_in_feet = CloudPairs(AXES[axis])
        pair, in_feet = self._motions.add(points, T_odom_body), None
        if pair is not None:
            self._pairs.append(pair)
        if fit(self._pairs).odds > 0.0:  # so the clouds are not in feet
            self._pairs_in_feet.clear()
            self._motions_in_feet = CloudPairs(AXES[axis])
        elif not self.plausible:
            in_feet = self._motions_in_feet.add(points * np.float32(FOOT), T_odom_body)
            if in_feet is not None:
                self._pairs_in_feet.append(in_feet)
        if pair is not None or in_feet is not None:
            self._judge()

    def add_motion(self, motion: Pose, variance: float, T_before: Pose, T_odom_body: Pose) -> None:
        """Judge a motion (4, 4) of clouds, its variance in m2, and odometry (4, 4) before and after it.

        It was registered from odometry's motion, so it shows nothing before the two are plausible.
        """
        if not self.plausible or self.settled or self._motions is None:
            return
        pair = self._motions.add_step(motion, variance, T_before, T_odom_body)
        if pair is not None:
            self._pairs.append(pair)
            self._judge()

    def _judge(self) -> None:
        """Weigh the readings, and unrelated clouds and odometry, by their odds."""
        sent, unrelated = self._axis == 0 and self._unit == 1.0, _ODD
        weighed = sorted(
            ((prior + fit(self._pairs_in_feet if reading is FEET else self._pairs, reading).odds, reading)
            for prior, reading in self._readings(sent)), key=lambda each: -each[0],
        )  # fmt: skip

        def odds(*but: Reading) -> float:
            """Return the log odds of all readings but some, and of unrelated motions."""
            return float(np.logaddexp.reduce([unrelated, *(odds for odds, reading in weighed if reading not in but)]))

        right = next((odds for odds, reading in weighed if reading is AS_SENT), -math.inf)
        self.plausible = self.plausible or right - odds(AS_SENT, MIRRORED, SWAPPED, *ODOMETRY) > 2.0 * SURE
        self.settled = right - odds(AS_SENT) > 2.0 * SURE
        self.doubtful = not self.plausible and right < odds(AS_SENT)
        (best, reading), (second, other) = weighed[:2]
        wrong = float(np.logaddexp.reduce([odds for odds, reading in weighed if reading is not AS_SENT]))
        self.finding = None
        if wrong - float(np.logaddexp(right, unrelated)) > SURE:
            rivals = [reading, other] if best - second < SURE and other is not AS_SENT else [reading]
            self.finding = "; or else ".join(f"{each.found}: {each.remedy}" for each in rivals)

    def _readings(self, sent: bool) -> Iterator[tuple[float, Reading]]:
        """Yield readings to compare, with their log priors; ``sent``: unit and vertical are correct."""
        if sent:
            yield 0.0, AS_SENT
        else:
            yield _ODD, MILLIMETRES if self._axis == 0 else turned_clouds(self._axis, 0.0)
        for quarter in (0.5 * math.pi, -0.5 * math.pi, math.pi):
            yield _ODD, turned_clouds(self._axis, quarter)
        seen = fit(self._pairs)
        if abs(wrap_angle(4.0 * seen.yaw)) > 4.0 * HEADING and seen.spread < HEADING:
            yield _ODD + _ANY_HEADING, turned_clouds(self._axis, seen.yaw)
        if AXIS_NAMES[self._axis] == "-y":
            yield _ODD, BOTH_CAMERA
        others = (*((FEET,) if self._pairs_in_feet else ()), MIRRORED, SWAPPED, *ODOMETRY)
        yield from ((_ODD if sent else 2.0 * _ODD, reading) for reading in others)
