"""Checks of clouds against odometry: axes, leans, units, and the motion by both.

The estimators are the calibration's: the ground of :mod:`coview_stream.odometry.gravity`, and the registration of
:mod:`coview_stream.localization.calibration.frame_motion`, here from many guesses. Where odometry contradicts the
lidar, it is read in each of the usual wrong ways. Readings are compared by the probability that odometry follows the
lidar's motions; a finding names it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coview_stream.config import KeyframeConfig, RegistrationConfig
from coview_stream.config.mount import Mount
from coview_stream.doctor.finding import Finding, Verdict
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import one_in
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rot_z, wrap_angle, yaw_of
from coview_stream.odometry.gravity import ground_plane

# limits between healthy and spoilt runs; set by hand on riverside_a, kitti04, handheld_livox and three simulated runs
_LEAN = math.radians(6.0)
_TOO_FAR = math.radians(11.0)  # the localizer corrects leans of about ten degrees by itself
_SWAY = math.radians(9.0)
_YAW, _YAW_SPREAD = math.radians(8.0), math.radians(8.0)
_SCALE = 0.12
_STILL, _MOVING = 0.5, 1.0  # metres

_MIN_PAIRS = 3
_FAILS = 0.1  # probability that a registration fails, as in the calibration
_SURE = math.log(99.0)  # odds of a finding: two motions that agree may be chance (1 in 82), three are not (1 in 730)
_METRES_PER_RADIAN = 5.0
_GROUND_FRAMES = 16
_BASELINE = 2.5  # metres between two frames that are compared
_LONGEST_CHAIN = 8  # frames, where the robot hardly moves
_SCALES = (3.0, 1.5, 0.8, 0.4)  # metres: largest correspondence distances of the registration, coarse to fine

_UP = np.array([0.0, 0.0, 1.0])
_AXES = np.array([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
_AXIS_NAMES = ("+z", "-z", "+y", "-y", "+x", "-x")
_R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_FOOT = 0.3048  # metres


@dataclass(frozen=True)
class SeenFrame:
    """Frame of a robot."""

    stamp: float  # seconds
    points: Points  # (N, 3) body frame, metres
    T_odom_body: Pose  # (4, 4) odometry at its stamp


@dataclass(frozen=True)
class _Ground:
    """Ground below the lidar, over several frames."""

    axis: int  # index into S of the cloud's axis that points up; 0 is z
    up: Floats  # (3,) mean normal in the cloud's axes
    up_level: Floats  # (3,) mean normal after odometry has levelled the cloud: (0, 0, 1) without a lean
    # median angle of the frames' normals from their mean, radians, the smaller of the robot's and odometry's
    sway: float
    height: float  # of the sensor above it, metres, median
    lean: float  # angle between the ground's normal and odometry's vertical, radians


@dataclass(frozen=True)
class _Pair:
    """Motion between two frames: the lidar's (4, 4) in level axes, its sigma in metres, and odometry (4, 4) at both."""

    motion: Pose
    sigma: float
    before: Pose
    after: Pose


@dataclass(frozen=True)
class _Fit:
    """Odometry against the lidar's motion, medians over pairs."""

    odds: float  # log odds that odometry follows the lidar, over all pairs
    misfit: float  # metres, a radian counting as five
    yaw: float  # angle from odometry's motion to the lidar's, radians: the heading of the lidar on the body
    spread: float  # deviation from it
    scale: float  # the lidar's distance over odometry's
    pairs: int  # number of pairs that moved

    @property
    def surely(self) -> str:
        """How probably the verdict of :attr:`odds` is wrong, in words."""
        return f"wrong {one_in(1.0 / (1.0 + math.exp(min(abs(self.odds), 100.0))))}"


Change = Callable[[Pose], Pose]
"""Odometry's poses -> poses as they should have been sent."""

RIVALS: dict[str, Change] = {
    "inverse": inverse,
    "transposed": lambda T: pose_from(T[:3, :3].T, T[:3, 3]),
    "z down": lambda T: np.diag([1.0, -1.0, -1.0, 1.0]) @ T @ np.diag([1.0, -1.0, -1.0, 1.0]),
    "camera": lambda T: pose_from(_R_body_camera, np.zeros(3)) @ T @ pose_from(_R_body_camera.T, np.zeros(3)),
    "millimetres": lambda T: pose_from(T[:3, :3], 0.001 * T[:3, 3]),
    "feet": lambda T: pose_from(T[:3, :3], _FOOT * T[:3, 3]),
}
"""Usual mistakes in odometry, each by the change that mends it."""

