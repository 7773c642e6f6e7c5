"""Checks of clouds against odometry: axes, leans, units, and the motion by both.

The ground comes from :mod:`coview_stream.odometry.gravity`. If odometry contradicts the lidar, both are read in each of
the usual wrong conventions (:mod:`coview_stream.localization.witness.conventions`, as in the localizer). Readings are
compared by the probability that odometry follows the lidar's motions; a finding states it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.clouds.reference_system import FOOT
from coview_stream.config.mount import Mount
from coview_stream.doctor.finding import Finding, Verdict
from coview_stream.errors import install_command
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import one_in
from coview_stream.geometry.transforms import Points, Pose, pose_from, rot_z, transform, yaw_of
from coview_stream.localization.witness.conventions import (
    AS_SENT_WORDS,
    AXES,
    BOTH_CAMERA,
    FEET,
    HEADING,
    MILLIMETRES,
    MIRRORED,
    ODOMETRY,
    SCALE,
    STILL,
    SURE,
    SWAPPED,
    UP,
    Fit,
    Pair,
    Reading,
    fit,
    turned_clouds,
    turning,
    unit_of,
)  # fmt: skip
from coview_stream.odometry.gravity import ground_plane

# limits between healthy and spoilt runs; set by hand on riverside_a, kitti04, handheld_livox and three simulated runs
_LEAN = math.radians(6.0)
_TOO_FAR = math.radians(11.0)  # the localizer itself corrects leans of about ten degrees
_SWAY = math.radians(9.0)
_MOVING = 1.0  # metres

_MIN_PAIRS = 3  # of clouds, to say that the lidar moves although odometry does not
_FAR = 5.0  # metres from the middle of the path: the middle of a cloud is only approximate
_ABOVE = 1.0  # metres of a lidar above the ground, approximately
IN_ODOMETRY = Reading(
    "clouds are in odometry's frame: they were moved there already, as FAST-LIO's /cloud_registered are",
    "send them in the body's frame, as they are seen (/cloud_registered_body)",
)
_CENTIMETRE = 0.01  # metres
CLOUDS_IN_CENTIMETRES = Reading("clouds are in centimetres", "send metres")
ODOMETRY_IN_CENTIMETRES = Reading(
    "odometry is in centimetres", "send metres", change=lambda T: pose_from(T[:3, :3], _CENTIMETRE * T[:3, 3])
)
IN_MAP = Reading("clouds are in a map's frame, and do not move with the robot", IN_ODOMETRY.remedy)
_GROUND_FRAMES = 16  # frames in which the ground is looked for
_DRIVE = "drive ten metres past walls, poles or trunks, with a bend, and ask again"


@dataclass(frozen=True)
class SeenFrame:
    """A robot's frame with its odometry."""

    stamp: float  # seconds
    points: Points  # (N, 3) body frame, metres
    T_odom_body: Pose  # (4, 4) odometry at its stamp


@dataclass(frozen=True)
class _Ground:
    """Ground below the lidar, over several frames."""

    axis: int  # index into AXES of the cloud's axis that points up; 0 is z
    up: Floats  # (3,) median normal in the cloud's axes
    up_level: Floats  # (3,) median normal in level axes, x along the body's heading: (0, 0, 1) without a lean
    # median angle of the frames' normals from their median, radians: in level or in odometry's axes, the smaller one
    sway: float
    height: float  # of the sensor above the ground, metres, median
    lean: float  # angle between the ground's normal and odometry's vertical, radians


def frame_findings(
    frames: Sequence[SeenFrame], robot: str | None = None, given: Mount | None = None
) -> Iterator[Finding]:
    """Judge frames in order, a metre or two apart, with their odometry; ``given``: mount already applied to them."""
    if not frames:
        return
    if len(frames) == 1:
        yield Finding("warn", "motion", "one frame shows no motion: axes and units were not checked", _DRIVE, robot)
        return
    unit = float(np.median([unit_of(frame.points) for frame in frames]))
    if unit != 1.0:
        frames = [replace(frame, points=frame.points * np.float32(unit)) for frame in frames]
    ground = _ground(frames)
    pairs, missing = _pairs(frames, ground)
    if missing:
        if ground is not None:
            yield _ground_finding(ground, robot, given)
        remedy = f"{install_command('node')} here, or ask the doctor where that is installed"
        yield Finding("warn", "motion", f"not compared with odometry: {missing}", remedy, robot)
        return
    still = _still(frames, pairs, robot)
    if still is not None:
        yield still
        if still.verdict != "FAIL" and ground is not None:
            yield _ground_finding(ground, robot, given)
        return
    seen = None if ground is None else fit(pairs)
    explanations = _explanations(frames, ground, pairs, seen, robot, unit, given)
    if explanations:
        yield from explanations
        return
    if ground is None:
        remedy = "is z up, are points in metres, and are those on the ground sent too? `coview-stream help reasons`"
        yield Finding("warn", "ground", "none is seen below the sensor", remedy, robot)
        return
    yield _ground_finding(ground, robot, given)
    yield _motion_finding(seen, fit(pairs, MIRRORED), robot)


