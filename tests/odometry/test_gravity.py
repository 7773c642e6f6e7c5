"""Where down is: from the ground, from a vector, and when it is not said."""

import numpy as np
import pytest
from fake_lidar_odometry import frame

from coview_stream.config.odometry import LidarOdometryConfig, down, parse_gravity
from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import rot_z
from coview_stream.odometry.gravity import Surfaces, find_ground, gravity_from_walls, ground_plane, level_rotation


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.1, -0.2), (-0.3, 0.15)])
def test_ground_plane_gives_up_direction_and_sensor_height(scene, tilt):
    cloud, up = frame(scene, tilt)
    found = find_ground(cloud)
    assert not isinstance(found, str)
    assert np.degrees(np.arccos(found.up @ up)) < 0.2
    assert found.height == pytest.approx(1.7, abs=0.03)
    assert found.share > 0.5
    assert (find_ground(cloud).up == found.up).all()


def wall():
    rng = np.random.default_rng(1)
    return np.column_stack([np.full(5000, 8.0), rng.uniform(-15, 15, 5000), rng.uniform(-1, 9, 5000)])


def noise():
    return np.random.default_rng(2).uniform([-20, -20, -9], [20, 20, 9], (4000, 3))


def table_top():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-20, 20, (20000, 2))
    near = np.abs(xy).max(axis=1) < 14
    return np.column_stack([xy, np.where(near, -1.0, -6.0 - 0.4 * np.abs(xy[:, 0]))])


def few():
    return np.array([[1.0, 2.0, -1.0], [3.0, 4.0, -1.0]])


@pytest.mark.parametrize("cloud", [wall, noise, table_top, few, lambda: np.empty((0, 3))])
def test_missing_ground_is_explained(cloud):
    assert isinstance(find_ground(cloud()), str)


def test_ceiling_or_plane_at_sensor_height_is_not_taken_for_ground(scene):
    cloud, _ = frame(scene)
    assert isinstance(find_ground(cloud * [1, 1, -1]), str)
    assert isinstance(find_ground(np.abs(cloud)), str)  # walls end there


def test_alignment_turns_up_to_z_and_keeps_the_heading():
    up = np.array([0.2, -0.1, 0.9]) / np.linalg.norm([0.2, -0.1, 0.9])
    R = level_rotation(up)
    assert np.allclose(R @ up, [0, 0, 1])
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.linalg.det(R) > 0
    forward = R @ [1, 0, 0]
    assert forward[1] == pytest.approx(0.0, abs=1e-12)
    assert forward[0] > 0


def test_gravity_option_keywords():
    assert parse_gravity("ground") == "ground"
    assert parse_gravity("level") == "level"
    assert parse_gravity("0.5,0,-9.8") == parse_gravity("0.5, 0, -9.8") == (0.5, 0.0, -9.8)
    assert parse_gravity("-1e-3,0,-9.81") == (-1e-3, 0.0, -9.81)
    assert np.allclose(down((0.0, 0.0, -9.81)), [0, 0, -1])
    assert np.allclose(down("level"), [0, 0, -1])


@pytest.mark.parametrize(
    "text", ["", "up", "0 0 -1", "1,2", "0,0,0", "0,0,nan", "1,0,0", "0,0,x", "0,0,-1,", "0,0,0,0"]
)
def test_invalid_gravity_is_refused(text):
    with pytest.raises(ConfigError, match="gravity"):
        parse_gravity(text)


def test_accelerometer_sign_is_explained():
    with pytest.raises(ConfigError, match="accelerometer"):
        LidarOdometryConfig(gravity=(0.0, 0.0, 9.81))
    for wrong in ("moon", (1.0, 2.0)):
        with pytest.raises(ConfigError, match="gravity"):
            LidarOdometryConfig(gravity=wrong)


TRUE = np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])


def wall_facing(normal, at, seed=0):
    """Points of an upright wall; upright along TRUE, horizontal along what is square to both."""
    rng = np.random.default_rng(seed)
    n = normal - (normal @ TRUE) * TRUE
    n /= np.linalg.norm(n)
    along = np.cross(TRUE, n)
    a, b = rng.uniform(-10, 10, (2, 3000))
    return at * n + a[:, None] * along + 0.4 * b[:, None] * TRUE + rng.normal(0, 0.01, (3000, 3))


def lean(up):
    return np.degrees(np.arccos(np.clip(up @ TRUE, -1, 1)))


GROUND = np.array([-0.03, 0.02, 1.0]) / np.linalg.norm([-0.03, 0.02, 1.0])  # the normal of a slope


def test_one_wall_corrects_across_it_and_leaves_the_rest():
    up, _ = gravity_from_walls(wall_facing(np.array([1.0, 0, 0]), 8.0), GROUND)
    assert abs(up[0] - TRUE[0]) < 0.01
    assert abs(up[1] - GROUND[1]) < 0.01


def test_without_walls_gravity_is_unchanged():
    flat = np.random.default_rng(0).uniform([-20, -20, -1.7], [20, 20, -1.69], (5000, 3))
    up, count = gravity_from_walls(flat, GROUND)
    assert np.allclose(up, GROUND)
    assert count == 0
    assert np.allclose(gravity_from_walls(np.empty((0, 3)), GROUND)[0], GROUND)


def test_two_walls_correct_a_slope_and_outvote_leaning_surfaces():
    cloud = [wall_facing(np.array([1.0, 0, 0]), 8.0), wall_facing(np.array([0, 1.0, 0]), -9.0)]
    up, count = gravity_from_walls(np.concatenate(cloud), GROUND)
    assert lean(GROUND) > 5
    assert lean(up) < 0.3
    assert count > 15
    assert np.linalg.norm(up) == pytest.approx(1.0)
    c, s = np.cos(np.radians(10.0)), np.sin(np.radians(10.0))
    cloud.append(wall_facing(np.array([1.0, 0, 0.2]), -8.0)[:600] @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]))
    assert lean(gravity_from_walls(np.concatenate(cloud), GROUND)[0]) < 0.6


def test_walls_and_ground_of_a_tilted_frame_point_up(scene):
    cloud, up = frame(scene, (0.05, -0.04))
    around = Surfaces.around(cloud, np.array([0.0, 0.0, 1.0]), None)
    seen = around.seen(rot_z(0.7) @ level_rotation(up))
    assert np.degrees(np.abs(seen.walls).max()) < 0.2
    assert np.degrees(np.abs(seen.ground).max()) < 0.3
    assert np.degrees(np.sqrt(np.diag(seen.covariance)).max()) < 2.0
    assert len(seen.rows()[1]) == 4


def test_nothing_around_is_nothing_seen():
    around = Surfaces.around(np.zeros((0, 3)), np.array([0.0, 0.0, 1.0]), None)
    seen = around.seen(np.eye(3))
    assert seen.walls is None
    assert seen.ground is None
    assert len(seen.rows()[1]) == 0
    assert np.isfinite(seen.covariance).all()


def test_ground_is_found_again_from_the_one_before_or_anew(scene):
    cloud, _ = frame(scene, (0.02, 0.0))
    anew = ground_plane(cloud)
    again = ground_plane(cloud, ground_plane(frame(scene)[0]))
    gone = ground_plane(cloud, ground_plane(cloud + np.array([0.0, 0.0, -6.0])))  # of a sensor that stood 6 m higher
    for found in (again, gone):
        assert np.degrees(np.arccos(np.clip(anew.up @ found.up, -1, 1))) < 0.3
        assert abs(anew.height - found.height) < 0.03