_AS_SENT = "x forward, y left, z up"
_READINGS: tuple[tuple[str, str, str, bool], ...] = (
    ("odometry is inverse: it is body <- odometry", "send T_odom_body, its inverse", "inverse", False),
    ("odometry's rotation is transposed", "send T_odom_body: rows for columns, or a conjugate", "transposed", False),
    ("odometry's z points down (north-east-down)", f"send it with {_AS_SENT}", "z down", False),
    ("odometry has a camera's axes (z forward, y down)", f"send it with {_AS_SENT}", "camera", False),
    ("clouds and odometry have a camera's axes (z forward, y down)", f"send both with {_AS_SENT}", "camera", True),
    ("odometry is in millimetres", "send metres", "millimetres", False),
    ("odometry is in feet", "send metres", "feet", False),
)
"""Finding, remedy, key of :data:`RIVALS`, and whether the clouds have a camera's axes, too."""


def frame_findings(frames: Sequence[SeenFrame], robot: str | None = None) -> Iterator[Finding]:
    """Judge frames in order, a metre or two apart, with their odometry."""
    if len(frames) < 2:
        return
    ground = _ground(frames)
    pairs, missing = _pairs(frames, ground)
    if missing:
        if ground is not None:
            yield _ground_finding(ground, robot)
        remedy = "pip install 'coview-stream[node]' here, or ask the doctor where that is installed"
        yield Finding("warn", "motion", f"not compared with odometry: {missing}", remedy, robot)
        return
    still = _still(frames, pairs, robot)
    if still is not None:
        yield still
        if still.verdict == "ok" and ground is not None:
            yield _ground_finding(ground, robot)
        return
    fit = None if ground is None else _fit(pairs, _turning(ground.up, _UP))
    if ground is None or ground.axis or fit is None or fit.odds < _SURE:
        explanation = _explanation(frames, ground, pairs, fit, robot)
        if explanation is not None:
            yield explanation
            return
    if ground is None:
        remedy = "is z up, are points in metres, and are those on the ground sent too? docs/reasons.md"
        yield Finding("warn", "ground", "none is seen below the sensor", remedy, robot)
        return
    yield _ground_finding(ground, robot)
    yield _motion_finding(fit, robot)


def _ground(frames: Sequence[SeenFrame]) -> _Ground | None:
    """Return the ground; None if no axis of the clouds has one in half of the frames."""
    chosen = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, _GROUND_FRAMES).astype(int))]
    by_axis = []
    for axis in _AXES:
        R = _turning(axis, _UP)
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


def _turning(start: Floats, end: Floats) -> Floats:
    """Return the smallest rotation (3, 3) that takes one unit vector (3,) to another."""
    v, c = np.cross(start, end), float(start @ end)
    if c < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + c))


def _pairs(frames: Sequence[SeenFrame], ground: _Ground | None) -> tuple[list[_Pair], str]:
    """Return the lidar's motion between frames some metres apart, and the library that is missing for it.

    Of the motions that a registration reaches from all guesses, the one that the clouds determine best counts: in 34
    of 35 steps of riverside_a, kitti04 and handheld_livox it is the true one, with odometry's guess and without.
    """
    if ground is None:
        return [], ""
    try:
        from coview_stream.localization.calibration.frame_motion import surface_points
        from coview_stream.localization.registration.clouds import LocalMap, prepare_scan, voxelized
        from coview_stream.localization.registration.register import register
    except ImportError as error:
        return [], f"{error.name} is not installed"
    config, here = RegistrationConfig(), np.zeros(3)
    level = pose_from(_turning(ground.up, _UP), here)
    pairs: list[_Pair] = []
    first, motion, step, variance = 0, np.eye(4), np.eye(4), 0.0
    target: LocalMap | None = None
    for k, frame in enumerate(frames):
        points = voxelized(frame.points, level, KeyframeConfig())
        motions: list[tuple[float, Pose]] = []
        if target is not None:
            scan = prepare_scan(points, here, config)
            for guess in _guesses(frames[k - 1].T_odom_body, frame.T_odom_body, step):
                match = register(scan, guess, target, config, _SCALES, centre=here)
                if match is not None and match.converged:
                    covariance = config.inflation**2 * np.linalg.inv(match.information)
                    motions.append((float(np.diag(covariance)[3:5].max()), match.T_map_source))
        target = LocalMap(*surface_points(points))
        if not motions:
            first, motion, step, variance = k, np.eye(4), np.eye(4), 0.0
            continue
        best, step = min(motions, key=lambda found: found[0])
        motion, variance = motion @ step, variance + best
        if np.linalg.norm(motion[:3, 3]) > _BASELINE or k - first >= _LONGEST_CHAIN:
            pairs.append(_Pair(motion, math.sqrt(variance), frames[first].T_odom_body, frame.T_odom_body))
            first, motion, variance = k, np.eye(4), 0.0
    return pairs, ""


