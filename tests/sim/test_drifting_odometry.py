"""Odometry: its own frame, gravity aligned, and drift of the promised size."""

import numpy as np
import pytest

from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, wrap_angle, yaw_of
from coview_stream.sim.odometry import OdometryConfig, drifting_odometry

PERFECT = OdometryConfig(yaw_walk=0, scale_error=0, position_walk=0, tilt_noise=0)


def circle(count=400, step=0.25):
    """A drive round a circle of 100 m, tilted a little."""
    angle = 2 * np.pi * step * np.arange(count) / 100.0
    radius = 100.0 / (2 * np.pi)
    tilt = np.array([[1, 0, 0.02], [0, 1, 0], [-0.02, 0, 1]]) / np.sqrt([1.0004, 1, 1.0004])
    positions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)])
    poses = [pose_from(rot_z(a + np.pi / 2) @ tilt, p) for a, p in zip(angle, positions, strict=True)]
    return np.stack(poses)


def test_without_drift_one_yaw_transform_explains_all_poses():
    truth = circle()
    odometry = drifting_odometry(truth, PERFECT, np.random.default_rng(1))
    T_odom_map = odometry[0] @ inverse(truth[0])
    np.testing.assert_allclose(odometry, T_odom_map @ truth, atol=1e-9)
    np.testing.assert_allclose(T_odom_map[2, :3], [0, 0, 1], atol=1e-9)
    assert np.abs(T_odom_map[:2, 3]).max() > 1.0


def test_drift_has_the_configured_size():
    truth = circle()
    config = OdometryConfig()
    yaw, ratio = [], []
    for seed in range(150):
        odometry = drifting_odometry(truth, config, np.random.default_rng(seed))
        offsets = [yaw_of(o) - yaw_of(t) for o, t in zip(odometry[[0, -1]], truth[[0, -1]], strict=True)]
        yaw.append(wrap_angle(offsets[1] - offsets[0]))
        lengths = [np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() for T in (odometry, truth)]
        ratio.append(lengths[0] / lengths[1])
    assert np.std(yaw) == pytest.approx(config.yaw_walk * np.sqrt(100.0), rel=0.25)
    assert np.std(ratio) == pytest.approx(config.scale_error, rel=0.3)
    assert max(abs(r - 1) for r in ratio) < 2.5 * config.scale_error


def test_odometry_stays_gravity_aligned():
    truth = circle()
    odometry = drifting_odometry(truth, OdometryConfig(), np.random.default_rng(3))
    up = np.einsum("nj,nj->n", odometry[:, 2, :3], truth[:, 2, :3])
    assert np.degrees(np.arccos(np.clip(up, -1, 1))).max() < 0.3
    np.testing.assert_allclose(np.linalg.det(odometry[:, :3, :3]), 1.0)


def test_odometry_of_one_frame():
    assert drifting_odometry(circle(1), OdometryConfig(), np.random.default_rng(0)).shape == (1, 4, 4)


@pytest.mark.parametrize("field", ["yaw_walk", "scale_error", "position_walk", "tilt_noise", "offset"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), 1e9])
def test_odometry_config_out_of_range_is_refused(field, value):
    with pytest.raises(ConfigError, match=field):
        OdometryConfig(**{field: value})
