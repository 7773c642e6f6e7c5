"""Real processes: a served map is replaced, systemd gets notices, engines are killed and stopped."""

import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from nightly import nightly
from serving import FALSE
from sockets import until

from coview_stream.basemap.basemap import BaseMap

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")]


def second_map(world_file, path):
    """The same survey as a map with another hash."""
    first = BaseMap.load(world_file)
    arrays = {name: np.array(array) for name, array in first.arrays.items()}
    BaseMap(arrays, {**first.parameters, "note": "surveyed again"}).save(path)
    return BaseMap.load(path).sha256


def test_map_is_replaced_while_poses_go_on(service, world_file):
    service.tracks()
    assert {service.notices.recv(500).split(b"\n")[0] for _ in range(4)} == {b"READY=1", b"WATCHDOG=1"}
    old = service.health()["map"]["sha256"]
    new = service.folder / "new.coview"
    sha256 = second_map(world_file, new)

    (service.folder / "half").write_bytes(new.read_bytes()[: new.stat().st_size // 2])
    (service.folder / "half").replace(service.map)
    service.process.send_signal(signal.SIGHUP)
    until(lambda: service.health()["map"]["reload"]["result"] == "refused", 30.0)
    assert service.health()["map"]["sha256"] == old
    assert any("refused" in record["message"] for record in service.said())
    service.tracks(1.0)

    new.replace(service.map)
    begin = len(service.poses)
    service.process.send_signal(signal.SIGHUP)
    until(lambda: service.health()["map"]["reload"]["result"] == "changed", 60.0)
    service.tracks(1.0)
    times, poses = zip(*service.poses[begin:], strict=True)
    shas = [pose.map_sha256 for pose in poses]
    assert set(shas) == {old, sha256}
    assert shas == sorted(shas, key=lambda sha: sha == sha256)  # never back
    change = shas.index(sha256)
    assert np.diff(times).max() < 1.0, "of a busy machine; on an idle one it is 0.1 s"
    assert poses[change].stamp_ns - poses[change - 1].stamp_ns <= 0.35e9  # by the robot's own clock
    assert max(service.errors()) < FALSE
    assert service.end() == 0


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=nightly)])
def test_engines_that_are_killed_or_stopped_at_any_time_come_back(service, number):
    rng = random.Random(int(number))
    service.tracks()
    for name in ("search", "track"):
        time.sleep(rng.uniform(0.0, 0.5))
        pid = service.engines()[name]
        os.kill(pid, number)
        until(lambda name=name, pid=pid: service.engines()[name] not in (None, pid), 10.0)
        assert not Path(f"/proc/{pid}").exists()  # nor a zombie
        until(lambda: service.health()["ready"]["ok"], 60.0)
        service.tracks(60.0)
    assert max(service.errors()) < FALSE
    restarts = {name: engine["restarts"] for name, engine in service.health()["engines"].items()}
    assert restarts == {"track": 1, "search": 1}
    # it was idle, and was started again without a job
    assert any("the search engine died (by signal 9)" in record["message"] for record in service.said())
