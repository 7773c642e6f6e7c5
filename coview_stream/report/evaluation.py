"""Errors of a trajectory against the truth (eqs 15-17), and whether a run succeeded.

Both trajectories are poses ``T_map_body``. A frame without a pose is *not localized*; it is never an error.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Bools, Floats, Indices
from coview_stream.geometry.transforms import Pose

MAX_ROTATION = float(np.radians(5.0))
"""A pose is right below this rotation error (eq. 15), radians, ..."""

MAX_TRANSLATION = 3.0
"""... and below this translation error (eq. 16), metres (the success criterion of eq. 17)."""

MAX_STAMP_GAP = 0.051
"""Poses farther than this from every true stamp (seconds) are not compared; half a frame at 10 Hz."""

MIN_RIGHT_SHARE = 0.95
"""A run succeeds if its first pose is right and more than this share of all poses are right."""

Trajectory = tuple[Floats, Floats]
"""Stamps (N,) in seconds, increasing, and poses (N, 4, 4) in metres, as ``read_tum`` returns them."""


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Errors of every estimated pose that has a true pose."""

    index: Indices
    """(K,) index of the true pose."""
    distance: Floats
    """(K,) metres driven along the truth up to this pose."""
    e_r: Floats
    """(K,) rotation errors, radians (eq. 15)."""
    e_t: Floats
    """(K,) translation errors, metres (eq. 16)."""

    @property
    def right(self) -> Bools:
        """Mask (K,) the poses that count as a success (eq. 17)."""
        return (self.e_r < MAX_ROTATION) & (self.e_t < MAX_TRANSLATION)


@dataclass(frozen=True)
class ErrorStats:
    """Statistics of an error, metres or degrees."""

    mean: float
    rmse: float
    median: float
    max: float


@dataclass(frozen=True)
class Evaluation:
    """Comparison of one run with the truth.

    Attributes:
        frames: number of true poses.
        posed: number of estimated poses with a true pose within ``MAX_STAMP_GAP``.
        unmatched: number of estimated poses without a true pose.
        share_localised: share of the frames with a right pose, 0 to 1.
        false_frames: number of wrong poses, which has to be zero.
        first_fix_m: metres driven before the first pose; None if there is none.
        success: the first pose is right, and more than 95 % of all poses are.
        translation: errors of the right poses, metres; None if there are none.
        rotation: errors of the right poses, degrees; None if there are none.
        worst_t_m: largest translation error of all poses including false ones, metres.
        worst_r_deg: largest rotation error of all poses including false ones, degrees.
        origin_t_m: translation error at the origin of the odometry, as in the paper; includes the yaw error times the
            lever arm from there to the robot. None without ``T_map_odom``.
    """

    frames: int
    posed: int
    unmatched: int
    share_localised: float
    false_frames: int
    first_fix_m: float | None
    success: bool
    translation: ErrorStats | None
    rotation: ErrorStats | None
    worst_t_m: float | None
    worst_r_deg: float | None
    origin_t_m: float | None = None

    def to_json(self) -> str:
        """Return one JSON object: ``format`` and the attributes; errors rounded to 0.1 mm and 0.0001 degree."""
        return json.dumps({"format": 1} | _rounded(asdict(self)), indent=1)


def frame_errors(estimate: Trajectory, truth: Trajectory) -> FrameErrors:
    """Return the errors of each estimated pose against the true pose with the nearest stamp.

    InputError if the truth holds no pose.
    """
    if not len(truth[0]):
        raise InputError("truth: holds no pose; give the trajectory that was really driven")
    index, T_est, T_true = _pairs(estimate, truth)
    e_t = np.linalg.norm(T_est[:, :3, 3] - T_true[:, :3, 3], axis=1)
    turns = T_est[:, :3, :3] @ T_true[:, :3, :3].transpose(0, 2, 1)
    e_r = np.asarray(Rotation.from_matrix(turns).magnitude()) if len(turns) else np.zeros(0)  # precise near zero
    return FrameErrors(index, driven(truth[1])[index], e_r, e_t)