def _ground(frames: Sequence[SeenFrame]) -> _Ground | None:
    """Return the ground; None if no axis of the clouds shows one in half of the frames."""
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, _GROUND_FRAMES).astype(int))]
    by_axis = []
    for axis in AXES:
        R = turning(axis, UP)
        tried = [(ground_plane(frame.points @ R.T), frame) for frame in chosen]
        by_axis.append([(plane, R.T @ plane.up, frame) for plane, frame in tried if not isinstance(plane, str)])
    shares = [sum(plane.share for plane, _, _ in normals) for normals in by_axis]
    best = int(np.argmax(shares))
    if 2 * len(by_axis[best]) < len(chosen):
        return None
    planes = by_axis[best]
    ups = np.array([up for _, up, _ in planes])
    odom = np.array([frame.T_odom_body[:3, :3] @ up for _, up, frame in planes])
    level = np.array([rot_z(-yaw_of(frame.T_odom_body)) @ up for up, (_, _, frame) in zip(odom, planes, strict=True)])
    (up_level, sway), (_, sway_odom) = _middle(level), _middle(odom)
    height = float(np.median([plane.height for plane, _, _ in planes]))
    lean = math.acos(float(np.clip(up_level[2], -1.0, 1.0)))
    return _Ground(best, _middle(ups)[0], up_level, min(sway, sway_odom), height, lean)


def _middle(directions: Floats) -> tuple[Floats, float]:
    """Return the median direction (3,) of unit vectors (N, 3), and the median angle from it, radians."""
    middle = np.median(directions, axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-9)
    return middle, float(np.median(np.arccos(np.clip(directions @ middle, -1.0, 1.0))))


def _pairs(frames: Sequence[SeenFrame], ground: _Ground | None) -> tuple[list[Pair], str]:
    """Return the lidar's motions, mostly over a metre or more, with odometry's, and any missing library."""
    if ground is None:
        return [], ""
    try:
        from coview_stream.localization.witness.first_motions import CloudPairs
    except ImportError as error:
        return [], f"{error.name} is not installed"
    motions = CloudPairs(ground.up)
    found = (motions.add(frame.points, frame.T_odom_body) for frame in frames)
    return [pair for pair in found if pair is not None], ""


