"""What was known of a robot's sensor before: a prior of the localizer, never trusted blindly."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.geometry.transforms import exp_so3
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.localizer import Localizer


def last_fix(world_map, clouds, odometry, known):
    localizer = Localizer(world_map)
    localizer.hint_calibration(known)
    for k, (cloud, T) in enumerate(zip(clouds, odometry, strict=True)):
        fix = localizer.step(cloud, T, 0.5 * k)
    return fix


@pytest.mark.slow
@pytest.mark.parametrize("lean", [0.0, 3.0])
def test_known_lean_is_measured_again(world_map, world_drive, lean):
    """Once it is right, and once the sensor has been set straight meanwhile."""
    known = Calibration(pitch=np.radians(-3.0), sigma_tilt=np.radians(0.1))
    R = exp_so3(np.radians([0.0, lean, 0.0]))
    clouds = [(cloud @ R.T).astype(np.float32) for cloud in world_drive.clouds]
    fix = last_fix(world_map, clouds, world_drive.T_odom_body, known)
    assert fix.T_map_body is not None
    assert np.degrees(fix.calibration.pitch) == pytest.approx(-lean, abs=0.4)


def test_known_calibration_changes_nothing_once_the_place_is_known(world_map, world_drive):
    localizer = Localizer(world_map)
    for k, (cloud, T) in enumerate(zip(world_drive.clouds, world_drive.T_odom_body, strict=True)):
        fix = localizer.step(cloud, T, 0.5 * k)
    localizer.hint_calibration(Calibration(pitch=0.1))
    assert localizer.fix().calibration == fix.calibration


def test_ground_offset_of_the_site_is_restored(world_map):
    localizer = Localizer(world_map)
    localizer.hint_calibration(Calibration(ground=0.35))
    offset = localizer._tracker.ground
    assert offset.metres > 0.15
    offset.clear()  # as at each place that is found
    assert offset.metres > 0.15
