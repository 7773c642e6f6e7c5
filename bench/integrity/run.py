"""A run: a localizer on a map, told frames and odometry and nothing else, until its first fix or the drive's end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.integrity.changes import rebuilt, shifted
from bench.integrity.drives import AS_MAPPED, Drive, World, mirrored, scaled, through, tilted
from bench.integrity.kinds import draw
from bench.integrity.maps import size_of
from bench.integrity.plan import Run
from bench.integrity.store import Result
from bench.integrity.ways import beside_border, lane
from coview_stream import BaseMap, Localizer
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.transforms import Pose, inverse, rotation_angle
from coview_stream.sim.scenes import Scene

NEAR_METRES, NEAR_DEGREES = 3.0, 5.0
"""Errors from which on a first fix is false; the project's for all runs."""

SHIFT = 4.0  # metres, of all buildings
_ALTERATION, _REBUILT = 240, 241  # random streams


def drive_of(run: Run) -> Drive | None:
    """Return the drive of a run, with its truth; None where its site has no such way."""
    kind, seed = (run.driven, run.drive_seed) if run.driven else (run.kind, run.seed)
    scene = draw(kind, seed, size_of(kind), run.changed)
    if run.rebuilt:
        scene = rebuilt(scene, run.drive_seed, run.rebuilt)
    scene, world = _altered(run, scene)
    route = None
    if run.family == "edge":
        route = beside_border(scene, run.drive_seed, run.beyond)
        if route is None:
            return None
    elif run.kind == "boxes":
        route = lane(scene, run.drive_seed, across=bool((run.seed // 2 + run.number) % 2))
    known = not run.driven and run.family != "storey"
    return through(scene, run.sensor, run.drive_seed, route=route, world=world, known=known)


def _altered(run: Run, scene: Scene) -> tuple[Scene, World]:
    rng = np.random.default_rng([run.drive_seed, _ALTERATION])
    sign, angle = rng.choice([-1.0, 1.0]), rng.uniform(0.0, 2 * np.pi)
    if run.family == "shifted":
        return shifted(scene, SHIFT * np.array([np.cos(angle), np.sin(angle)])), AS_MAPPED
    if run.family == "mirrored":
        return scene, mirrored()
    if run.family == "scaled":
        return scene, scaled(1.0 + sign * rng.uniform(0.03, 0.05))
    if run.family == "tilted":
        return scene, tilted(np.radians(rng.uniform(2.0, 4.0)), angle)
    return scene, AS_MAPPED


def first_fix(localizer: Localizer, drive: Drive) -> Result:
    """Follow a drive to its first fix: the outcome, and what was said last."""
    localizer.reset()
    said, way = "", drive.driven
    out: Result = {"outcome": "none", "state": localizer.state.value}
    for k, stamp in enumerate(drive.stamps):
        cloud = drive.frame(k)
        try:
            fix = localizer.step(cloud, drive.odometry[k], float(stamp))
        except (CloudError, RunError):
            continue
        said = fix.evidence.reason if fix.evidence is not None else said
        out |= {"state": fix.state.value, "reason": said, "metres": round(float(way[k]), 2), "frames": k + 1}
        if fix.T_map_body is not None:
            out |= judged(fix.T_map_body, None if drive.truth is None else drive.truth[k])
            out |= {"risk": float(1.0 - fix.confidence), "seconds": round(float(stamp - drive.stamps[0]), 2)}
            break
    return out


def judged(T_map_body: Pose, truth: Pose | None) -> Result:
    """Compare a first fix with the only right pose, or with none."""
    if truth is None:
        return {"outcome": "false"}
    off = inverse(truth) @ T_map_body
    metres, degrees = float(np.linalg.norm(off[:3, 3])), float(np.degrees(rotation_angle(off)))
    right = metres < NEAR_METRES and degrees < NEAR_DEGREES
    errors = {"error_m": round(metres, 3), "error_deg": round(degrees, 3)}
    return {"outcome": "right" if right else "false", **errors}


def localizer_on(base: BaseMap, risk: float | None) -> Localizer:
    """Return a localizer on a map, with the usual integrity risk or another one."""
    config = LocalizerConfig()
    if risk is not None:
        config = replace(config, acceptance=replace(config.acceptance, risk=risk))
    localizer = Localizer(base, config)
    localizer.prepare()
    return localizer
