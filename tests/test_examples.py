"""The examples and the README's own code run, on small simulated worlds, and do what they say."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from nightly import nightly

from coview_stream import BaseMap, State
from coview_stream.clouds import read_tum
from coview_stream.messages import decode_cloud, encode_pose
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.sim import SimulationConfig, simulate
from coview_stream.stream.transport.memory_transport import MemoryTransport

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A drive of 10 m through a small campus, where the README expects the demo's."""
    folder = tmp_path_factory.mktemp("examples") / "coview-demo" / "world"
    folder.parent.mkdir()
    config = SimulationConfig(scene="campus", sensor="os64", seed=1, size=100.0, length=10.0)
    simulate(folder, config)
    return folder


@pytest.fixture(scope="module")
def one_map():
    return {}


@pytest.fixture
def built_once(one_map, monkeypatch):
    """Examples whose idea is not the building share one map."""
    real = BaseMap.build

    def build(path, learned=True):
        if path not in one_map:
            one_map[path] = real(path, learned=learned)
        return one_map[path]

    monkeypatch.setattr(BaseMap, "build", build)


def example(name):
    return runpy.run_path(str(ROOT / "examples" / name))["main"]


def block(name):
    found = re.search(rf"<!-- {name} -->\n```\w+\n(.*?)```\n<!-- end -->", README, re.DOTALL)
    assert found, f"README.md has no block {name}"
    return found[1]


@pytest.mark.slow
def test_example_locate_run(world, capsys):
    errors = example("locate_run.py")(world)
    assert len(errors) > 10
    assert max(errors) < 0.3
    out = capsys.readouterr().out
    assert "TRACKING" in out
    assert "mean position error" in out


@pytest.mark.slow
@pytest.mark.usefixtures("built_once")
def test_example_agent(world, capsys):
    fix, _ = example("agent.py")(world, period=0.05)
    assert fix.state is State.TRACKING
    truth = read_tum(world / "truth.tum")[1][-1]
    assert np.linalg.norm(fix.T_map_body[:3, 3] - truth[:3, 3]) < 0.3
    out = capsys.readouterr().out
    assert "SEARCHING, by evidence" in out
    assert "frames left out, longest call" in out


@pytest.mark.slow
def test_example_custom_descriptor(world, capsys):
    shares = example("custom_descriptor.py")(world)
    assert set(shares) == {"scan_context", "coview", "paper"}
    assert max(shares["scan_context"], shares["coview"]) >= 0.5
    assert capsys.readouterr().out.count("keyframes") == len(shares)


@pytest.mark.slow
@pytest.mark.usefixtures("built_once")
def test_example_poses_on_the_map(world, tmp_path):
    picture = tmp_path / "poses.png"
    assert example("poses_on_the_map.py")(world, picture) > 10
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 5000


@pytest.mark.slow
@pytest.mark.usefixtures("built_once")
def test_example_errors_and_bounds(world, tmp_path):
    table = example("errors_and_bounds.py")(world, tmp_path / "errors.png")
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    assert len(table) > 10
    assert (table[:, 1] < table[:, 3]).mean() > 0.95  # errors stay within their protection levels


@pytest.mark.slow
@pytest.mark.usefixtures("built_once")
def test_example_carried_away(world, capsys):
    assert len(example("carried_away.py")(world)) == 2
    assert "carried back: found after" in capsys.readouterr().out


NO_DEFAULTS = [path for path in (ROOT / "examples").glob("*.py") if "sys.argv[1] if" not in path.read_text("utf-8")]


@pytest.mark.parametrize("path", sorted(NO_DEFAULTS), ids=lambda path: path.stem)
def test_example_without_arguments_or_defaults_prints_its_usage(path, monkeypatch):
    monkeypatch.setattr("sys.argv", [str(path)])
    with pytest.raises(SystemExit, match=f"python examples/{path.name}"):
        runpy.run_path(str(path), run_name="__main__")


@pytest.mark.slow
def test_example_map_of_arrays(world, tmp_path, capsys):
    base_map = example("map_of_arrays.py")(world, tmp_path / "site.coview")
    assert base_map.crs == "EPSG:25832"
    assert base_map.bounds[0][0] > 499_000.0
    assert "points/m2" in capsys.readouterr().out


