"""Kinds of dirt by name: off by default, each with its own numbers, and the truth stays the truth."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from tiny_world import TINY

from coview_stream.cli import main
from coview_stream.clouds import read_cloud, read_tum
from coview_stream.errors import ConfigError
from coview_stream.recordings.open_run import open_run
from coview_stream.sim import Dirt, parse_dirt, simulate
from coview_stream.sim.dirt import KINDS_OF_DIRT, real
from coview_stream.sim.dirt.scan import Stream, stream
from coview_stream.sim.dirt.survey import Density
from coview_stream.sim.simulate import frames, scene_of, trajectories

BASE_POINTS, FRAME_POINTS = 12759, [24385, 24316, 24337, 24366]
TRUTH = ["1000.300000", "-8.652942", "11.659302", "-0.467424"]
ODOMETRY = ["1000.300000", "-274.298736", "240.661939", "-39.517563"]
THIN = Density(1.0, 5.0)  # a survey that is done quickly
OFF_SENSOR = ("gravity", "odometry", "slip", "strips", "density", "seasons", "years")


@pytest.mark.slow
def test_a_clean_world_is_what_it_was_before_there_was_dirt(world):
    """Figures of the code before dirt; a few points may differ where another processor rounds otherwise."""
    assert len(read_cloud(world / "base.laz")) == pytest.approx(BASE_POINTS, abs=3)
    counts = [len(read_cloud(world / "run" / "frames" / f"{k:06d}.pcd")) for k in range(4)]
    assert counts == pytest.approx(FRAME_POINTS, abs=3)
    assert (world / "truth.tum").read_text().splitlines()[-1].split()[:4] == TRUTH
    assert (world / "run" / "odometry.tum").read_text().splitlines()[-1].split()[:4] == ODOMETRY
    assert "dirt" not in json.loads((world / "world.json").read_text())


def test_every_kind_has_a_name_and_can_be_switched_on_alone():
    assert {each.name for each in fields(Dirt)} == {"seed", *KINDS_OF_DIRT}
    for name in KINDS_OF_DIRT:
        assert parse_dirt(name).kinds == (name,)
    assert real().kinds == parse_dirt("real").kinds == KINDS_OF_DIRT
    assert Dirt().kinds == ()


def test_a_number_says_how_strong():
    dirt = parse_dirt("mounting:3, snow:0.4,years:5")
    assert dirt.mounting.lean == 3.0
    assert dirt.snow.depth == 0.4
    assert dirt.years.years == 5.0
    assert parse_dirt("real,snow:0.1").kinds == KINDS_OF_DIRT
    assert parse_dirt("real,snow:0.1").snow.depth == 0.1
    for name in KINDS_OF_DIRT:
        values = parse_dirt(name).to_dict()[name]
        assert all(value is not None for value in values.values())


@pytest.mark.parametrize("text", ["moon", "snow:deep", "snow:9", "real:2", "glass:1.5", "companions"])
def test_unknown_dirt_is_refused(text):
    with pytest.raises(ConfigError):
        parse_dirt(text)
    with pytest.raises(ConfigError, match=r"'mounting:99', the number being degrees that the sensor leans.*0 and 30"):
        parse_dirt("mounting:99")


@pytest.mark.parametrize("name", KINDS_OF_DIRT)
def test_settings_out_of_range_are_refused(name):
    settings = type(getattr(real(), name))
    for field in fields(settings):
        if not isinstance(field.default, bool | tuple):
            with pytest.raises(ConfigError, match=f"{field.name}|most"):
                settings(**{field.name: 1e9})
            with pytest.raises(ConfigError, match=field.name):
                settings(**{field.name: float("nan") if isinstance(field.default, float) else -1})


@pytest.mark.slow
def test_the_command_line_takes_dirt(tmp_path, capsys):
    argv = ["simulate", str(tmp_path / "w"), "--scene", "village", "--seed", "5", "--size", "80", "--density", "2"]
    assert main([*argv, "--length", "0.3", "--dirt", "rain,mounting:3", "--dirt-seed", "4"]) == 0
    facts = json.loads((tmp_path / "w" / "world.json").read_text())["dirt"]
    assert set(facts) == {"seed", "rain", "mounting"}
    assert (facts["seed"], facts["mounting"]["lean"]) == (4, 3.0)
    assert "dirt: mounting 3: degrees that the sensor leans" in capsys.readouterr().out
    assert main([*argv, "--dirt", "moon"]) == 2
    assert "moon" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS_OF_DIRT)
def test_each_kind_changes_what_it_should_and_never_the_truth(name, world, tmp_path):
    simulate(tmp_path / "w", replace(TINY, dirt=parse_dirt(name, seed=1)))
    assert (tmp_path / "w" / "sweeps").exists() is (name == "motion")
    assert (tmp_path / "w" / "truth.tum").read_bytes() == (world / "truth.tum").read_bytes()
    odometry = (tmp_path / "w" / "run" / "odometry.tum").read_bytes()
    assert (odometry != (world / "run" / "odometry.tum").read_bytes()) is (name in ("gravity", "odometry", "slip"))
    ours, theirs = (read_cloud(each / "base.laz").points for each in (tmp_path / "w", world))
    same_map = ours.shape == theirs.shape and bool((ours == theirs).all())
    assert same_map is (name not in ("strips", "density", "seasons", "years"))
    ours, theirs = (read_cloud(each / "run" / "frames" / "000003.pcd").points for each in (tmp_path / "w", world))
    same_frame = ours.shape == theirs.shape and bool((ours == theirs).all())
    assert same_frame is (name in OFF_SENSOR and name != "years")


@pytest.mark.slow
def test_equal_seeds_give_equal_dirt(tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        simulate(tmp_path / name, replace(TINY, dirt=replace(real(seed), density=THIN)))
    for file in ("run/odometry.tum", "run/frames/000002.pcd", "run/frames/000003.pcd"):
        a, b, c = ((tmp_path / name / file).read_bytes() for name in "abc")
        assert a == b
        assert a != c
    a, b, c = (read_cloud(tmp_path / name / "base.laz").map_points() for name in "abc")
    np.testing.assert_array_equal(a, b)
    assert a.shape != c.shape
    assert read_tum(tmp_path / "a" / "truth.tum")[1].shape == read_tum(tmp_path / "c" / "truth.tum")[1].shape


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "sensor"),
    [("town", "os64"), ("campus", "mid360"), ("industrial", "vlp16"), ("forest", "vlp16"), ("forest", "mid360")],
)
def test_all_dirt_at_once_leaves_a_run_to_work_with(scene, sensor, tmp_path):
    simulate(tmp_path / "w", replace(TINY, scene=scene, sensor=sensor, length=0.35, dirt=replace(real(), density=THIN)))
    run = open_run(tmp_path / "w" / "run")
    assert len(run) == 3
    for frame in run:
        assert len(frame.points) > 4_000
        assert np.abs(frame.points).max() < 140.0
    assert len(open_run(tmp_path / "w" / "sweeps")) == 3


def test_one_kind_leaves_the_random_numbers_of_another():
    alone, both = (replace(TINY, dirt=parse_dirt(text)) for text in ("slip", "slip,gravity:0"))
    scene = scene_of(TINY)
    np.testing.assert_allclose(trajectories(scene, alone)[2], trajectories(scene, both)[2], atol=1e-9)
    assert stream(1, 0, Stream.SLIP).random() != stream(1, 0, Stream.GRAVITY).random()
    assert stream(1, 0, Stream.SLIP).random() != stream(1, 1, Stream.SLIP).random()


@pytest.mark.slow
def test_frames_without_odometry_are_deskewed_by_the_truth():
    config = replace(TINY, dirt=parse_dirt("motion"))
    scene = scene_of(config)
    _, truth, _ = trajectories(scene, config)
    for own, given in zip(frames(scene, config, truth), frames(scene, config, truth, truth), strict=True):
        np.testing.assert_array_equal(own, given)
