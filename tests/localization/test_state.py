"""States of a localizer: the transition table, its page, and DOUBTED and LOST on real frames."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import small_world
from any_risk import NEVER
from small_world import pose_error
from trackers import follow, garbage

from coview_stream.config import AcceptanceConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import TRANSITIONS, Event, State, next_state
from coview_stream.localization.tracking.monitor import RejectionReason

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tracking.md"


def test_every_state_is_reached_from_searching_and_every_event_changes_some_state():
    reached = {State.SEARCHING}
    for _ in State:
        reached |= {next_state(state, event) for state in reached for event in Event}
    assert reached == set(State)
    assert {event for _, event in TRANSITIONS} == set(Event)
    assert not [pair for pair, after in TRANSITIONS.items() if after is pair[0]]  # only changes are listed


def test_tracking_begins_by_an_accepted_place_or_a_doubted_one_that_is_verified():
    begins = {pair for pair, after in TRANSITIONS.items() if after is State.TRACKING}
    searching = {(state, Event.PLACE_ACCEPTED) for state in State if not state.has_place}
    assert begins == searching | {(State.DOUBTED, Event.MATCH_VERIFIED)}
    assert [event for event in Event if next_state(State.LOST, event) is not State.LOST] == [Event.PLACE_ACCEPTED]


def test_doubted_is_reported_as_ambiguous():
    reported = {state: state.reported for state in State}
    assert reported.pop(State.DOUBTED) == "AMBIGUOUS"
    assert reported == {state: state.value for state in State if state is not State.DOUBTED}


def test_docs_have_the_transition_table_and_every_state():
    text = PAGE.read_text(encoding="utf-8")
    (printed,) = re.findall(r"<!-- transitions -->\n(.*?)\n<!-- end -->", text, re.DOTALL)
    rows = ["| state | event | next state |", "|---|---|---|"]
    rows += [f"| {state} | {event.value} | {after} |" for (state, event), after in TRANSITIONS.items()]
    assert printed == "\n".join(rows)
    for state in State:
        assert len(re.findall(rf"^\| {state} \| [^|]+ \| (?:yes|no) \|$", text, re.MULTILINE)) == 1


@pytest.mark.slow
def test_localizer_moves_only_along_the_table(world_map, world_drive):
    """Searched for and found, asked to verify, covered, seeing garbage, lost and found again."""
    localizer, states = Localizer(world_map), [State.SEARCHING]

    def moved():
        """Check that the reported events lead from the state before to the present one."""
        after = states[-1]
        for event in localizer.take_events():
            assert next_state(after, event) is not after
            after = next_state(after, event)
        assert localizer.state is after
        assert localizer.take_events() == ()
        states.append(after)

    def step(k, cloud=None, stamp=None):
        cloud = world_drive.clouds[k] if cloud is None else cloud
        fix = localizer.step(cloud, world_drive.T_odom_body[k], 0.5 * k if stamp is None else stamp)
        assert fix.state is localizer.state
        assert (fix.T_map_body is not None) == (fix.state is State.TRACKING)
        moved()

    usual = localizer.search.config
    localizer.search.config = replace(usual, acceptance=NEVER)
    for k in range(2):
        step(k)
    localizer.search.config = usual
    for k in range(2, 5):
        step(k)
    localizer.require_verification()
    moved()
    step(4, stamp=2.1)
    step(5, garbage(5, 60))
    step(6, garbage(6))
    step(7, garbage(7))  # one frame may be garbage, two lose the place
    for k in (8, 9):
        step(k)
    moves = [(before, after) for before, after in pairwise(states) if after is not before]
    assert list(dict.fromkeys(moves)) == [
        (State.SEARCHING, State.AMBIGUOUS),
        (State.AMBIGUOUS, State.TRACKING),
        (State.TRACKING, State.DOUBTED),
        (State.DOUBTED, State.TRACKING),
        (State.DOUBTED, State.LOST),
        (State.LOST, State.TRACKING),
    ]
    localizer.require_verification()
    localizer.reset()
    assert localizer.state is State.SEARCHING
    assert localizer.take_events() == ()


RULE = AcceptanceConfig()


@pytest.fixture
def tracking(world_map, world_drive):
    """A localizer that tracks, after the drive's first five frames."""
    localizer = Localizer(world_map)
    assert follow(localizer, world_drive, range(5))[-1].state is State.TRACKING
    return localizer