@pytest.mark.slow
def test_example_trajectory_for_gis(world, tmp_path, capsys):
    pytest.importorskip("pyproj", reason="pip install 'coview-stream[geo]'")
    files = example("trajectory_for_gis.py")(world, tmp_path / "out")
    assert [path.name for path in files] == ["trajectory.geojson", "trajectory.csv"]
    assert files[1].read_text().startswith("stamp,x,y,z,qx,qy,qz,qw,latitude,longitude,height")
    assert "ends at 48." in capsys.readouterr().out


@nightly
def test_example_tiles_of_a_city(world, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / "cache"))
    base_map = example("tiles_of_a_city.py")(world, tmp_path / "city", workers=1)
    assert len(base_map)
    out = capsys.readouterr().out
    first, second = re.findall(r"(\d+) tiles, (\d+) as they were", out)
    assert (first[1], second[1]) == ("0", first[0])


def test_example_transforms(capsys):
    import asyncio
    import threading
    import time

    net, ended = MemoryTransport(), threading.Event()
    T = np.eye(4)
    T[:3, 3] = 5.0, 6.0, 7.0

    def publish():
        for k in range(1, 400):
            pose = PoseMessage(k * 100_000_000, "r1", "TRACKING", T, np.eye(6), 0.9, "ab", T_map_odom=T)
            net.publish(Sample("coview/r1/out/pose", encode_pose(pose, "json").payload))
            if ended.wait(0.01):
                return

    sender = threading.Thread(target=publish, daemon=True)
    sender.start()
    begin = time.monotonic()
    found = asyncio.run(example("transforms.py")("r1", count=3, transport=net))
    ended.set()
    sender.join()
    assert time.monotonic() - begin < 20
    np.testing.assert_array_equal(found, [T] * 3)
    assert "odometry's zero is at 5.00 6.00 7.00 on the map" in capsys.readouterr().out


@pytest.mark.slow
def test_example_single_scan(tmp_path, capsys):
    world = tmp_path / "world"
    simulate(world, SimulationConfig(scene="campus", sensor="os64", seed=2, size=140.0, length=0.0))
    fix = example("single_scan.py")(world / "base.laz", world / "run" / "frames" / "000000.pcd")
    assert fix.T_map_body is not None, capsys.readouterr().out
    truth = read_tum(world / "truth.tum")[1][0]
    assert np.linalg.norm(fix.T_map_body[:3, 3] - truth[:3, 3]) < 0.3


@pytest.mark.slow
def test_example_robot(world_run, capsys):
    """A stand-in node answers every cloud with a pose of the same stamp."""
    net = MemoryTransport()

    def answer(sample):
        pose = PoseMessage(decode_cloud(sample).stamp_ns, "r1", "TRACKING", np.eye(4), np.eye(6), 0.9, "ab")
        net.publish(Sample("coview/r1/out/pose", encode_pose(pose, "json").payload))

    net.subscribe("coview/r1/in/cloud", answer, "newest")
    net.publish(Sample("coview/r1/out/status", b"{}"))
    assert example("robot.py")(world_run, "r1", seconds=0.0, transport=net) == 7
    out = capsys.readouterr().out
    assert "100.00 s: x 0.00  y 0.00  z 0.00  (wrong 1 in 10)" in out
    assert [s.key for s in net.samples("coview/r1/in/*")] == ["coview/r1/in/odom", "coview/r1/in/cloud"] * 7
    assert net.raised == []


def test_every_example_is_tested_and_short():
    here = Path(__file__).read_text(encoding="utf-8")
    for path in (ROOT / "examples").glob("*.py"):
        assert f'example("{path.name}")' in here, f"{path.name} is not tested"
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 60, f"{path.name} says too much"


@pytest.mark.slow
def test_readme_python_runs(world, monkeypatch, capsys):
    monkeypatch.chdir(world.parents[1])
    exec(compile(block("python"), "README.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) > 10  # a line per frame that got a pose
