"""The localizer on a small world: correct poses, none where it cannot know, refusals with a remedy."""

import copy
import inspect
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import small_world
from small_world import assert_pose, pose_error
from trackers import assert_usual, follow, garbage

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import AcceptanceConfig
from coview_stream.errors import CloudError, ConfigError, InputError, MapError, RunError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.frame import StepCheck
from coview_stream.localization.localizer import JUMPED, Localizer
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.state import Event, State
from coview_stream.localization.tracking.shared_error import FLOOR

UTM = np.array([512_345.6, 5_403_210.9, 287.4])


def test_first_fix_and_later_poses_are_correct(world_fixes, world_drive):
    posed = [k for k, fix in enumerate(world_fixes) if fix.T_map_body is not None]
    assert posed
    assert posed[0] <= 5  # 12 m
    assert posed == list(range(posed[0], len(world_fixes)))
    for k in posed:
        assert_pose(world_fixes[k].T_map_body, world_drive.T_map_body[k], 0.08, 0.3)


def test_no_pose_unless_tracking(world_map, world_fixes, elsewhere):
    outside = follow(Localizer(world_map), elsewhere)
    assert not any(fix.state is State.TRACKING for fix in outside)
    for fix in (*world_fixes, *outside):
        known = fix.state is State.TRACKING
        assert (fix.T_map_body is not None) == (fix.T_map_odom is not None) == (fix.covariance is not None) == known
        assert known or fix.state in (State.SEARCHING, State.AMBIGUOUS)
        assert known or fix.confidence == 0.0
        assert fix.evidence is not None


def test_covariance_is_symmetric_positive_and_translation_first(world_fixes):
    covariance = world_fixes[-1].covariance
    assert covariance.shape == (6, 6)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0
    sigma = np.sqrt(np.diag(covariance))
    # metres come first: millimetres to decimetres; then radians: tenths of a degree; map points lie off their surfaces
    assert (sigma[:3] > FLOOR[3:]).all()
    assert (sigma[:3] < 0.3).all()
    assert (sigma[3:] < np.radians(1.0)).all()
    assert (sigma[3:] > FLOOR[:3]).all()


def test_confidence_is_the_probability_that_the_search_found(world_fixes):
    posed = [fix for fix in world_fixes if fix.T_map_body is not None]
    assert posed[0].confidence == posed[0].evidence.confidence
    assert {fix.confidence for fix in posed} == {posed[0].confidence}  # tracking goes on from that place
    assert posed[0].confidence > 1.0 - AcceptanceConfig().risk


@pytest.mark.slow
def test_utm_map_and_utm_odometry_keep_millimetres(world_map, world_drive, world_fixes):
    odometry = small_world.pose_from(small_world.ODOM_FAR[:3, :3], [443_000.4, 5_900_000.8, -60.0])
    far = world_drive.seen_from(odometry)
    moved_map = BaseMap({**world_map.arrays, "origin": UTM + world_map.origin}, world_map.parameters)
    fixes = follow(Localizer(moved_map), far, 8)
    posed = 0
    for here, there, T_odom_body in zip(world_fixes, fixes, far.T_odom_body, strict=False):
        assert there.state is here.state
        if here.T_map_body is not None:
            posed += 1
            np.testing.assert_allclose(there.T_map_body[:3, 3] - UTM, here.T_map_body[:3, 3], atol=1e-3)
            np.testing.assert_allclose(there.T_map_body[:3, :3], here.T_map_body[:3, :3], atol=1e-4)
            np.testing.assert_allclose(there.T_map_odom @ T_odom_body, there.T_map_body, atol=1e-3)
    assert posed >= 2


