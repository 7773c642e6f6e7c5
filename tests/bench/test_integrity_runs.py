import json
from dataclasses import dataclass, field

import numpy as np
import pytest

from bench.integrity import run as runs
from bench.integrity.drives import AS_MAPPED, Drive, mirrored, scaled, tilted
from bench.integrity.integrity import chosen
from bench.integrity.kinds import CALIBRATION, DRAWN, REPORTED, draw
from bench.integrity.plan import FAMILIES, Run, plan
from bench.integrity.ways import FAR, NEAR, beside_border, lane
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.result import Fix, KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.search.request import SearchRequest
from coview_stream.localization.state import State


def every(group, count=1080):
    return [run for site in plan(group, count) for run in site]


def test_kinds_to_fit_on_and_reported_ones_are_disjoint():
    used = {
        group: {k for run in every(group) for k in (run.kind, run.driven) if k} for group in ("calibration", "reported")
    }
    assert used["calibration"] == CALIBRATION
    assert used["reported"] == REPORTED
    assert not CALIBRATION & REPORTED


def test_the_plan_has_the_runs_that_the_bounds_need_and_names_each_once():
    found = every("reported")
    of_class = [run.of_class for run in found]
    assert len(found) == 1080
    assert of_class.count("ordinary") >= 300
    assert of_class.count("outside") >= 300
    assert of_class.count("near copies") >= 400
    assert len({run.key for run in found}) == 1080
    assert len({(run.kind, run.seed, run.drive_seed, run.driven) for run in found}) == 1080
    assert {run.family for run in found} | {run.family for run in every("calibration")} == set(FAMILIES)


def test_sixty_runs_have_every_reported_family():
    assert {run.family for run in every("reported", 60)} == {run.family for run in every("reported")}


def test_families_are_picked_by_parts_of_their_names():
    assert {run.family for site in chosen(plan("reported", 200), "court,old") for run in site} == {"court", "old"}
    with pytest.raises(InputError, match="none of the runs"):
        chosen(plan("reported", 20), "lighthouse")


def poses(count=4):
    turns = [rot_z(0.3 * k) for k in range(count)]
    return np.array([pose_from(R, np.array([3.0 + k, 2.0 * k, 1.5])) for k, R in enumerate(turns)])


