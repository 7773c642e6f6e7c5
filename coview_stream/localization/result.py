"""Fixes: the localizer's answers to frames, with state, pose, covariance and evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from coview_stream.config.mount import Mount
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import NO_OTHER, ProtectionLevel, one_in, protection_level
from coview_stream.geometry.transforms import (
    Pose,
    pose_fields,
    pose_in_words,
    position_of,
    quaternion_of,
    stddev_of,
    yaw_of,
)
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.registration.register import propagate, swap_rotation_translation
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import FAULTS, RejectionReason
from coview_stream.localization.tracking.motion import Drift

_SHARES = tuple(f.name for f in fields(Evidence))


@dataclass(frozen=True)
class KeyframeEvidence:
    """The evidence of one keyframe, and the decision on it.

    Attributes:
        stamp: seconds.
        state: after the decision.
        reason: one clause for people.
        score: :attr:`Evidence.score` of the most probable or the tracked place; 0 without one.
        rival: score of the most probable other place by the likelihood field; 0 without one, and while tracking.
        evidence: parts of the score, if a hypothesis could be registered.
        station: of the most probable place of a search; None if no vote named it, and while tracking.
        shift: sectors by which it is turned (eq. 9); None likewise, and if learned features named the place.
        cause: of the decision, while tracking; None from a search.
        innovation: squared Mahalanobis distance, 6 degrees of freedom, between the registration and odometry's
            prediction; None without a registration, and from a search.
        confidence: posterior probability that the robot is at the most probable or tracked place.
        by_chance: expected number of places of the map that would fit as well by chance; None while tracking.
    """

    stamp: float
    state: State
    reason: str
    score: float = 0.0
    rival: float = 0.0
    evidence: Evidence | None = None
    station: int | None = None
    shift: int | None = None
    cause: RejectionReason | None = None
    innovation: float | None = None
    confidence: float | None = None
    by_chance: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain data for ``result.json`` and the status: always the same keys, None for an unknown value."""
        shares = {} if self.evidence is None else vars(self.evidence)
        parts = {n: round(shares[n], 4) if n in shares else None for n in _SHARES}
        return {
            "stamp": self.stamp,
            "state": self.state.reported,
            "reason": self.reason,
            "score": round(self.score, 4),
            "rival": round(self.rival, 4),
            **parts,
            "station": self.station,
            "shift": self.shift,
            "cause": None if self.cause is None else self.cause.value,
            "innovation": _number(self.innovation, ".2f"),
            "confidence": _number(self.confidence, ".17g"),
            "by_chance": _number(self.by_chance, ".3g"),
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> KeyframeEvidence:
        """Read data of :meth:`to_json`, also of earlier versions with fewer keys; KeyError or ValueError."""
        has_shares = data.get(_SHARES[0]) is not None
        parts = Evidence(**{n: float(data[n]) for n in _SHARES}) if has_shares else None
        return cls(
            float(data["stamp"]),
            State(data["state"]),
            reason=str(data["reason"]),
            score=float(data["score"]),
            rival=float(data["rival"]),
            evidence=parts,
            station=data["station"],
            shift=data["shift"],
            cause=None if data.get("cause") is None else RejectionReason(data["cause"]),
            innovation=data.get("innovation"),
            confidence=data.get("confidence"),
            by_chance=data.get("by_chance"),
        )


def calibration_says(
    calibration: Calibration, evidence: KeyframeEvidence | None, mount: Mount | None = None, one_scan: bool = False
) -> list[str]:
    """Return the clauses of a calibration; none while clouds or odometry have a fault, which may have spoilt it."""
    return [] if evidence is not None and evidence.cause in FAULTS else calibration.describe(mount, one_scan)


def calibration_json(
    calibration: Calibration | None,
    evidence: KeyframeEvidence | None,
    mount: Mount | None = None,
    one_scan: bool = False,
) -> dict[str, Any] | None:
    """Plain data of a calibration, None for None; ``says`` has its clauses, given the newest ``evidence``."""
    if calibration is None:
        return None
    return calibration.to_json() | {"says": calibration_says(calibration, evidence, mount, one_scan)}


def _number(value: float | None, form: str) -> float | None:
    """Round a number by its format; None for None and for numbers that JSON cannot hold."""
    return None if value is None or not math.isfinite(value) else float(f"{value:{form}}")


@dataclass(frozen=True, eq=False)
class Fix:
    """The localizer's answer to one frame. Equality is identity.

    Attributes:
        stamp: of the frame, seconds.
        state: see :class:`~coview_stream.localization.state.State`.
        T_map_body: (4, 4) float64 in the frame of the map's sources; None unless TRACKING.
        T_map_odom: (4, 4) float64, leads from the frame's raw odometry pose to ``T_map_body``; None unless TRACKING.
        covariance: (6, 6) over (x, y, z, roll, pitch, yaw), m2 and rad2; None unless TRACKING. The angles are small
            rotations about the map's axes x, y and z (up), not the body's own roll and pitch. It is relative to the
            map, without the error of its georeferencing, and calibrated on simulated drives: see docs/tracking.md. One
            sigma of x, y and z, metres, is ``fix.stddev[:3]``.
        confidence: probability in [0, 1] that the robot is at this place, the lesser of those by the search that found
            it and by the newest registration: see docs/integrity.md. 0 unless TRACKING.
        evidence: of the newest keyframe, None before the first.
        drift: rates of odometry's drift, to propagate this pose; None unless TRACKING.
        protection: metres and degrees that the pose's error, relative to the map, exceeds at most once in a thousand
            poses: see docs/tracking.md; None unless TRACKING.
        calibration: corrections of clouds and odometry, in any state; measured from the second keyframe on.
    """

    stamp: float
    state: State
    T_map_body: Pose | None = None
    T_map_odom: Pose | None = None
    covariance: Floats | None = None
    confidence: float = 0.0
    evidence: KeyframeEvidence | None = None
    drift: Drift | None = None
    protection: ProtectionLevel | None = None
    calibration: Calibration | None = None

    def carried(self, stamp: float, T_odom_body: Pose, driven: float, turned: float) -> Fix:
        """Return this fix propagated to a later frame by odometry, with the covariance of its drift added.

        ``stamp`` in seconds and raw ``T_odom_body`` (4, 4) are the later frame's; from this fix's frame to it the robot
        has ``driven`` metres and ``turned`` radians.

        Raises:
            ValueError: this fix lacks its pose, ``T_map_odom``, covariance or drift.
        """
        if self.T_map_odom is None or self.T_map_body is None or self.covariance is None or self.drift is None:
            raise ValueError("a fix without a pose corrects nothing")
        T_map_body = self.T_map_odom @ T_odom_body
        shift = T_map_body[:3, 3] - self.T_map_body[:3, 3]
        carried = swap_rotation_translation(propagate(swap_rotation_translation(self.covariance), shift))
        covariance = carried + self.drift.reported(max(0.0, driven), max(0.0, turned))
        doubt, others = (1.0, NO_OTHER) if self.protection is None else (self.protection.doubt, self.protection.others)
        level = protection_level(covariance, doubt, others=others)
        return replace(self, stamp=stamp, T_map_body=T_map_body, covariance=covariance, protection=level)

    @property
    def position(self) -> Floats | None:
        """(3,) x, y, z of the body in the frame of the map's sources, metres; None unless TRACKING."""
        return None if self.T_map_body is None else position_of(self.T_map_body)

    @property
    def yaw(self) -> float | None:
        """Heading of the body's x axis, radians in (-pi, pi], counter-clockwise from the map's x; None likewise."""
        return None if self.T_map_body is None else yaw_of(self.T_map_body)

    @property
    def quaternion(self) -> Floats | None:
        """(4,) x, y, z, w of the rotation map <- body; None unless TRACKING."""
        return None if self.T_map_body is None else quaternion_of(self.T_map_body)

    @property
    def stddev(self) -> Floats | None:
        """(6,) standard deviations of x, y, z, roll, pitch, yaw, metres and radians; None unless TRACKING."""
        return None if self.covariance is None else stddev_of(self.covariance)

    def to_json(self) -> dict[str, Any]:
        """Plain data with the names of pose messages: always the same keys, None for an unknown value.

        ``state`` is one of the four reported states; ``orientation`` is x, y, z, w; matrices are row-major.
        """
        pose: dict[str, Any] = dict.fromkeys(("position", "orientation", "covariance"))
        if self.T_map_body is not None:
            pose = pose_fields(self.T_map_body, self.covariance)
        return {
            "stamp": float(self.stamp),
            "state": self.state.reported,
            **pose,
            "confidence": float(self.confidence),
            "protection_level": None if self.protection is None else self.protection.to_json(),
            "T_map_odom": None if self.T_map_odom is None else self.T_map_odom.tolist(),
            "evidence": None if self.evidence is None else self.evidence.to_json(),
            "calibration": calibration_json(self.calibration, self.evidence),
        }

    def __repr__(self) -> str:
        """Return stamp, state and pose, or why there is none, in one line."""
        head = f"Fix({self.stamp:.3f} s, {self.state}"
        if self.T_map_body is not None:
            return f"{head}: {pose_in_words(self.T_map_body, self.covariance)}, wrong: {one_in(1.0 - self.confidence)})"
        return f"{head})" if self.evidence is None else f"{head}: {self.evidence.reason})"
