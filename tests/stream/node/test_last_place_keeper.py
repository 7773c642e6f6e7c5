"""Places that a node keeps between two starts: saved, handed over, forgotten; a bad disk is only a warning."""

import logging
import shutil
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fake_node import STEP, Site, declared
from fake_robot import SHA, T_MAP_ODOM, Robot, ns, pose, tracking, unknown
from sockets import until

from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.state import State
from coview_stream.stream.node.engine_queue import FrameJob
from coview_stream.stream.node.engines import TrackEngine
from coview_stream.stream.node.last_place import LastPlace, load, save
from coview_stream.stream.node.last_place_keeper import LastPlaceKeeper

BEFORE = pose_from(rot_z(1.0), [30.0, 40.0, 1.5])


@pytest.fixture
def robot():
    made = Robot()
    made.moved(0.0)
    return made


def jobs_of(robot, count=3, answer=unknown, begin=0.1):
    """Hints that the next frames take to the engine."""
    return [robot.frame(begin + 0.1 * k, answer).hint for k in range(count)]


def test_pose_hint_goes_with_one_frame_and_so_does_its_calibration(robot):
    known = Calibration(pitch=0.05)
    robot.session.offer(LastPlace(SHA, 5, BEFORE, calibration=known))
    jobs = [robot.frame(0.1 + 0.1 * k, unknown) for k in range(3)]
    assert [job.hint for job in jobs] == [BEFORE, None, None]
    assert [job.calibration for job in jobs] == [known, None, None]
    robot.session.restart_search("asked to search again", forget=True)
    assert robot.frame(0.5, unknown).calibration is None


def test_calibration_of_a_robot_without_a_place_is_reported_but_not_saved(robot, tmp_path):
    """A robot that searches estimates its corrections again; only an accepted place confirms them."""
    known, relearnt = Calibration(pitch=0.05), Calibration(pitch=-0.03)

    def calibrated(result, calibration):
        return replace(result, fix=replace(result.fix, calibration=calibration))

    robot.frame(0.1, lambda job: calibrated(tracking(job), known))
    keeper = LastPlaceKeeper(tmp_path, [robot.session])
    keeper.keep()
    robot.frame(0.2, lambda job: calibrated(unknown(job, State.LOST), relearnt))
    assert robot.session.robot_state.calibration == relearnt
    keeper.keep()
    assert load(tmp_path, robot.session.keys.robot, SHA).calibration == known
    later = Robot()
    LastPlaceKeeper(tmp_path, [later.session]).hint()
    later.moved(0.0)
    assert later.frame(0.1, unknown).calibration == known
    robot.session.reset()
    assert robot.session.robot_state.calibration is None


@pytest.mark.parametrize(("rejected", "hint"), [(True, BEFORE), (False, None)])
def test_pose_hint_is_kept_when_frame_is_rejected_and_dropped_when_engine_fails(robot, rejected, hint):
    robot.session.offer(LastPlace(SHA, 5, BEFORE))
    robot.saw(0.0)
    robot.moved(0.05)
    robot.session.handle_failure(robot.session.take_job("track"), "boom", rejected=rejected)
    assert jobs_of(robot) == [hint, None, None]


def test_pose_hint_waits_while_a_frame_is_running(robot):
    robot.saw(0.0)
    robot.moved(0.05)
    job = robot.session.take_job("track")
    robot.session.offer(LastPlace(SHA, 5, BEFORE))
    robot.session.handle_result(job, unknown(job), robot.now)
    assert jobs_of(robot) == [BEFORE, None, None]


def test_pose_hint_is_sent_again_after_engine_restart(robot):
    robot.session.offer(LastPlace(SHA, 5, BEFORE))
    jobs_of(robot, 1)
    robot.session.engine_restarted("search")
    assert jobs_of(robot, 1, begin=0.2) == [None]
    robot.session.engine_restarted("track")
    assert jobs_of(robot, 1, begin=0.3) == [BEFORE]


