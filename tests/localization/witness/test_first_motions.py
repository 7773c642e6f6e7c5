"""Conventions by clouds of a small world: named within ten metres, and not where there is nothing to name."""

import numpy as np
import pytest
import small_world

from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.tracking.monitor import RejectionReason
from coview_stream.localization.witness.first_motions import Conventions

pytestmark = pytest.mark.slow
SENT = {
    "in feet": np.eye(3) / 0.3048,
    "in millimetres": np.eye(3) * 1e3,
    "z points down": np.diag([1.0, -1.0, -1.0]),
    "y points forward": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "left-handed": np.diag([1.0, -1.0, 1.0]),
}


@pytest.fixture(scope="module")
def drive(scene):
    """Twelve metres straight on, then round a bend; a frame each metre and a half."""
    return small_world.record_along(scene, small_world.drive(10), 1.6)


def judged(drive, matrix=None, frames=99):
    conventions = Conventions()
    for cloud, T in list(zip(drive.clouds, drive.T_odom_body, strict=True))[:frames]:
        conventions.add(cloud if matrix is None else (cloud @ matrix.T).astype(np.float32), T)
    return conventions


def test_right_clouds_are_plausible_and_then_settled(drive):
    assert judged(drive, frames=5).plausible
    whole = judged(drive)
    assert (whole.finding, whole.settled) == (None, True)


@pytest.mark.parametrize("name", SENT)
def test_wrong_clouds_are_named_within_ten_metres_and_a_mirror_in_a_bend(drive, name):
    found = judged(drive, SENT[name], frames=99 if name == "left-handed" else 7)
    assert name in found.finding
    assert not found.settled


def test_each_of_two_readings_has_its_remedy(drive):
    found = judged(drive, np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), frames=4).finding
    first, second = found.split("; or else ")
    assert "x and y of one are swapped: send both" in first
    assert "y points forward: send them" in second
    assert "--mount" in second


def test_a_finding_goes_when_the_sender_is_mended(drive):
    conventions = judged(drive, SENT["y points forward"], frames=6)
    assert conventions.finding
    for cloud, T in list(zip(drive.clouds, drive.T_odom_body, strict=True))[6:]:
        conventions.add(cloud, T)
    assert conventions.finding is None


def test_a_corridor_without_ends_shows_no_motion_along_it():
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-20.0, 20.0, 0.2), np.arange(-2.0, 2.1, 0.2)))
    floor = np.column_stack([x, y, np.full(len(x), -1.7)])
    walls = [np.column_stack([x, np.full(len(x), side), y + 0.3]) for side in (-2.1, 2.1)]
    cloud, conventions = np.concatenate([floor, *walls]).astype(np.float32), Conventions()
    for k in range(4):
        conventions.add(cloud, pose_from(np.eye(3), [1.2 * k, 0.0, 0.0]))
    assert (conventions.finding, conventions.plausible) == (None, False)


def test_rings_on_the_walls_of_a_corridor_raise_no_doubt():
    """They move with the sensor, so clouds seem to stand; but odometry's motion fits as well."""
    azimuth, up = (
        each.ravel() for each in np.meshgrid(np.radians(np.arange(0.2, 360.0, 0.4)), np.radians(range(-15, 16, 2)))
    )
    rays = np.column_stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
    rng, conventions = np.random.default_rng(0), Conventions()
    for k in range(12):
        to_wall = (1.5 - 0.2 * np.sin(k) * np.sign(rays[:, 1])) / np.abs(rays[:, 1])
        to_floor = np.where(rays[:, 2] < 0.0, 0.8, 1.7) / np.abs(rays[:, 2])
        reach = np.minimum(to_wall, to_floor)
        cloud = rays * (reach + rng.normal(0.0, 0.015, len(rays)))[:, None]
        conventions.add(cloud[reach < 60.0].astype(np.float32), pose_from(np.eye(3), [k, 0.2 * np.sin(k), 0.0]))
        assert not conventions.doubtful
    assert conventions.finding is None


def test_the_localizer_names_it_and_gives_no_pose(world_map, drive):
    localizer = Localizer(world_map)
    for k, (cloud, T) in enumerate(zip(drive.clouds, drive.T_odom_body, strict=True)):
        fix = localizer.step((cloud @ SENT["y points forward"].T).astype(np.float32), T, float(k))
        if k >= 6:
            assert fix.T_map_body is None
            assert fix.evidence.cause is RejectionReason.CONVENTIONS
            assert "y points forward" in fix.evidence.reason


def test_nothing_that_was_sent_wrongly_is_searched_once_the_sender_is_mended(world_map, drive):
    localizer, first = Localizer(world_map), None
    for k, (cloud, T) in enumerate(zip(drive.clouds, drive.T_odom_body, strict=True)):
        sent = cloud if k >= 6 else (cloud @ SENT["y points forward"].T).astype(np.float32)
        request = localizer.add_frame(sent, T, float(k))
        first = first or request
        if k >= 6 and request is not None:
            break
    assert len(request.submap) < 1.2 * len(first.submap)  # of one frame, as the first
