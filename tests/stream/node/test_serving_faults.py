"""Clocks that jump and stand still, more frames than can be processed, and a full disk, with real processes."""

import resource
import sys
import time

import pytest
from nightly import nightly
from serving import FALSE
from sockets import until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")]

# the host's clock shows another day at every look, before or after
JUMPING_CLOCK = """
import random, time
_now, _ns, _rng = time.time, time.time_ns, random.Random(7)
_jump = lambda: _rng.uniform(-1e5, 1e5)
time.time = lambda: _now() + _jump()
time.time_ns = lambda: max(0, _ns() + int(1e9 * _jump()))
"""


@nightly
def test_steps_of_the_host_clock_change_nothing(serve, tmp_path):
    from coview_stream.clouds.python_child import python_environment

    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(JUMPING_CLOCK)
    service = serve(PYTHONPATH=f"{tmp_path / 'site'}:{python_environment()['PYTHONPATH']}")
    service.tracks()
    begin = len(service.poses)
    time.sleep(5.0)
    robot = service.robot()
    assert len(service.poses) - begin > 25  # 50 on an idle machine
    assert (robot["state"], robot["counters"]["losses"]) == ("TRACKING", 0)
    assert abs(service.health()["stamp_ns"] * 1e-9 - time.time()) > 1.0  # the clock did jump
    assert max(service.errors()) < FALSE


@pytest.mark.parametrize("step", [3600.0, -49_900.0], ids=["forwards", "backwards"])
def test_robot_whose_clock_is_set_is_found_again(serve, step):
    service = serve()
    service.tracks()
    service.stamp_of = lambda seconds: 50_000.0 + step + seconds
    until(lambda: service.robot()["state"] != "TRACKING", 20.0)
    until(lambda: abs(service.poses[-1][1].stamp_ns * 1e-9 - 50_000.0 - step) < 400.0, 60.0)
    assert max(service.errors()) < FALSE


@nightly
def test_frozen_stamps_give_no_pose(serve):
    service = serve()
    service.tracks()
    running, frozen = service.stamp_of, []

    def standing(seconds):
        frozen[:] = frozen or [seconds]
        return running(frozen[0])

    service.stamp_of = standing
    until(lambda: service.robot()["state"] != "TRACKING", 10.0)
    count = len(service.poses)
    time.sleep(1.5)
    assert len(service.poses) <= count + 1
    assert service.robot()["counters"]["duplicate"] > 5
    service.stamp_of = running
    service.tracks(60.0)
    # while it stood still, one stamp was of many places: only the others count
    off = {pose.stamp_ns: error for (_, pose), error in zip(list(service.poses), service.errors(), strict=False)}
    off.pop(round(running(frozen[0]) * 1e9), None)
    assert max(off.values()) < FALSE


@nightly
def test_more_frames_than_can_be_processed_are_counted_and_bounded(serve):
    service = serve()
    service.tracks()
    before = service.health()
    service.pace = 0.002
    time.sleep(6.0)
    during = service.health()
    service.pace = 0.1
    assert during["live"]["ok"]
    grown = {
        "node": during["memory_bytes"] - before["memory_bytes"],
        **{name: e["memory_bytes"] - before["engines"][name]["memory_bytes"] for name, e in during["engines"].items()},
    }
    assert max(grown.values()) < 200e6, grown
    counters = service.robot()["counters"]
    ended = ("processed", "dropped", "late", "no_odometry", "out_of_order", "duplicate", "rejected", "malformed")
    assert 0 <= counters["received"] - sum(counters[name] for name in ended) <= 10
    assert counters["engine_restarts"] == 0
    service.tracks(60.0)
    assert max(service.errors()) < FALSE


@nightly
def test_full_disk_is_one_warning_and_the_poses_go_on(serve):
    service = serve()
    service.tracks()
    limits = resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))

    def warnings():
        return [record for record in service.said() if "cannot keep the last poses" in record["message"]]

    until(warnings, 20.0)
    time.sleep(6.0)  # the next attempt, which fails as well
    assert len(warnings()) == 1
    service.tracks(5.0)
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, limits)
    until(lambda: list((service.folder / "state").glob("*.json")), 20.0)
    assert list((service.folder / "state").glob("*.part")) == []
    assert max(service.errors()) < FALSE
    assert service.end() == 0
