"""Sweeps of a moving robot: bent as they are measured, straight after the product's deskewing."""

from __future__ import annotations

import numpy as np
import pytest
from surface_distance import distance_to_surfaces
from yard import vlp16, yard

from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, transform
from coview_stream.recordings.open_run import open_run
from coview_stream.sim.dirt import Dirt
from coview_stream.sim.dirt.robot import Motion, Track, beam_times
from coview_stream.sim.dirt.scan import Recording, Scanner
from coview_stream.sim.mesh import box, placed

WALLS = (placed(box(4, 60, 9), 14, 0), placed(box(60, 4, 9), 0, 14), placed(box(4, 60, 9), -14, 0))
STAMPS = 1000.0 + 0.1 * np.arange(6)


def turning(rate=60.0, speed=5.0):
    """Six poses of a robot that turns ``rate`` degrees a second at ``speed``."""
    turn = np.radians(rate) * 0.1 * np.arange(6)
    return np.stack([pose_from(rot_z(float(a)), [speed * 0.1 * k, 0.0, 1.5]) for k, a in enumerate(turn)])


def off_the_walls(motion, odometry=None):
    """Median distance from the walls of the points above the ground, metres, over the last four frames."""
    scene, truth = yard(*WALLS), turning()
    scanner = Scanner(scene, vlp16(), Dirt(motion=motion), 1.5, lambda _: np.random.default_rng(1))
    clouds = list(scanner.frames(STAMPS, truth, truth if odometry is None else odometry))
    points = np.concatenate([transform(T, cloud) for T, cloud in zip(truth[2:], clouds[2:], strict=True)])
    return float(np.median(distance_to_surfaces(scene, points[points[:, 2] > 0.5])))


@pytest.mark.slow
def test_a_turning_sweep_is_bent_without_deskewing_and_lies_on_the_walls_after_it():
    bent, straight = off_the_walls(Motion(deskewed=False)), off_the_walls(Motion())
    assert straight < 0.03
    assert bent > 5 * straight


def test_a_sweep_that_is_deskewed_by_wrong_odometry_stays_bent():
    still = np.tile(turning()[-1], (6, 1, 1))
    assert off_the_walls(Motion(), still) > 0.1


def test_odometry_in_its_own_frame_straightens_as_well():
    T_odom_scene = pose_from(rot_z(1.0), [300.0, -100.0, 20.0])
    assert off_the_walls(Motion(), T_odom_scene @ turning()) < 0.03


def test_the_track_runs_smoothly_through_the_poses_of_the_frames():
    truth = turning()
    truth[3, 1, 3] += 0.3  # a swerve
    odometry = pose_from(rot_z(0.5), [10.0, 20.0, 0.0]) @ truth
    odometry[4:, 0, 3] += 0.2  # an error that arises between two frames
    track = Track(STAMPS, truth, odometry)
    np.testing.assert_allclose(track.true(STAMPS), truth, atol=1e-9)
    np.testing.assert_allclose(track.odom(STAMPS), odometry, atol=1e-6)
    fine = np.linspace(STAMPS[0] - 0.1, STAMPS[-1], 601)
    velocity = np.diff(track.true(fine)[:, :3, 3], axis=0) / np.diff(fine)[:, None]
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.5  # 6 m/s of swerve in 0.1 s, no steps in it
    segment = track.segment(3, 50.0)
    assert len(segment.stamps) == 6
    assert segment.stamps[-1] == round(STAMPS[3] * 1e9)
    np.testing.assert_allclose(segment.poses[-1], odometry[3], atol=1e-6)


def test_beams_leave_in_order_and_the_last_at_the_stamp():
    times = beam_times(1000)
    assert times[0] == pytest.approx(-0.0999)
    assert times[-1] == 0.0
    assert (np.diff(times) > 0).all()


def test_a_single_frame_stands_still():
    truth = turning()[:1]
    track = Track(STAMPS[:1], truth, truth)
    np.testing.assert_allclose(inverse(truth[0]) @ track.true(STAMPS[:1] - 0.05)[0], np.eye(4), atol=1e-12)


@pytest.mark.slow
def test_the_recording_holds_raw_sweeps_that_the_reader_deskews(tmp_path):
    scene, truth = yard(*WALLS), turning()
    scanner = Scanner(scene, vlp16(), Dirt(motion=Motion()), 1.5, lambda _: np.random.default_rng(1))
    with Recording(tmp_path / "sweeps") as recording:
        frames = list(scanner.frames(STAMPS, truth, truth, recording))
    run = open_run(tmp_path / "sweeps")
    assert len(run) == 6
    np.testing.assert_allclose(run.stamps, STAMPS, atol=1e-6)
    np.testing.assert_allclose(run.poses, truth, atol=1e-6)
    np.testing.assert_allclose(run.read(4).points, frames[4], atol=2e-3)
    raw = run.source.message(4)
    assert raw.times.min() == pytest.approx(-0.1, abs=1e-3)
    assert np.abs(raw.points - frames[4]).max() > 0.3


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError, match="rate"):
        Motion(rate=1.0)
