"""Checks of clouds against odometry by what they show: axes, leans, units, and the motion of both.

Frames are judged as they came. Where ground and motion do not fit, they are read in each of the ways in which set-
ups are usually wrong, and what fits then is what is wrong. The limits were set by hand after one look, which no
command repeats, at riverside_a, kitti04, handheld_livox and three simulated runs (town, campus, with dirt), as they
are and with the faults of ``tests/doctor/test_frame_checks.py``. Unspoilt, the ground leaned by 0.3 to 4.2 degrees,
motions differed by 0.04 to 0.22 m and 0.2 to 2.5 degrees, distances by 0 to 5 %; spoilt, a motion differed by 1.2 m
and more, unless read as it was spoilt.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.config.mount import Mount
from coview_stream.doctor.finding import Finding, Verdict
from coview_stream.doctor.frame_geometry import (
    RIVALS,
    Attitude,
    MotionFit,
    PairMotion,
    SeenFrame,
    attitude,
    fit,
    pair_motions,
    turned_frames,
    turning,
)
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Pose, pose_from, rot_z

# set by hand as said above, each between the largest of unspoilt runs and the least of spoilt ones
_LEAN = math.radians(6.0)
_ESTIMATED = math.radians(11.0)  # the localizer corrects leans of about ten degrees by itself
_SPREAD = math.radians(9.0)
_MISFIT, _GOOD_MISFIT = 0.6, 0.45  # metres
_ALIKE = 0.15  # metres between the misfits of two explanations that are both named
_SURE_MISFIT = 0.25  # metres; no other reading need be tried
_YAW, _YAW_SPREAD = math.radians(8.0), math.radians(8.0)
_SCALE = 0.12
# set by hand
_MIN_PAIRS = 3
_STILL, _SEEN_MOVING = 0.5, 1.0  # metres
_GROUND_FRAMES = 16
_UP = np.array([0.0, 0.0, 1.0])
_R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class _Judged:
    """What frames show when they are read in one way."""

    ground: Attitude | None
    pairs: list[PairMotion]
    motion: MotionFit | None

    def follows(self, misfit: float) -> bool:
        """Tell whether the ground is below and odometry follows the lidar, whether or not the sensor leans."""
        ground, motion = self.ground, self.motion
        if ground is None or motion is None or ground.axis or _tumbles(ground):
            return False
        return motion.pairs >= _MIN_PAIRS and motion.misfit < misfit

    def fits(self, misfit: float) -> bool:
        """Tell whether the ground is level, too."""
        return self.ground is not None and _lean(self.ground) < _LEAN and self.follows(misfit)


Frames = list[SeenFrame]
Reading = tuple[str, str, Callable[[Sequence[SeenFrame]], Frames]]
"""What is found, the remedy, and how frames have to be read then."""


def _clouds_times(scale: float) -> Callable[[Sequence[SeenFrame]], Frames]:
    return lambda frames: [replace(f, points=f.points * np.float32(scale)) for f in frames]


def _odometry_as(change: Callable[[Pose], Pose]) -> Callable[[Sequence[SeenFrame]], Frames]:
    return lambda frames: [replace(f, T_odom_body=change(f.T_odom_body)) for f in frames]


def _steps_times(scale: float) -> Callable[[Sequence[SeenFrame]], Frames]:
    return _odometry_as(lambda T: pose_from(T[:3, :3], scale * T[:3, 3]))


_READINGS: tuple[Reading, ...] = (
    ("odometry is inverse: it is body <- odometry", "send T_odom_body, its inverse", _odometry_as(RIVALS["inverse"])),
    (
        "odometry's rotation is transposed",
        "rows and columns are exchanged, or the quaternion is conjugate: send T_odom_body",
        _odometry_as(RIVALS["transposed"]),
    ),
    (
        "odometry's z points down, its y to the right (north-east-down)",
        "send it with x forward, y left, z up",
        _odometry_as(RIVALS["z down"]),
    ),
    (
        "clouds and odometry have a camera's axes (z forward, y down)",
        "send both with x forward, y left, z up",
        lambda frames: turned_frames(frames, _R_body_camera, odometry_too=True),
    ),
    (
        "odometry has a camera's axes (z forward, y down)",
        "send it with x forward, y left, z up",
        lambda frames: [
            replace(f, T_odom_body=new.T_odom_body)
            for f, new in zip(frames, turned_frames(frames, _R_body_camera, odometry_too=True), strict=True)
        ],
    ),
    ("clouds are in millimetres", "send metres", _clouds_times(0.001)),
    ("clouds are in feet", "send metres", _clouds_times(0.3048)),
    ("odometry is in millimetres", "send metres", _steps_times(0.001)),
    ("odometry is in feet", "send metres", _steps_times(0.3048)),
)


def frame_findings(frames: Sequence[SeenFrame], robot: str | None = None) -> Iterator[Finding]:
    """Judge frames in order, a metre or two apart, with their odometry."""
    if len(frames) < 2:
        return
    judged = _judge(frames)
    still = _still(frames, judged, robot)
    if still is not None:
        yield still
        if still.verdict == "ok" and judged.ground is not None:
            yield _ground_finding(judged.ground, robot)
        return
    if not judged.follows(_MISFIT):
        others = [o for o in (_mount_finding(frames, judged, robot), _read_otherwise(frames, robot)) if o is not None]
        if others:
            others.sort(key=lambda other: other[0])  # what follows the lidar most closely comes first
            best = others[0][1]
            if len(others) > 1 and others[1][0] < others[0][0] + _ALIKE:  # as on a straight drive
                found = f"{best.found}; or else {others[1][1].found}"
                remedy = f"{best.remedy}; or else {others[1][1].remedy}: a drive with a curve tells which"
                best = replace(best, found=found, remedy=remedy)
            yield best
            return
    if judged.ground is None or judged.ground.frames < 2:
        remedy = "is z up, are points in metres, and are those on the ground sent too? docs/troubleshooting.md"
        yield Finding("warn", "ground", "none is seen below the sensor", remedy, robot)
        return
    yield _ground_finding(judged.ground, robot)
    yield _motion_finding(judged.motion, robot)


def _judge(frames: Sequence[SeenFrame]) -> _Judged:
    chosen = np.unique(np.linspace(0, len(frames) - 1, _GROUND_FRAMES).astype(int))
    ground = attitude([frames[i] for i in chosen])
    if ground is None or ground.axis:
        return _Judged(ground, [], None)
    pairs = pair_motions(frames, turning(ground.up, _UP), ground.height)
    return _Judged(ground, pairs, fit(pairs) if pairs else None)


def _still(frames: Sequence[SeenFrame], judged: _Judged, robot: str | None) -> Finding | None:
    """Judge odometry that does not move; None if it does."""
    at = np.array([f.T_odom_body[:3, 3] for f in frames])
    moved = float(np.linalg.norm(at - at[0], axis=1).max())
    if moved > _STILL:
        return None
    seen = float(np.median([abs(p.seen.step) for p in judged.pairs])) if judged.pairs else 0.0
    if len(judged.pairs) >= _MIN_PAIRS and seen > _SEEN_MOVING:
        found = f"odometry stands still, but the lidar moves: {seen:.1f} m between frames, odometry {moved:.2f} m"
        return Finding("FAIL", "motion", found, "is odometry the identity, or not running? send it live", robot)
    found = f"the robot stands still ({moved:.2f} m): nothing can be said of its motion"
    return Finding("ok", "motion", found, "drive ten metres and ask again", robot)


def _read_otherwise(frames: Sequence[SeenFrame], robot: str | None) -> tuple[float, Finding] | None:
    """Return what is wrong, if the frames fit when read in another way, and the misfit that is left, metres."""
    best: tuple[float, Finding] | None = None
    for found, remedy, read in _READINGS:
        judged = _judge(read(frames))
        if judged.motion is not None and judged.fits(_GOOD_MISFIT):
            text = f"{found}: read so, it follows the lidar to {judged.motion.misfit:.2f} m"
            if best is None or judged.motion.misfit < best[0]:
                best = judged.motion.misfit, Finding("FAIL", "axes and units", text, remedy, robot)
            if judged.motion.misfit < _SURE_MISFIT:
                break
    return best


def _mount_finding(frames: Sequence[SeenFrame], judged: _Judged, robot: str | None) -> tuple[float, Finding] | None:
    """Return how the clouds are turned in the body, if they fit when turned back, and the misfit left, metres."""
    ground = judged.ground
    if ground is None:
        return None
    R = turning(ground.up, _UP)
    turned = _judge(turned_frames(frames, R, odometry_too=False)) if ground.axis else judged
    motion = turned.motion
    if motion is None or motion.pairs < _MIN_PAIRS or abs(motion.scale - 1.0) > _SCALE:
        return None
    if motion.spread > _YAW_SPREAD or (abs(motion.yaw) < _YAW and not ground.axis):
        return None
    R = np.asarray(rot_z(-motion.yaw)) @ R
    again = _judge(turned_frames(frames, R, odometry_too=False))
    if again.motion is None or not again.fits(_GOOD_MISFIT):
        return None
    yaw = -math.degrees(motion.yaw)
    if ground.axis == 1:
        found = "the lidar is upside down"
    elif ground.axis:
        found = f"the lidar's {'+-'[ground.axis % 2]}{'y' if ground.axis < 4 else 'x'} axis points up, not its z"
    else:
        found = f"the lidar is turned by {yaw:.0f} degrees against the motion of the body, about the vertical"
    if abs(yaw) > 8.0 and ground.axis:
        found += f", and it is turned by {yaw:.0f} degrees about the vertical"
    return again.motion.misfit, Finding("FAIL", "mount", found, _set_mount(R), robot)


def _set_mount(R: Floats) -> str:
    return f"set --mount={Mount().turned(R).option}"


def _lean(ground: Attitude) -> float:
    return math.acos(max(-1.0, min(1.0, float(ground.up[2]))))


def _lean_odom(ground: Attitude) -> float:
    return math.acos(max(-1.0, min(1.0, float(ground.up_odom[2]))))


def _tumbles(ground: Attitude) -> bool:
    return min(ground.spread, ground.spread_odom) > _SPREAD


def _ground_finding(ground: Attitude, robot: str | None) -> Finding:
    if ground.axis:
        found = "the ground is not where z points down"
        return Finding("FAIL", "ground", found, "are x forward, y left and z up in clouds and odometry?", robot)
    if _tumbles(ground):
        found = f"the ground sways by {math.degrees(min(ground.spread, ground.spread_odom)):.0f} degrees under odometry"
        return Finding("FAIL", "ground", found, "odometry's roll and pitch do not belong to these clouds", robot)
    by_odometry = ground.spread_odom < ground.spread and _lean_odom(ground) > _lean(ground) - math.radians(2)
    lean = _lean_odom(ground) if by_odometry else _lean(ground)
    height = f"the sensor is {ground.height:.1f} m above it"
    if lean < _LEAN:
        return Finding("ok", "ground", f"level to {math.degrees(lean):.1f} degrees, {height}", robot=robot)
    mount = Mount().turned(turning(ground.up, _UP))
    pitch, roll = math.degrees(mount.pitch), math.degrees(mount.roll)
    which = f"{pitch:.1f} degrees in pitch, {roll:.1f} in roll"
    verdict: Verdict = "warn" if lean < _ESTIMATED else "FAIL"
    told = math.degrees(max(ground.spread, ground.spread_odom) - min(ground.spread, ground.spread_odom)) > 2.0
    if by_odometry and told:
        found = f"odometry leans {math.degrees(lean):.1f} degrees against the ground, whichever way the robot heads"
        remedy = "align odometry to gravity (its z up), unless the site is a slope"
    elif told:
        found = f"the sensor leans {math.degrees(lean):.1f} degrees against odometry: {which}, and turns with the body"
        remedy = f"set --mount={mount.option}"
    else:
        found = f"the sensor leans {math.degrees(lean):.1f} degrees against odometry's level: {which}"
        remedy = f"set --mount={mount.option} if it is the sensor; align odometry to gravity if it is odometry"
    return Finding(verdict, "ground", f"{found}; {height}", remedy, robot)


def _motion_finding(motion: MotionFit | None, robot: str | None) -> Finding:
    if motion is None or motion.pairs < _MIN_PAIRS:
        found = "too few frames show clearly how the robot moved to compare it with odometry"
        return Finding("ok", "motion", found, "drive ten metres past walls, poles or trunks and ask again", robot)
    found = (
        f"odometry differs from what the lidar sees by {motion.misfit:.2f} m "
        f"({motion.pairs} steps of some metres; heading in the body {math.degrees(motion.yaw):.1f} degrees, "
        f"distances times {motion.scale:.2f})"
    )
    if motion.misfit < _MISFIT:
        return Finding("ok", "motion", found, robot=robot)
    if motion.spread < _YAW_SPREAD and abs(motion.yaw) < _YAW:
        return Finding("FAIL", "motion", found, "are both in metres? is odometry's scale right?", robot)
    remedy = "is it T_odom_body of the body the clouds are in, at their stamps? docs/troubleshooting.md"
    return Finding("FAIL", "motion", found, remedy, robot)