def right(fix, truth, metres=0.08):
    return fix.T_map_body is not None and pose_error(fix.T_map_body, truth)[0] < metres


def carried(drive, frm, to):
    """The drive's odometry after the robot was put from one frame's place to another's: it felt nothing."""
    return drive.seen_from(drive.T_odom_body[frm] @ inverse(drive.T_map_body[to]))


def dusty(drive, k):
    """A frame of which half is dust."""
    some = np.random.default_rng(0).permutation(len(drive.clouds[k]))[: len(drive.clouds[k]) * 6 // 10]
    return np.concatenate([drive.clouds[k][some], garbage()])


def covered(seed):
    """A sack over the sensor: a few returns from within it."""
    return np.random.default_rng(seed).uniform(-0.4, 0.4, (200, 3)).astype(np.float32)


def test_rejected_registration_gives_doubted_state_without_pose(tracking, world_fixes, world_drive):
    assert world_fixes[0].evidence.cause is world_fixes[0].evidence.innovation is None  # as the search's
    (usual,) = follow(tracking, world_drive, [5])
    assert (usual.evidence.cause, usual.evidence.reason) == (RejectionReason.VERIFIED, "verified")
    assert 0.0 < usual.evidence.innovation < RULE.max_innovation
    assert usual.evidence.stamp == 2.5
    assert usual.drift is not None
    assert usual.evidence.confidence > 1.0 - RULE.risk
    doubtful = tracking.step(dusty(world_drive, 6), world_drive.T_odom_body[6], 3.0)
    assert doubtful.state is State.DOUBTED
    assert doubtful.T_map_body is doubtful.T_map_odom is doubtful.covariance is doubtful.drift is None
    assert doubtful.confidence == 0.0
    assert doubtful.evidence.cause in (RejectionReason.GROUND, RejectionReason.FITNESS, RejectionReason.FREE_SPACE)
    assert 0.5 < doubtful.evidence.confidence < 1.0 - RULE.risk
    assert "wrong 1 in " in doubtful.evidence.reason
    (known,) = follow(tracking, world_drive, [7])
    assert known.state is State.TRACKING
    assert right(known, world_drive.T_map_body[7])


@pytest.mark.parametrize("driving", [False, True])
def test_covered_sensor_is_doubted_and_checked_at_each_frame(tracking, world_drive, driving):
    """Uncovered, the pose is back at once, and nothing was lost: the frames before are no evidence of the place."""
    at = [5 + driving * (k // 3) for k in range(6)]
    fixes = [tracking.step(covered(k), world_drive.T_odom_body[n], 3.0 + k) for k, n in enumerate(at)]
    assert [fix.state for fix in fixes] == [State.DOUBTED] * 6
    assert [fix.T_map_body for fix in fixes] == [None] * 6
    assert fixes[0].evidence.cause is RejectionReason.BLIND
    assert fixes[-1].evidence.stamp == 8.0
    (again,) = follow(tracking, world_drive, [at[-1]], 9.0)
    assert again.state is State.TRACKING
    assert right(again, world_drive.T_map_body[at[-1]])


@pytest.mark.slow
def test_restarted_odometry_far_away_is_lost_and_relocalized(tracking, world_drive):
    """A place without a map may lie at the map's edge, but no robot drives 6,000 km between two frames."""
    anew = world_drive.seen_from(pose_from(rot_z(-2.0), [443_000.4, 5_900_000.8, -60.0]))
    tracking.add_frame(anew.clouds[0], anew.T_odom_body[0], 3.0)
    lost = tracking.fix()
    assert lost.evidence.cause is RejectionReason.ODOMETRY
    assert lost.state is State.LOST
    assert lost.T_map_body is None
    again = follow(tracking, anew, range(1, 5), 3.5)
    assert all(fix.T_map_body is None or right(fix, anew.T_map_body[k]) for k, fix in enumerate(again, start=1))
    assert again[-1].state is State.TRACKING


@pytest.mark.slow
@pytest.mark.parametrize("to", [0, 1])
def test_kidnapped_robot_gets_no_wrong_pose(world_map, world_drive, to):
    """Odometry says that it stands; the very first frame of the other place takes the pose away."""
    localizer = Localizer(world_map)
    assert follow(localizer, world_drive, range(9))[-1].state is State.TRACKING
    drive = carried(world_drive, 8, to)
    doubts = []
    localizer.add_frame(drive.clouds[to], drive.T_odom_body[to], 4.1, on_doubt=lambda: doubts.append(localizer.state))
    assert doubts == [State.TRACKING]  # long before it is known where else it is
    stood = [localizer.fix()]
    stood += [localizer.step(drive.clouds[to], drive.T_odom_body[to], 4.1 + 0.1 * k) for k in range(1, 5)]
    went = follow(localizer, drive, range(to + 1, 10), 5.0)
    fixes = stood + went
    truths = [drive.T_map_body[to]] * 5 + drive.T_map_body[to + 1 :]
    assert stood[0].T_map_body is None
    for fix, truth in zip(fixes, truths, strict=True):
        assert fix.T_map_body is None or right(fix, truth)
    lost = [fix for fix in fixes if fix.state is State.LOST]
    assert lost
    assert lost[0].evidence.reason.startswith("more probably elsewhere: ")
    assert lost[0].evidence.confidence < 0.5
    assert lost[0].evidence.cause in (RejectionReason.FITNESS, RejectionReason.FREE_SPACE, RejectionReason.GROUND)
    assert went[-1].state is State.TRACKING


@pytest.mark.slow
def test_kidnapping_with_frozen_odometry_is_detected(tracking, world_drive):
    elsewhere = small_world.scan(small_world.boxes(seed=77), world_drive.T_map_body[3])
    fixes = [tracking.step(elsewhere, world_drive.T_odom_body[4], 2.1 + 0.5 * k) for k in range(22)]
    assert all(fix.T_map_body is None for fix in fixes)
    assert {fix.state for fix in fixes} <= {State.DOUBTED, State.LOST}
    assert fixes[0].state is State.DOUBTED
    assert fixes[11].state is State.LOST  # after five seconds


@pytest.mark.slow
@pytest.mark.parametrize("begin", [12, 20])
def test_frozen_odometry_while_moving_gives_no_wrong_pose(world_map, slow_drive, begin):
    """A ferry, a lift truck, ice: 0.2 m at every frame, of which odometry feels nothing."""
    localizer = Localizer(world_map)
    clouds, truth = slow_drive.clouds, slow_drive.T_map_body
    known = [localizer.step(clouds[k], slow_drive.T_odom_body[k], 0.1 * k) for k in range(begin)]
    while known[-1].state is not State.TRACKING:
        begin += 1
        known.append(localizer.step(clouds[begin - 1], slow_drive.T_odom_body[begin - 1], 0.1 * begin))
    fixes = [
        localizer.step(clouds[k], slow_drive.T_odom_body[begin - 1], 0.1 * k + 0.1) for k in range(begin, len(clouds))
    ]
    assert len(fixes) > 8
    for fix, T in zip(fixes, truth[begin:], strict=True):
        assert fix.T_map_body is None or pose_error(fix.T_map_body, T)[0] < 0.3
    assert any(fix.evidence.cause is RejectionReason.ODOMETRY for fix in fixes)
    # it is set down: the lidar has followed it all the way
    still = localizer.step(clouds[-1], slow_drive.T_odom_body[begin - 1], 0.1 * len(clouds) + 0.1)
    assert still.state is State.TRACKING
    assert right(still, truth[-1], 0.05)


@pytest.mark.slow
def test_covered_sensor_is_doubted_then_lost_then_relocalized(tracking, world_drive):
    """As soon as any place could be: the first keyframe that sees anything counts already."""
    seconds = np.arange(2.5, 2.5 + RULE.max_blind_s + 2.0, 1.0)
    fixes = [tracking.step(covered(k), world_drive.T_odom_body[5], t) for k, t in enumerate(seconds)]
    assert all(fix.T_map_body is None for fix in fixes)
    assert fixes[0].evidence.cause is RejectionReason.BLIND
    blind = [fix for fix in fixes if fix.stamp < 2.5 + RULE.max_blind_s]
    assert {fix.state for fix in blind} == {State.DOUBTED}
    assert fixes[-1].state is State.LOST
    again = follow(tracking, world_drive, range(6, 10), 100.0)
    posed = [k for k, fix in enumerate(again) if fix.T_map_body is not None]
    assert posed[0] < 3
    for k in posed:
        assert right(again[k], world_drive.T_map_body[6 + k])


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [2.0, 40.0])
def test_after_a_cover_the_pose_returns_with_the_first_frame_that_is_certain(world_map, world_drive, seconds):
    """Meanwhile it may have been carried, and after a long cover one that fits only in part is not certain."""
    for dust in (False, True):
        localizer = Localizer(world_map)
        follow(localizer, world_drive, range(5))
        for t in np.arange(2.5, 2.5 + seconds, 0.5):
            assert localizer.step(covered(1), world_drive.T_odom_body[5], t).T_map_body is None
        if dust:
            first = localizer.step(dusty(world_drive, 5), world_drive.T_odom_body[5], 2.5 + seconds)
            assert first.T_map_body is None
        after = follow(localizer, world_drive, range(5, 8), 0.5 + seconds)
        posed = [
            right(fix, world_drive.T_map_body[k]) for k, fix in enumerate(after, start=5) if fix.T_map_body is not None
        ]
        assert all(posed)
        assert len(posed) == len(after) or dust


@pytest.mark.slow
def test_leaving_the_map_ends_poses_and_returning_restores_them(world_map, scene):
    """Straight over the edge and back again; no pose is wrong, and none is given 10 m after the map was last seen."""
    way = [pose_from(np.eye(3), [x, -4.0, small_world.SENSOR_HEIGHT]) for x in (-14.0, 110.0)]
    out = small_world.record_along(scene, way, 2.6)
    localizer, fixes = Localizer(world_map), []
    frames = [*range(len(out.clouds)), *reversed(range(len(out.clouds)))]
    for n, k in enumerate(frames):
        fixes.append(localizer.step(out.clouds[k], out.T_odom_body[k], 0.5 * n))
    for fix, k in zip(fixes, frames, strict=True):
        assert fix.T_map_body is None or right(fix, out.T_map_body[k], 0.15)
        # the map's edge is seen from 45 m
        if out.T_map_body[k][0, 3] > small_world.HALF + 45.0 + 10.0:
            assert fix.T_map_body is None
    assert any(fix.evidence.cause is RejectionReason.OFF_MAP for fix in fixes)
    assert any(fix.state is State.LOST for fix in fixes)
    assert fixes[-1].state is State.TRACKING


@pytest.mark.slow
@pytest.mark.parametrize("seen", ["the place", "dust", "garbage"])
def test_first_frame_after_pause_decides_the_state(tracking, world_drive, seen):
    """Frames from before the pause are no doubt that has lasted: one good frame is enough."""
    cloud = {"the place": world_drive.clouds[5], "dust": dusty(world_drive, 5), "garbage": garbage()}[seen]
    tracking.require_verification()
    fix = tracking.step(cloud, world_drive.T_odom_body[5], 60.0)
    assert fix.state is fix.evidence.state is (State.TRACKING if seen == "the place" else State.DOUBTED)
    assert fix.evidence.cause is not None


@pytest.mark.slow
def test_robot_moved_during_odometry_pause_gets_no_wrong_pose(tracking, world_drive):
    """Odometry paused, the robot was moved by hand 10 m back, and odometry goes on where it was."""
    follow(tracking, world_drive, [5])
    tracking.require_verification()
    moved = carried(world_drive, 5, 0)
    fixes = follow(tracking, moved, range(4), 2.6)
    assert fixes[0].T_map_body is None
    assert all(fix.T_map_body is None or right(fix, moved.T_map_body[k]) for k, fix in enumerate(fixes))
