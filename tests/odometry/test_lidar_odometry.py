"""Lidar odometry with any registration and with kiss-icp: gravity, prediction, deskewing, refusal."""

import subprocess
import sys

import numpy as np
import pytest
import small_world
from fake_lidar_odometry import Told, frame, swept

from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.errors import CloudError, RunError
from coview_stream.geometry.transforms import inverse, is_pose, pose_from, rot_z, tilt_of, transform
from coview_stream.odometry.lidar_odometry import LidarOdometry

LEVEL = LidarOdometryConfig(gravity="level", keep_level=False)


@pytest.fixture(scope="module")
def cloud(scene):
    return frame(scene)[0]


def moved(x, yaw=0.0):
    return pose_from(rot_z(yaw), [x, 0.0, 0.0])


def stepped(cloud, told, frames=2, config=LEVEL):
    """Odometry that has seen the cloud a few times, ten times a second."""
    odometry = LidarOdometry(config, told)
    for k in range(frames):
        odometry.step(cloud, None, 0.1 * k)
    return odometry


def test_odometry_frame_is_level_with_tilted_sensor(scene):
    cloud, up = frame(scene, (0.15, -0.1))
    odometry = LidarOdometry(registration=Told())
    T = odometry.step(cloud, None, 5.0)
    assert np.degrees(np.arccos((T[:3, :3].T @ [0, 0, 1]) @ up)) < 0.2
    assert (T[:3, 3] == 0).all()
    assert odometry.ground is not None


def test_given_gravity_is_used(cloud):
    g = np.array([0.1, -0.2, -0.97])
    odometry = LidarOdometry(LidarOdometryConfig(gravity=tuple(g)), Told())
    T = odometry.step(cloud, None, 5.0)
    assert np.allclose(T[:3, :3] @ (g / np.linalg.norm(g)), [0, 0, -1])
    assert odometry.ground is None


def test_odometry_starts_at_first_frame_with_ground(cloud):
    odometry = LidarOdometry(registration=Told())
    wall = np.random.default_rng(0).uniform([8, -15, -1], [8.1, 15, 9], (5000, 3)).astype(np.float32)
    with pytest.raises(CloudError, match="--gravity level"):
        odometry.step(wall, None, 5.0)
    assert tilt_of(odometry.step(cloud, None, 5.1)) < 0.01


def test_constant_velocity_prediction_scales_with_time(cloud):
    told = Told(np.eye(4), moved(1.0, 0.1), moved(2.0, 0.2))
    odometry = stepped(cloud, told, 3)
    odometry.step(cloud, None, 0.5)
    step = inverse(moved(1.0, 0.1)) @ moved(2.0, 0.2)
    guess = inverse(moved(2.0, 0.2)) @ told.guesses[3]
    assert np.allclose(guess[:3, 3], 3 * step[:3, 3])
    assert np.arctan2(guess[1, 0], guess[0, 0]) == pytest.approx(0.3)


def test_sweep_is_deskewed_by_previous_motion(cloud):
    step = moved(1.0, 0.05)
    told = Told(np.eye(4), step)
    odometry = stepped(cloud, told)
    skewed, times = swept(cloud, step)
    odometry.step(skewed, times, 0.2)
    assert np.abs(skewed - cloud).max() > 0.5
    assert np.abs(told.frames[2] - cloud).max() < 0.1
    assert np.abs(odometry.points - cloud).max() < 0.1


def three_steps(cloud, times):
    """What registration got of the third frame of a robot that drives a metre a frame."""
    told = Told(np.eye(4), moved(1.0))
    odometry = LidarOdometry(LEVEL, told)
    for k in range(3):
        odometry.step(cloud, times, 0.1 * k)
    return told.frames[2]


@pytest.mark.parametrize("times", [0.0, 7.0, np.nan, np.inf, 1.6e9])
def test_constant_point_times_deskew_nothing(cloud, times):
    assert (three_steps(cloud, np.full(len(cloud), times)) == cloud).all()


def test_point_with_bad_time_is_not_moved(cloud):
    times = np.linspace(-0.1, 0.0, len(cloud))
    times[7] = np.nan
    frame = three_steps(cloud, times)
    assert np.allclose(frame[7], cloud[7], atol=0.01)
    assert np.isfinite(frame).all()
    assert np.abs(frame[0] - cloud[0]).max() > 0.5