def test_invalid_frames_raise_and_change_nothing(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    cloud, T = world_drive.clouds[0], world_drive.T_odom_body[0]
    bad = [
        (cloud[:, :2], T, 0.0, CloudError),
        (cloud[:9], T, 0.0, CloudError),
        (np.full((50, 3), np.nan, np.float32), T, 0.0, CloudError),
        (np.empty((0, 3), np.float32), T, 0.0, CloudError),
        (cloud, T @ np.diag([1.1, 1.1, 1.1, 1.0]), 0.0, RunError),
        (cloud, T @ np.diag([1.0, -1.0, 1.0, 1.0]), 0.0, RunError),
        (cloud, pose_from(T[:3, :3], [np.nan, 0.0, 0.0]), 0.0, RunError),
        (cloud, T[:3], 0.0, RunError),
        (cloud, T, float("nan"), RunError),
    ]
    fixes = []
    for k in range(5):
        for points, pose, stamp, error in bad:
            with pytest.raises(error):
                localizer.step(points, pose, stamp)
        fixes.append(localizer.step(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k))
    assert_usual(fixes, world_fixes, 1e-9)


def test_nan_rows_are_dropped(world_map, world_drive):
    cloud = np.full((len(world_drive.clouds[0]) + 500, 3), np.nan, np.float32)
    cloud[250:-250] = world_drive.clouds[0]
    one, other = Localizer(world_map), Localizer(world_map)
    with_nan = one.step(cloud, world_drive.T_odom_body[0], 0.0)
    without = other.step(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0)
    assert with_nan.evidence.score == pytest.approx(without.evidence.score)


@pytest.mark.slow
@pytest.mark.parametrize("how", [Localizer.reset, Localizer.relocalize])
def test_reset_and_relocalize_search_again_and_find(world_map, world_drive, world_fixes, how):
    localizer = Localizer(world_map)
    follow(localizer, world_drive, 6)
    assert localizer.search.last_query
    how(localizer, 1)
    assert localizer.state is State.SEARCHING
    assert not localizer.search.last_query
    # another odometry frame must not matter: the old one is forgotten
    T_other = pose_from(rot_z(-0.4), [1e5, -2e5, 3.0])
    again = follow(localizer, world_drive.seen_from(T_other), 6, 100.0)
    assert [fix.state for fix in again] == [fix.state for fix in world_fixes[:6]]
    assert_pose(again[-1].T_map_body, world_drive.T_map_body[5], 0.08, 0.3)


def test_after_an_interrupted_step_the_place_is_searched_anew(world_map, world_drive, world_fixes):
    class Interrupted(Localizer):
        def apply_search_result(self, result):
            super().apply_search_result(result)
            raise KeyboardInterrupt

    localizer = Interrupted(world_map)
    with pytest.raises(KeyboardInterrupt):
        follow(localizer, world_drive)
    assert localizer.fix().stamp == 0.0  # its state may be saved
    localizer.__class__ = Localizer
    with pytest.raises(CloudError):
        localizer.step(np.zeros((3, 3), np.float32), world_drive.T_odom_body[0], 99.0)
    assert_usual(follow(localizer, world_drive, 6, 100.0), world_fixes[:6], 0.02)


@pytest.fixture(scope="module")
def results(world_map, world_drive):
    """Results of the drive's searches, up to the one that accepts a place; good for every fresh localizer."""
    localizer, results = Localizer(world_map), []
    for k, (cloud, T) in enumerate(zip(world_drive.clouds, world_drive.T_odom_body, strict=True)):
        results.append(localizer.search.update(localizer.add_frame(cloud, T, 0.5 * k)))
        if results[-1].accepted is not None:
            return results
        localizer.apply_search_result(results[-1])
    raise AssertionError("no place was accepted")


def searched(world_map, drive, results):
    """A localizer that has every frame up to the decisive one; its result is not applied yet."""
    localizer = Localizer(world_map)
    for k, result in enumerate(results):
        localizer.add_frame(drive.clouds[k], drive.T_odom_body[k], 0.5 * k)
        if result.accepted is None:
            localizer.apply_search_result(result)
    return localizer, results[-1], len(results) - 1


def test_add_frame_and_apply_search_result_equal_step(world_map, world_drive, world_fixes, results):
    localizer = Localizer(world_map)
    for k, reference in enumerate(world_fixes[:7]):
        request = localizer.add_frame(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
        assert (request is not None) == (k < len(results))  # tracking asks for nothing
        if request is not None:
            localizer.apply_search_result(results[k])
        fix = localizer.fix()
        assert fix.state is reference.state
        assert fix.evidence == reference.evidence
        if reference.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_body, reference.T_map_body, atol=1e-9)
            np.testing.assert_allclose(fix.covariance, reference.covariance, atol=1e-12)


def test_fix_before_first_frame_raises(world_map):
    with pytest.raises(RuntimeError, match="no frame"):
        Localizer(world_map).fix()


@pytest.mark.parametrize("since", ["reset", "loss", "acceptance"])
def test_search_result_from_before_a_change_is_ignored(world_map, world_drive, results, since):
    localizer, result, k = searched(world_map, world_drive, results)
    if since == "reset":
        localizer.reset()
        localizer.apply_search_result(result)  # before any frame
        localizer.add_frame(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
    else:
        localizer.apply_search_result(result)
    for n in range(1, 4) if since == "loss" else ():
        localizer.add_frame(garbage(n), world_drive.T_odom_body[k + n], 0.5 * (k + n))
    before = localizer.fix()
    assert before.state is {"reset": State.SEARCHING, "loss": State.LOST, "acceptance": State.TRACKING}[since]
    localizer.apply_search_result(result)
    assert localizer.fix().to_json() == before.to_json()


def test_late_search_result_gives_the_current_pose(world_map, world_drive, results):
    localizer, result, k = searched(world_map, world_drive, results)
    for n in (k + 1, k + 2):
        localizer.add_frame(world_drive.clouds[n], world_drive.T_odom_body[n], 0.5 * n)
    assert localizer.fix().T_map_body is None
    localizer.apply_search_result(result)
    fix = localizer.fix()
    assert fix.state is State.TRACKING
    assert_pose(fix.T_map_body, world_drive.T_map_body[k + 2], 0.08, 0.3)


def test_late_search_result_not_fitting_newest_frame_gives_no_pose(world_map, world_drive, results):
    localizer, result, k = searched(world_map, world_drive, results)
    T_odom_body = world_drive.T_odom_body[k].copy()
    T_odom_body[:2, 3] += 0.65  # too little for a keyframe, whose motion would be measured
    for n in (k + 1, k + 2):
        localizer.add_frame(garbage(n), T_odom_body, 0.5 * n)
    localizer.apply_search_result(result)
    fix = localizer.fix()
    assert fix.state is State.DOUBTED
    assert fix.T_map_body is None
    # and what follows decides
    localizer.add_frame(world_drive.clouds[k + 3], world_drive.T_odom_body[k + 3], 0.5 * (k + 3))
    assert localizer.fix().state is State.TRACKING


@pytest.mark.parametrize("metres", [60.0, 400.0])
def test_place_is_given_up_where_odometry_jumps_and_found_again(world_map, world_drive, world_fixes, metres):
    localizer, at = Localizer(world_map), 6
    jumped = pose_from(rot_z(1.0), [metres, 5.0, 0.0])
    for k, (cloud, T, usual) in enumerate(zip(world_drive.clouds, world_drive.T_odom_body, world_fixes, strict=False)):
        fix = localizer.step(cloud, T if k < at else jumped @ T, 0.5 * k)
        given_up = Event.PLACE_GIVEN_UP in localizer.take_events()
        assert given_up == (k == at)
        if fix.T_map_body is not None:
            assert_pose(fix.T_map_body, world_drive.T_map_body[k], 0.08, 0.3)
        assert k >= at or fix.state is usual.state
    assert fix.state is State.TRACKING


def test_jump_is_the_reason_until_a_search_ends(world_map, world_drive):
    localizer = Localizer(world_map)
    for k in range(6):
        localizer.step(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k)
    far = pose_from(np.eye(3), [100.0, 0.0, 0.0])
    for k, odom_odom in ((6, far), (7, far @ far)):
        request = localizer.add_frame(world_drive.clouds[k], odom_odom @ world_drive.T_odom_body[k], 0.5 * k)
        fix = localizer.fix()
        assert (fix.state, fix.T_map_body, fix.evidence.reason) == (State.LOST, None, JUMPED)
        assert any(pose_error(T @ request.T_odom_body, world_drive.T_map_body[6])[0] < 3.0 for T in request.hints)


def test_robot_that_really_moved_with_odometry_is_found_where_it_is(world_map, world_drive):
    localizer = Localizer(world_map)
    for k, stamp in ((0, 0.0), (1, 0.5), (2, 1.0), (9, 1.02)):  # 17 m in 0.02 s
        fix = localizer.step(world_drive.clouds[k], world_drive.T_odom_body[k], stamp)
    assert Event.PLACE_GIVEN_UP in localizer.take_events()
    assert_pose(fix.T_map_body, world_drive.T_map_body[9], 0.08, 0.3)


@pytest.mark.parametrize(
    ("steps", "jumps"),
    [
        ([1, 1, 40, -40, 1], [2, 3]),  # one wrong sample
        ([10] * 6, []),  # frames without stamps
        ([0, 10] * 6, [1, 3]),  # from place to place, without stamps
        ([6, 0, 6, 0, 9, 0], []),
        ([0.1, 0.9, 0.9], []),
    ],
)
def test_steps_that_no_robot_drives_are_jumps(steps, jumps):
    check, places = StepCheck(), np.cumsum([0.0, *steps])
    found = [check.add(pose_from(np.eye(3), [x, 0.0, 0.0]), 0.1 * k) for k, x in enumerate(places)]
    assert np.flatnonzero(found[1:]).tolist() == jumps


def test_steps_of_frames_without_stamps_are_no_jumps(world_map, world_drive):
    localizer = Localizer(world_map)
    for k, (cloud, T) in enumerate(zip(world_drive.clouds, world_drive.T_odom_body, strict=False)):
        fix = localizer.step(cloud, T, 0.02 * k)  # 2.4 m, which would be 120 m/s
        assert Event.PLACE_GIVEN_UP not in localizer.take_events()
    assert fix.state is State.TRACKING


@pytest.mark.parametrize("before", [True, False], ids=["result first", "verification first"])
def test_require_verification_withholds_pose_until_verified(world_map, world_drive, results, before):
    localizer, result, k = searched(world_map, world_drive, results)
    if before:
        localizer.apply_search_result(result)
        assert localizer.fix().state is State.TRACKING
    localizer.require_verification()
    if not before:
        localizer.apply_search_result(result)
    assert localizer.state is localizer.fix().state is State.DOUBTED
    assert localizer.fix().T_map_body is None
    # the robot stands still: nothing is due, and yet it is verified
    fix = localizer.step(world_drive.clouds[k], world_drive.T_odom_body[k], 0.5 * k + 0.1)
    assert fix.state is State.TRACKING
    assert fix.evidence.stamp == 0.5 * k + 0.1
    assert pose_error(fix.T_map_body, world_drive.T_map_body[k])[0] < 0.08


@pytest.mark.slow
def test_body_on_the_ground_is_localized_as_its_sensor_is(world_map, world_drive, world_fixes):
    """The same clouds and drive, told of a body whose origin is the ground below the sensor."""
    down = pose_from(np.eye(3), [0.0, 0.0, -1.7])
    localizer, lifted = Localizer(world_map), np.float32([0.0, 0.0, 1.7])
    for k in range(6):
        fix = localizer.step(world_drive.clouds[k] + lifted, world_drive.T_odom_body[k] @ down, 0.5 * k)
    assert fix.state is State.TRACKING
    assert pose_error(fix.T_map_body, world_drive.T_map_body[5] @ down)[0] < 0.08


def test_frame_is_copied_and_left_as_it_is(world_map, world_drive, results):
    """A driver may reuse its array for the next frame; a search result applied later still registers this one."""
    localizer = Localizer(world_map)
    for k, result in enumerate(results):
        array, T = world_drive.clouds[k].copy(), world_drive.T_odom_body[k].copy()
        localizer.add_frame(array, T, 0.5 * k)
        np.testing.assert_array_equal(array, world_drive.clouds[k])
        np.testing.assert_array_equal(T, world_drive.T_odom_body[k])
        array[:] = 0.0
        localizer.apply_search_result(result)
    assert pose_error(localizer.fix().T_map_body, world_drive.T_map_body[k])[0] < 0.08


@pytest.mark.slow
def test_standing_robot_keeps_tracking_without_shrinking_covariance(world_map, world_drive):
    localizer = Localizer(world_map)
    assert follow(localizer, world_drive, 6)[-1].state is State.TRACKING
    frame = world_drive.clouds[5], world_drive.T_odom_body[5]
    fixes = [localizer.step(*frame, 3.0 + 0.1 * k) for k in range(200)]
    assert all(fix.state is State.TRACKING for fix in fixes)
    small_world.assert_pose(fixes[-1].T_map_body, world_drive.T_map_body[5], 0.05, 0.3)
    early, late = (np.sqrt(np.diag(fixes[k].covariance))[:2].max() for k in (20, -1))
    assert late > 0.8 * early


def test_localizer_of_a_path_loads_the_map(world_file):
    assert Localizer(str(world_file)).base_map.sha256 == Localizer(world_file).base_map.sha256 != ""
    with pytest.raises(MapError, match=r"nowhere\.coview"):
        Localizer("nowhere.coview")


def test_config_or_map_of_another_type_is_refused_with_its_remedy(world_map):
    for config in ({}, {"reloc": "coview"}, "coview"):
        with pytest.raises(ConfigError, match=r"give a LocalizerConfig, such as LocalizerConfig\(reloc='coview'\)"):
            Localizer(world_map, config)
    with pytest.raises(InputError, match=r"base_map is a ndarray; give a BaseMap or the path of a \.coview file"):
        Localizer(np.zeros((9, 3)))


def test_intensities_do_not_change_a_fix(world_map, world_drive, world_fixes):
    localizer = Localizer(world_map)
    for k, known in enumerate(world_fixes[:3]):
        cloud = world_drive.clouds[k]
        rows = np.column_stack([cloud, np.arange(len(cloud))])
        fix = localizer.step(rows, world_drive.T_odom_body[k], known.stamp)
        assert fix.to_json() == known.to_json()
    with pytest.raises(CloudError, match=r"give cloud\[:, :3\]"):
        localizer.step(np.zeros((99, 6)), np.eye(4), 99.0)


def test_localizer_says_its_state_and_map(world_map, world_drive):
    localizer = Localizer(world_map)
    assert repr(localizer).startswith("Localizer(SEARCHING, no frame yet, on BaseMap(")
    localizer.step(world_drive.clouds[0], world_drive.T_odom_body[0], 12.0)
    assert "frame of 12.000 s" in repr(localizer)


@pytest.mark.parametrize("take", [pickle.dumps, copy.copy, copy.deepcopy])
def test_localizer_cannot_be_copied_and_says_what_to_do(world_map, take):
    with pytest.raises(TypeError, match=r"make one in each process, Localizer\(base_map\)"):
        take(Localizer(world_map))


PAGE = Path(__file__).resolve().parents[2] / "docs" / "method.md"
MAX_LINES = 40
STEPS = {
    Localizer.step: ["predict", "search", "match to map", "verify", "update"],
    GlobalSearch.update: ["vote", "propose", "score", "register", "decide"],
}


@pytest.mark.parametrize("function", STEPS, ids=lambda function: function.__qualname__)
def test_algorithm_fits_on_one_screen(function):
    lines, docstring = (text.count("\n") for text in (inspect.getsource(function), function.__doc__))
    assert lines - docstring <= MAX_LINES


def test_headings_of_the_method_page_are_in_the_order_of_the_steps():
    for function, steps in STEPS.items():
        for step in steps:
            assert re.search(rf"\b_?{step.replace(' ', '_')}\b", inspect.getsource(function)), step
    text = PAGE.read_text(encoding="utf-8")
    headings = [heading.strip().lower() for heading in re.findall(r"^##+ ([^(\n]+)", text, re.MULTILINE)]
    first = headings.index("predict")
    assert headings[first : first + 11] == [
        "predict", "search", "vote", "propose", "score", "register", "verify", "decide",
        "match to map", "verify", "update",
    ]  # fmt: skip
