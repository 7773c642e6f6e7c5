"""Robots of one node that cannot be told apart by their keys are refused."""

from __future__ import annotations

import re

import pytest

from coview_stream.errors import ConfigError
from coview_stream.stream.transport.keys import PRESETS, check_disjoint, robot_keys


def fleet(preset="native", names=("r1", "r2"), **given):
    return [robot_keys(preset, "coview", name, **given) for name in names]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_has_disjoint_robot_keys(preset):
    check_disjoint(fleet(preset, ("r1", "r2", "r10")))


def test_wildcard_keys_of_one_robot_are_accepted():
    check_disjoint(fleet(names=["r1"], cloud="**/cloud", odometry="*/odom"))
    check_disjoint(fleet(cloud="site/*/{robot}/**", odometry="{robot}$*/odom", pose="poses/{robot}"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cloud": "lidar/points"}, "--cloud-key.*r1.*r2.*use {robot} in --cloud-key"),
        ({"cloud": "**/cloud"}, "--cloud-key.*r1.*r2.*use {robot} in --cloud-key"),
        ({"odometry": "*/odom"}, "--odometry-key.*r1.*r2.*use {robot} in --odometry-key"),
        ({"cloud": "a/{robot}/*", "odometry": "a/*/odom"}, "--cloud-key and --odometry-key"),
        ({"pose": "pose"}, "--pose-key.*r1 and r2.*use {robot} in --pose-key"),
        ({"pose": "coview/{robot}/in/odom"}, "--pose-key.*robot r1.*input of r1.*--odometry-key"),
        ({"cloud": "{robot}/**", "pose": "{robot}/pose"}, "--pose-key.*robot r1.*input of r1.*--cloud-key"),
    ],
)
def test_overlapping_keys_are_refused(given, message):
    with pytest.raises(ConfigError, match=re.sub(r"([{}])", r"\\\1", message)):
        check_disjoint(fleet(**given))


def test_pose_key_read_by_another_robot_is_refused():
    first = robot_keys("native", "coview", "r1", pose="coview/r2/in/odom")
    with pytest.raises(ConfigError, match=r"poses of robot r1 .* input of r2"):
        check_disjoint([first, robot_keys("native", "coview", "r2")])


def test_duplicate_robot_name_is_refused():
    with pytest.raises(ConfigError, match="each name once"):
        check_disjoint(fleet(names=("r1", "r1")))
