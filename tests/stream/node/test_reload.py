"""Change of the map under a running node: no pose is lost, a map that cannot be used changes nothing."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fake_node import STEP, Engine, Runner, Site
from fake_robot import KEYS, T_MAP_ODOM, Robot, pose, tracking, unknown
from sockets import until

from coview_stream.errors import MapError
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.search.hints import PlaceGuess
from coview_stream.stream.node.engine_process import CancelledError, DiedError
from coview_stream.stream.node.node import OpenedMap
from coview_stream.stream.node.session import Session

OTHER = "b" * 64


class Change:
    """A running node whose robots have places, and another map that is opened for it."""

    def __init__(self, *names, max_handover=60.0, step=0):
        self.engine = Engine()
        self.runners = Runner(self.engine), Runner(self.engine)
        self.error, self.open_as = None, None
        self.notices = []
        self.site = Site(*names, open_map=self.open, on_reload=self.notices.append)
        self.keys = self.site.keys.values()
        self.reloader = self.site.node.reloader
        self.reloader.max_handover = max_handover
        self.site.node.start()
        self.step = step

    def open(self, served, cancelled):
        if self.error is not None:
            raise self.error
        if self.open_as is not None:
            return self.open_as()
        sessions = [Session(keys, OTHER, self.site.node.config) for keys in self.keys]
        return OpenedMap(OTHER, dict(zip(("track", "search"), self.runners, strict=True)), sessions)

    def drive(self):
        """A frame of each robot, and a moment for the engines."""
        self.step += 1
        for name in self.site.keys:
            self.site.sees(name, STEP * self.step)
        time.sleep(0.005)

    def drive_until(self, condition, seconds=20.0):
        until(lambda: self.drive() or condition(), seconds)

    def states(self):
        return [session.state()[0].reported for session in self.site.node.sessions]

    def maps(self):
        return [session.map_sha256 for session in self.site.node.sessions]


@pytest.fixture
def changes():
    made = []

    def make(*names, **more):
        made.append(change := Change(*names, **more))
        change.drive_until(lambda: change.states() == ["TRACKING"] * len(names))
        return change

    yield make
    for change in made:
        change.site.node.close(5.0)


def test_robots_keep_the_old_map_until_the_new_one_has_verified_their_place(changes):
    change = changes("r1", "r2")
    old = change.maps()[0]
    before = change.site.node.sessions[0]
    change.engine.answer = unknown  # the new map does not know them yet
    assert change.site.node.reload()["ok"]
    change.drive_until(lambda: len(change.engine.served) > 6)
    assert change.maps() == [old, old]
    assert change.states() == ["TRACKING"] * 2
    counted = before.counters.received
    change.engine.answer = Engine().answer
    change.drive_until(lambda: change.maps() == [OTHER, OTHER])
    assert change.states() == ["TRACKING"] * 2
    change.drive_until(lambda: change.reloader.last["result"] == "changed")
    assert change.notices == [True, False]
    assert change.site.track.closed == 1
    after = change.site.node.sessions[0]
    assert after.counters.received > counted
    assert [t["to"] for t in after.history.to_json()] == ["TRACKING"]  # nothing was lost meanwhile
    poses = change.site.poses("r1")
    stamps = [p.stamp_ns for p in poses]
    assert stamps == sorted(stamps)
    of = {}
    for message in poses:
        of.setdefault(message.stamp_ns, []).append(message.map_sha256)
    assert all(len(set(shas)) == 1 for shas in of.values())
    assert [p.map_sha256 for p in poses] == sorted((p.map_sha256 for p in poses), reverse=old > OTHER)


@pytest.mark.slow
def test_flood_of_reloads_opens_the_map_once_a_second_and_is_one_line(changes, caplog):
    change = changes("r1")
    opened = []
    change.open_as = lambda: opened.append(1)
    begin = time.monotonic()
    with caplog.at_level("INFO"):
        while time.monotonic() < begin + 0.3:
            assert change.site.node.reload()["ok"]
            time.sleep(0.001)
        until(lambda: change.reloader.last["result"] == "unchanged")
        assert 1 <= len(opened) <= 1.0 + (time.monotonic() - begin)
        until(lambda: len(opened) > 1)  # that was asked for last is done
        until(lambda: change.reloader.outcome == "unchanged")
    assert sum("loaded again" in record.getMessage() for record in caplog.records) == 1


def test_place_on_the_old_map_is_a_hypothesis_on_the_new_one(changes):
    change = changes("r1")
    hints = []

    def answer(job):
        hints.append(job.hint)
        return unknown(job)

    change.engine.answer = answer
    change.site.node.reload()
    change.drive_until(lambda: len(hints) > 3)
    assert hints[0] is not None
    assert np.isfinite(hints[0]).all()
    assert hints[1] is None  # told once


@pytest.mark.slow
def test_robot_that_begins_anew_after_a_change_that_it_slept_through_has_poses_again(changes):
    change = changes("r1", max_handover=0.1, step=5000)
    change.site.node.reload()
    until(lambda: change.reloader.last["result"] == "changed")
    session = change.site.node.sessions[0]
    assert "could be read" not in session.state()[1]
    change.step, last = 0, change.site.poses("r1")[-1].stamp_ns
    change.drive_until(lambda: change.site.poses("r1")[-1].stamp_ns < last)
    assert session.counters.clock_restarts == 1


def test_robot_that_the_new_map_does_not_know_is_searched_for_after_a_while(changes):
    change = changes("r1", max_handover=0.3)
    change.engine.answer = unknown
    change.site.node.reload()
    change.drive_until(lambda: change.reloader.last["result"] == "changed")
    assert change.maps() == [OTHER]
    assert change.states() != ["TRACKING"]


@pytest.mark.slow
@pytest.mark.parametrize("error", [MapError("it is damaged"), DiedError("it is damaged"), ValueError("it is damaged")])
def test_map_that_cannot_be_used_changes_nothing(changes, error, caplog):
    change = changes("r1")
    old = change.maps()
    change.error = error
    change.site.node.reload()
    change.drive_until(lambda: change.reloader.last["result"] == "refused")
    assert "it is damaged" in change.reloader.last["error"]
    change.drive_until(lambda: "going on with the one before" in caplog.text)
    assert (change.maps(), change.states()) == (old, ["TRACKING"])
    change.error = None
    change.site.node.reload()  # and the next one is welcome
    change.drive_until(lambda: change.maps() == [OTHER])


def test_node_that_ends_during_a_change_ends(changes):
    change = changes("r1")
    change.engine.answer = unknown
    change.site.node.reload()
    change.drive_until(lambda: change.engine.served)
    assert change.site.node.close(5.0)
    assert [runner.closed for runner in change.runners] == [1, 1]
    until(lambda: "coview-reload" not in [t.name for t in threading.enumerate()])


def test_cancelled_opening_is_no_error(changes, caplog):
    change = changes("r1")
    change.error = CancelledError("the node ends")
    change.site.node.reload()
    until(lambda: change.notices == [True, False])
    assert "refused" not in caplog.text


def test_change_that_fails_before_the_hand_over_leaves_no_engines(changes):
    change = changes("r1")
    change.keys = ()  # a map without a session for each robot
    change.reloader.request()
    until(lambda: change.reloader.last["result"] == "failed", 10.0)
    assert all(runner.closed == 1 for runner in change.runners)
    assert len(change.site.node.feeds) == 1


def on_other_map(old=None):
    """A robot's session on another map, which begins with the place on the first one."""
    robot = Robot()
    robot.session = Session(KEYS, OTHER)
    if old is not None:
        robot.session.begin_beside(old.session)
    return robot


