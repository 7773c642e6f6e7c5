"""Evidence of a slip or a displaced robot: where a registration contradicts odometry, and between registrations.

A registration may fit beside the pose by odometry. Either odometry is wrong (wheels slip, the robot is pushed) and the
lidar is right, or odometry is right and a building or a stack of containers stands a metre off its surveyed place. The
scans decide, by the likelihood ratio of one place against all others, given how well scans usually fit here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

import coview_kernels as kernels
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import ALERT_DEGREES, ALERT_METRES
from coview_stream.geometry.transforms import Points, Pose, boxminus, inverse, transform
from coview_stream.localization.evidence.observation import ObservedScan
from coview_stream.localization.registration.clouds import LocalMap
from coview_stream.localization.tracking.place_evidence import PlaceEvidence

_VIEWS = 4  # newest views in which a moved part is searched for


def off_by(T_map_body: Pose, T_map_other: Pose) -> tuple[float, float]:
    """Return metres and degrees between two poses."""
    gap = boxminus(T_map_body, T_map_other)
    return float(np.linalg.norm(gap[3:])), math.degrees(float(np.linalg.norm(gap[:3])))


def matters(metres: float, degrees: float) -> bool:
    """Return whether two poses are too far apart for both to be right: more than half of the alert limit."""
    return metres > 0.5 * ALERT_METRES or degrees > 0.5 * ALERT_DEGREES


class Dispute:
    """Candidate places while odometry is contradicted, and the scans' evidence for each of them.

    The first is odometry's. Scans within one view (a metre) see the same, so the newest of a view counts, and views add
    up. A place that appears later starts with the evidence of the first. Odometry's prior is the probability, by the
    clouds alone, that it has not slipped. Structure that fits only at another candidate may have moved since the
    survey, however many scans show it there.
    """

    def __init__(self, place: PlaceEvidence, view: float) -> None:
        """Weigh by ``place``; a view is ``view`` metres long."""
        self._place = place
        self._view = view
        self.clear()

    def clear(self) -> None:
        """Forget all candidates."""
        self._poses: list[Pose] = []  # T_map_odom
        self._before = np.zeros(0)  # log-likelihood ratios of the earlier views
        self._newest = np.zeros(0)  # and of the current one
        self._begun = -math.inf  # metres driven at the start of the view
        self._scans: list[ObservedScan] = []  # the newest of each view

    def settle(
        self, scan: ObservedScan, T_map_predicted: Pose, T_map_seen: Sequence[Pose], travelled: float, risk: float,
        slipped: float,
    ) -> Pose | None:  # fmt: skip
        """Return the right ``T_map_body`` (4, 4) if odometry has slipped; None while undecided.

        The candidates are the pose by odometry and the registered ones ``T_map_seen``; ``risk`` is the accepted
        probability that another candidate is right, too far off for both to be right. ``slipped`` are the odds, by the
        clouds alone, that odometry has slipped.
        """
        if travelled - self._begun >= self._view:
            self._begun = travelled
            self._before = self._before + self._newest
            self._scans = [*self._scans, scan][-_VIEWS:]
        self._scans[-1] = scan
        T_body_odom = inverse(scan.T_odom_body)
        owners = self._assign(T_map_predicted, T_map_seen, scan.T_odom_body)
        candidates = [T_map_predicted @ T_body_odom, *self._poses[1:], *(T @ T_body_odom for T in T_map_seen)]
        ratios = self._place.ratios(scan, np.stack(candidates))
        self._newest = ratios[: len(self._poses)].copy()
        np.maximum.at(self._newest, owners, ratios[len(self._poses) :])
        total, here = self._before + self._newest, [T @ scan.T_odom_body for T in self._poses]
        total[0] -= math.log(slipped)
        best = int(total.argmax())
        # a place near the best one contradicts it only if it is odometry's
        apart = np.array([k == 0 or matters(*off_by(T, here[best])) for k, T in enumerate(here)])

        def leads() -> bool:
            return best != 0 and float(total[best] - np.logaddexp.reduce(total[apart])) >= -math.log(risk)

        if leads():  # or odometry is right, and what fits here has moved
            moved = self._place.log_odds_of_moved(self._scans, self._poses[best], self._poses[0])
            total[0] = np.logaddexp(total[0], total[best] + moved - math.log(slipped))
        return here[best] if leads() else None

    def _assign(self, T_map_predicted: Pose, T_map_seen: Sequence[Pose], T_odom_body: Pose) -> list[int]:
        """Return the index of each registered pose's nearest candidate, moved there; one far from all is a new one.

        Odometry's candidate, the first, follows ``T_map_predicted`` instead.
        """
        T_body_odom = inverse(T_odom_body)
        self._poses[:1] = [T_map_predicted @ T_body_odom]
        self._before = self._before if len(self._before) else np.zeros(1)
        for T in T_map_seen:
            if all(matters(*off_by(T_place @ T_odom_body, T)) for T_place in self._poses):
                self._poses.append(T @ T_body_odom)
                self._before = np.append(self._before, self._before[0])
        owners = []
        for T in T_map_seen:
            gaps = [np.divide(off_by(place @ T_odom_body, T), (ALERT_METRES, ALERT_DEGREES)) for place in self._poses]
            owners.append(int(np.max(gaps, axis=1).argmin()))
        for k, T in zip(owners, T_map_seen, strict=True):
            if k:
                self._poses[k] = T @ T_body_odom
        return owners


_REACH = 0.3  # metres: about the map's point spacing
_MIN_RANGE, _MAX_RANGE = 2.0, 35.0  # horizontal metres from the body
_HEIGHT = 1.0  # metres above the lowest ground nearby
_FLOOR_RADIUS = 10.0  # metres within which the lowest 5 % of the points show it
_POINTS = 400  # compared, at most
_MIN_POINTS = 60
_NEWEST_SHARE = 0.3  # weight of a new share in the usual one: averages about three registrations
_DROP = 0.7  # of the usual share: see DisplacementCheck


class DisplacementCheck:
    """Check of single frames against the map, to register before the next registration is due.

    A registration is due once a metre. A robot that is lifted and put down elsewhere, or carried with its wheels in the
    air, would have a wrong pose until then. So for every frame, the share of a few hundred points above the ground that
    have a map point nearby is compared with the usual share. It was below 0.7 of the usual share in fewer than 1 % of
    the frames at the right pose, in more than half of those half a metre off, and in more than 98 % anywhere else
    (measured once, on the simulated worlds 5101, 5103, 5106 and 5108; no command prints it).
    """

    usual: float | None = None  # share in [0, 1]; None before the first registration

    def learn(self, points: Points, position: Floats, T: Pose, target: LocalMap) -> None:
        """Add a frame with a verified registration ``T`` (4, 4), map <- frame; others would make a slow error usual.

        Its points (N, 3) float32 and the body's ``position`` (3,) are in that level frame, metres.
        """
        share = share_on_map(points, position, T, target)
        if share is not None:
            self.usual = share if self.usual is None else self.usual + _NEWEST_SHARE * (share - self.usual)

    def is_displaced(self, points: Points, position: Floats, T: Pose, target: LocalMap) -> bool:
        """Return whether a frame fits the map much less than usual; arguments as in :meth:`learn`."""
        if self.usual is None:
            return False
        share = share_on_map(points, position, T, target)
        return share is not None and share < _DROP * self.usual


def share_on_map(points: Points, position: Floats, T: Pose, target: LocalMap) -> float | None:
    """Share of the points above the ground with a map point nearby; None for too few points.

    Arguments are those of :meth:`DisplacementCheck.learn`.
    """
    x, y = points[:, 0] - np.float32(position[0]), points[:, 1] - np.float32(position[1])
    square = x * x + y * y
    near = points[:, 2][square < _FLOOR_RADIUS**2]
    if len(near) < _MIN_POINTS:
        return None
    floor = np.partition(near, len(near) // 20)[len(near) // 20]
    between = (square > _MIN_RANGE**2) & (square < _MAX_RANGE**2)
    wanted = np.flatnonzero(between & (points[:, 2] > floor + _HEIGHT))
    if len(wanted) < _MIN_POINTS:
        return None
    sample = wanted[np.linspace(0, len(wanted) - 1, min(_POINTS, len(wanted))).astype(np.int64)]
    distance, _ = kernels.nearest(target.grid, transform(T, points[sample]), _REACH)
    return float((distance < _REACH).mean())
