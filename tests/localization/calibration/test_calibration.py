"""Calibration of a localizer: leaning sensor, odometry of another scale, known values, late results, resets."""

from itertools import pairwise

import numpy as np
import pytest
from small_world import pose_error

from coview_stream.config import LocalizerConfig
from coview_stream.errors import InputError
from coview_stream.geometry.transforms import exp_so3, pose_from
from coview_stream.localization.calibration.calibration import Calibration
from coview_stream.localization.calibration.estimator import CalibrationEstimator, mixed
from coview_stream.localization.evidence.observation import Evidence
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.result import KeyframeEvidence
from coview_stream.localization.search.acceptance import SearchResult
from coview_stream.localization.state import State

LEAN = np.radians(3.0)


def leaning(drive, roll=0.0, pitch=LEAN):
    """Clouds of the drive from a sensor that leans, by default down by three degrees."""
    R = exp_so3(np.array([roll, pitch, 0.0]))
    return [(cloud @ R.T).astype(np.float32) for cloud in drive.clouds]


def follow(localizer, clouds, odometry, truth):
    """Return metres and degrees of error of each pose, and the last fix."""
    errors, fix = [], None
    for k, (cloud, T) in enumerate(zip(clouds, odometry, strict=True)):
        fix = localizer.step(cloud, T, 0.5 * k)
        if fix.T_map_body is not None:
            np.testing.assert_allclose(fix.T_map_odom @ T, fix.T_map_body, atol=1e-5)
            errors.append(pose_error(fix.T_map_body, truth[k]))
    return np.array(errors), fix


@pytest.mark.slow
@pytest.mark.parametrize("lean", [(0.0, 3.0), (-2.0, -2.0)])
@pytest.mark.parametrize("known", [0.0, -3.0])
def test_leaning_sensor_is_levelled(world_map, world_drive, world_fixes, lean, known):
    """With any lean that was known before."""
    localizer, clouds = Localizer(world_map), leaning(world_drive, *np.radians(lean))
    if known:
        localizer.hint_calibration(Calibration(pitch=np.radians(known), sigma_tilt=np.radians(0.1)))
    errors, fix = follow(localizer, clouds, world_drive.T_odom_body, world_drive.T_map_body)
    assert len(errors) >= 0.85 * sum(each.T_map_body is not None for each in world_fixes)
    assert (errors.max(axis=0) < (0.1, 0.6)).all()
    estimate = np.degrees([fix.calibration.roll, fix.calibration.pitch])
    np.testing.assert_allclose(estimate, -np.array(lean), atol=0.4)


@pytest.mark.slow
def test_search_result_that_comes_frames_later_levels_the_sensor(world_map, world_drive):
    """The keyframe's clouds were levelled by the calibration of then."""
    localizer, waiting, errors, clouds = Localizer(world_map), [], [], leaning(world_drive)
    for k, cloud in enumerate(clouds):
        if len(waiting) == 2:
            localizer.apply_search_result(localizer.search.update(waiting.pop(0)))
        request = localizer.add_frame(cloud, world_drive.T_odom_body[k], 0.5 * k)
        if request is not None:
            waiting.append(request)
        fix = localizer.fix()
        if fix.T_map_body is not None:
            errors.append(pose_error(fix.T_map_body, world_drive.T_map_body[k]))
    assert len(errors) > 0.5 * len(clouds)
    assert (np.max(errors, axis=0) < (0.1, 0.6)).all()
    assert fix.calibration.pitch == pytest.approx(-LEAN, abs=np.radians(0.3))


@pytest.mark.slow
def test_calibration_outlives_the_odometry_frame_but_no_reset(world_map, world_drive):
    localizer, clouds = Localizer(world_map), leaning(world_drive)
    _, fix = follow(localizer, clouds, world_drive.T_odom_body, world_drive.T_map_body)
    assert fix.state is State.TRACKING
    localizer.relocalize(1)
    T_other = pose_from(exp_so3(np.array([0.0, 0.0, 1.0])), [40.0, -3.0, 1.0])
    localizer.add_frame(clouds[0], T_other @ world_drive.T_odom_body[0], 60.0)
    begun = localizer.fix()
    assert begun.T_map_body is None
    assert begun.calibration.pitch == pytest.approx(-LEAN, abs=np.radians(0.3))
    localizer.reset(2)
    localizer.add_frame(clouds[0], world_drive.T_odom_body[0], 90.0)
    assert localizer.fix().calibration.pitch == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.93, 1.0, 1.07])
