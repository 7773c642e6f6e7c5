"""AsyncLocalizer: the fixes of a Localizer, calls that never wait, and processes that die, stop or are forked away."""

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_world import pose_error
from sockets import until
from trackers import assert_same

from coview_stream import AsyncLocalizer, BaseMap, CloudError, CoViewError, InputError, PlaceGuess, RunError
from coview_stream.geometry.transforms import pose_from, rot_z
from coview_stream.localization.localizer import JUMPED
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.state import State
from coview_stream.stream.async_localizer import Mailbox
from coview_stream.stream.node.engine_queue import FrameResult
from coview_stream.stream.node.engines import SearchEngine, TrackEngine

WAIT = 120.0  # seconds, however slow the machine is


class Worked:
    """A mailbox whose jobs are done in this process, when they are asked for."""

    def __init__(self, engines, drive):
        self.mailbox, self.engines, self.drive = Mailbox(), engines, drive

    def step(self, k, work=True):
        self.mailbox.add_frame(self.drive.clouds[k], self.drive.T_odom_body[k], 0.5 * k)
        while work and any([self.do("track"), self.do("search")]):
            pass
        return self.mailbox.fix()

    def do(self, engine):
        job = self.mailbox.take_job(engine)
        if job is not None:
            self.mailbox.handle_result(job, self.engines[engine].run(job), 0.0)
        return job is not None


@pytest.fixture
def engines(world_map):
    return {"track": TrackEngine(world_map), "search": SearchEngine(world_map)}


@pytest.fixture
def worked(engines, world_drive):
    return Worked(engines, world_drive)


def test_frames_that_are_worked_on_have_the_fixes_of_a_localizer(worked, world_fixes):
    for k, fix in enumerate(world_fixes):
        assert_same(worked.step(k), fix)


def test_fix_is_carried_on_by_odometry_until_it_is_too_old(worked, world_fixes):
    """Nobody does the jobs meanwhile: a call that needed one would have no pose, or not return."""
    last = [worked.step(k) for k in range(3)][-1]
    for k in range(3, 10):
        fix = worked.step(k, work=False)
        assert fix.state is State.TRACKING
        assert fix.evidence.stamp == last.evidence.stamp  # so old is the registration
        assert fix.stamp == 0.5 * k
        assert pose_error(fix.T_map_body, world_fixes[k].T_map_body)[0] < 0.05
        assert (fix.stddev[:3] > last.stddev[:3]).all()
        assert fix.protection.metres > last.protection.metres
        last = fix
    assert worked.mailbox.counters.dropped == 6
    worked.mailbox.note_doubt(worked.mailbox.take_job("track"))  # its frame contradicts the place
    assert worked.mailbox.fix().state is State.DOUBTED
    assert worked.mailbox.fix().evidence.reason == "a frame speaks against the place, and others are tried"
    worked.mailbox.add_frame(worked.drive.clouds[9], worked.drive.T_odom_body[9], 6.5)
    doubted = worked.mailbox.fix()
    assert doubted.state is State.DOUBTED
    assert doubted.evidence.reason == "no frame of the last 5.5 s has been worked on"


def test_jump_of_odometry_withholds_the_pose_until_a_frame_has_found_it_again(worked, world_fixes):
    for k in range(4):
        worked.step(k)
    jumped = pose_from(rot_z(1.0), [400.0, 0.0, 0.0])
    worked.mailbox.add_frame(worked.drive.clouds[4], jumped @ worked.drive.T_odom_body[4], 2.0)
    lost = worked.mailbox.fix()
    assert (lost.state, lost.T_map_body, lost.evidence.reason) == (State.LOST, None, JUMPED)
    job = worked.mailbox.take_job("track")
    np.testing.assert_allclose(job.hint, world_fixes[3].T_map_body)
    worked.mailbox.handle_result(job, worked.engines["track"].run(job), 0.0)
    while any([worked.do("track"), worked.do("search")]):
        pass
    found = worked.mailbox.fix()
    assert found.state is State.TRACKING
    assert pose_error(found.T_map_body, worked.drive.T_map_body[4])[0] < 0.1


