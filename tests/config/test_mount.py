"""Mounting of a lidar: what its numbers mean, and what is refused."""

import math

import numpy as np
import pytest

from coview_stream.config.mount import Mount, parse_mount
from coview_stream.config.node import NodeConfig
from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import is_pose


def test_upside_down_turns_left_and_up_over():
    points = np.array([[1.0, 2.0, 3.0]], dtype=np.float32)
    assert np.allclose(parse_mount("180,0,0").to_body(points), [[1, -2, -3]], atol=1e-6)
    assert np.allclose(parse_mount("0,0,90").to_body(points), [[-2, 1, 3]], atol=1e-6)
    assert np.allclose(parse_mount("0,90,0").to_body(points), [[3, 2, -1]], atol=1e-6)  # looks down


def test_rolled_first_then_pitched_then_turned_then_shifted():
    mount = parse_mount("90,0,90,10,20,30")
    assert mount.to_body(np.array([[0.0, 0.0, 1.0]])) == pytest.approx(np.array([[11.0, 20.0, 30.0]]))
    assert is_pose(mount.T_body_sensor)
    assert mount.to_body(np.zeros((1, 3), np.float32)).dtype == np.float32


def test_lidar_that_is_the_body_is_not_touched():
    points = np.full((3, 3), np.nan, np.float32)
    assert Mount().to_body(points) is points
    assert NodeConfig().mount == Mount() == parse_mount("0,0,0")


def test_missing_returns_stay_missing():
    points = np.array([[np.nan] * 3, [np.inf, 0, 0], [1, 2, 3]], np.float32)
    assert np.isfinite(parse_mount("10,20,30,1,2,3").to_body(points)).all(axis=1).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "give roll,pitch,yaw"),
        ("1,2,3,4", "4 numbers"),
        ("1", "1 number;"),
        ("1,2,3,4,5,6,7", "7 numbers"),
        ("a,b,c", "give roll,pitch,yaw"),
        ("0 0 180", "give roll,pitch,yaw"),
        ("nan,0,0", "not finite"),
        ("0,361,0", "beyond 360 degrees"),
        ("-720,0,0", "beyond 360 degrees"),
        ("0,0,0,0,0,1500", "not a mount"),
    ],
)
def test_mount_that_is_none_is_refused_in_one_line(text, said):
    with pytest.raises(ConfigError, match=said) as caught:
        parse_mount(text)
    assert str(caught.value).startswith(f"--mount={text}: ")
    assert "\n" not in str(caught.value)


def test_angles_alone_are_a_guess_of_heading_and_place():
    assert parse_mount("180,0,30,0,0,0").drawn
    assert parse_mount("0,0,0").drawn
    guessed = parse_mount("180,0,30")
    assert not guessed.drawn
    assert (guessed.option, parse_mount("180,0,30,0,0,0").option) == ("180,0,30", "180,0,30,0,0,0")
    assert not guessed.turned(np.eye(3)).drawn


def test_correction_is_said_as_an_option_that_has_it():
    mount = parse_mount("180,10,90,0.3,-0.2,0.5")
    R = Mount(roll=0.02, pitch=-0.05).T_body_sensor[:3, :3]
    found = parse_mount(mount.turned(R).option)
    assert np.allclose(found.T_body_sensor[:3, :3], R @ mount.T_body_sensor[:3, :3], atol=2e-3)
    assert np.allclose(found.T_body_sensor[:3, 3], R @ mount.T_body_sensor[:3, 3], atol=6e-3)
    for same in ("0,2.9,0,0,0,0", "0,90,0,0.1,0,0.4", "0,-90,30,0,0,0"):
        assert Mount().moved(parse_mount(same).T_body_sensor).option == same


@pytest.mark.parametrize("wrong", [{"roll": 7.0}, {"yaw": math.nan}, {"x": 1000.0}, {"z": math.inf}])
def test_mount_out_of_range_is_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Mount(**wrong)
