"""Checks of a recorded run: stamps, clouds against odometry, and whether the map has a place for it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from coview_stream.doctor.finding import Finding, from_error
from coview_stream.doctor.frame_checks import SeenFrame, frame_findings
from coview_stream.errors import CloudError, CoViewError

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.recordings.run import Run

# sizes of the sample
_FRAMES, _WINDOWS = 80, 4
_APART = 1.0  # metres between frames, about
_STANDING_STRIDE = 5  # frames, where odometry does not move
_MIN_RATE, _MAX_RATE = 0.2, 100.0  # Hz; frames of lidars come 1 to 30 times a second
_SEARCHED = 60  # frames


def run_findings(run: Run, base_map: BaseMap | None = None) -> Iterator[Finding]:
    """Judge a run of several frames and, with a map, whether it is localized there."""
    yield stamps_finding(run)
    try:
        frames = seen_frames(run)
    except CoViewError as error:
        yield from_error("run", error)
        return
    wrong = False
    for finding in frame_findings(frames):
        wrong |= finding.verdict == "FAIL"
        yield finding
    if base_map is not None and not wrong:
        yield place_finding(run, base_map)


def stamps_finding(run: Run) -> Finding:
    """Judge the time between frames, to find milliseconds or nanoseconds in place of seconds."""
    step = float(np.median(np.diff(run.stamps))) if len(run) > 1 else float("nan")
    found = f"{len(run)} frames, {step:.4g} s from one to the next"
    for factor, unit in ((1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")):
        if step > factor * 1e-2:
            return Finding("FAIL", "stamps", found, f"they look like {unit}: write seconds")
    if 1e-12 < step < 1.0 / _MAX_RATE:
        return Finding("FAIL", "stamps", found, "stamps have to be in seconds; these are a smaller unit of time apart")
    if step > 1.0 / _MIN_RATE:
        return Finding("warn", "stamps", found, "frames are far apart: five a second are usual")
    return Finding("ok", "stamps", found)


def seen_frames(run: Run) -> list[SeenFrame]:
    """Read frames about a metre apart, in a few stretches of a long run, without damaged ones."""
    steps = np.linalg.norm(np.diff(run.poses[:, :3, 3], axis=0), axis=1)
    step = float(np.median(steps)) if len(steps) else 0.0
    stride = _STANDING_STRIDE if len(run) > 2 * _FRAMES else 1
    if step > 1e-3:
        stride = max(1, min(round(_APART / step), stride * 4))
    indices = np.arange(0, len(run), stride)
    if len(indices) > _FRAMES:
        window = _FRAMES // _WINDOWS
        begins = np.linspace(0, len(indices) - window, _WINDOWS).astype(int)
        indices = indices[np.unique((begins[:, None] + np.arange(window)).ravel())]
    frames = []
    for index in indices:
        try:
            frame = run.read(int(index))
        except CloudError:
            continue
        frames.append(SeenFrame(frame.stamp, frame.points, frame.T_odom_body))
    return frames


def place_finding(run: Run, base_map: BaseMap) -> Finding:
    """Search the map for the beginning of the run."""
    try:
        from coview_stream.localization.localizer import Localizer
        from coview_stream.localization.state import State
    except ImportError as error:
        return Finding(
            "warn", "place", f"not searched for: {error.name} is missing", "pip install 'coview-stream[all]'"
        )
    localizer = Localizer(base_map)
    reason, driven = "", 0.0
    step = max(1, len(run) // _SEARCHED)
    indices = range(0, len(run), step) if len(run) <= 4 * _SEARCHED else range(0, 4 * _SEARCHED, 4)
    before = None
    for index in indices:
        try:
            frame = run.read(index)
        except CloudError:
            continue
        if before is not None:
            driven += float(np.linalg.norm(frame.T_odom_body[:3, 3] - before))
        before = frame.T_odom_body[:3, 3]
        fix = localizer.step(frame.points, frame.T_odom_body, frame.stamp)
        if fix is None:
            continue
        reason = "" if fix.evidence is None else fix.evidence.reason
        if fix.state is State.TRACKING:
            return Finding("ok", "place", f"found after {driven:.0f} m: {reason}")
    found = f"none on this map after {driven:.0f} m: {reason or 'too little has been seen'}"
    remedy = (
        "clouds and odometry fit each other, so: is the robot on this map, is the map of this site and in metres, "
        "and has the site not changed? docs/reasons.md"
    )
    return Finding("warn", "place", found, remedy)
