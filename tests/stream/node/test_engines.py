"""The track and the search engine on the small world: together they are a localizer; robots do not mix."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from trackers import assert_same, follow

import coview_kernels
from coview_kernels import runtime
from coview_kernels.launch import Launch
from coview_stream.basemap.basemap import BaseMap
from coview_stream.errors import CloudError, MapError, RunError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import Event, State
from coview_stream.odometry.buffer import Segment
from coview_stream.stream.node.engine_queue import FrameJob, SearchJob
from coview_stream.stream.node.engines import SearchEngine, TrackEngine, open_engine

FRAMES = 7
OTHER_ODOMETRY = pose_from(rot_z(-1.2), [-300.0, 40.0, 7.0])


class Follower:
    """Feeds the frames of a robot to both engines: the search that a frame asks for ends before the next frame."""

    def __init__(self, track, search, robot="r1", epoch=1):
        self.track, self.search, self.robot, self.epoch = track, search, robot, epoch
        self.search_result = None
        self.fixes = []
        self.verdicts = []

    def job(self, drive, k):
        stamp, cloud, T = round(5e8 * k), drive.clouds[k], drive.T_odom_body[k]
        return FrameJob(self.robot, self.epoch, stamp, cloud, T, search_result=self.search_result)

    def follow(self, drive, frames, known=()):
        """Track frames; ``known`` verdicts spare the search."""
        for k in frames:
            result = self.track.run(self.job(drive, k))
            self.search_result = None
            if result.request is not None and k < len(known):
                self.search_result = known[k]
            elif result.request is not None:
                self.search_result = self.search.run(SearchJob(self.robot, result.request))
                self.verdicts.append(self.search_result)
            self.fixes.append(result.fix)
        return self.fixes


@pytest.fixture(scope="module")
def engines(world_map):
    return TrackEngine(world_map), SearchEngine(world_map)


@pytest.fixture(scope="module")
def reference(engines, world_drive):
    """A robot that has had the engines for itself."""
    follower = Follower(*engines, "alone")
    follower.follow(world_drive, range(FRAMES))
    return follower


@pytest.fixture
def launched(monkeypatch):
    """Names of the kernel modules that were launched since it was last cleared."""
    coview_kernels.warm_up()  # modules that import one another do so now
    names = set()
    kernels, launch = runtime.kernels, Launch.__call__
    monkeypatch.setattr(runtime, "kernels", lambda name: names.add(name) or kernels(name))
    monkeypatch.setattr(Launch, "__call__", lambda self: names.add(self._name[0]) or launch(self))
    return names


@pytest.mark.slow
@pytest.mark.skipif(coview_kernels.backend() == "numpy", reason="no kernels are compiled")
def test_engines_name_the_kernels_that_they_launch(world_map, world_file, world_drive, launched):
    """A kernel without a name is compiled at every start, or when the first job needs it, which takes a second."""
    track, search = TrackEngine(world_map), SearchEngine(world_map)
    asked = {}

    def watched(engine):
        def run(job):
            launched.clear()
            result = engine.run(job)
            asked.setdefault(engine, set()).update(launched)
            return result

        return SimpleNamespace(run=run)

    follower = Follower(watched(track), watched(search), "fresh")
    follower.follow(world_drive, range(FRAMES))
    assert follower.fixes[-1].state is State.TRACKING
    for engine in (track, search):
        launched.clear()
        coview_kernels.warm_up(*engine.kernels, *engine.later_kernels)
        named = set(launched)
        launched.clear()
        fresh = type(engine)(BaseMap.load(world_file))
        fresh.prepare()
        fresh.prepare_later()
        assert launched <= named
        # the field judges slips of odometry, sorted points show moved parts, and none happened; the map has no features
        assert asked[engine] | ({"field"} if engine is track else {"nearest", "overhead", "windows"}) == named


def test_search_engine_that_has_rested_keeps_no_page_of_the_map_and_finds_the_same(engines, world_file, world_drive):
    jobs, watched = [], SimpleNamespace(run=lambda job: jobs.append(job) or engines[1].run(job))
    Follower(engines[0], watched, "rests").follow(world_drive, range(FRAMES))

    def resident():
        lines, total, ours = Path("/proc/self/smaps").read_text().splitlines(), 0, False
        for line in lines:
            ours = str(world_file) in line if line[0] in "0123456789abcdef" and "-" in line.split()[0] else ours
            total += int(line.split()[1]) if ours and line.startswith("Rss:") else 0
        return total

    found = []
    for rests in (False, True):
        engine = SearchEngine(BaseMap.load(world_file))
        for job in jobs:
            found.append(engine.run(job))
            before = resident()
            if rests:
                engine.rest()
                assert resident() < before
    half = len(found) // 2
    for one, other in zip(found[:half], found[half:], strict=True):
        np.testing.assert_array_equal(one.leader, other.leader)


@pytest.mark.slow
@pytest.mark.skipif(coview_kernels.backend() == "numpy", reason="no kernels are compiled")
def test_prepared_localizer_compiles_no_kernel_later(world_file, world_drive, launched):
    """Neither for the search nor for tracking: such a step would take a second."""
    launched.clear()
    localizer = Localizer(world_file)
    localizer.prepare()
    prepared = set(launched)
    launched.clear()
    assert follow(localizer, world_drive, FRAMES)[-1].state is State.TRACKING
    assert launched <= prepared


def test_track_and_search_engines_equal_localizer_one_frame_late(reference, world_fixes):
    first = next(k for k, fix in enumerate(world_fixes) if fix.state is State.TRACKING)
    assert first + 1 < FRAMES
    assert reference.fixes[0].state is State.SEARCHING
    for k in range(1, first + 1):
        assert reference.fixes[k].state is world_fixes[k - 1].state
        assert reference.fixes[k].T_map_body is None
    for k in range(first + 1, FRAMES):
        assert_same(reference.fixes[k], world_fixes[k])


@pytest.mark.slow
def test_two_robots_give_same_results_as_each_alone(engines, reference, world_drive):
    other_drive = world_drive.seen_from(OTHER_ODOMETRY)
    one, two = Follower(*engines, "one"), Follower(*engines, "two", epoch=9)
    for k in range(FRAMES):
        one.follow(world_drive, [k])
        two.follow(other_drive, [k])
    for here, there, undisturbed in zip(one.fixes, two.fixes, reference.fixes, strict=True):
        assert_same(here, undisturbed)
        assert there.state is undisturbed.state
        if there.T_map_body is not None:
            np.testing.assert_allclose(there.T_map_body, undisturbed.T_map_body, atol=0.02)


def test_frames_that_are_rejected_change_nothing_and_what_comes_with_them_is_applied_once(
    engines, reference, world_drive
):
    """Search results, hints and demands to verify the place: handed over again with the next frame."""
    bad = (
        ({"points": np.full((50, 3), np.nan, np.float32)}, CloudError),
        ({"points": world_drive.clouds[0][:3]}, CloudError),
        ({"T_odom_body": np.diag([1.0, 1.0, 2.0, 1.0])}, RunError),
    )
    plain, careless = Follower(engines[0], None, "plain"), Follower(engines[0], None, "twice")
    events = {plain.robot: [], careless.robot: []}
    for k in range(FRAMES):
        for robot in (plain, careless):
            result = reference.verdicts[k - 1] if 0 < k <= len(reference.verdicts) else None
            job = replace(robot.job(world_drive, k), search_result=result, hint=world_drive.T_map_body[k])
            job = replace(job, require_verification=k == FRAMES - 1)
            for wrong, error in bad if robot is careless else ():
                with pytest.raises(error):
                    engines[0].run(replace(job, **wrong))
            answer = engines[0].run(job)
            robot.fixes.append(answer.fix)
            events[robot.robot].append(answer.events)
    assert events["twice"] == events["plain"]
    assert sum(events["plain"], ())[-2:] == (Event.VERIFICATION_REQUIRED, Event.MATCH_VERIFIED)
    assert Event.PLACE_ACCEPTED in sum(events["plain"], ())
    for fix, undisturbed in zip(careless.fixes, plain.fixes, strict=True):
        assert_same(fix, undisturbed)


def test_new_epoch_resets_both_engines(engines, reference, world_drive):
    follower = Follower(*engines, "restarted")
    follower.follow(world_drive, range(2))
    follower.epoch, follower.search_result, follower.fixes = 2, None, []
    # another odometry frame: votes of the old one would speak for places that are not
    follower.follow(world_drive.seen_from(OTHER_ODOMETRY), range(FRAMES))
    assert [fix.state for fix in follower.fixes] == [fix.state for fix in reference.fixes]
    np.testing.assert_allclose(follower.fixes[-1].T_map_body, reference.fixes[-1].T_map_body, atol=0.02)


@pytest.mark.slow
def test_forgotten_robot_starts_from_scratch(engines, reference, world_drive):
    follower = Follower(*engines, "forgotten")
    follower.follow(world_drive, range(3))
    for engine in engines:
        engine.forget("forgotten")
        engine.forget("never seen")
    follower.search_result, follower.fixes = None, []
    follower.follow(world_drive, range(3))
    for fix, first in zip(follower.fixes, reference.fixes, strict=False):
        assert fix.state is first.state
        assert (fix.evidence and fix.evidence.reason) == (first.evidence and first.evidence.reason)


def test_frame_marked_for_verification_is_verified(engines, reference, world_drive):
    follower = Follower(*engines, "suspect")
    fix = follower.follow(world_drive, range(FRAMES), reference.verdicts)[-1]
    assert fix.state is State.TRACKING
    last = follower.job(world_drive, FRAMES - 1)  # at the same place: without suspicion nothing is looked at
    for later, suspect in ((10**8, False), (2 * 10**8, True)):
        again = replace(last, stamp_ns=last.stamp_ns + later, require_verification=suspect)
        fix = engines[0].run(again).fix
        assert fix.state is State.TRACKING
        assert (fix.evidence.stamp == pytest.approx(again.stamp_ns * 1e-9)) == suspect


def test_points_with_times_are_deskewed(engines, world_drive):
    """A sweep on the move is, deskewed, the frame that was measured at once."""
    speed, T = 8.0, world_drive.T_odom_body[0]
    points = world_drive.clouds[0]
    times = np.random.default_rng(2).choice([-0.1, -0.05, 0.0], len(points))
    swept = points.copy()
    for t in (-0.1, -0.05):
        swept[times == t] = transform(inverse(pose_from(np.eye(3), [speed * t, 0, 0])), points[times == t])
    along = [T @ pose_from(np.eye(3), [speed * t, 0, 0]) for t in (-0.1, 0.0)]
    segment = Segment(np.array([900_000_000, 1_000_000_000], np.int64), np.array(along))
    request = engines[0].run(FrameJob("moving", 1, 1_000_000_000, swept, T, times, segment)).request
    np.testing.assert_allclose(request.cloud, points, atol=0.01)


def test_job_of_the_other_engine_is_refused(engines, world_drive):
    track, search = engines
    frame = FrameJob("r1", 1, 0, world_drive.clouds[0], world_drive.T_odom_body[0])
    with pytest.raises(TypeError, match="FrameJob"):
        search.run(frame)
    asked = track.run(FrameJob("asking", 1, 0, world_drive.clouds[0], world_drive.T_odom_body[0])).request
    with pytest.raises(TypeError, match="SearchJob"):
        track.run(SearchJob("asking", asked))


def test_engines_open_from_a_map_file(world_file, tmp_path):
    sha256 = BaseMap.load(world_file).sha256
    assert isinstance(open_engine("track", world_file, sha256), TrackEngine)
    assert isinstance(open_engine("search", world_file, sha256), SearchEngine)
    with pytest.raises(MapError, match="replaced"):
        open_engine("track", world_file, "0" * 64)
    with pytest.raises(MapError, match="none"):
        open_engine("track", tmp_path / "none.coview", sha256)


def test_engine_forgets_the_sensor_only_when_a_client_asks(engines, world_drive):
    """Another odometry frame is the same robot's."""
    engine = engines[0]
    known = Calibration(pitch=0.05, sigma_tilt=0.001, sigma_scale=0.001)
    cloud, T = world_drive.clouds[0], world_drive.T_odom_body[0]
    told = [
        engine.run(FrameJob("leaning", epoch, 1_000_000_000, cloud, T, calibration=hint, first_epoch=first))
        for epoch, first, hint in ((4, 4, known), (5, 4, None), (6, 6, None))
    ]
    pitches = [result.fix.calibration.pitch for result in told]
    assert pitches[0] > 0.02
    assert pitches[1] == pitches[0]
    assert pitches[2] == 0.0
