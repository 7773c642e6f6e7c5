"""What is known of a sensor, over a search result that comes late, another odometry frame, and a reset."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from small_world import pose_error

from coview_stream.geometry.transforms import exp_so3, pose_from
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.state import State

LEAN = np.radians(3.0)


@pytest.fixture(scope="module")
def leaning(world_drive):
    """Clouds of the drive from a sensor that looks down by three degrees."""
    R = exp_so3(np.array([0.0, LEAN, 0.0]))
    return [(cloud @ R.T).astype(np.float32) for cloud in world_drive.clouds]


@pytest.mark.slow
def test_search_result_that_comes_frames_later_levels_the_sensor(world_map, world_drive, leaning):
    """The keyframe's clouds were levelled by what was known then."""
    localizer, waiting, errors = Localizer(world_map), [], []
    for k, cloud in enumerate(leaning):
        if len(waiting) == 2:
            localizer.apply_search_result(localizer.search.update(waiting.pop(0)))
        request = localizer.add_frame(cloud, world_drive.T_odom_body[k], 0.5 * k)
        if request is not None:
            waiting.append(request)
        fix = localizer.fix()
        if fix.T_map_body is not None:
            errors.append(pose_error(fix.T_map_body, world_drive.T_map_body[k]))
    assert len(errors) > 0.5 * len(leaning)
    assert max(metres for metres, _ in errors) < 0.1
    assert max(degrees for _, degrees in errors) < 0.6
    assert fix.calibration.pitch == pytest.approx(-LEAN, abs=np.radians(0.3))


@pytest.mark.slow
def test_calibration_outlives_the_odometry_frame_but_no_reset(world_map, world_drive, leaning):
    localizer = Localizer(world_map)
    for k, cloud in enumerate(leaning):
        fix = localizer.step(cloud, world_drive.T_odom_body[k], 0.5 * k)
    assert fix.state is State.TRACKING
    localizer.relocalize(1)
    T_other = pose_from(exp_so3(np.array([0.0, 0.0, 1.0])), [40.0, -3.0, 1.0])
    localizer.add_frame(leaning[0], T_other @ world_drive.T_odom_body[0], 60.0)
    begun = localizer.fix()
    assert begun.T_map_body is None
    assert begun.calibration.pitch == pytest.approx(-LEAN, abs=np.radians(0.3))
    localizer.reset(2)
    localizer.add_frame(leaning[0], world_drive.T_odom_body[0], 90.0)
    assert localizer.fix().calibration.pitch == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1.05])
def test_odometry_in_utm_that_turns_is_corrected(world_map, world_drive, world_fixes, scale):
    """Far from its origin, a factor or a turn about that would be kilometres."""
    utm = np.array([512_345.6, 5_403_210.9, 287.4])
    odometry, turned = [pose_from(world_drive.T_odom_body[0][:3, :3], utm)], 0.0
    for before, T in pairwise(world_drive.T_odom_body):
        step = T[:3, 3] - before[:3, 3]
        turned += np.radians(0.1) * float(np.linalg.norm(step))
        turn = exp_so3(np.array([0.0, 0.0, turned]))
        odometry.append(pose_from(turn @ T[:3, :3], odometry[-1][:3, 3] + scale * (turn @ step)))
    localizer, errors = Localizer(world_map), []
    for k, (cloud, T) in enumerate(zip(world_drive.clouds, odometry, strict=True)):
        fix = localizer.step(cloud, T, 0.5 * k)
        if fix.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_odom @ T, fix.T_map_body, atol=1e-5)
            errors.append(pose_error(fix.T_map_body, world_drive.T_map_body[k]))
    assert len(errors) >= 0.8 * sum(each.T_map_body is not None for each in world_fixes)
    assert max(metres for metres, _ in errors) < 0.15
    assert (1.0 + fix.calibration.scale) * scale == pytest.approx(1.0, abs=0.02)