def test_failure_is_raised_once_and_the_last_place_is_a_hint(worked, world_fixes):
    for k in range(3):
        worked.step(k)
    mailbox = worked.mailbox
    worked.step(3, work=False)
    job = mailbox.take_job("track")
    mailbox.handle_failure(job, "Traceback ...\nZeroDivisionError: by nothing")
    with pytest.raises(CoViewError, match="failed at a frame: ZeroDivisionError: by nothing"):
        mailbox.raise_error()
    mailbox.raise_error()
    lost = mailbox.fix()
    assert lost.state is State.LOST
    assert "by nothing" in lost.evidence.reason
    worked.step(4, work=False)
    again = mailbox.take_job("track")
    np.testing.assert_array_equal(again.hint, world_fixes[2].T_map_body)
    assert again.epoch == job.epoch + 1
    result = worked.engines["track"].run(again)
    mailbox.handle_result(again, replace(result, fix=replace(result.fix, evidence=None)), 0.0)
    assert mailbox.fix().evidence is lost.evidence  # there is nothing newer
    mailbox.add_frame(worked.drive.clouds[4], worked.drive.T_odom_body[4], 2.25)
    ambiguous = KeyframeEvidence(2.25, State.AMBIGUOUS, "one place leads")
    mailbox.handle_result(mailbox.take_job("track"), replace(result, fix=replace(result.fix, evidence=ambiguous)), 0.0)
    assert mailbox.fix().state is State.LOST
    assert mailbox.fix().evidence is ambiguous
    assert worked.step(5).state is State.TRACKING


def test_failed_search_leaves_the_frames_alone(worked):
    worked.step(0, work=False)
    worked.do("track")
    assert worked.mailbox.searching
    job = worked.mailbox.take_job("search")
    worked.mailbox.engine_restarted("search", "the search engine died")
    with pytest.raises(CoViewError, match="the search engine died; it is started again"):
        worked.mailbox.raise_error()
    worked.mailbox.handle_failure(job, "the search engine died")
    assert not worked.mailbox.searching
    worked.mailbox.raise_error()  # not again
    assert [worked.step(k) for k in (1, 2)][-1].state is State.TRACKING


def test_failures_of_later_searches_are_told(worked):
    """A search engine that died without a job does not hide them."""
    mailbox = worked.mailbox
    mailbox.engine_restarted("search", "the search engine died")
    with pytest.raises(CoViewError, match="died"):
        mailbox.raise_error()
    worked.step(0, work=False)
    worked.do("track")
    mailbox.handle_failure(mailbox.take_job("search"), "ZeroDivisionError: by nothing")
    with pytest.raises(CoViewError, match="a search failed: ZeroDivisionError: by nothing"):
        mailbox.raise_error()


@pytest.mark.parametrize("keep_calibration", [True, False])
def test_results_from_before_a_new_beginning_are_ignored(worked, keep_calibration):
    for k in range(2):
        worked.step(k)
    worked.step(2, work=False)
    job = worked.mailbox.take_job("track")
    worked.mailbox.begin(keep_calibration)
    worked.mailbox.handle_result(job, worked.engines["track"].run(job), 0.0)
    assert worked.mailbox.state is State.SEARCHING
    assert (worked.mailbox.calibration is None) is not keep_calibration
    with pytest.raises(RuntimeError, match="no frame yet"):
        worked.mailbox.fix()
    assert worked.step(0).state is State.TRACKING


class Watched:
    """Stands for a fix or a queue whose reader has to hold the mailbox's lock."""

    T_map_body = calibration = None

    def __init__(self, mailbox):
        self.changed, self.free = mailbox.changed, []

    def __getattr__(self, name):
        """Note whether another thread, as the feed's, gets the lock now."""

        def enter():
            self.free.append(self.changed.acquire(blocking=False))
            if self.free[-1]:
                self.changed.release()

        other = threading.Thread(target=enter)
        other.start()
        other.join()
        return State.SEARCHING


def test_feed_changes_nothing_while_the_state_is_read(worked):
    """It would forget the fix between a look whether there is one and a look at its state."""
    worked.step(0, work=False)
    job, mailbox = worked.mailbox.take_job("track"), worked.mailbox
    fix = Watched(mailbox)
    mailbox.handle_result(job, FrameResult(fix, None, 0.0, ()), 0.0)
    fix.free.clear()
    assert mailbox.state is State.SEARCHING
    mailbox.queue = queue = Watched(mailbox)
    assert mailbox.searching
    assert fix.free
    assert not any(fix.free + queue.free)


def test_a_map_in_memory_is_refused(world_map):
    with pytest.raises(InputError, match="save it"):
        AsyncLocalizer(BaseMap(world_map.arrays, world_map.parameters))


@pytest.fixture(scope="module")
def running(world_file):
    with AsyncLocalizer(world_file) as localizer:
        localizer.prepare(WAIT)
        yield localizer


@pytest.fixture
def localizer(running):
    """One for the tests that leave it whole."""
    running.reset()
    return running


def follow(localizer, drive, frames, start=0.0):
    """Fixes of frames, half a second apart, each waited for."""
    fixes = []
    for k in frames:
        localizer.step(drive.clouds[k], drive.T_odom_body[k], start + 0.5 * k)
        fixes.append(localizer.wait(WAIT))
    return fixes


@pytest.mark.slow
def test_waited_for_it_gives_the_fixes_of_a_localizer(localizer, world_drive, world_fixes):
    for fix, other in zip(follow(localizer, world_drive, range(len(world_fixes))), world_fixes, strict=True):
        assert_same(fix, other)
    assert localizer.state is State.TRACKING
    assert localizer.calibration == localizer.fix().calibration
    localizer.relocalize()
    assert localizer.state is State.SEARCHING


