"""A localizer whose sensor leans, or whose odometry has another scale, on the small world."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import pose_error

from coview_stream.geometry.transforms import exp_so3, pose_from
from coview_stream.localization.localizer import Localizer


def poses_of(localizer, clouds, odometry, truth):
    """Return frame, metres and degrees of error of each pose, and the last fix."""
    errors, fix = [], None
    for k, (cloud, T) in enumerate(zip(clouds, odometry, strict=True)):
        fix = localizer.step(cloud, T, 0.5 * k)
        if fix.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_odom @ T, fix.T_map_body, atol=1e-6)
            errors.append((k, *pose_error(fix.T_map_body, truth[k])))
    return errors, fix


@pytest.mark.slow
@pytest.mark.parametrize("lean", [(0.0, 3.0), (-2.0, -2.0)])
def test_leaning_sensor_is_levelled(world_map, world_drive, world_fixes, lean):
    R = exp_so3(np.radians([*lean, 0.0]))
    clouds = [(cloud @ R.T).astype(np.float32) for cloud in world_drive.clouds]
    errors, fix = poses_of(Localizer(world_map), clouds, world_drive.T_odom_body, world_drive.T_map_body)
    straight = sum(each.T_map_body is not None for each in world_fixes)
    assert len(errors) >= 0.85 * straight
    assert max(metres for _, metres, _ in errors) < 0.1
    assert max(degrees for _, _, degrees in errors) < 0.6
    assert np.degrees(fix.calibration.roll) == pytest.approx(-lean[0], abs=0.3)
    assert np.degrees(fix.calibration.pitch) == pytest.approx(-lean[1], abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.93, 1.07])
def test_scale_of_odometry_is_learnt(world_map, world_drive, world_fixes, scale):
    odometry = [pose_from(T[:3, :3], scale * T[:3, 3]) for T in world_drive.T_odom_body]
    errors, fix = poses_of(Localizer(world_map), world_drive.clouds, odometry, world_drive.T_map_body)
    assert len(errors) >= 0.85 * sum(each.T_map_body is not None for each in world_fixes)
    assert max(metres for _, metres, _ in errors) < 0.1
    assert (1.0 + fix.calibration.scale) * scale == pytest.approx(1.0, abs=0.02)