def test_odometry_in_utm_that_turns_is_corrected(world_map, world_drive, world_fixes, scale):
    """Far from its origin, a factor or a turn about that would be kilometres."""
    utm = np.array([512_345.6, 5_403_210.9, 287.4])
    odometry, turned = [pose_from(world_drive.T_odom_body[0][:3, :3], utm)], 0.0
    for before, T in pairwise(world_drive.T_odom_body):
        step = T[:3, 3] - before[:3, 3]
        turned += np.radians(0.1) * float(np.linalg.norm(step))
        turn = exp_so3(np.array([0.0, 0.0, turned]))
        odometry.append(pose_from(turn @ T[:3, :3], odometry[-1][:3, 3] + scale * (turn @ step)))
    errors, fix = follow(Localizer(world_map), world_drive.clouds, odometry, world_drive.T_map_body)
    assert len(errors) >= 0.8 * sum(each.T_map_body is not None for each in world_fixes)
    assert errors[:, 0].max() < 0.15
    assert (1.0 + fix.calibration.scale) * scale == pytest.approx(1.0, abs=0.02)


def test_known_calibration_changes_nothing_once_the_place_is_known(world_map, world_drive):
    localizer = Localizer(world_map)
    _, fix = follow(localizer, world_drive.clouds, world_drive.T_odom_body, world_drive.T_map_body)
    assert fix.calibration.describe() == []  # this sensor and this odometry are right
    with pytest.raises(InputError, match="delay is 1000000000"):
        localizer.hint_calibration(Calibration(delay=1e9))
    localizer.hint_calibration(Calibration(pitch=0.1))
    assert localizer.fix().calibration == fix.calibration


def test_late_cloud_has_no_pose_before_odometry_goes_back_to_its_moment(world_map, world_drive):
    localizer = Localizer(world_map, LocalizerConfig(cloud_delay=0.3))
    fixes = [localizer.step(world_drive.clouds[0], world_drive.T_odom_body[0], stamp) for stamp in (0.0, 0.2, 0.4)]
    assert [fix.state for fix in fixes] == [State.SEARCHING, State.SEARCHING, State.TRACKING]
    assert "does not go back to this cloud's moment" in fixes[1].evidence.reason


def test_ground_offset_of_the_site_is_restored_and_outlives_the_place(world_map):
    localizer = Localizer(world_map)
    localizer.hint_calibration(Calibration(ground=0.35))
    assert localizer.calibration.ground > 0.15
    localizer.relocalize()
    localizer.hint_calibration(Calibration())
    assert localizer.calibration.ground > 0.15


def test_scale_is_restored_where_the_sensor_cannot_lean(world_map):
    """Lidar odometry levels itself: its tilt is known for sure, and says nothing of how well the scale is."""
    localizer = Localizer(world_map, LocalizerConfig(sensor_leans=False))
    localizer.hint_calibration(Calibration(pitch=0.05, scale=0.03, sigma_scale=0.001))
    assert 0.008 < localizer.calibration.scale < 0.03
    assert localizer.calibration.sigma_scale > 0.01  # doubted, for wheels may have been changed
    assert localizer.calibration.pitch == 0.0


def test_better_known_values_stay_group_by_group():
    estimator = CalibrationEstimator()
    estimator.learn(Calibration(pitch=0.03, scale=0.0, sigma_tilt=np.radians(0.1), sigma_scale=0.05))
    estimator.learn(Calibration(pitch=-0.05, scale=0.03, sigma_scale=0.001).doubted())
    assert estimator.calibration.pitch == pytest.approx(0.03, abs=0.002)
    assert 0.008 < estimator.calibration.scale < 0.03


def test_mixture_has_the_sigma_of_each_axis():
    straight = Calibration(sigma_tilt=1e-9)
    mixture = mixed(straight, Calibration(roll=np.radians(4.0), sigma_tilt=1e-9), 0.5)
    assert np.degrees(mixture.sigma_tilt) == pytest.approx(2.0 / np.sqrt(2.0))


def test_leaders_that_alternate_do_not_begin_the_search_anew_at_every_frame(world_map, world_drive):
    """A robot that stands still sees nothing new: what it has seen is levelled once, and evidence adds up."""
    localizer, epochs, shares = Localizer(world_map), [], Evidence(1.0, 1.0, 1.0, 1.0, 1.0)
    for k in range(20):
        request = localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.1 * k)
        if request is not None:
            epochs.append(request.epoch)
        lean = pose_from(exp_so3(np.radians([0.0, 4.0 * (k % 2), 0.0])), np.zeros(3))
        report = KeyframeEvidence(0.1 * k, State.SEARCHING, "", evidence=shares, confidence=0.9)
        localizer.apply_search_result(SearchResult(None, report, epoch=epochs[-1], leader=lean))
    assert abs(localizer.calibration.pitch) > np.radians(1.0)
    assert len(set(epochs)) == 2