@pytest.mark.slow
def test_useless_frames_and_hints_are_refused_and_change_nothing(localizer, world_drive, world_fixes):
    follow(localizer, world_drive, [0])
    with pytest.raises(CloudError, match="finite points"):
        localizer.step(world_drive.clouds[1][:3], world_drive.T_odom_body[1], 0.5)
    with pytest.raises(RunError, match="is that of the frame before"):
        localizer.step(world_drive.clouds[1], world_drive.T_odom_body[1], 0.0)
    with pytest.raises(InputError, match="no ground"):
        localizer.guess_place(PlaceGuess(1e6, 0.0))
    with pytest.raises(RunError, match="T_map_body"):
        localizer.hint_pose(np.full((4, 4), np.nan))
    assert_same(follow(localizer, world_drive, [1])[0], world_fixes[1])


@pytest.mark.slow
def test_hints_reach_the_search(localizer, world_drive, world_fixes):
    localizer.hint_pose(world_fixes[0].T_map_body)
    localizer.hint_calibration(world_fixes[-1].calibration)
    localizer.guess_place(PlaceGuess(*world_fixes[0].position[:2], within=60.0))
    assert follow(localizer, world_drive, [0])[0].state is State.TRACKING


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize("end", ["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("name", ["track", "search"])
def test_dead_or_stopped_process_is_told_and_started_again(world_file, world_drive, world_fixes, name, end):
    """No call waits for it: a step that did would never return, as a frame of this size fills the pipe."""
    with AsyncLocalizer(world_file) as localizer:
        follow(localizer, world_drive, range(3))
        first = localizer.engines[name].pid
        os.kill(first, getattr(signal, end))
        large = np.tile(world_drive.clouds[3], (40, 1))
        stamps = itertools.count(100)

        def told():
            try:
                localizer.step(large, world_drive.T_odom_body[3], next(stamps))
            except CoViewError as error:
                return str(error)
            return ""

        errors = []
        until(lambda: errors.append(told()) or errors[-1], WAIT)
        assert re.fullmatch(rf"the {name} engine .*; it is started again", "".join(errors))
        assert not Path(f"/proc/{first}").exists()  # no zombie is left
        found = follow(localizer, world_drive, [4, 5], start=1e6)[-1]
        assert found.state is State.TRACKING
        np.testing.assert_allclose(found.T_map_body, world_fixes[5].T_map_body, atol=0.05)
        children = [engine.pid for engine in localizer.engines.values()]
        assert first not in children
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)
    localizer.close()
    with pytest.raises(CoViewError, match="closed"):
        localizer.fix()


@pytest.mark.slow
def test_a_map_that_was_replaced_is_told(world_file):
    base_map = BaseMap.load(world_file)
    base_map.sha256 = "0" * 64
    with AsyncLocalizer(base_map) as localizer, pytest.raises(CoViewError, match="replaced by another map"):
        localizer.prepare(WAIT)


SCRIPT = """
import os, signal, sys, time
import numpy as np
from coview_stream import AsyncLocalizer, CoViewError

def say(*words):  # at once
    os.write(1, (" ".join(map(str, words)) + "\\n").encode())

localizer = AsyncLocalizer(sys.argv[1])
child = os.fork()
if child == 0:
    try:
        localizer.step(np.zeros((20, 3), np.float32), np.eye(4), 0.0)
    except CoViewError as error:
        say(error)
    if sys.argv[2] == "SIGKILL":  # this process has the parent's pipes, and lives on
        time.sleep(600.0)
    sys.exit()
if sys.argv[2] != "SIGKILL":
    os.waitpid(child, 0)
say(*(engine.pid for engine in localizer.engines.values()), child)
if sys.argv[2] != "its end":
    os.kill(os.getpid(), getattr(signal, sys.argv[2]))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs fork and /proc")
@pytest.mark.parametrize("end", ["its end", "SIGINT", "SIGKILL"])
def test_processes_end_with_the_agent(world_file, tmp_path, end):
    """The script has no guard of its main module; a process that it has forked is told so, and ends nothing."""
    script = tmp_path / "agent.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, script, world_file, end], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env=environment,
    ) as agent:  # fmt: skip
        lines = sorted(agent.stdout.readline() for _ in range(2))
        *engines, forked = map(int, lines[0].split())
        assert lines[1] == "this AsyncLocalizer belongs to the process that forked this one; make one here\n"
        try:
            assert agent.wait(WAIT) == (0 if end == "its end" else -getattr(signal, end))
            assert len(engines) == 2
            until(lambda: not any(map(alive, engines)), WAIT)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(forked, signal.SIGKILL)


def alive(pid):
    """Whether a process runs; one that has ended may wait for the process that adopted it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
