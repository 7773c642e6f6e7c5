"""Scores of a tracked drive: pure functions of the localizer's answers and of the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.localization.result import Fix

FALSE_METRES, FALSE_DEGREES = 1.0, 5.0  # a pose further from the truth than either is false
DOUBTFUL_METRES = 0.5
"""One further than this is counted beside them."""

MAX_HELD = 0.5  # seconds that a false pose counts at most: until the next frame, or so long


@dataclass(frozen=True)
class Track:
    """Answers of the localizer, frame by frame (N)."""

    stamps: Floats  # seconds
    states: Sequence[str]  # names; ``SKIPPED`` for a frame that it refused
    reasons: Sequence[str]  # of the newest evidence
    poses: Floats  # (N, 4, 4) map <- body, NaN where there was none
    covariances: Floats  # (N, 6, 6) over (x, y, z, roll, pitch, yaw), NaN where there was no pose
    seconds: Floats  # that each step took
    levels: Floats  # (N, 2) protection levels, metres and degrees, likewise

    @classmethod
    def of(cls, fixes: Sequence[Fix | str], stamps: Floats, seconds: Floats) -> Track:
        """Collect fixes at the ``stamps``; a refused frame has the reason in place of its fix."""
        poses, covariances = np.full((len(fixes), 4, 4), np.nan), np.full((len(fixes), 6, 6), np.nan)
        levels = np.full((len(fixes), 2), np.nan)
        states, reasons = [], []
        for k, fix in enumerate(fixes):
            if isinstance(fix, str):
                states.append("SKIPPED")
                reasons.append(fix)
                continue
            states.append(fix.state.reported)
            reasons.append(fix.evidence.reason if fix.evidence else "")
            if fix.T_map_body is not None:
                poses[k] = fix.T_map_body
            if fix.covariance is not None:
                covariances[k] = fix.covariance
            if fix.protection is not None:
                levels[k] = fix.protection.metres, fix.protection.degrees
        return cls(stamps, states, reasons, poses, covariances, seconds, levels)

    @property
    def tracking(self) -> Bools:
        """(N,) whether the frame has a pose."""
        posed = ~np.isnan(self.poses[:, 0, 0])
        return np.asarray(posed & (np.asarray(self.states) == "TRACKING"))


@dataclass(frozen=True)
class Errors:
    """Errors of all frames, NaN where there is no pose."""

    twist: Floats  # (N, 6) over (x, y, z, roll, pitch, yaw) in map axes, metres and radians
    metres: Floats  # (N,) length of the first three
    degrees: Floats  # (N,) angle of the others

    @property
    def right(self) -> Bools:
        """(N,) whether the frame has a pose that is not false."""
        return np.asarray((self.metres <= FALSE_METRES) & (self.degrees <= FALSE_DEGREES))


def errors(track: Track, truth: Floats) -> Errors:
    """Compare with the true poses (N, 4, 4), map <- body."""
    twist = np.full((len(truth), 6), np.nan)
    known = track.tracking
    if known.any():
        poses, true = track.poses[known], truth[known]
        twist[known, :3] = poses[:, :3, 3] - true[:, :3, 3]
        apart = poses[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
        twist[known, 3:] = Rotation.from_matrix(apart).as_rotvec()
    lengths = [np.linalg.norm(twist[:, k : k + 3], axis=1) for k in (0, 3)]
    return Errors(twist, lengths[0], np.degrees(lengths[1]))


def held(stamps: Floats) -> Floats:
    """(N,) seconds for which each frame's answer counts: until the next frame, at most :data:`MAX_HELD`."""
    if len(stamps) < 2:
        return np.zeros(len(stamps))
    gaps = np.diff(stamps)
    return np.asarray(np.minimum(np.r_[gaps, np.median(gaps)], MAX_HELD))


def recovery(right: Bools, stamps: Floats, driven: Floats, end: int) -> tuple[float, float] | None:
    """Seconds and metres driven from the frame ``end`` to the first right pose; None if there is none."""
    if not right[end:].any():
        return None
    k = end + int(right[end:].argmax())
    return float(stamps[k] - stamps[end]), float(driven[k] - driven[end])


def losses(states: Sequence[str], reasons: Sequence[str]) -> list[str]:
    """Reason of each loss: of each frame that is LOST after one that was not."""
    pairs = zip(states[:-1], states[1:], reasons[1:], strict=True)
    return [reason for before, state, reason in pairs if state == "LOST" != before]


def score(track: Track, truth: Floats, driven: Floats, events: Sequence[tuple[str, int, int]]) -> dict[str, Any]:
    """All figures of one drive but coverage; metres, degrees, seconds, milliseconds; None where there is no pose.

    Args:
        track: answers of the localizer.
        truth: (N, 4, 4) map <- body.
        driven: (N,) metres.
        events: name, first frame, and first frame after it.
    """
    error, known = errors(track, truth), track.tracking
    right, hold = error.right, held(track.stamps)
    false = known & ~right
    before = np.r_[False, known[:-1]]  # stepping from a pose searches no map
    reasons = losses(track.states, track.reasons)
    happened = []
    for name, begin, end in events:
        back = recovery(right, track.stamps, driven, end)
        until = len(right) if back is None else end + int(right[end:].argmax()) + 1
        during = float(hold[begin:until][false[begin:until]].sum())
        seconds, metres = back or (None, None)
        happened.append({"what": name, "recovery_s": seconds, "recovery_m": metres, "false_s": during})
    steps = np.percentile(track.seconds[before] * 1e3, [50, 99]).tolist() if before.any() else (None, None)
    return {
        "driven_m": float(driven[-1]),
        "right_percent": 100 * float(right.mean()),
        "first_fix_m": float(driven[known.argmax()]) if known.any() else None,
        "rmse_m": rms(error.metres[known]),
        "max_m": _max(error.metres[known]),
        "rmse_deg": rms(error.degrees[known]),
        "max_deg": _max(error.degrees[known]),
        "false_frames": int(false.sum()),
        "false_s": float(hold[false].sum()),
        "doubtful_frames": int((error.metres[known] > DOUBTFUL_METRES).sum()),
        "losses": len(reasons),
        "reasons": reasons,
        "events": happened,
        "p50_ms": steps[0],
        "p99_ms": steps[1],
    }


def rms(values: Floats) -> float | None:
    """Return the root mean square; None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _max(values: Floats) -> float | None:
    return float(values.max()) if len(values) else None
