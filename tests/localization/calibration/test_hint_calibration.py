"""What was known of a robot's sensor before: a prior of the localizer, never trusted blindly."""

from __future__ import annotations

import numpy as np
import pytest

from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import exp_so3
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator, mixed
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.state import State


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


def test_scale_is_restored_where_the_sensor_cannot_lean(world_map):
    """Lidar odometry levels itself: its tilt is known for sure, and says nothing of how well the scale is."""
    localizer = Localizer(world_map, LocalizerConfig(sensor_leans=False))
    localizer.hint_calibration(Calibration(pitch=0.05, scale=0.03, sigma_scale=0.001))
    assert 0.008 < localizer.calibration.scale < 0.03  # doubted, for wheels may have been changed
    assert localizer.calibration.pitch == 0.0


def test_what_is_known_better_here_stays_group_by_group(world_map):
    localizer = Localizer(world_map)
    estimator = localizer._frames.estimator
    estimator.restore(Calibration(pitch=0.03, scale=0.0, sigma_tilt=np.radians(0.1), sigma_scale=0.05))
    localizer.hint_calibration(Calibration(pitch=-0.05, scale=0.03, sigma_scale=0.001))
    assert localizer.calibration.pitch == pytest.approx(0.03, abs=0.002)
    assert 0.008 < localizer.calibration.scale < 0.03


def test_ground_that_was_learned_here_is_not_given_up_for_a_hint(world_map):
    localizer = Localizer(world_map)
    offset = localizer._tracker.ground
    offset._views, offset.metres = 3, 0.1
    localizer.hint_calibration(Calibration(ground=0.35))
    assert offset.metres == 0.1
    offset.restore(0.3)
    offset.restore(0.0)
    assert offset.metres == 0.0


def test_what_a_leader_supposed_ends_with_it():
    estimator = CalibrationEstimator()
    before = estimator.calibration
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.radians([0.0, 4.0, 0.0]))
    estimator.suppose_attitude(T, np.eye(4), np.radians(0.3) ** 2, 0.7)
    assert abs(np.degrees(estimator.calibration.pitch)) > 1.0
    estimator.forget_leader()
    assert estimator.calibration == before


def test_mixture_has_the_sigma_of_each_axis():
    straight = Calibration(sigma_tilt=1e-9)
    mixture = mixed(straight, Calibration(roll=np.radians(4.0), sigma_tilt=1e-9), 0.5)
    assert np.degrees(mixture.sigma_tilt) == pytest.approx(2.0 / np.sqrt(2.0))


def test_leaders_that_alternate_do_not_begin_the_search_anew_at_every_frame(world_map, world_drive):
    """A robot that stands still sees nothing new: what it has seen is levelled once, and evidence adds up."""
    localizer = Localizer(world_map)
    localizer.search.update = lambda request: SearchResult(None, KeyframeEvidence(request.stamp, State.SEARCHING, ""))
    straight, leaning = np.eye(4), np.eye(4)
    leaning[:3, :3] = exp_so3(np.radians([0.0, 4.0, 0.0]))
    epochs = set()
    for k in range(20):
        localizer.step(world_drive.clouds[0], world_drive.T_odom_body[0], 0.1 * k)
        epochs.add(localizer._requests.epoch)
        T = leaning if k % 2 else straight
        localizer._frames.estimator.suppose_attitude(T, np.eye(4), 1e-5, 0.9)
    assert len(epochs) <= 2
