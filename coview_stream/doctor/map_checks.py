"""Checks of a map, and of a recorded run on it: stamps, clouds against odometry, a place, and faulty sensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coview_stream.clouds.reference_system import FOOT
from coview_stream.config import LocalizerConfig, TrackingConfig
from coview_stream.doctor.finding import Finding, from_error
from coview_stream.doctor.frame_checks import SeenFrame, frame_findings
from coview_stream.doctor.machine_checks import GB, MIN_MEMORY
from coview_stream.errors import CloudError, CoViewError, MapError, RunError, counted, install_command
from coview_stream.geometry.protection import one_in

if TYPE_CHECKING:
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.localization.calibration.calibration import Calibration
    from coview_stream.recordings.run import Frame, Run

    Judge = Callable[[Frame], tuple[str, str, float] | None]
    Progress = Callable[[int, int], None]

_NETWORK_MEMORY = 0.04 * GB  # for the network and SciPy, in the search process
_INDEX_MEMORY = 1100.0  # bytes per station: 1024 for the index, the rest for a search's results
_FIELD_MEMORY = 88.0  # bytes per surveyed square metre: 20 per cell, and 8 for the coarse level
_FEATURE_MEMORY = 20.0  # bytes per square metre: 7 dimensions on 2 m cells, spectra, scores of a query


def open_map(path: Path) -> tuple[BaseMap | None, Finding]:
    """Open a map, read all of it and compare its checksum; None if it is unusable."""
    from coview_stream.basemap.basemap import BaseMap
    from coview_stream.basemap.file_format import VERSION

    try:
        base_map = BaseMap.load(path)
    except MapError as error:
        return None, from_error("map", error)
    text = f"{path}: format {VERSION}, {len(base_map)} stations, {len(base_map.points)} points, checksum holds"
    return base_map, Finding("ok", "map", text)


def map_findings(base_map: BaseMap, size: int, available: int | None) -> Iterator[Finding]:
    """Judge an open map whose file has ``size`` bytes, with ``available`` bytes of memory (None: unknown)."""
    yield Finding("ok", "map sha256", base_map.sha256)
    if not len(base_map):
        yield Finding("FAIL", "map stations", "none: nowhere to search", "build it again, from ground and walls")
    missing = base_map.require_features("auto")
    if missing is not None:
        yield replace(from_error("map features", missing), verdict="warn")
    elif base_map.learned is None:
        yield Finding("ok", "map features", "none: searches go by co-view descriptors")
    else:
        yield Finding("ok", "map features", f"{base_map.learned.bytes / 1e6:.1f} MB, of the installed networks")
    needed = node_memory(base_map)
    text = f"a node needs about {needed / GB:.1f} GB, and {size / GB:.2f} GB of page cache for the file"
    if available is not None and needed > available:
        remedy = f"{available / GB:.1f} GB are available: build with a larger --block-size, or cut the map"
        yield Finding("FAIL", "map memory", text, remedy)
    elif available is not None and needed + size > available:
        remedy = f"{available / GB:.1f} GB are available: searches will wait for the disk"
        yield Finding("warn", "map memory", text, remedy)
    else:
        yield Finding("ok", "map memory", text)


def node_memory(base_map: BaseMap) -> float:
    """Return a node's bytes: processes, the station index, the likelihood field, a search, and learned features.

    Learned features fill the rectangle around the map, however little of it has points.
    """
    surveyed = int((base_map.survey.values > 0).sum()) * base_map.config.block**2
    needed = MIN_MEMORY + len(base_map) * _INDEX_MEMORY + surveyed * _FIELD_MEMORY
    if base_map.require_features("auto") is None and base_map.learned is not None:
        needed += _NETWORK_MEMORY + base_map.learned.box_area * _FEATURE_MEMORY
    return needed


# sizes of the sample
_FRAMES, _WINDOWS = 80, 4  # frames at most, in this many stretches of a long run
_APART = 1.0  # metres between frames, approximately
_STANDING_STRIDE = 5  # frames, if odometry does not move
_MIN_RATE, _MAX_RATE = 0.2, 100.0  # Hz; lidars send 1 to 30 frames per second
_SEARCHED = 60  # frames given to the search, or up to twice as many of a short run
_ENOUGH = 20.0  # metres: most robots are found within ten
_BETWEEN = 0.21  # seconds between watched frames, at most: odometry in between does not hide accelerations
_WATCHED = 1500  # frames: five minutes
_MAX_REBUILT = 5_000_000  # points of a map rebuilt in memory: a million takes a core 7 s and 0.2 GB


def run_findings(
    run: Run, base_map: BaseMap | None = None, config: LocalizerConfig | None = None, progress: Progress | None = None
) -> Iterator[Finding]:
    """Judge a run of several frames and, with a map, whether it can be localized; ``progress``: of the frames."""
    config = config or LocalizerConfig()
    if run.mount is not None and not run.mount.drawn:
        config = replace(config, mount_drawn=False)
    yield stamps_finding(run)
    try:
        frames = seen_frames(run)
    except CoViewError as error:
        yield from_error("run", error)
        return
    found = list(frame_findings(frames, given=run.mount))
    wrong = [finding.what for finding in found if finding.verdict == "FAIL"]
    sensors = []
    if len(run) > 1 and wrong in ([], ["motion"]):
        sensors = list(sensor_findings(run, None if wrong else base_map, config, progress))
    lies = any(finding.verdict == "FAIL" for finding in sensors)
    yield from (finding for finding in found if not (lies and finding.what == "motion"))  # ``sensors`` name the cause
    if lies or not wrong:
        yield from sensors
    if base_map is not None and not wrong and not lies:
        yield place_finding(run, base_map, config, progress)


def stamps_finding(run: Run) -> Finding:
    """Judge the time between frames, to detect milliseconds or nanoseconds instead of seconds."""
    step = run.interval
    found = counted(len(run), "frame") + f", {step:.4g} s from one to the next" * (len(run) > 1)
    if run.stamp_unit != "seconds":
        return Finding("FAIL", "stamps", found, f"they look like {run.stamp_unit}: write seconds")
    if 1e-12 < step < 1.0 / _MAX_RATE:
        return Finding("FAIL", "stamps", found, "stamps have to be in seconds; these are a smaller unit of time apart")
    if step > 1.0 / _MIN_RATE:
        return Finding("warn", "stamps", found, "frames are far apart: five a second are usual")
    return Finding("ok", "stamps", found)


def seen_frames(run: Run) -> list[SeenFrame]:
    """Read undamaged frames about a metre apart, in a few stretches of a long run; CloudError if there are none."""
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
    frames, damage = [], None
    for index in indices:
        try:
            frame = run.read(int(index))
        except CloudError as error:
            damage = damage or error
            continue
        frames.append(SeenFrame(frame.stamp, frame.points, frame.T_odom_body))
    if not frames and damage is not None:
        raise damage
    return frames


def place_finding(run: Run, base_map: BaseMap, config: LocalizerConfig, progress: Progress | None = None) -> Finding:
    """Search the map for the beginning of the run; FAIL if no place stands out after enough metres.

    A map without a reference system may be in feet: it is searched again in metres, unless it is too large.
    """
    try:
        from coview_stream.localization.localizer import Localizer
        from coview_stream.localization.state import State
        from coview_stream.report.evaluation import driven as metres_driven
    except ImportError as error:
        remedy = install_command("all")
        return Finding("warn", "place", f"not searched for: {error.name} is missing", remedy)

    def searched(on: BaseMap) -> tuple[float, State, str]:
        """Return the metres driven, the state, and both metres and reason in words."""
        localizer = Localizer(on, config)
        reason = ""
        for done, index in enumerate(indices, start=1):
            if progress is not None:
                progress(done, len(indices))
            try:
                frame = run.read(index)
            except CloudError:
                continue
            evidence = localizer.step(frame.points, frame.T_odom_body, frame.stamp).evidence
            reason = reason if evidence is None else evidence.reason.removeprefix("found: ")
            if localizer.state is State.TRACKING:
                break
        after = f"after {metres[index]:.0f}" + f" of {metres[-1]:.0f}" * goes_on + " m"
        return metres[index], localizer.state, f"{after}: {reason or 'too little has been seen'}"

    step = max(1, len(run) // _SEARCHED)
    indices = range(0, len(run), step) if len(run) <= 4 * _SEARCHED else range(0, 4 * _SEARCHED, 4)
    goes_on = indices[-1] + step < len(run)
    metres = metres_driven(run.poses)
    driven, state, text = searched(base_map)
    if state is State.TRACKING:
        return Finding("ok", "place", f"found {text}")
    sure = driven >= _ENOUGH and state is State.SEARCHING  # AMBIGUOUS: it may be found later
    untried = ""
    if sure and base_map.crs is None and len(base_map.points) > _MAX_REBUILT:
        millions = f"{len(base_map.points) / 1e6:.1f} million points to build again, {_MAX_REBUILT / 1e6:g} at most"
        untried = f" (feet were not tried: {millions})"
    elif sure and base_map.crs is None:
        in_metres = in_feet(base_map, progress is not None)
        _, state, converted = (0.0, state, "") if in_metres is None else searched(in_metres)
        if state is State.TRACKING:
            found = f"the map is in feet: none on it {text}; found {converted} once it is converted"
            return Finding("FAIL", "place", found, "build it again with --crs feet, or us-feet")
    (left, low, _), (right, high, _) = base_map.bounds
    name = "this map" if base_map.path is None else base_map.path.name
    map_name = f"{name} ({left:.0f}, {low:.0f} to {right:.0f}, {high:.0f} m)"
    remedy = "`locate` looks at all of the run; " * goes_on + (
        "clouds and odometry fit each other, so: is the robot on this map, is the map of this site and in metres"
        f"{untried}, and has the site not changed? `coview-stream help reasons`"
    )
    return Finding("FAIL" if sure else "warn", "place", f"none on {map_name} {text}", remedy)


def in_feet(base_map: BaseMap, progress: bool = False) -> BaseMap | None:
    """Return the map as if its coordinates were feet, with a bar on stderr if ``progress``; None if that fails."""
    from coview_stream.basemap.basemap import BaseMap

    try:
        return BaseMap.build(np.asarray(base_map.points) * np.float32(FOOT), config=base_map.config, progress=progress)
    except CoViewError:
        return None


def sensor_findings(
    run: Run, base_map: BaseMap | None, config: LocalizerConfig, progress: Progress | None = None
) -> Iterator[Finding]:
    """Compare clouds, odometry and, with a map, registrations over the run.

    Yields a FAIL if at some frame a fault was more probable than none (poses are withheld long before), and names the
    cause that most frames gave; otherwise yields an ok, and the calibration at the end, estimated as while tracking.
    """
    try:
        judge, outcome = _judge(base_map, config)
    except ImportError:
        return  # a library is missing: the finding about motion has reported it
    stride = max(1, int(_BETWEEN / max(float(np.median(np.diff(run.stamps))), 1e-6)))
    stride -= stride % 2 == 0  # odd, as two drivers may alternate
    indices = range(0, len(run), stride)[:_WATCHED]
    told = list[tuple[str, str, float]]()
    for done, index in enumerate(indices, start=1):
        if progress is not None:
            progress(done, len(indices))
        try:
            fault = judge(run.read(index))
        except (CloudError, RunError):
            continue
        if fault is not None:
            told.append(fault)
    surest = max((probability for _, _, probability in told), default=0.0)
    if surest > 0.5:
        cause = Counter(cause for cause, _, _ in told).most_common(1)[0][0]
        reason = next(reason for other, reason, _ in reversed(told) if other == cause)
        found = f"{reason}; so in {len(told)} of {len(indices)} frames (wrong {one_in(1.0 - surest)})"
        yield Finding("FAIL", "sensors", found, f"cause {cause}: `coview-stream help reasons` says what to do")
    else:
        of, calibration = outcome()
        seconds = run.stamps[indices[-1]] - run.stamps[0]
        yield Finding("ok", "sensors", f"{of} tell the same motion over {seconds:.0f} s")
        for clause in calibration.describe(run.mount):
            found, _, remedy = clause.partition("; ")
            if base_map is None and "sensor leans" in found:
                remedy = "or the ground slopes: the doctor with a map knows"
            yield Finding("ok", "calibration", found, remedy)


def _judge(base_map: BaseMap | None, config: LocalizerConfig) -> tuple[Judge, Callable[[], tuple[str, Calibration]]]:
    """Return functions for a frame's fault (cause, reason, probability) and for the compared inputs and calibration."""
    from coview_stream.localization.frame import FramePreparation
    from coview_stream.localization.localizer import Localizer
    from coview_stream.localization.tracking.monitor import FAULTS
    from coview_stream.localization.tracking.motion import Drift
    from coview_stream.localization.witness.witness import Witness

    if base_map is not None:
        from coview_stream.localization.calibration.calibration import Calibration

        localizer = Localizer(base_map, config)

        def localized(frame: Frame) -> tuple[str, str, float] | None:
            said = localizer.step(frame.points, frame.T_odom_body, frame.stamp).evidence
            if said is None or said.cause not in FAULTS:
                return None
            return said.cause.value, said.reason, localizer.sensor_fault

        def measured() -> tuple[str, Calibration]:  # places that only led a search say nothing about map or lean
            if localizer.state.has_place:
                return "clouds, odometry and map", localizer.calibration
            return "clouds and odometry", Calibration()

        return localized, measured
    frames, drift = FramePreparation(config), Drift.of(TrackingConfig())
    witness = Witness(config.registration, frames.estimator)

    def watched(frame: Frame) -> tuple[str, str, float] | None:
        points, T_odom_body = frames.validate(frame.points, frame.T_odom_body, frame.stamp)
        prepared = frames.prepare(points, T_odom_body, frame.stamp, drift.variances)
        witness.add(prepared.stamp, prepared.cloud, prepared.scan, prepared.T_odom_raw)
        accused = witness.while_searching(drift)
        return None if accused is None else (accused.cause.value, accused.sentence, witness.faults.sensors)

    return watched, lambda: ("clouds and odometry", frames.calibration)
