"""Offline localization of a recorded run, and its files: trajectory, evidence, timings."""

from __future__ import annotations

import json
import os
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from coview_stream.basemap.basemap import BaseMap
from coview_stream.clouds.atomic_file import atomic_file
from coview_stream.clouds.trajectory import write_tum
from coview_stream.config import Channel, LocalizerConfig, Mount
from coview_stream.descriptors.coview import Descriptor
from coview_stream.errors import CloudError, InputError, RunError, counted
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.protection import LEVELS, ProtectionLevel, one_in
from coview_stream.geometry.transforms import Poses, pose_from, pose_from_tum
from coview_stream.localization.backward import RecordedFrame, RecordingLocalizer
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.result import Fix, KeyframeEvidence, calibration_json, calibration_says
from coview_stream.localization.search.acceptance import Considered
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.localization.smoothing import PoseKind, SmoothedPose, smooth_run
from coview_stream.localization.state import State
from coview_stream.localization.tracking.monitor import FAULTS, RejectionReason
from coview_stream.recordings.run import Run

_KINDS = {
    PoseKind.SMOOTHED: "frames with a live pose",
    PoseKind.BACKWARD: "tracked backwards from a later fix",
    PoseKind.BRIDGED: "bridged by odometry",
}
_TOLD = 3  # interruptions that a summary lists

TRAJECTORY, FILTERED = "trajectory.tum", "filtered.tum"
"""Trajectories of a run: the best one and, with smoothing, the live one beside it."""

TRAJECTORY_PNG, DESCRIPTORS_PNG = "trajectory.png", "descriptors.png"
"""Pictures of a run; ``report.run_pictures`` draws them."""


@dataclass(frozen=True)
class Interruption:
    """Span of frames without a pose after the first fix, or with a reported fault.

    Attributes:
        first: stamp of the first frame, seconds.
        last: stamp of the last frame.
        frames: number of frames.
        reason: newest one with the most frequent cause.
    """

    first: float
    last: float
    frames: int
    reason: str

    def to_json(self) -> dict[str, Any]:
        """Plain data of ``result.json``."""
        return {"first_stamp": self.first, "last_stamp": self.last, "frames": self.frames, "reason": self.reason}


@dataclass(frozen=True)
class Stretch:
    """Successive smoothed poses of one kind; frames without a pose may lie between them.

    Attributes:
        kind: of the poses.
        first: stamp of the first frame, seconds.
        last: stamp of the last frame.
        frames: number of poses.
        protection_m: greatest protection level of the poses, metres.
    """

    kind: PoseKind
    first: float
    last: float
    frames: int
    protection_m: float

    def to_json(self) -> dict[str, Any]:
        """Plain data of ``result.json``."""
        about = {"kind": self.kind.value, "first_stamp": self.first, "last_stamp": self.last, "frames": self.frames}
        return {**about, "protection_m": round(self.protection_m, 4)}