def _guesses(before: Pose, after: Pose, step: Pose) -> Iterator[Pose]:
    """Yield motions (4, 4) to begin a registration with: odometry's as sent and mended, the one before, and none.

    Then odometry's distance in all directions, for a lidar of any heading.
    """
    odometry = inverse(before) @ after
    yield odometry
    yield step
    yield np.eye(4)
    for change in RIVALS.values():
        yield inverse(change(before)) @ change(after)
    far = float(np.linalg.norm(odometry[:3, 3]))
    if far > _STILL:
        for heading in np.arange(0.0, 2.0 * np.pi, np.pi / 3):
            yield pose_from(odometry[:3, :3], [far * math.cos(heading), far * math.sin(heading), 0.0])


def _log_odds(gap: float, far: float, farther: float, sigma: float) -> float:
    """Return the log odds that odometry follows the lidar by one motion, ``gap`` metres from it.

    If it follows, the gap stays within the heading and scale that are no finding, over ``far`` metres; if not, it is
    an unrelated motion of up to ``farther`` metres. The lidar's motion has its ``sigma``, and fails now and then.
    """
    follows = (math.hypot(_YAW, _SCALE) * far) ** 2 + sigma**2
    unrelated = follows + farther**2
    exponent = 0.5 * gap**2 * (1.0 / unrelated - 1.0 / follows)
    ratio = unrelated / follows * math.exp(exponent)
    return math.log(((1.0 - _FAILS) * ratio + _FAILS) / (_FAILS * ratio + 1.0 - _FAILS))


def _fit(pairs: Sequence[_Pair], R_up: Floats, change: Change | None = None, R_body: Floats | None = None) -> _Fit:
    """Compare the lidar's motion, in axes levelled by ``R_up`` (3, 3), with odometry's, mended by ``change``.

    ``R_body`` (3, 3), body <- cloud, is None where the clouds have the body's axes.
    """
    R = R_up if R_body is None else R_body
    heading = yaw_of(pose_from(R @ R_up.T, np.zeros(3)))
    misfits, ratios, odds = [], [], 0.0
    for pair in pairs:
        before, after = (pair.before, pair.after) if change is None else (change(pair.before), change(pair.after))
        moved = rot_z(-yaw_of(before)) @ (after[:3, 3] - before[:3, 3])
        step = complex(moved[0], moved[1])
        driven = complex(pair.motion[0, 3], pair.motion[1, 3]) * np.exp(1j * heading)
        turn = wrap_angle(yaw_of(after) - yaw_of(before) - yaw_of(pair.motion))
        misfits.append(abs(step - driven) + _METRES_PER_RADIAN * abs(turn))
        far = max(abs(driven), _BASELINE)
        odds += _log_odds(misfits[-1], far, max(far, abs(step)), pair.sigma)
        if min(abs(step), abs(driven)) > _STILL:
            ratios.append(driven / step)
    misfit = float(np.median(misfits)) if misfits else math.inf
    if not ratios:
        return _Fit(odds, misfit, 0.0, math.pi, 1.0, 0)
    angles = np.angle(ratios)
    yaw = float(np.angle(np.median(np.cos(angles)) + 1j * np.median(np.sin(angles))))
    spread = float(np.median(np.abs(np.angle(np.exp(1j * (angles - yaw))))))
    return _Fit(odds, misfit, yaw, spread, float(np.median(np.abs(ratios))), len(ratios))


def _explanation(
    frames: Sequence[SeenFrame], ground: _Ground | None, pairs: Sequence[_Pair], fit: _Fit | None, robot: str | None
) -> Finding | None:
    """Return the mistake that explains why the lidar contradicts odometry; both where two explain it alike."""
    candidates: list[tuple[float, Finding]] = []

    def consider(fit: _Fit, finding: Finding, words: str = "") -> None:
        if fit.odds > _SURE:
            text = f"{finding.found}: read so, {words} {fit.misfit:.2f} m" if words else finding.found
            candidates.append((fit.odds, replace(finding, found=f"{text} ({fit.surely})")))

    if ground is not None and fit is not None:
        R_up = _turning(ground.up, _UP)
        R = rot_z(-fit.yaw) @ R_up
        if fit.spread < _YAW_SPREAD and abs(fit.scale - 1.0) < _SCALE and (ground.axis or abs(fit.yaw) > _YAW):
            consider(_fit(pairs, R_up, None, R), _mount_finding(ground.axis, Mount().turned(R), robot))
        for found, remedy, change, clouds_too in _READINGS:
            if (ground.axis != 0) == clouds_too:
                R_body = _turning(_R_body_camera @ ground.up, _UP) @ _R_body_camera if clouds_too else None
                mended = _fit(pairs, R_up, RIVALS[change], R_body)
                consider(mended, Finding("FAIL", "axes and units", found, remedy, robot), "it follows the lidar to")
    if not candidates:
        for unit, metres in (("feet", _FOOT), ("millimetres", 0.001)):
            scaled = [replace(frame, points=frame.points * np.float32(metres)) for frame in frames]
            ground = _ground(scaled)
            if ground is not None and not ground.axis:
                mended = _fit(_pairs(scaled, ground)[0], _turning(ground.up, _UP))
                finding = Finding("FAIL", "axes and units", f"clouds are in {unit}", "send metres", robot)
                consider(mended, finding, "odometry follows the lidar to")
    candidates.sort(key=lambda candidate: -candidate[0])
    if not candidates:
        return None
    odds, best = candidates[0]
    if len(candidates) > 1 and odds - candidates[1][0] < _SURE:  # as on a straight drive
        other = candidates[1][1]
        remedy = f"{best.remedy}; or else {other.remedy}: a drive with a curve tells which"
        return replace(best, found=f"{best.found}; or else {other.found}", remedy=remedy)
    return best


