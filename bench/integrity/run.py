"""A run: a localizer on a map, told frames and odometry and nothing else, until its first fix or the drive's end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.integrity.changes import rebuilt, shifted
from bench.integrity.drives import AS_MAPPED, Drive, World, mirrored, scaled, through, tilted
from bench.integrity.kinds import draw
from bench.integrity.maps import size_of
from bench.integrity.plan import STATED, Run
from bench.integrity.store import Result
from bench.integrity.ways import beside_border, lane
from coview_stream import BaseMap, Localizer
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.arrays import Floats
from coview_stream.geometry.transforms import Points, Pose, inverse, pose_from, rotation_angle
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.result import Fix
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.recognizers import SearchIndex
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


@dataclass(frozen=True)
class Robot:
    """A localizer, and the search that answers its requests: so that what each keyframe's search states is seen.

    Attributes:
        localizer: the localizer.
        search: on the same map.
        origin: (3,) of the map, metres.
    """

    localizer: Localizer
    search: GlobalSearch
    origin: Floats

    @classmethod
    def on(cls, base: BaseMap, risk: float | None) -> Robot:
        """Return one on a map, with the usual integrity risk or another one."""
        config = LocalizerConfig()
        if risk is not None:
            config = replace(config, acceptance=replace(config.acceptance, risk=risk))
        maps, index = LocalMaps(base, config.registration.source_range), SearchIndex.of(base, config)
        localizer = Localizer(base, config, maps, index)
        localizer.prepare()
        return cls(localizer, GlobalSearch(base, config, maps, index), base.origin)

    def step(self, cloud: Points, T_odom_body: Pose, stamp: float) -> tuple[Fix, Leader | None]:
        """Do as :meth:`Localizer.step` does; return what a search has stated as well, if there was one."""
        request = self.localizer.add_frame(cloud, T_odom_body, stamp)
        leader = None
        if request is not None:
            result = self.search.update(request)
            self.localizer.apply_search_result(result)
            if result.leader is not None and result.evidence.confidence is not None:
                T = result.leader @ request.T_odom_body
                leader = Leader(1.0 - result.evidence.confidence, pose_from(T[:3, :3], T[:3, 3] + self.origin))
        return self.localizer.fix(), leader


class Leader(NamedTuple):
    """The most probable place of a keyframe, accepted or not: its stated error, and the robot's pose there."""

    error: float
    T_map_body: Pose


def first_fix(robot: Robot, drive: Drive) -> Result:
    """Follow a drive to its first fix: the outcome, what was said last, and what was stated on the way.

    ``stated`` has, for each of :data:`STATED` that some keyframe went below, the first one's error, the metres driven,
    and whether its most probable place was right.
    """
    robot.localizer.reset()
    said, way, stated = "", drive.driven, dict[str, Result]()
    out: Result = {"outcome": "none", "state": robot.localizer.state.value, "stated": stated}
    for k, stamp in enumerate(drive.stamps):
        cloud = drive.frame(k)
        try:
            fix, leader = robot.step(cloud, drive.odometry[k], float(stamp))
        except (CloudError, RunError):
            continue
        truth = None if drive.truth is None else drive.truth[k]
        if leader is not None:
            right = judged(leader.T_map_body, truth)["outcome"] == "right"
            new = {"error": leader.error, "metres": round(float(way[k]), 2), "right": right}
            stated |= {f"{e:g}": new for e in STATED if leader.error < e and f"{e:g}" not in stated}
        said = fix.evidence.reason if fix.evidence is not None else said
        out |= {"state": fix.state.value, "reason": said, "metres": round(float(way[k]), 2), "frames": k + 1}
        if fix.T_map_body is not None:
            out |= judged(fix.T_map_body, truth)
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