def covered(cloud):
    return (0.3 * cloud / np.linalg.norm(cloud, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize(
    "bad",
    [
        lambda c: np.empty((0, 3), np.float32),
        lambda c: c[:50],
        lambda c: np.full_like(c, np.nan),
        lambda c: np.full_like(c, np.inf),
        lambda c: c + np.float32(1e7),
        lambda c: c.astype(np.float64) + 1e300,
        lambda c: c[:, :2],
        lambda c: "cloud",
        covered,
    ],
    ids=["empty", "few", "nan", "inf", "far", "absurd", "flat", "text", "covered"],
)
def test_bad_frame_is_refused_and_changes_nothing(cloud, bad):
    told = Told(np.eye(4), moved(0.1))
    odometry = stepped(cloud, told)
    with pytest.raises(CloudError):
        odometry.step(bad(cloud), None, 0.2)
    assert len(told.frames) == 2
    assert np.allclose(odometry.step(cloud, None, 0.3), moved(0.3))  # as predicted from the motion before
    assert odometry.restarts == 0


def test_nan_rows_are_dropped_with_their_times(cloud):
    told = Told()
    odometry = LidarOdometry(LEVEL, told)
    holes = cloud.copy()
    holes[::10] = np.nan
    odometry.step(holes, np.linspace(0, 0.1, len(cloud)), 0.0)
    assert len(told.frames[0]) == len(odometry.points) == np.isfinite(holes).all(axis=1).sum()
    with pytest.raises(CloudError, match="one time per point"):
        odometry.step(cloud, np.zeros(3), 0.1)


@pytest.mark.parametrize("stamp", [0.0, -1.0, np.nan, np.inf])
def test_stamps_must_increase(cloud, stamp):
    odometry = stepped(cloud, Told(), 1)
    with pytest.raises(RunError, match="stamp"):
        odometry.step(cloud, None, stamp)
    assert is_pose(odometry.step(cloud, None, 0.1))


def test_gap_restarts_local_map_at_last_pose(cloud):
    told = Told(np.eye(4), moved(1.0), moved(2.0))
    odometry = stepped(cloud, told, 3)
    clears = told.clears
    assert np.allclose(odometry.step(cloud, None, 30.0), moved(2.0))
    assert told.clears == clears + 1
    assert odometry.restarts == 1


@pytest.mark.parametrize("wild", [moved(40.0), moved(0.0, 2.5), np.full((4, 4), np.nan)])
def test_implausible_motion_is_refused(cloud, wild):
    told = Told(np.eye(4), moved(1.0), wild)
    odometry = stepped(cloud, told)
    with pytest.raises(CloudError, match="lost its way"):
        odometry.step(cloud, None, 0.2)
    assert odometry.restarts == 1
    assert np.allclose(odometry.step(cloud, None, 0.3), moved(1.0))


def test_caller_may_reuse_its_frame_array(cloud):
    told = Told()
    odometry = LidarOdometry(LEVEL, told)
    buffer = cloud.copy()
    T = odometry.step(buffer, None, 0.0)
    buffer[:], T[:] = 0.0, 0.0
    assert (odometry.points == cloud).all()
    assert is_pose(odometry.step(cloud, None, 0.1))


def test_reset_starts_a_new_odometry_frame(cloud):
    odometry = LidarOdometry(LEVEL, Told(np.eye(4), moved(1.0)))
    odometry.step(cloud, None, 10.0)
    odometry.step(cloud, None, 10.1)
    odometry.reset()
    assert np.allclose(odometry.step(cloud, None, 3.0), np.eye(4))


@pytest.mark.slow
def test_walls_correct_drifting_tilt(cloud):
    tilt = np.eye(4)
    tilt[:3, :3] = [[np.cos(2e-4), 0, np.sin(2e-4)], [0, 1, 0], [-np.sin(2e-4), 0, np.cos(2e-4)]]
    lean = [np.linalg.matrix_power(tilt, k) for k in range(220)]  # the robot stands, and registration tilts it
    ends = {}
    for level in (True, False):
        odometry = LidarOdometry(LidarOdometryConfig(gravity="level", keep_level=level), Told(*lean))
        for k in range(220):
            T = odometry.step(cloud, None, 0.1 * k)
        ends[level] = np.degrees(tilt_of(T))
        assert is_pose(T)
    assert ends[False] > 2.5
    assert ends[True] < 0.4


def test_levelling_does_not_shake_what_registration_holds_still(cloud):
    rng = np.random.default_rng(0)
    odometry = LidarOdometry(LidarOdometryConfig(gravity="level"), Told(*[np.eye(4)] * 40))
    tilts = []
    for k in range(40):
        holes = cloud[rng.random(len(cloud)) < 0.1]  # other points of the same surfaces: walls lean otherwise each time
        tilts.append(odometry.step(holes, None, 0.1 * k)[2, :2])
    assert np.degrees(np.abs(np.diff(tilts, axis=0)).max()) < 0.1


def test_shaken_body_is_guessed_upright(scene):
    cloud, _ = frame(scene)
    shaken, up = frame(scene, (0.03, -0.02))
    told = Told(np.eye(4))
    odometry = stepped(cloud, told, 1, LidarOdometryConfig(gravity="level"))
    odometry.step(shaken, None, 0.1)
    assert np.degrees(np.arccos(told.guesses[1][2, :3] @ up)) < 0.5


# ---- kiss-icp itself


@pytest.fixture(scope="module")
def kiss():
    pytest.importorskip("kiss_icp.kiss_icp", reason="kiss-icp is not installed: pip install 'kiss-icp>=1.2'")


@pytest.fixture(scope="module")
def drive(kiss, map_points):
    """Poses and scans at 10 Hz from rest: faster and faster up to 4 m/s, with a bend."""
    poses, speed = [small_world.drive()[0]], 0.0
    for k in range(24):
        speed = min(0.4, speed + 0.04)
        poses.append(poses[-1] @ pose_from(rot_z(0.04 if k > 12 else 0.0), [speed, 0.0, 0.0]))
    return poses, [sampled(map_points, T, k) for k, T in enumerate(poses)]


def sampled(map_points, T, seed):
    """Points of all surfaces within 25 m: rings of a spinning lidar on a bare plane hold point-to-point fast."""
    chosen = np.random.default_rng(seed).choice(map_points, 30_000, replace=False)
    seen = transform(inverse(T), chosen)
    return seen[np.linalg.norm(seen, axis=1) < 25.0].astype(np.float32)


def errors(odometry, drive, clouds):
    """Metres and degrees at the end, of the motion since the start; ``clouds`` are (points, times)."""
    poses = [odometry.step(points, times, 0.1 * k) for k, (points, times) in enumerate(clouds)]
    truth = inverse(drive[0][0]) @ drive[0][-1]
    return small_world.pose_error(inverse(poses[0]) @ poses[-1], truth)


def test_kiss_icp_follows_a_drive(drive):
    odometry = LidarOdometry()
    metres, degrees = errors(odometry, drive, [(cloud, None) for cloud in drive[1]])
    assert metres < 0.15
    assert degrees < 0.6
    assert odometry.restarts == 0


def test_deskewing_compensates_motion_during_a_sweep(drive):
    poses, clouds = drive
    sweeps = [(clouds[0], None)]
    sweeps += [swept(c, inverse(a) @ b) for a, b, c in zip(poses, poses[1:], clouds[1:], strict=False)]
    deskewed = errors(LidarOdometry(), drive, sweeps)
    plain = errors(LidarOdometry(), drive, [(points, None) for points, _ in sweeps])
    assert deskewed[0] < 0.15
    assert deskewed[0] < 0.7 * plain[0]


HOSTILE = """
import numpy as np
from coview_stream.errors import CloudError
from coview_stream.config.odometry import LidarOdometryConfig
from coview_stream.odometry.lidar_odometry import LidarOdometry
rng = np.random.default_rng(0)
cloud = rng.uniform(-30, 30, (3000, 3)).astype(np.float32)
n = len(cloud)
some = np.linspace(-0.1, 0.0, n)
odd = [np.full(n, v) for v in (0.0, 5.0, np.nan, np.inf)]
odd += [np.where(np.arange(n) == 7, v, some) for v in (np.nan, np.inf)]
odometry = LidarOdometry(LidarOdometryConfig(gravity="level"))
odometry.step(cloud, some, 0.0)
odometry.step(cloud + [0.3, 0, 0], some, 0.1)
for k, times in enumerate(odd):
    odometry.step(cloud, times, 0.2 + 0.1 * k)
for frame, times in ((cloud[:0], some[:0]), (cloud[:1], some[:1]), (cloud * np.nan, some), (cloud + 1e9, some)):
    try:
        odometry.step(frame, times, 2.0)
    except CloudError:
        continue
    raise SystemExit("taken")
one_place = np.ones((500, 3), np.float32)
assert np.isfinite(odometry.step(one_place, None, 2.0)).all()
assert np.isfinite(odometry.step(cloud, some, 2.1)).all()
print("alive")
"""


@pytest.mark.slow
def test_no_input_aborts_the_process(kiss):
    done = subprocess.run([sys.executable, "-c", HOSTILE], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "alive"), done.stderr
