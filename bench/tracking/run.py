"""One scenario: the drive is fed to a localizer, which is told frames and odometry and nothing else."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness.trajectory_scores import Told
from bench.harness.worlds import fingerprint, remembered
from bench.tracking.drives import Drive, seen
from bench.tracking.scenarios import Scenario
from bench.tracking.worlds import Recorded, map_of, open_world

_SELVES = tuple(f"bench/tracking/{part}.py" for part in ("run", "drives", "scenarios", "worlds"))


def told_of(folder: Path, scenario: Scenario) -> tuple[Told, Drive]:
    """Return what the localizer said on a scenario's drive, now or when the same code ran before, and the drive.

    Worlds, maps and answers are kept in ``folder``.
    """
    recorded = open_world(folder, scenario.world)
    drive = scenario.drive(recorded.truth)
    site = map_of(folder, scenario.world, scenario.variant)
    out = folder / "tracking-results" / scenario.name.replace("/", "-")
    arrays = out.with_suffix(".npz")
    spec = {"code": fingerprint(), "bench": fingerprint(*_SELVES), "scenario": repr(scenario.world)}

    def work() -> dict[str, Any]:
        told = follow(site, recorded, drive)
        out.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(arrays, **vars(told))
        return {"frames": len(drive)}

    remembered(out.with_suffix(".json"), spec, work)
    with np.load(arrays) as kept:
        fields = dict(kept)
    texts = {name: fields.pop(name).tolist() for name in ("states", "reasons")}
    return Told(**texts, **fields), drive


def follow(site: Path, recorded: Recorded, drive: Drive) -> Told:
    """Feed a drive to a new localizer on a map, and write down what it says."""
    from coview_stream import BaseMap, Localizer
    from coview_stream.errors import CloudError, RunError

    count = len(drive)
    poses, covariances = np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
    seconds = np.zeros(count)
    states, reasons = [], []
    localizer = Localizer(BaseMap.load(site))
    for k in range(count):
        cloud = seen(recorded.read(int(drive.frames[k])), int(drive.cover[k]), int(drive.frames[k]))
        begin = time.perf_counter()
        try:
            fix = localizer.step(cloud, drive.odometry[k], float(drive.stamps[k]))
        except (CloudError, RunError) as error:
            states.append("SKIPPED")
            reasons.append(str(error))
            continue
        seconds[k] = time.perf_counter() - begin
        states.append(fix.state.value)
        reasons.append(fix.evidence.reason if fix.evidence else "")
        if fix.T_map_body is not None:
            poses[k] = fix.T_map_body
        if fix.covariance is not None:
            covariances[k] = fix.covariance
    return Told(drive.stamps, states, reasons, poses, covariances, seconds)