@dataclass
class RunResult:
    """Result of localizing a run.

    Attributes:
        frames: number of frames in the run.
        fixes: one per usable frame, in order.
        keyframes: evidence of every keyframe and, while tracking, registration, in order.
        skipped: file and reason of every unusable frame.
        seconds: duration of each step; empty if unknown.
        query: descriptors of the keyframe of the first fix, if any.
        winner: evidence of that keyframe.
        sources: recognizers that named places: "coview", "learned"; empty if unknown.
        driven: metres of odometry up to the first fix; None if unknown.
        mount: of the run's lidar; None for the body itself.
        smoothed: poses by the whole run, in order; None unless requested.
        considered: places of the newest search, if no frame has a pose; else None.
        node_reason: why there was no pose, as reported by a node; empty without a node.
        dropped: clause on the work that a node's machine had no time for; empty if there was none.
    """

    frames: int
    fixes: list[Fix] = field(default_factory=list)
    keyframes: list[KeyframeEvidence] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    query: dict[Channel, Descriptor] = field(default_factory=dict)
    winner: KeyframeEvidence | None = None
    sources: tuple[str, ...] = ()
    driven: float | None = None
    mount: Mount | None = None
    smoothed: list[SmoothedPose] | None = None
    considered: Considered | None = None
    node_reason: str = ""
    dropped: str = ""

    @property
    def reason(self) -> str:
        """Why no frame has a pose; empty if one has, or if the reason is unknown."""
        if self.posed:
            return ""
        return self.node_reason or (self.keyframes[-1].reason if self.keyframes else "")

    @property
    def posed(self) -> list[Fix]:
        """Fixes that have a pose."""
        return [fix for fix in self.fixes if fix.T_map_body is not None]

    @property
    def trusted(self) -> bool:
        """Whether there are poses, the last one no earlier than the last frame with a fault of units or axes."""
        told = self.faults.get(RejectionReason.CONVENTIONS)
        return bool(self.posed) and (told is None or self.posed[-1].stamp >= told.last)

    @property
    def filtered(self) -> tuple[Floats, Poses]:
        """Stamps (P,) and live poses (P, 4, 4) map <- body, of the frames that had one."""
        return _trajectory(self.posed)

    @property
    def trajectory(self) -> tuple[Floats, Poses]:
        """Stamps and poses likewise, :attr:`smoothed` if the run was, else live."""
        return self.filtered if self.smoothed is None else _trajectory(self.smoothed)

    @property
    def stretches(self) -> list[Stretch]:
        """Successive smoothed poses of one kind, in order."""
        out: list[Stretch] = []
        for pose in self.smoothed or ():
            metres = pose.protection.metres
            if out and out[-1].kind is pose.kind:
                worst = max(out[-1].protection_m, metres)
                out[-1] = replace(out[-1], last=pose.stamp, frames=out[-1].frames + 1, protection_m=worst)
            else:
                out.append(Stretch(pose.kind, pose.stamp, pose.stamp, 1, metres))
        return out

    @property
    def calibration(self) -> Calibration | None:
        """The run's last calibration, with or without a pose; None if there was none."""
        return self.fixes[-1].calibration if self.fixes else None

    @property
    def state(self) -> State:
        """The last frame's state; SEARCHING if there was none."""
        return self.fixes[-1].state if self.fixes else State.SEARCHING

    @property
    def first(self) -> Fix | None:
        """The first fix that has a pose."""
        return next(iter(self.posed), None)

    @property
    def interruptions(self) -> list[Interruption]:
        """Interruptions after the first fix, in order; skipped frames do not count."""
        gaps: list[list[Fix]] = []
        fixed, going_on = False, False
        for fix in self.fixes:
            has = fix.T_map_body is not None
            if fixed and not has:
                if not going_on:
                    gaps.append([])
                gaps[-1].append(fix)
            fixed, going_on = fixed or has, fixed and not has
        return [Interruption(gap[0].stamp, gap[-1].stamp, len(gap), _usual_reason(gap)) for gap in gaps]

    @property
    def faults(self) -> dict[RejectionReason, Interruption]:
        """Faults of clouds and odometry by cause, with the first, last and number of frames, with or without a pose."""
        told: dict[RejectionReason, list[Fix]] = {}
        for fix in self.fixes:
            if fix.evidence is not None and fix.evidence.cause in FAULTS:
                told.setdefault(fix.evidence.cause, []).append(fix)
        return {
            cause: Interruption(fixes[0].stamp, fixes[-1].stamp, len(fixes), _usual_reason(fixes))
            for cause, fixes in told.items()
        }

    def to_json(self, base_map: BaseMap) -> dict[str, Any]:
        """Plain data of ``result.json``: poses map <- body and map <- odom, seconds, metres.

        ``confidence`` is the first fix's.
        """
        last = self.posed[-1] if self.posed else None
        evidence = self.fixes[-1].evidence if self.fixes else None
        latency = np.quantile(self.seconds, [0.5, 0.95, 0.99]).round(6).tolist() if self.seconds else [None] * 3
        return {
            "format": 1,
            "state": self.state.reported,
            "reason": self.reason or None,
            "T_map_odom": None if last is None or last.T_map_odom is None else last.T_map_odom.tolist(),
            "protection_level": None if last is None or last.protection is None else last.protection.to_json(),
            "calibration": calibration_json(self.calibration, evidence, self.mount, self.frames == 1),
            "mount": None if self.mount is None else self.mount.to_json(),
            "first_fix_stamp": None if self.first is None else self.first.stamp,
            "confidence": None if self.first is None else self.first.confidence,
            "first_fix_m": None if self.driven is None else round(self.driven, 3),
            "frames": self.frames,
            "posed": len(self.posed),
            "smoothed": None if self.smoothed is None else [stretch.to_json() for stretch in self.stretches],
            "interruptions": [gap.to_json() for gap in self.interruptions],
            "faults": [{"cause": cause.value} | told.to_json() for cause, told in self.faults.items()],
            "skipped": self.skipped,
            "sources": list(self.sources),
            "map_sha256": base_map.sha256,
            "timings_s": dict(zip(("p50", "p95", "p99"), latency, strict=True)),
            "keyframes": [keyframe.to_json() for keyframe in self.keyframes],
        }


