"""Worlds on disk: the layout of the contract, equal seeds equal bytes, all or nothing."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tiny_world import TINY

from coview_stream.cli import main
from coview_stream.clouds import read_cloud, read_tum
from coview_stream.config.mount import parse_mount
from coview_stream.errors import ConfigError, InputError
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import Dirt, Simulated, SimulationConfig, simulate
from coview_stream.sim.dirt.robot import Motion
from coview_stream.sim.simulate import frames, scene_of, trajectories

ORIGIN = (412_000.0, 5_318_000.0, 240.0)


def test_simulated_files_follow_the_run_layout(world):
    facts = json.loads((world / "world.json").read_text())
    stamps, truth = read_tum(world / "truth.tum")
    odometry_stamps, _ = read_tum(world / "run" / "odometry.tum")
    assert len(stamps) == facts["frames"] == len(list((world / "run" / "frames").iterdir()))
    np.testing.assert_array_equal(stamps, odometry_stamps)
    np.testing.assert_allclose(np.diff(stamps), 0.1)
    assert len(read_cloud(world / "base.laz")) == facts["base_points"] > 5_000
    first = next(iter(open_run(world / "run")))
    assert len(first.points) > 5_000
    assert truth[0, 2, 2] > 0.98


@pytest.mark.slow
def test_equal_seeds_give_equal_bytes_and_others_another_world(world, tmp_path):
    simulate(tmp_path / "b", TINY)
    names = sorted(path.relative_to(world) for path in world.rglob("*") if path.is_file())
    assert names == sorted(p.relative_to(tmp_path / "b") for p in (tmp_path / "b").rglob("*") if p.is_file())
    for name in names:
        ours, theirs = world / name, tmp_path / "b" / name
        if name.suffix == ".laz":  # its header holds the date of the day
            np.testing.assert_array_equal(read_cloud(ours).map_points(), read_cloud(theirs).map_points())
        else:
            assert ours.read_bytes() == theirs.read_bytes(), name
    simulate(tmp_path / "c", replace(TINY, seed=6))
    assert (tmp_path / "c" / "truth.tum").read_bytes() != (world / "truth.tum").read_bytes()


def test_origin_moves_only_map_and_ground_truth(world, tmp_path, capsys):
    argv = ["simulate", str(tmp_path / "u"), "--scene", "village", "--seed", "5", "--size", "80"]
    assert main([*argv, "--length", "0.5", "--density", "2", "--utm"]) == 0
    assert "map points, 4 frames" in capsys.readouterr().out
    moved, here = read_cloud(tmp_path / "u" / "base.laz"), read_cloud(world / "base.laz")
    np.testing.assert_allclose(moved.map_points() - ORIGIN, here.map_points(), atol=2e-3)
    T_moved, T_here = read_tum(tmp_path / "u" / "truth.tum")[1], read_tum(world / "truth.tum")[1]
    np.testing.assert_allclose(T_moved[:, :3, 3] - ORIGIN, T_here[:, :3, 3], atol=1e-5)
    for name in ("run/odometry.tum", "run/frames/000000.pcd"):
        assert (tmp_path / "u" / name).read_bytes() == (world / name).read_bytes()


def test_foreign_files_are_not_overwritten(tmp_path):
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(InputError, match="not empty"):
        simulate(tmp_path, TINY, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


class Broken:
    """Dirt of the odometry that ends the simulation after the base map."""

    def apply(self, *_):
        raise InputError("broken")


def test_failed_simulation_leaves_no_files(tmp_path):
    with pytest.raises(InputError, match="broken"):
        simulate(tmp_path / "w", replace(TINY, dirt=Dirt(slip=Broken())))
    assert list(tmp_path.iterdir()) == []


def test_only_an_earlier_simulated_world_is_replaced(world, tmp_path):
    copy = tmp_path / "w"
    shutil.copytree(world, copy)
    with pytest.raises(InputError, match="--overwrite"):
        simulate(copy, TINY)
    (copy / "run" / "frames" / "999999.pcd").write_bytes(b"left over")
    assert isinstance(simulate(copy, TINY, overwrite=True), Simulated)
    assert not (copy / "run" / "frames" / "999999.pcd").exists()


def test_frames_of_a_mounted_sensor_are_its_own_and_the_option_turns_them_back(tmp_path, capsys):
    argv = ["simulate", str(tmp_path / "m"), "--scene", "village", "--seed", "5", "--size", "80", "--length", "0"]
    assert main([*argv, "--density", "2", "--mount=0,45,0,0.3,0,0.2"]) == 0
    assert "locate ... --mount=0,45,0,0.3,0,0.2" in capsys.readouterr().out
    mount = parse_mount("0,45,0,0.3,0,0.2")
    raw, body = (next(iter(open_run(tmp_path / "m" / "run", mount=given))).points for given in (None, mount))
    np.testing.assert_allclose(body, mount.to_body(raw), atol=1e-5)
    elevation = np.degrees(np.arctan2(raw[:, 2], np.hypot(raw[:, 0], raw[:, 1])))
    assert np.abs(elevation).max() < 15.1
    ahead = body[(np.abs(body[:, 1]) < 1.0) & (body[:, 0] > 0.5)]
    assert len(ahead) > 500  # a nose down by 45 degrees sees the road before the robot
    assert np.abs(ahead[:, 2] + 1.5).max() < 0.4


@pytest.mark.slow
def test_a_mounted_moving_sensor_is_deskewed_as_an_upright_one(tmp_path):
    moving = replace(TINY, length=1.0, dirt=Dirt(motion=Motion()))
    turned = replace(moving, mount=parse_mount("0,0,90"))
    clouds = []
    for name, config in (("a", moving), ("b", turned)):
        simulate(tmp_path / name, config)
        clouds.append([frame.points for frame in open_run(tmp_path / name / "run", mount=config.mount)][-1])
        assert len(open_run(tmp_path / name / "sweeps", mount=config.mount)) > 0
    apart = cKDTree(clouds[0]).query(clouds[1])[0]  # another beam leaves first, on the same surfaces
    assert np.median(apart) < 0.1


def test_a_robot_with_a_terrestrial_scanner_stands_while_it_scans():
    config = replace(TINY, sensor="blk360", length=11.0, speed=0.5)
    scene = scene_of(config)
    stamps, truth, odometry = trajectories(scene, config)
    np.testing.assert_allclose(np.diff(stamps), 40.0 + 5.0 / 0.5)
    assert len(truth) == len(odometry) == 3
    np.testing.assert_allclose(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1), 5.0, atol=0.2)
    cloud = next(frames(scene, config, truth))
    assert 50_000 < len(cloud) < 150_000


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("scene", "moon"),
        ("sensor", "radar"),
        ("seed", -1),
        ("size", 10.0),
        ("length", -1.0),
        ("density", 0.0),
        ("changed", 1.5),
        ("speed", 0.0),
        ("height", float("nan")),
        ("origin", (1.0, 2.0)),
    ],
)
def test_invalid_simulation_config_is_refused(field, value):
    with pytest.raises(ConfigError, match=field):
        SimulationConfig(**{field: value})


@pytest.mark.parametrize(
    "options",
    [["--scene", "moon"], ["--size", "5"], ["--utm", "--origin", "1", "2", "3"], ["--drift", "-1"], ["--seed", "x"]],
)
def test_bad_simulate_options_are_one_line_and_write_nothing(options, tmp_path, refused):
    refused("simulate", tmp_path / "w", *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_another_drive_seed_is_another_run_through_the_same_world():
    first, other = SimulationConfig(seed=3), SimulationConfig(seed=3, drive_seed=1)
    scenes = [scene_of(config) for config in (first, other)]
    assert np.array_equal(scenes[0].now.solid.vertices, scenes[1].now.solid.vertices)
    one, two = (trajectories(scene, config)[1] for scene, config in zip(scenes, (first, other), strict=True))
    assert len(one) != len(two) or not np.allclose(one, two)
    assert "drive_seed" not in first.to_dict()
    assert other.to_dict()["drive_seed"] == 1
