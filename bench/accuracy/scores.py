"""Scores of a tracked drive, and its exposure: pure functions of the localizer's answers and of the truth."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bench.harness.rows import NOTHING, Row, judged
from coview_stream.geometry.arrays import Bools, Floats
from coview_stream.localization.result import Fix

FALSE_METRES, FALSE_DEGREES = 1.0, 5.0  # a pose further from the truth than either is false
MAX_HELD = 0.5  # most seconds for which a false pose counts, if no frame follows sooner


@dataclass(frozen=True)
class Track:
    """Answers of the localizer, frame by frame (N)."""

    stamps: Floats  # seconds
    states: Sequence[str]  # names; ``SKIPPED`` for a frame that it refused
    poses: Floats  # (N, 4, 4) map <- body, NaN where there was none
    covariances: Floats  # (N, 6, 6) over (x, y, z, roll, pitch, yaw), NaN where there was no pose
    levels: Floats  # (N, 4) protection levels: metres, degrees, metres in the plane and in height, likewise

    @classmethod
    def of(cls, fixes: Sequence[Fix | None], stamps: Floats) -> Track:
        """Collect fixes at the ``stamps``; a refused frame has None."""
        poses, covariances, levels = (np.full((len(fixes), *shape), np.nan) for shape in ((4, 4), (6, 6), (4,)))
        for k, fix in enumerate(fixes):
            if fix is not None and fix.T_map_body is not None:
                poses[k] = fix.T_map_body
            if fix is not None and fix.covariance is not None:
                covariances[k] = fix.covariance
            if fix is not None and fix.protection is not None:
                level = fix.protection
                levels[k] = level.metres, level.degrees, level.horizontal, level.vertical
        states = ["SKIPPED" if fix is None else fix.state.reported for fix in fixes]
        return cls(stamps, states, poses, covariances, levels)

    @classmethod
    def of_poses(cls, stamps: Floats, poses: Floats) -> Track:
        """Return the track of poses (N, 4, 4), NaN where there is none, without covariances."""
        states = np.where(np.isnan(poses[:, 0, 0]), "SEARCHING", "TRACKING").tolist()
        return cls(stamps, states, poses, *(np.full((len(poses), *shape), np.nan) for shape in ((6, 6), (4,))))

    @property
    def tracking(self) -> Bools:
        """Mask (N,) the frames with a pose."""
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
        """Mask (N,) the frames with a pose that is not false."""
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
    """Return the seconds (N,) for which each frame's answer counts: to the next frame, at most :data:`MAX_HELD`."""
    if len(stamps) < 2:
        return np.zeros(len(stamps))
    gaps = np.diff(stamps)
    return np.asarray(np.minimum(np.r_[gaps, np.median(gaps)], MAX_HELD))


def recovery(right: Bools, driven: Floats, end: int) -> float | None:
    """Return the metres driven from the frame ``end`` to the first right pose; None if there is none."""
    return float(driven[end + int(right[end:].argmax())] - driven[end]) if right[end:].any() else None


def losses(states: Sequence[str]) -> int:
    """Count the frames that are LOST after one that was not."""
    return sum(state == "LOST" != before for before, state in itertools.pairwise(states))


def times(false: Bools) -> int:
    """Count the times at which frames (N,) begin to be false."""
    return int((np.diff(false.astype(int), prepend=0) == 1).sum())


def score(track: Track, truth: Floats, driven: Floats, events: Sequence[int]) -> dict[str, Any]:
    """Return all figures of one drive except coverage; metres, degrees, seconds; None without a pose.

    Takes the true poses (N, 4, 4) map <- body, metres ``driven`` (N,), and the first frame after each event.
    """
    error, known = errors(track, truth), track.tracking
    false = known & ~error.right
    return {
        "driven_m": float(driven[-1]),
        "tracked_m": float(np.diff(driven, prepend=driven[0])[known].sum()),
        "tracked_s": float(held(track.stamps)[known].sum()),
        "false_times": times(false),
        "right_percent": 100 * float(error.right.mean()),
        "first_fix_m": float(driven[known.argmax()]) if known.any() else None,
        "rmse_m": rms(error.metres[known]),
        "max_m": float(error.metres[known].max()) if known.any() else None,
        "rmse_deg": rms(error.degrees[known]),
        "max_deg": float(error.degrees[known].max()) if known.any() else None,
        "false_frames": int(false.sum()),
        "false_s": float(held(track.stamps)[false].sum()),
        "losses": losses(track.states),
        "recoveries_m": [recovery(error.right, driven, end) for end in events],
    }


def exposed(bench: str, event: str, events: int, drives: Sequence[dict[str, Any]]) -> Row:
    """Return the row that puts events beside the kilometres and hours of the drives with a pose, as :func:`score`."""
    km, hours = (sum(drive[key] for drive in drives) / unit for key, unit in (("tracked_m", 1e3), ("tracked_s", 3.6e3)))
    return judged(f"{bench}/{event}, times", f"{events} in {km:.2f} km and {hours:.2f} h of tracking", "", None, events)


def rate(events: int, exposure: float) -> str:
    """Write events per exposure with their upper Poisson bound, 95 %."""
    if not exposure:
        return NOTHING
    return f"{events / exposure:.2g} (below {float(chi2.ppf(0.95, 2 * (events + 1))) / 2 / exposure:.2g})"


def rms(values: Floats) -> float | None:
    """Return the root mean square; None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
