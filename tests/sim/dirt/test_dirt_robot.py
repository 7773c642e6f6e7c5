"""A leaning sensor, and faults of odometry: each of the stated size, and nothing else."""

import numpy as np
import pytest
from surface_distance import distance_to_surfaces
from yard import standing, vlp16, yard

from coview_stream.geometry.transforms import inverse, pose_from, rot_z, rotation_angle, transform, wrap_angle, yaw_of
from coview_stream.recordings.open_run import open_run
from coview_stream.sim.dirt import Dirt
from coview_stream.sim.dirt.robot import Gravity, Miscalibration, Motion, Mounting, Slip, Track, beam_times
from coview_stream.sim.dirt.scan import Recording, Scanner
from coview_stream.sim.mesh import box, placed

RNG = np.random.default_rng


def path(count=401, step=0.25):
    """A level drive along a wide bend."""
    heading = np.linspace(0.0, 1.5, count)
    steps = step * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    places = np.cumsum(steps, axis=0) - steps
    return np.stack([pose_from(rot_z(float(a)), place) for a, place in zip(heading, places, strict=True)])


def lengths(poses):
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def leans(poses):
    return np.degrees(np.arccos(np.clip(poses[:, 2, 2], -1, 1)))


@pytest.mark.parametrize("seed", range(5))
def test_the_sensor_leans_as_much_as_stated_and_sits_beside_its_place(seed):
    T = Mounting(lean=3.0, lever=0.2).draw(RNG(seed))
    assert np.degrees(np.arccos(T[2, 2])) == pytest.approx(3.0)
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.2)
    turned = Mounting(lean=0.0, yaw=2.0).draw(RNG(seed))
    assert 0.0 < np.degrees(rotation_angle(turned)) < 8.0


def test_a_leaning_sensor_tilts_the_cloud_but_not_the_robot():
    scene = yard(placed(box(4, 30, 9), 15, 0))
    dirt = Dirt(mounting=Mounting(lean=4.0, lever=0.3))
    scanner = Scanner(scene, vlp16(), dirt, 1.5, lambda _: RNG(1))
    truth = standing()
    points = next(scanner.frames(np.zeros(1), truth, truth))
    taken_at_its_word = transform(truth[0], points)
    corrected = transform(truth[0] @ scanner.T_body_sensor, points)
    assert np.median(distance_to_surfaces(scene, corrected)) < 0.03
    assert np.median(distance_to_surfaces(scene, taken_at_its_word)) > 0.1


@pytest.mark.parametrize("seed", range(4))
def test_odometry_scale_is_off_by_the_stated_share(seed):
    off = Miscalibration(scale=0.05, yaw_rate=0.0, yaw_walk=0.0).apply(path(), RNG(seed))
    ratio = lengths(off) / lengths(path())
    np.testing.assert_allclose(np.abs(ratio - 1.0), 0.05)
    assert np.ptp(ratio) < 1e-9
    np.testing.assert_allclose(off[:, :3, :3], path()[:, :3, :3])


def test_odometry_turns_by_the_stated_rate():
    off = Miscalibration(scale=0.0, yaw_rate=0.1, yaw_walk=0.0).apply(path(), RNG(0))
    extra = np.degrees(wrap_angle(yaw_of(off[-1]) - yaw_of(path()[-1])))
    assert abs(extra) == pytest.approx(10.0)  # 100 m
    # the false turn bends the way as well: it ends elsewhere
    assert np.linalg.norm(off[-1, :3, 3] - path()[-1, :3, 3]) > 5.0


def test_odometry_heading_walks_with_the_root_of_the_distance():
    truth, fault = path(), Miscalibration(scale=0.0, yaw_rate=0.0, yaw_walk=0.5)
    ends = [np.degrees(wrap_angle(yaw_of(fault.apply(truth, RNG(k))[-1]) - 1.5)) for k in range(200)]
    assert np.std(ends) == pytest.approx(5.0, rel=0.2)


def test_wheels_slip_in_bursts_and_nowhere_else():
    fault = Slip(share=0.5, turn=4.0, length=2.0, every=25.0)
    off = fault.apply(path(), RNG(3))
    ratio = lengths(off) / lengths(path())
    slipped = np.abs(ratio - 1.0) > 1e-6
    assert set(np.round(np.abs(ratio[slipped] - 1.0), 6)) == {0.5}
    starts = np.flatnonzero(np.diff(slipped.astype(int)) == 1)
    assert len(starts) == 4
    assert slipped.sum() * 0.25 == pytest.approx(4 * 2.0, abs=1.0)
    heading = np.unwrap([yaw_of(T) for T in off]) - np.unwrap([yaw_of(T) for T in path()])
    turned = np.abs(np.diff(heading)) > 1e-9
    assert (turned == slipped).mean() > 0.99
    assert np.degrees(np.abs(np.diff(heading[[*starts, -1]]))).max() > 0.5


def test_gravity_is_off_by_the_stated_angle_and_turns_slowly():
    truth, stamps = path(), np.linspace(0.0, 60.0, 401)
    off = Gravity(error=0.5, period=240.0).apply(truth, stamps, RNG(2))
    np.testing.assert_allclose(leans(off), 0.5, atol=1e-6)
    towards = np.unwrap(np.arctan2(off[:, 1, 2], off[:, 0, 2]))
    assert towards[-1] - towards[0] == pytest.approx(np.pi / 2, abs=1e-6)
    climb = np.abs(off[:, 2, 3]).max()  # level ground rises or falls
    assert 0.1 < climb < 100.0 * np.radians(0.5)
    np.testing.assert_allclose(lengths(off), lengths(truth))


def test_a_run_of_one_frame_has_nothing_to_be_wrong_and_a_short_one_slips_once():
    assert len(Slip().bursts(3.0, RNG(0))) == 1
    one = path(1)
    for off in (
        Miscalibration().apply(one, RNG(0)),
        Slip().apply(one, RNG(0)),
        Gravity(error=0.0).apply(one, np.zeros(1), RNG(0)),
    ):
        np.testing.assert_allclose(off, one)


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


def test_a_turning_sweep_lies_on_the_walls_only_after_deskewing_by_right_odometry_of_any_frame():
    straight = off_the_walls(Motion(), pose_from(rot_z(1.0), [300.0, -100.0, 20.0]) @ turning())
    assert straight < 0.03
    assert off_the_walls(Motion(deskewed=False)) > 5 * straight
    assert off_the_walls(Motion(), np.tile(turning()[-1], (6, 1, 1))) > 0.1


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