def locate(
    base_map: BaseMap,
    run: Run,
    config: LocalizerConfig | None = None,
    progress: Callable[[int, int, Fix | None], None] | None = None,
    guess: PlaceGuess | None = None,
    smooth: bool = False,
) -> RunResult:
    """Feed a run through a :class:`Localizer`, frame by frame, without looking ahead; then smooth it on request.

    A frame that cannot be read is skipped and recorded.

    Args:
        base_map: the map.
        run: the run.
        config: of the localizer.
        progress: called with the numbers of finished and of all frames, and the frame's fix, None if it is skipped.
        guess: of the place at the first frame; only its circle is trusted.
        smooth: add poses by the whole run, also of frames without a live pose (``smoothed``).

    Raises:
        MapError, InputError: as :class:`Localizer`; no frame could be used (the message ends with the first frame's
            error); or the map has no ground at the guess.
    """
    if run.mount is not None and not run.mount.drawn:
        config = replace(config or LocalizerConfig(), mount_drawn=False)
    localizer = RecordingLocalizer(base_map, config) if smooth else Localizer(base_map, config)
    recorded: list[RecordedFrame] = []
    if guess is not None:
        localizer.guess_place(guess)
    localizer.prepare()
    located = RunResult(len(run), sources=localizer.search.names, mount=run.mount)
    driven, before = 0.0, None
    for index in range(len(run)):
        try:
            frame = run.read(index, localizer.calibration.sweep)
            begin = time.perf_counter()
            fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        except (CloudError, RunError) as error:
            path = run.frames_paths[index]  # unknown to the localizer
            located.skipped.append(str(error) if path.name in str(error) else f"{path}: {error}")
            if progress:
                progress(index + 1, len(run), None)
            continue
        located.seconds.append(time.perf_counter() - begin)
        if isinstance(localizer, RecordingLocalizer):
            recorded.append(RecordedFrame(index, frame.T_odom_body, frame.origin, fix, localizer.registered))
        here = frame.T_odom_body[:3, 3]
        driven, before = driven + (0.0 if before is None else float(np.linalg.norm(here - before))), here
        if frame.origin.any() and fix.T_map_body is not None and fix.T_map_odom is not None:
            # a single scan may be stored far from its zero: express the pose in the file's own coordinates
            away = pose_from(np.eye(3), -frame.origin)
            fix = replace(fix, T_map_body=fix.T_map_body @ away, T_map_odom=fix.T_map_odom @ away)
        if located.winner is None and fix.T_map_body is not None:
            located.driven, located.winner, located.query = driven, fix.evidence, localizer.search.last_query
        if fix.evidence is not None and (not located.keyframes or located.keyframes[-1] is not fix.evidence):
            located.keyframes.append(fix.evidence)
        located.fixes.append(fix)
        if progress:
            progress(index + 1, len(run), fix)
    if not located.fixes:
        raise InputError(f"{run.path}: not one of {len(run)} frames could be used; first: {located.skipped[0]}")
    if not located.posed:
        located.considered = localizer.search.considered
    if isinstance(localizer, RecordingLocalizer):
        located.smoothed = smooth_run(localizer, run, recorded)
    return located