def test_pose_hint_is_ignored_while_tracking(robot):
    robot.localized(0.1)
    robot.session.offer(LastPlace(SHA, 5, BEFORE))
    assert jobs_of(robot, 2, tracking, 0.2) == [None, None]
    robot.session.engine_restarted()
    np.testing.assert_allclose(jobs_of(robot, 1, begin=0.4)[0], T_MAP_ODOM @ pose(0.6), atol=1e-9)


@pytest.mark.parametrize("ask", ["relocalize", "reset"])
def test_reset_or_relocalize_drops_pose_hints(robot, ask):
    robot.session.offer(LastPlace(SHA, 5, BEFORE))
    robot.localized(0.1)
    robot.session.reset() if ask == "reset" else robot.session.restart_search("asked", forget=True)
    assert robot.session.last_place() is None
    robot.moved(0.2)
    robot.session.engine_restarted()
    robot.session.offer(LastPlace(SHA, 5, BEFORE))  # by a disk that has been slow
    robot.moved(0.25)
    assert jobs_of(robot, 3, begin=0.3) == [None] * 3
    # but a place that was found since then is known
    robot.frame(0.8)
    assert robot.session.last_place().stamp_ns == ns(0.81)
    robot.session.engine_restarted()
    assert jobs_of(robot, 1, begin=0.9)[0] is not None


def test_last_known_pose_is_the_newest(robot):
    assert robot.session.last_place() is None
    robot.frame(0.1, unknown)
    assert robot.session.last_place() is None
    robot.localized(0.2)
    robot.moved(0.4)
    poses = robot.counters.poses
    now = robot.session.last_place()
    assert now.stamp_ns == ns(0.4)
    np.testing.assert_allclose(now.T_map_body, T_MAP_ODOM @ pose(0.8), atol=1e-9)
    assert robot.counters.poses == poses  # nothing has been published
    robot.session.tick(robot.now + 60.0)
    assert robot.session.last_place() is None


def test_pose_hint_reaches_the_localizer(world_map, world_drive):
    engine = TrackEngine(world_map)

    def hints(k, hint=None):
        job = FrameJob("r1", 1, ns(0.5 * k), world_drive.clouds[k], world_drive.T_odom_body[k], hint=hint)
        return engine.run(job).request.hints

    assert [len(hints(0, world_drive.T_map_body[0])), len(hints(1)), len(hints(2))] == [1, 1, 1]
    engine.forget("r1")
    assert hints(0, pose_from(np.eye(3), [1e9, 0.0, 0.0])) == ()  # the hint is of no use, but the frame is


def remembering(folder, *names, **more):
    site = declared(*names)
    return site, LastPlaceKeeper(folder, list(site.sessions.values()), **more)