def _explanations(
    frames: Sequence[SeenFrame],
    ground: _Ground | None,
    pairs: Sequence[Pair],
    seen: Fit | None,
    robot: str | None,
    unit: float,
    given: Mount | None,
) -> list[Finding]:
    """Return the mistakes that explain why the lidar contradicts odometry: more than one if they do so equally well.

    ``unit`` is the clouds' unit in metres, which they have been multiplied by. The tried readings, "as sent" and
    "unrelated motions" are equally probable beforehand.
    """
    candidates: list[tuple[float, Finding]] = []
    sent = seen is not None and ground is not None and not ground.axis and unit == 1.0
    as_sent = seen.odds if sent and seen is not None else -math.inf
    enough = max(0.0, as_sent) + SURE

    def explained() -> bool:
        return any(odds > enough for odds, _ in candidates)

    def consider(reading: Reading, finding: Finding | None = None) -> None:
        as_read = fit(pairs, reading)
        if finding is None:
            found = f"{reading.found}: read so, it follows the lidar to {as_read.misfit:.2f} m"
            finding = Finding("FAIL", "axes and units", found, reading.remedy, robot)
        candidates.append((as_read.odds, finding))

    if ground is not None and seen is not None:
        R = rot_z(-seen.yaw) @ turning(ground.up, UP)
        if seen.spread < HEADING and abs(seen.scale - 1.0) < SCALE and (ground.axis or abs(seen.yaw) > HEADING):
            axes = turned_clouds(ground.axis, seen.yaw)
            consider(axes, _mount_finding(ground.axis, axes, R, robot, given))
        if unit != 1.0:
            consider(MILLIMETRES)
        for reading in (
            ()
            if explained() and unit != 1.0
            else (BOTH_CAMERA,)
            if ground.axis
            else (MIRRORED, SWAPPED, *ODOMETRY, ODOMETRY_IN_CENTIMETRES)
        ):
            consider(reading)
    if not explained() and as_sent <= SURE:
        as_they_came = [replace(frame, points=frame.points / np.float32(unit)) for frame in frames]
        for reading, frames_of_body in _of_fixed_frames(as_they_came):
            ground = _ground(frames_of_body)
            if not explained() and ground is not None and not ground.axis:
                pairs = _pairs(frames_of_body, ground)[0]
                consider(reading)
    if not explained() and as_sent <= SURE:
        for reading, size in ((FEET, FOOT), (CLOUDS_IN_CENTIMETRES, _CENTIMETRE)):
            scaled = [replace(frame, points=frame.points * np.float32(size / unit)) for frame in frames]
            ground = _ground(scaled)
            if ground is not None and not ground.axis:
                pairs = _pairs(scaled, ground)[0]
                consider(reading)
    if not explained():
        return []
    candidates.sort(key=lambda candidate: -candidate[0])
    odds = np.array([*(odds for odds, _ in candidates), 0.0, as_sent])
    shares = np.exp(odds - odds.max())
    shares /= shares.sum()
    told = [finding for each, finding in candidates if each > enough and odds[0] - each < SURE]
    if len(told) == 1:
        return [replace(told[0], found=f"{told[0].found} (wrong {one_in(1.0 - shares[0])})")]
    shown = [f"{each.found} ({share:.0%} probable)" for each, share in zip(told, shares, strict=False)]
    first, *others = [replace(each, found=found) for each, found in zip(told, shown, strict=True)]
    first = replace(first, remedy=f"{first.remedy}; bends or uneven ground may tell which")
    return [first, *(replace(each, verdict="warn", found=f"or else {each.found}") for each in others)]


_GUESSED = (
    "its heading is good to some degrees and its place on the body is not seen: X,Y,Z by the drawing or /tf_static"
)


def _of_fixed_frames(frames: Sequence[SeenFrame]) -> Iterator[tuple[Reading, list[SeenFrame]]]:
    """Yield readings with the clouds in a fixed frame, odometry's or a map's, and the clouds moved to the body.

    The middle of the points moves with the robot, which shows roughly where a map's frame has its origin and x axis.
    """
    poses = np.array([frame.T_odom_body for frame in frames])
    middles = np.array([np.median(frame.points, axis=0) for frame in frames], dtype=np.float64)
    at, seen = poses[:, :2, 3] @ [1.0, 1.0j], middles[:, :2] @ [1.0, 1.0j]
    turned = np.vdot(at - at.mean(), seen - seen.mean())
    moved = float(np.vdot(at - at.mean(), at - at.mean()).real)
    # in such a frame the middle moves about as far as the robot; that of one repeated scan does not move
    if float(np.abs(at - at.mean()).max()) < _FAR or abs(turned) < 0.5 * moved:
        return
    low = float(np.median([np.quantile(frame.points[:, 2], 0.1) for frame in frames]))
    T = pose_from(rot_z(float(np.angle(turned))), np.zeros(3))
    shift = seen.mean() - at.mean() * turned / abs(turned)
    T[:3, 3] = shift.real, shift.imag, low + _ABOVE - float(np.median(poses[:, 2, 3]))
    for reading, T_frame_odom in ((IN_ODOMETRY, np.eye(4)), (IN_MAP, T)):
        levelled = np.linalg.inv(T_frame_odom @ poses)
        yield reading, [replace(f, points=transform(M, f.points)) for f, M in zip(frames, levelled, strict=True)]