def _mount_finding(axis: int, mount: Mount, robot: str | None) -> Finding:
    turned = f"turned by {mount.yaw:.0f} degrees"
    if not axis:
        found = f"the lidar is {turned} against the motion of the body"
    else:
        found = (
            "the lidar is upside down" if axis == 1 else f"the lidar's {_AXIS_NAMES[axis]} axis points up, not its z"
        )
        found += f", {turned} about the vertical" if abs(mount.yaw) > math.degrees(_YAW) else ""
    return Finding("FAIL", "mount", found, f"set --mount={mount.option}", robot)


def _still(frames: Sequence[SeenFrame], pairs: Sequence[_Pair], robot: str | None) -> Finding | None:
    """Judge odometry that does not move; None if it does."""
    at = np.array([frame.T_odom_body[:3, 3] for frame in frames])
    moved = float(np.linalg.norm(at - at[0], axis=1).max())
    if moved > _STILL:
        return None
    driven = float(np.median([np.linalg.norm(pair.motion[:2, 3]) for pair in pairs])) if pairs else 0.0
    if len(pairs) >= _MIN_PAIRS and driven > _MOVING:
        found = f"odometry stands still, but the lidar moves: {driven:.1f} m between frames, odometry {moved:.2f} m"
        return Finding("FAIL", "motion", found, "is odometry the identity, or not running? send it live", robot)
    found = f"the robot stands still ({moved:.2f} m): nothing can be said of its motion"
    return Finding("ok", "motion", found, "drive ten metres and ask again", robot)


def _ground_finding(ground: _Ground, robot: str | None) -> Finding:
    if ground.axis:
        found = "the ground is not where z points down"
        return Finding("FAIL", "ground", found, f"are clouds and odometry sent with {_AS_SENT}?", robot)
    if ground.sway > _SWAY:
        found = f"the ground sways by {math.degrees(ground.sway):.0f} degrees under odometry"
        return Finding("FAIL", "ground", found, "odometry's roll and pitch do not belong to these clouds", robot)
    height = f"the sensor is {ground.height:.1f} m above it"
    if ground.lean < _LEAN:
        return Finding("ok", "ground", f"level to {math.degrees(ground.lean):.1f} degrees, {height}", robot=robot)
    mount = Mount().turned(_turning(ground.up_level, _UP))
    found = (
        f"the sensor leans {math.degrees(ground.lean):.1f} degrees against odometry's level "
        f"({math.degrees(mount.pitch):.1f} in pitch, {math.degrees(mount.roll):.1f} in roll); {height}"
    )
    remedy = f"set --mount={mount.option} if it is the sensor; align odometry to gravity if it is odometry"
    verdict: Verdict = "warn" if ground.lean < _TOO_FAR else "FAIL"
    return Finding(verdict, "ground", found, remedy, robot)


def _motion_finding(fit: _Fit | None, robot: str | None) -> Finding:
    if fit is None or abs(fit.odds) < _SURE:
        found = "too few frames show clearly how the robot moved to compare it with odometry"
        return Finding("ok", "motion", found, "drive ten metres past walls, poles or trunks and ask again", robot)
    steps = f"{fit.pairs} steps of some metres, {fit.surely}"
    if fit.odds > 0.0:
        return Finding("ok", "motion", f"odometry follows the lidar's to {fit.misfit:.2f} m ({steps})", robot=robot)
    found = (
        f"odometry differs from the lidar's by {fit.misfit:.2f} m ({steps}; heading in the body "
        f"{math.degrees(fit.yaw):.1f} degrees, distances times {fit.scale:.2f})"
    )
    if fit.spread < _YAW_SPREAD and abs(fit.yaw) < _YAW:
        return Finding("FAIL", "motion", found, "are both in metres? is odometry's scale right?", robot)
    remedy = "is it T_odom_body of the body the clouds are in, at their stamps? docs/reasons.md"
    return Finding("FAIL", "motion", found, remedy, robot)