def test_last_pose_is_saved_and_hinted_at_next_start(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    site, kept = remembering(tmp_path, "r1", "r2")
    kept.hint()
    kept.keep()
    assert not list(tmp_path.iterdir())  # no pose is known yet
    site.frame("r1", 0.0)
    kept.keep()
    saved = load(tmp_path, "r1", SHA)
    assert saved.stamp_ns == ns(0.0)
    assert load(tmp_path, "r2", SHA) is None

    again, other = remembering(tmp_path, "r1", "r2")
    other.hint()
    assert "r1: was last at 100.0, -20.0" in caplog.text
    for name, place in (("r1", saved.T_map_body), ("r2", None)):
        again.sees(name, 5.0)
        suggested = again.sessions[name].take_job("track").hint
        assert suggested is None if place is None else np.array_equal(suggested, place)
    assert again.status("r1")["state"] == "SEARCHING"  # it is never trusted


def test_standing_robot_is_saved_once(tmp_path):
    site, kept = remembering(tmp_path, "r1")
    site.frame("r1", 0.0)
    for k in range(1, 4):
        site.moves("r1", STEP * k, x=0.01 * k)
        kept.keep()
    assert load(tmp_path, "r1", SHA).stamp_ns == ns(STEP)
    for seconds, place in ((0.3, {"x": 0.5}), (0.4, {"x": 0.5, "yaw": 0.1})):
        site.moves("r1", seconds, **place)
        kept.keep()
        assert load(tmp_path, "r1", SHA).stamp_ns == ns(seconds)
    np.testing.assert_allclose(load(tmp_path, "r1", SHA).T_map_body, T_MAP_ODOM @ pose(0.5, yaw=0.1), atol=1e-9)


@pytest.mark.parametrize("ask", ["relocalize", "reset"])
def test_reset_or_relocalize_deletes_saved_pose(tmp_path, ask):
    save(tmp_path, "r1", LastPlace(SHA, 5, BEFORE))
    save(tmp_path, "r2", LastPlace(SHA, 5, BEFORE))
    site, kept = remembering(tmp_path, "r1", "r2")
    kept.hint()
    site.net.query(f"coview/r1/rpc/{ask}")
    kept.keep()
    assert load(tmp_path, "r1", SHA) is None
    assert load(tmp_path, "r2", SHA) is not None
    site.frame("r1", 0.0)
    kept.keep()
    assert load(tmp_path, "r1", SHA) is not None
    kept.keep()
    assert load(tmp_path, "r1", SHA) is not None  # it was asked for once


def test_failing_disk_logs_one_warning(tmp_path, caplog):
    site, kept = remembering(tmp_path / "state", "r1")
    (tmp_path / "state").write_text("a file where the directory should be")
    site.frame("r1", 0.0)
    for k in range(1, 5):
        site.moves("r1", 0.2 * k)
        kept.keep()
    (line,) = [r.getMessage() for r in caplog.records]
    assert str(tmp_path / "state") in line
    (tmp_path / "state").unlink()
    kept.keep()
    assert load(tmp_path / "state", "r1", SHA) is not None

    shutil.rmtree(tmp_path / "state")
    (tmp_path / "state").write_text("once more")
    for k in range(5, 9):
        site.moves("r1", 0.2 * k)
        kept.keep()
    assert len(caplog.records) == 2  # once more, for it had worked meanwhile


def test_error_for_one_robot_does_not_stop_saving_others(tmp_path, caplog):
    def fail():
        raise RuntimeError("unforeseen")

    site, kept = remembering(tmp_path, "r1", "r2")
    for name in ("r1", "r2"):
        site.frame(name, 0.0)
    site.sessions["r1"].last_place = fail
    kept.keep()
    assert load(tmp_path, "r2", SHA) is not None
    assert "unforeseen" in caplog.text


@pytest.mark.slow
def test_running_node_saves_periodically_and_at_close(tmp_path):
    site = Site("r1")
    site.node.start({"last-pose": LastPlaceKeeper(tmp_path, list(site.sessions.values()), interval=0.5).run})
    try:
        site.sees("r1", 0.0)
        until(lambda: load(tmp_path, "r1", SHA) is not None)
        site.moves("r1", 1.0)  # well before the next round
    finally:
        assert site.node.close(5.0)
    np.testing.assert_allclose(load(tmp_path, "r1", SHA).T_map_body, T_MAP_ODOM @ pose(2.0), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("access", ["load", "save"])
def test_hanging_disk_does_not_block_the_node(tmp_path, access):
    hangs, hanging, released = threading.Event(), threading.Event(), threading.Event()

    class Folder(type(tmp_path)):
        """A directory whose files hang."""

        def __truediv__(self, name):
            if hangs.is_set():
                hanging.set()
                released.wait(30.0)
            return super().__truediv__(name)

    site = Site("r1")
    if access == "load":
        hangs.set()
    site.node.start({"last-pose": LastPlaceKeeper(Folder(tmp_path), list(site.sessions.values()), interval=0.02).run})
    try:
        hangs.set()
        site.sees("r1", 0.0)
        until(hanging.is_set)
        before = len(site.net.samples("coview/r1/out/pose"))
        until(lambda: len(site.net.samples("coview/r1/out/pose")) >= before + 3)
        site.moves("r1", 0.1)
        begin = time.monotonic()
        assert site.node.close(5.0)
        assert time.monotonic() - begin < 4.0
    finally:
        released.set()