def _mount_finding(axis: int, axes: Reading, R: Floats, robot: str | None, given: Mount | None) -> Finding:
    yaw = Mount().turned(R).yaw
    turned = f"turned by {math.degrees(yaw):.0f} degrees"
    if not axis:
        found = f"the lidar is {turned} against the motion of the body"
    elif axis == 1:
        found = "the lidar is upside down" + f", {turned} about the vertical" * (abs(yaw) > HEADING)
    else:
        found = f"the lidar's {axes.found.partition(': ')[2]}"
    mount = _turned_in_place(replace(given or Mount(), drawn=False), R)
    if given is not None and given != Mount():
        found = f"by --mount={given.option} {found}"
    return Finding("FAIL", "mount", found, f"set --mount={mount.option}; {_GUESSED}", robot)


def _turned_in_place(given: Mount, R: Floats) -> Mount:
    """Return the mount with clouds also turned by ``R`` (3, 3); its position is the given one, as in a drawing."""
    return replace(given.turned(R), x=given.x, y=given.y, z=given.z)


def _still(frames: Sequence[SeenFrame], pairs: Sequence[Pair], robot: str | None) -> Finding | None:
    """Judge odometry that does not move; None if it does."""
    at = np.array([frame.T_odom_body[:3, 3] for frame in frames])
    moved = float(np.linalg.norm(at - at[0], axis=1).max())
    if moved > STILL:
        return None
    driven = float(np.median([np.linalg.norm(pair.motion[:2, 3]) for pair in pairs])) if pairs else 0.0
    if len(pairs) >= _MIN_PAIRS and driven > _MOVING:
        found = f"odometry stands still, but the lidar moves: {driven:.1f} m between frames, odometry {moved:.2f} m"
        return Finding("FAIL", "motion", found, "is odometry the identity, or not running? send it live", robot)
    found = f"the robot stands still ({moved:.2f} m): nothing can be said of its motion"
    return Finding("warn", "motion", found, _DRIVE, robot)


def _ground_finding(ground: _Ground, robot: str | None, given: Mount | None) -> Finding:
    if ground.axis:
        found = "the ground is not where z points down"
        return Finding("FAIL", "ground", found, f"are clouds and odometry sent with {AS_SENT_WORDS}?", robot)
    if ground.sway > _SWAY:
        found = f"the ground sways by {math.degrees(ground.sway):.0f} degrees under odometry"
        return Finding("FAIL", "ground", found, "odometry's roll and pitch do not belong to these clouds", robot)
    height = f"the sensor is {ground.height:.1f} m above it"
    if ground.lean < _LEAN:
        return Finding("ok", "ground", f"level to {math.degrees(ground.lean):.1f} degrees, {height}", robot=robot)
    R = turning(ground.up_level, UP)
    mount = Mount().turned(R)
    found = (
        f"the sensor leans {math.degrees(ground.lean):.1f} degrees against odometry's level "
        f"({math.degrees(mount.pitch):.1f} in pitch, {math.degrees(mount.roll):.1f} in roll); {height}"
    )
    right = _turned_in_place(given or Mount(), R)
    remedy = f"set --mount={right.option} if it is the sensor; align odometry to gravity if it is odometry"
    verdict: Verdict = "warn" if ground.lean < _TOO_FAR else "FAIL"
    return Finding(verdict, "ground", found, remedy, robot)


def _motion_finding(seen: Fit | None, mirrored: Fit, robot: str | None) -> Finding:
    if seen is None or abs(seen.odds) < SURE:
        found = "too few frames show clearly how the robot moved to compare it with odometry"
        return Finding("warn", "motion", found, _DRIVE, robot)
    wrong = one_in(1.0 / (1.0 + math.exp(min(abs(seen.odds), 100.0))))
    steps = f"{seen.pairs} steps of some metres, wrong {wrong}"
    if seen.odds > 0.0:
        straight = mirrored.odds > seen.odds - SURE
        remedy = "a drive this straight does not tell whether y points left: ask again after a curve" * straight
        return Finding("ok", "motion", f"odometry follows the lidar's to {seen.misfit:.2f} m ({steps})", remedy, robot)
    found = (
        f"odometry differs from the lidar's by {seen.misfit:.2f} m ({steps}; heading in the body "
        f"{math.degrees(seen.yaw):.1f} degrees, distances times {seen.scale:.2f})"
    )
    if seen.spread < HEADING and abs(seen.yaw) < HEADING:
        return Finding("FAIL", "motion", found, "are both in metres? is odometry's scale right?", robot)
    remedy = "is it T_odom_body of the body the clouds are in, at their stamps? `coview-stream help reasons`"
    return Finding("FAIL", "motion", found, remedy, robot)