def test_calibration_goes_to_the_new_map_without_the_ground_of_the_old_survey():
    calibration = Calibration(roll=0.02, scale=0.01, ground=0.4)

    def calibrated(job):
        result = tracking(job)
        return replace(result, fix=replace(result.fix, calibration=calibration))

    old = Robot().localized(0.0, answer=calibrated)
    job = on_other_map(old).frame(0.1)
    assert job.hint is not None
    assert job.calibration == replace(calibration, ground=0.0)


def test_guess_goes_to_the_new_map_without_its_circle():
    old = Robot()
    assert old.session.guess_place(PlaceGuess(1.0, 2.0, within=300.0))
    assert on_other_map(old).frame(0.1).guess == PlaceGuess(1.0, 2.0)


def test_no_pose_after_the_switch_is_older_than_the_last_or_a_second_one_of_its_stamp():
    old, new = Robot().localized(0.0), on_other_map().localized(0.0, T_map_odom=pose(7.0) @ T_MAP_ODOM)
    old.moved(0.1)
    last = old.session.pose()
    new.session.continue_from(old.session)
    assert new.session.pose() is None
    new.moved(0.1)
    again = new.session.pose()
    assert again.stamp_ns == last.stamp_ns
    np.testing.assert_array_equal(again.T_map_body, last.T_map_body)
    new.moved(0.2)
    following = new.session.pose()
    assert following.map_sha256 == OTHER
    np.testing.assert_allclose(following.T_map_body, pose(7.0) @ T_MAP_ODOM @ pose(0.4), atol=1e-9)