def in_world(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def test_a_mirrored_world_shows_every_point_mirrored_and_has_no_right_pose():
    world, cloud = mirrored(), np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    for T, turned in zip(poses(), world.poses(poses()), strict=True):
        assert np.linalg.det(turned[:3, :3]) == pytest.approx(1.0)
        seen = in_world(turned, world.cloud(cloud))
        assert np.allclose(seen, in_world(T, cloud) * (-1, 1, 1), atol=1e-5)
        assert turned[2, 2] == pytest.approx(1.0)  # upright still
    assert not world.right


@pytest.mark.parametrize("factor", [0.96, 1.05])
def test_a_map_that_is_too_large_is_the_robots_world_times_that(factor):
    world, cloud = scaled(factor), np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    for T, smaller in zip(poses(), world.poses(poses()), strict=True):
        assert np.allclose(factor * in_world(smaller, world.cloud(cloud)), in_world(T, cloud), atol=1e-5)
    assert world.right


def test_a_tilted_map_is_turned_against_gravity_and_fits():
    world, cloud = tilted(np.radians(3.0), 0.7), np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    seen = [in_world(T, world.cloud(cloud)) for T in world.poses(poses())]
    mapped = [in_world(T, cloud) for T in poses()]
    R = world.poses(np.eye(4)[None])[0, :3, :3]
    assert np.degrees(np.arccos(R[2, 2])) == pytest.approx(3.0)
    assert all(np.allclose(a, b @ R.T, atol=1e-5) for a, b in zip(seen, mapped, strict=True))


def one(family, kind="village", **more):
    return Run("reported", family, kind, 71_000, 0, "vlp16", **more)


@pytest.mark.parametrize(
    ("run", "right"),
    [
        (one("ordinary village"), True),
        (one("outside, same kind", driven="village"), False),
        (one("mirrored"), False),
        (one("scaled"), True),
        (one("tilted"), True),
        (one("storey", "storey", changed=1.0), False),
        (one("court", "court"), True),
    ],
)
def test_truth_is_the_pose_on_the_map_or_nothing(run, right):
    drive = runs.drive_of(run)
    assert (drive.truth is not None) == right
    assert drive.driven[-1] == pytest.approx(60.0, abs=1.5)
    if right:
        assert np.array_equal(drive.truth, drive.poses)


def test_buildings_are_shifted_and_what_else_stands_is_not():
    scene = draw("village", 71_000, 120.0, 0.0)
    moved = runs._altered(one("shifted"), scene)[0]
    step = np.linalg.norm(moved.now.solid.vertices - scene.now.solid.vertices, axis=1)
    assert set(step.round(3)) == {0.0, runs.SHIFT}
    assert moved.mapped is scene.mapped
    assert moved.now.foliage is scene.now.foliage


@pytest.mark.parametrize("kind", sorted({*DRAWN} | {"suburb"}))
def test_the_survey_is_the_same_whatever_changes_later(kind):
    before, after = (draw(kind, 6, 200.0, changed) for changed in (0.0, 1.0))
    assert np.array_equal(before.mapped.solid.vertices, after.mapped.solid.vertices)
    changing = kind not in ("boxes", "avenue", "court")
    assert changing != (
        before.now.solid.vertices.shape == after.now.solid.vertices.shape
        and np.array_equal(before.now.solid.vertices, after.now.solid.vertices)
    )


def test_a_court_is_the_same_from_four_sides_within_its_walls():
    scene = draw("court", 5, 160.0, 0.0)
    near = scene.mapped.solid.vertices[len(scene.site.mesh().vertices) :]
    near = near[(np.linalg.norm(near[:, :2], axis=1) < 30.0) & (near[:, 2] > -0.1)]
    turned = near @ rot_z(np.pi / 2).T
    assert len(near) > 100
    assert all(np.linalg.norm(near - point, axis=1).min() < 1e-6 for point in turned)


def test_ways_at_the_border_stay_within_it_or_beyond():
    scene = draw("village", 71_000, 180.0, 0.0)
    for beyond, sign in ((False, 1.0), (True, -1.0)):
        way = beside_border(scene, 3, beyond)
        depth = sign * (90.0 - np.abs(way).max(axis=1))
        assert depth.min() > NEAR - 3.0
        assert depth.max() < FAR + 3.0


def test_lanes_lead_along_the_boxes_or_across():
    scene = draw("boxes", 4, 520.0, 0.0)
    along, across = (lane(scene, 5, each) for each in (False, True))
    headings = [(way[len(way) // 3] - way[0]) / np.linalg.norm(way[len(way) // 3] - way[0]) for way in (along, across)]
    assert abs(headings[0] @ headings[1]) < 0.05


ORIGIN = np.array([100.0, -50.0, 3.0])


@dataclass
class Told:
    """A localizer that asks for a search at every frame, and has the fix ``found`` from one of them on."""

    at: int
    found: object
    seen: list = field(default_factory=list)
    applied: list = field(default_factory=list)
    state: State = State.SEARCHING

    def reset(self):
        self.seen.clear()

    def add_frame(self, cloud, T_odom_body, stamp):
        self.seen.append(len(cloud))
        nothing = np.empty((0, 3), dtype=np.float32)
        return SearchRequest(stamp, T_odom_body, nothing, nothing, nothing)

    def apply_search_result(self, result):
        self.applied.append(result)

    def fix(self):
        if len(self.seen) > self.at:
            return Fix(0.0, State.TRACKING, self.found, confidence=0.99995)
        return Fix(0.0, State.AMBIGUOUS)


@dataclass
class Stating:
    """A search that states errors, one a keyframe, of places that lie so many metres off the odometry's poses."""

    errors: list
    metres: list
    asked: int = 0

    def update(self, request):
        k, self.asked = self.asked, self.asked + 1
        error = self.errors[k] if k < len(self.errors) else None
        known = None if error is None else 1.0 - error
        said = KeyframeEvidence(request.stamp, State.AMBIGUOUS, "said", confidence=known)
        leader = None if error is None else pose_from(np.eye(3), [self.metres[k], 0.0, 0.0] - ORIGIN)
        return SearchResult(None, said, leader=leader)


def robot(at, found, errors=(), metres=()):
    return runs.Robot(Told(at, found), Stating(list(errors), list(metres)), ORIGIN)


def drive(truth):
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = 0.4 * np.arange(20)
    cast = []

    def frame(k):
        cast.append(k)
        return np.zeros((k + 1, 3), np.float32)

    return Drive(T, T, AS_MAPPED.poses(T) if truth else None, frame), cast


def test_a_run_ends_at_its_first_fix_and_casts_no_further_frame():
    way, cast = drive(truth=True)
    out = runs.first_fix(robot(5, way.truth[5]), way)
    assert cast == list(range(6))
    assert (out["outcome"], out["frames"], out["metres"]) == ("right", 6, 2.0)
    assert out["risk"] == pytest.approx(5e-5)
    assert runs.first_fix(robot(5, way.truth[15]), way)["outcome"] == "false"
    assert runs.first_fix(robot(5, way.truth[5]), drive(truth=False)[0])["outcome"] == "false"


def test_a_run_without_a_fix_keeps_what_was_said_last():
    out = runs.first_fix(robot(99, None), drive(truth=True)[0])
    assert (out["outcome"], out["state"], out["frames"]) == ("none", "AMBIGUOUS", 20)
    assert "risk" not in out
    assert out["stated"] == {}


def test_first_errors_below_each_limit_are_noted_with_the_place_they_are_of():
    errors, metres = [0.5, 0.05, 0.02, 5e-4, 1e-9], [0.0, 4.0, 0.0, 1.0, 50.0]
    out = runs.first_fix(robot(99, None, errors, metres), drive(truth=True)[0])
    tenth, hundredth, thousandth = (out["stated"][name] for name in ("0.1", "0.01", "0.001"))
    assert tenth == {"error": pytest.approx(0.05), "metres": 0.4, "right": False}  # 4 m off
    assert hundredth == {"error": pytest.approx(5e-4), "metres": 1.2, "right": True}
    assert thousandth == hundredth
    nowhere = runs.first_fix(robot(99, None, errors, metres), drive(truth=False)[0])
    assert [each["right"] for each in nowhere["stated"].values()] == 3 * [False]
    json.dumps(out, allow_nan=False)


def test_watching_the_search_changes_no_fix(world_map, world_drive, world_fixes):
    watched, leaders = runs.Robot.on(world_map, None), []
    for k, (cloud, T) in enumerate(zip(world_drive.clouds, world_drive.T_odom_body, strict=True)):
        fix, leader = watched.step(cloud, T, 0.5 * k)
        assert (fix.state, fix.confidence) == (world_fixes[k].state, world_fixes[k].confidence)
        np.testing.assert_array_equal(fix.T_map_body, world_fixes[k].T_map_body)
        leaders.append(leader)
    assert leaders[0].error == 1.0 - world_fixes[0].confidence
    assert runs.judged(leaders[0].T_map_body, world_drive.T_map_body[0])["error_m"] < 0.2
    assert not any(leaders[1:])  # it was found, nothing is searched for