def from_stream(
    stamps: Sequence[float], poses: Sequence[dict[str, Any]], statuses: Sequence[dict[str, Any]]
) -> RunResult:
    """Assign a node's published messages (JSON poses and statuses) to a run's frames, by stamp in seconds.

    A frame has a pose if one was published for its stamp; duplicate stamps count once. Other frames have the state of
    the newest earlier status.
    """
    pose_at = {round(p["stamp_ns"] / 1000): p for p in poses}  # stamps of runs are exact to a microsecond
    states = sorted((s["last_frame_ns"] or 0, s["state"]) for s in statuses)
    located = RunResult(len(stamps))
    for stamp in stamps:
        pose = pose_at.get(round(stamp * 1e6))
        if pose is None:
            before = bisect_right(states, round(stamp * 1e9), key=lambda t: t[0])
            located.fixes.append(Fix(stamp, State(states[before - 1][1]) if before else State.SEARCHING))
        else:
            T = pose_from_tum([*pose["position"], *pose["orientation"]])
            covariance = np.array(pose["covariance"], dtype=np.float64).reshape(6, 6)
            known_level = pose.get("protection_level")  # older nodes send none
            level = None if known_level is None else ProtectionLevel(*(known_level[name] for name in LEVELS))
            confidence = float(pose["confidence"])
            located.fixes.append(Fix(stamp, State.TRACKING, T, None, covariance, confidence, protection=level))
    for status in statuses:
        if status.get("evidence"):
            evidence = KeyframeEvidence.from_json(status["evidence"])
            if not located.keyframes or located.keyframes[-1].stamp != evidence.stamp:
                located.keyframes.append(evidence)
    if live := [status for status in statuses if "counters" in status and not status["node"]["ending"]]:
        located.dropped = _dropped(live[-1]["counters"], len(stamps))
        located.node_reason = "; ".join(part for part in (located.dropped, live[-1]["reason"]) if part)
    return located


def _dropped(counters: dict[str, int], frames: int) -> str:
    """Return a clause on the work that a node's machine dropped for lack of time; empty if there was none."""
    searches = counters["searches"] + counters["searches_skipped"]
    parts = [
        (counters["dropped"], frames, "frames"),
        (counters["searches_skipped"], searches, "keyframes to search for"),
    ]
    said = [f"{number} of {total} {name}" for number, total, name in parts if number]
    return f"the machine had no time for {' and '.join(said)}" if said else ""


def write(located: RunResult, base_map: BaseMap, out: str | os.PathLike[str]) -> None:
    """Write ``trajectory.tum`` (posed frames only) and ``result.json`` into ``out``; remove an earlier run's pictures.

    The trajectory of a smoothed run has its smoothed poses, and ``filtered.tum`` the live ones.

    Raises:
        InputError: the directory cannot be written.
    """
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stale = (f"trajectory.{suffix}" for suffix in ("csv", "kitti", "geojson", "gpx"))  # of --export
        for name in (TRAJECTORY_PNG, DESCRIPTORS_PNG, FILTERED, *stale):  # they would contradict the new trajectory
            (folder / name).unlink(missing_ok=True)
        write_tum(folder / TRAJECTORY, *located.trajectory)
        if located.smoothed is not None:
            write_tum(folder / FILTERED, *located.filtered)
        text = json.dumps(located.to_json(base_map), indent=1) + "\n"
        with atomic_file(folder / "result.json") as stream:
            stream.write(text.encode())
    except OSError as error:
        raise InputError(f"{folder}: cannot write the results ({error.strerror}); choose another place") from error


