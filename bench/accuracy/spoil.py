"""Conditions: what is imperfect on real robots, made of a run that is good.

A condition is a name with its figures, ``pitch:2``; several joined by ``+`` follow one another. What stands
behind ``#`` only names another draw of what is random, ``drift#2``.

=============== =====================================================================================
base            the run as it is
pitch:DEG       clouds pitched, nose down, by DEG degrees; odometry is not told (roll:DEG likewise)
odo:PCT:YAW     odometry made anew of the truth: PCT % too long, a yaw walk of YAW degrees per sqrt(m)
drift           odo:5:0.5 with either sign of the scale
beams16         16 of 64 rings of elevation
near30          only points within 30 m
sparse3         every third frame
start:K:N       frames K to K + N - 1
back            the frames in reverse order
rev180          the body turned around its z axis by 180 degrees, in clouds, odometry and truth
still:K         frame K ten times, 0.2 s apart, with 2 mm of noise in the odometry
one:K           frame K alone, as a cloud file
=============== =====================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from coview_stream.errors import InputError
from coview_stream.geometry.arrays import Floats, Indices
from coview_stream.geometry.transforms import Points, Poses, inverse, pose_from

_DRIFT = (5.0, 0.5)  # per cent, degrees per sqrt(m)
_RINGS, _KEPT = 64, 16  # of elevation
_NEAR = 30.0  # metres
_COPIES, _PERIOD, _JITTER = 10, 0.2, 0.002  # of a frame; seconds; metres


@dataclass(frozen=True)
class Variant:
    """A run under a condition, in terms of the frames that it was made of.

    Attributes:
        frames: (N,) which frame of the original each is.
        stamps: (N,) seconds, increasing.
        odometry: (N, 4, 4) odometry <- body, metres.
        truth: (N, 4, 4) map <- body, the body being the one that odometry is about.
        changes: done to each cloud (K, 3) in the body frame, in this order.
        alone: whether the frame is given as a cloud file, without stamp and odometry.
    """

    frames: Indices
    stamps: Floats
    odometry: Poses
    truth: Poses
    changes: tuple[Callable[[Points], Points], ...] = ()
    alone: bool = False

    def cloud(self, points: Points) -> Points:
        """Return what becomes of a frame's cloud (K, 3), metres."""
        for change in self.changes:
            points = change(points)
        return np.ascontiguousarray(points, dtype=np.float32)

    def changed(self, change: Callable[[Points], Points]) -> Variant:
        """Return it with one more change of the clouds."""
        return replace(self, changes=(*self.changes, change))

    def chosen(self, of: Indices) -> Variant:
        """Return it with some of its frames, in that order."""
        odometry, truth = self.odometry[of], self.truth[of]
        return replace(self, frames=self.frames[of], stamps=self.stamps[of], odometry=odometry, truth=truth)


def spoilt(condition: str, run: Variant, seed: int) -> Variant:
    """Return the run under a condition; the same seed makes the same.

    Raises:
        InputError: no such condition, wrong figures, or a frame that the run does not have.
    """
    rng = np.random.default_rng(seed)
    for part in condition.split("#")[0].split("+"):
        name, *words = part.split(":")
        if name not in _CONDITIONS:
            raise InputError(f"no condition {part!r}; there are {', '.join(_CONDITIONS)}")
        wanted, make = _CONDITIONS[name]
        try:
            figures = [float(word) for word in words]
        except ValueError as error:
            raise InputError(f"condition {part!r}: {error}") from error
        if len(figures) != wanted:
            raise InputError(f"condition {part!r}: has {len(figures)} figures, {wanted} are needed")
        try:
            run = make(run, figures, rng)
        except IndexError as error:
            raise InputError(f"condition {part!r}: the run has {len(run.frames)} frames") from error
    if not len(run.frames):
        raise InputError(f"condition {condition!r}: leaves no frame")
    return run


def _base(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run


def _leant(axis: str, run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    R = Rotation.from_euler(axis, figures[0], degrees=True).as_matrix()
    return run.changed(lambda points: points @ R.T.astype(np.float32))


def _odometry(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    scale, walk = 1.0 + figures[0] / 100.0, figures[1]
    poses = [run.odometry[0]]
    for before, after in zip(run.truth[:-1], run.truth[1:], strict=True):
        step = inverse(before) @ after
        metres = float(np.linalg.norm(step[:3, 3]))
        turn = Rotation.from_euler("z", rng.normal(0.0, walk * np.sqrt(metres)), degrees=True).as_matrix()
        poses.append(poses[-1] @ pose_from(step[:3, :3] @ turn, step[:3, 3] * scale))
    return replace(run, odometry=np.array(poses))


def _drift(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return _odometry(run, (float(rng.choice([-1.0, 1.0])) * _DRIFT[0], _DRIFT[1]), rng)


def rings(points: Points, kept: int = _KEPT) -> Points:
    """Keep some of 64 rings of elevation, evenly spread over where the points (K, 3) are."""
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    low, high = np.percentile(elevation, [0.5, 99.5])  # single points above and below are no ring
    ring = np.clip((elevation - low) / max(high - low, 1e-9) * _RINGS, 0, _RINGS - 1).astype(int)
    return points[np.isin(ring, np.round(np.linspace(0, _RINGS - 1, kept)).astype(int))]


def _beams(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.changed(rings)


def _near(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.changed(lambda points: points[np.linalg.norm(points, axis=1) < _NEAR])


def _sparse(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.chosen(np.arange(0, len(run.frames), 3))


def _part(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    return run.chosen(np.arange(len(run.frames))[int(figures[0]) : int(figures[0] + figures[1])])


def _back(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    stamps = run.stamps[0] + run.stamps[-1] - run.stamps
    return replace(run, stamps=stamps).chosen(np.arange(len(run.frames))[::-1])


def _turned(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned = run.changed(lambda points: points * np.array([-1.0, -1.0, 1.0], dtype=np.float32))
    return replace(turned, odometry=run.odometry @ turn, truth=run.truth @ turn)


def _still(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    run.frames[int(figures[0])]  # raises IndexError
    copies = run.chosen(np.full(_COPIES, int(figures[0])))
    odometry = copies.odometry.copy()
    odometry[:, :3, 3] += rng.normal(0.0, _JITTER, (_COPIES, 3))
    return replace(copies, stamps=np.arange(_COPIES) * np.float64(_PERIOD), odometry=odometry)


def _one(run: Variant, figures: Sequence[float], rng: np.random.Generator) -> Variant:
    run.frames[int(figures[0])]
    return replace(run.chosen(np.array([int(figures[0])])), stamps=np.zeros(1), alone=True)


_CONDITIONS: dict[str, tuple[int, Callable[[Variant, Sequence[float], np.random.Generator], Variant]]] = {
    "base": (0, _base),
    "pitch": (1, partial(_leant, "y")),
    "roll": (1, partial(_leant, "x")),
    "odo": (2, _odometry),
    "drift": (0, _drift),
    "beams16": (0, _beams),
    "near30": (0, _near),
    "sparse3": (0, _sparse),
    "start": (2, _part),
    "back": (0, _back),
    "rev180": (0, _turned),
    "still": (1, _still),
    "one": (1, _one),
}