def _pairs(estimate: Trajectory, truth: Trajectory) -> tuple[Indices, Floats, Floats]:
    """Return row (K,) of the nearest true pose in time, estimated poses (K, 4, 4) that have one, and true poses."""
    (stamps, poses), (true_stamps, true_poses) = estimate, truth
    after = np.clip(np.searchsorted(true_stamps, stamps), 0, len(true_stamps) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(true_stamps[before] - stamps) < np.abs(true_stamps[after] - stamps)
    index = np.where(closer, before, after)
    matched = np.abs(true_stamps[index] - stamps) < MAX_STAMP_GAP
    return index[matched], poses[matched], true_poses[index[matched]]


def constant_offset(estimate: Trajectory, truth: Trajectory) -> str | None:
    """Describe the constant shift or transform between the truth and a non-empty estimate; None if there is none."""
    _, T_est, T_true = _pairs(estimate, truth)
    apart = T_true[:, :3, 3] - T_est[:, :3, 3]
    of_body = np.einsum("nji,nj->ni", T_est[:, :3, :3], apart)
    for each, name in ((apart, "do the origins differ"), (of_body, "do the places on the body differ")):
        shift = np.median(each, axis=0)
        if (np.linalg.norm(each - shift, axis=1) < MAX_TRANSLATION / 3.0).mean() > MIN_RIGHT_SHARE:
            return f"lies {', '.join(f'{s:.2f}' for s in shift)} m from the estimate all along: {name}?"
    turn = Rotation.from_matrix(T_true[:, :3, :3] @ T_est[:, :3, :3].transpose(0, 2, 1)).mean()
    apart = T_true[:, :3, 3] - turn.apply(T_est[:, :3, 3])
    if (np.linalg.norm(apart - np.median(apart, axis=0), axis=1) < MAX_TRANSLATION).mean() > MIN_RIGHT_SHARE:
        return "all are off by one transform: is the truth in the map's frame (map <- body), or is it odometry?"
    return None


def driven(poses: Floats) -> Floats:
    """Return metres driven (N,) up to each of the poses (N, 4, 4)."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(poses)]


def evaluate(estimate: Trajectory, truth: Trajectory, T_map_odom: tuple[Pose, Pose] | None = None) -> Evaluation:
    """Compare an estimated trajectory with the truth; an empty one is "not localized", never an error.

    Args:
        estimate: stamps and poses ``T_map_body``, only where the robot was localized.
        truth: stamps and poses ``T_map_body`` of every frame.
        T_map_odom: estimated and true poses of the odometry frame, for ``origin_t_m``.

    Raises:
        InputError: the truth holds no pose.
    """
    errors = frame_errors(estimate, truth)
    origins = None if T_map_odom is None else [T[:3, 3] for T in T_map_odom]
    right, posed, frames = errors.right, len(errors.index), len(truth[0])
    return Evaluation(
        frames=frames,
        posed=posed,
        unmatched=len(estimate[0]) - posed,
        share_localised=len(np.unique(errors.index[right])) / frames,
        false_frames=int((~right).sum()),
        first_fix_m=float(errors.distance[0]) if posed else None,
        success=bool(posed and right[0] and right.mean() > MIN_RIGHT_SHARE),
        translation=_stats(errors.e_t[right]),
        rotation=_stats(np.degrees(errors.e_r[right])),
        worst_t_m=float(errors.e_t.max()) if posed else None,
        worst_r_deg=float(np.degrees(errors.e_r.max())) if posed else None,
        origin_t_m=None if origins is None else float(np.linalg.norm(origins[0] - origins[1])),
    )


def _stats(values: Floats) -> ErrorStats | None:
    if not len(values):
        return None
    rmse = float(np.sqrt(np.mean(values**2)))
    return ErrorStats(float(values.mean()), rmse, float(np.median(values)), float(values.max()))


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return round(value, 4) if isinstance(value, float) else value
