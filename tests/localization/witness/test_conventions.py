"""Units and axes by motions: which reading of clouds and odometry explains them, and how it is said."""

from itertools import pairwise

import numpy as np
import pytest

from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z
from coview_stream.localization.witness.conventions import (
    AS_SENT,
    AXES,
    FEET,
    MIRRORED,
    ODOMETRY,
    RIVALS,
    SURE,
    Pair,
    fit,
    turned_clouds,
    unit_of,
)

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def drive(change=lambda T: T, clouds=None, sway=0.0, turn=0.15, count=4):
    """Pairs 2 m apart round a bend; ``change`` spoils odometry, ``clouds`` (4, 4) are the axes <- the body's."""
    poses, clouds = [np.eye(4)], np.eye(4) if clouds is None else clouds
    for k in range(count):
        lean = exp_so3([sway * (-1) ** k, 0.0, 0.0])
        step = pose_from(rot_z(turn) @ lean, [2.0, 0.02, 0.0])
        poses.append(poses[-1] @ step)
    return [
        Pair(clouds @ inverse(a) @ b @ np.linalg.inv(clouds), 0.03, change(a), change(b)) for a, b in pairwise(poses)
    ]


def test_motions_that_agree_are_as_sent_and_no_other_reading_comes_near():
    seen = fit(drive())
    assert seen.odds > SURE
    assert (seen.misfit, seen.yaw, seen.scale) == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)
    others = [MIRRORED, *(turned_clouds(0, angle) for angle in (np.pi / 2, -np.pi / 2, np.pi)), *ODOMETRY[2:]]
    assert max(fit(drive(), reading).odds for reading in others) < seen.odds - SURE


@pytest.mark.parametrize("heading", [np.pi / 2, -np.pi / 2, np.pi, 0.6])
def test_turned_clouds_are_read_by_their_heading(heading):
    pairs = drive(clouds=pose_from(rot_z(heading), np.zeros(3)))
    seen = fit(pairs)
    assert seen.odds < 0
    assert np.exp(1j * seen.yaw) == pytest.approx(np.exp(1j * heading), abs=1e-6)
    assert fit(pairs, turned_clouds(0, heading)).odds > SURE


def test_a_mirror_shows_in_a_bend_and_in_sways_but_not_on_a_level_straight():
    for bend in (drive(clouds=MIRROR), drive(clouds=MIRROR, turn=0.0, sway=np.radians(1.0))):
        assert fit(bend, MIRRORED).odds > fit(bend).odds + SURE
    straight = drive(clouds=MIRROR, turn=0.0)
    assert fit(straight, MIRRORED).odds - fit(straight).odds < 0.5


def test_odometry_of_a_plane_is_no_mirror():
    def planar(T):
        yaw = np.arctan2(T[1, 0], T[0, 0])
        return pose_from(rot_z(yaw), [*T[:2, 3], 0.0])

    pairs = drive(change=planar, sway=np.radians(1.0))
    assert fit(pairs).odds > SURE
    assert fit(pairs, MIRRORED).odds < 0


@pytest.mark.parametrize("name", ["transposed", "z down", "camera", "millimetres", "feet"])
def test_spoilt_odometry_is_read_by_what_mends_it(name):
    spoil = {
        "transposed": RIVALS["transposed"],
        "z down": RIVALS["z down"],
        "camera": lambda T: inverse(pose_from(CAMERA, np.zeros(3))) @ T @ pose_from(CAMERA, np.zeros(3)),
        "millimetres": lambda T: pose_from(T[:3, :3], 1000.0 * T[:3, 3]),
        "feet": lambda T: pose_from(T[:3, :3], T[:3, 3] / 0.3048),
    }
    pairs = drive(change=spoil[name])
    reading = next(each for each in ODOMETRY if each.change is RIVALS[name])
    assert fit(pairs, reading).odds > SURE > fit(pairs).odds


CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.mark.parametrize(
    ("axis", "heading", "words"),
    [
        (0, np.pi / 2, "body: y points forward"),
        (0, 0.5, "body: x points 29 degrees to the right"),
        (1, 0.0, "body: z points down"),
        (3, np.pi / 2, "body: -y points up, z points forward"),
    ],
)
def test_axes_are_named(axis, heading, words):
    assert turned_clouds(axis, heading).found.endswith(words)
    assert np.linalg.norm(AXES[axis]) == 1.0


def test_a_cloud_in_millimetres_lies_farther_than_any_lidar_sees():
    near = np.random.default_rng(0).normal(0.0, 20.0, (500, 3)).astype(np.float32)
    assert (unit_of(near), unit_of(near * 1000), unit_of(near / np.float32(0.3048))) == (1.0, 0.001, 1.0)
    assert AS_SENT.found != FEET.found