def summary(located: RunResult) -> str:
    """Summarize a result in a few lines for people."""
    posed = located.posed
    share = f"{len(posed)} of {counted(located.frames, 'frame')}"
    lines = [f"{'state':<18} {located.state.reported}", f"{'localized':<18} {share}"]
    if posed:
        x, y, z = np.asarray(posed[-1].T_map_body)[:3, 3]
        level = posed[-1].protection
        within = ""
        if level is not None and located.trusted:
            within = f", within {level.horizontal:.2f} m, in height {level.vertical:.2f} m, but for 1 in 1,000"
        lines.append(f"{'last position':<18} {x:.3f} {y:.3f} {z:.3f} m{within}")
        where = "" if located.driven is None else f"after {located.driven:.1f} m: "
        lines.append(f"{'found':<18} {where}wrong {one_in(1.0 - posed[0].confidence)}")
        lines.extend(f"{'without a pose':<18} {text}" for text in _interrupted(located))
        if located.smoothed is not None:
            counts = Counter(pose.kind for pose in located.smoothed)
            lines.append(f"{'smoothed':<18} {', '.join(f'{counts[kind]} {_KINDS[kind]}' for kind in PoseKind)}")
        if located.calibration is not None:
            says = calibration_says(located.calibration, located.fixes[-1].evidence, located.mount, located.frames == 1)
            lines.extend(f"{'calibration':<18} {clause}" for clause in says)
    elif located.reason:
        lines.append(f"{'reason':<18} {located.reason}")
    begin = located.fixes[0].stamp if located.fixes else 0.0
    for cause, told in located.faults.items():
        span = f"{counted(told.frames, 'frame')} from {told.first - begin:.1f} s to {told.last - begin:.1f} s"
        never_mended = cause is RejectionReason.CONVENTIONS and bool(posed) and not located.trusted
        doubtful = "; poses before it are not to be trusted" * never_mended
        lines.append(f"{'FAULT ' + cause.value:<18} {span}: {told.reason}{doubtful}")
    if located.smoothed is not None and not posed:
        lines.append(f"{'smoothed':<18} nothing: there was no fix to smooth from")
    if located.skipped:
        lines.append(f"{'skipped':<18} {counted(len(located.skipped), 'frame')}; first: {located.skipped[0]}")
    if located.seconds:
        p50, p99 = np.quantile(located.seconds, [0.5, 0.99]) * 1e3
        lines.append(f"{'step time':<18} p50 {p50:.1f} ms, p99 {p99:.0f} ms")
    return "\n".join(lines)


def _trajectory(posed: Sequence[Fix] | Sequence[SmoothedPose]) -> tuple[Floats, Poses]:
    poses = np.array([pose.T_map_body for pose in posed], dtype=np.float64).reshape(-1, 4, 4)
    return np.array([pose.stamp for pose in posed], dtype=np.float64), poses


def _usual_reason(gap: Sequence[Fix]) -> str:
    """Return the newest reason that has the most frequent cause: at first the cause may not be clear."""
    unsaid = {state: "no pose arrived" if state is State.TRACKING else state.reported for state in State}
    reasons = [(unsaid[fix.state], None) if (e := fix.evidence) is None else (e.reason, e.cause) for fix in gap]
    cause = Counter(cause for _, cause in reasons).most_common(1)[0][0]
    return next(reason for reason, other in reversed(reasons) if other is cause)


def _interrupted(located: RunResult) -> list[str]:
    """List the longest interruptions, in the order of the run."""
    gaps, begin = located.interruptions, located.fixes[0].stamp
    longest = sorted(gaps, key=lambda gap: -gap.frames)[:_TOLD]
    lines = [
        f"{counted(gap.frames, 'frame')} from {gap.first - begin:.1f} s to {gap.last - begin:.1f} s: {gap.reason}"
        for gap in gaps
        if gap in longest
    ]
    if len(gaps) > _TOLD:
        rest = sum(gap.frames for gap in gaps) - sum(gap.frames for gap in longest)
        lines.append(f"{rest} frames in {len(gaps) - _TOLD} more places: see result.json")
    return lines
