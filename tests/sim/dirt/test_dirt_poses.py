"""A leaning sensor, and faults of odometry: each of the stated size, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from surface_distance import distance_to_surfaces
from yard import standing, vlp16, yard

from coview_stream.errors import ConfigError
from coview_stream.geometry.transforms import rotation_angle, transform, wrap_angle, yaw_of
from coview_stream.sim.dirt import Dirt
from coview_stream.sim.dirt.robot import Gravity, Miscalibration, Mounting, Slip
from coview_stream.sim.dirt.scan import Scanner
from coview_stream.sim.mesh import box, placed

RNG = np.random.default_rng


def path(count=401, step=0.25):
    """A level drive along a wide bend."""
    heading = np.linspace(0.0, 1.5, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(heading), -np.sin(heading)
    steps = step * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    poses[1:, :3, 3] = np.cumsum(steps[:-1], axis=0)
    return poses


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
    fault = Miscalibration(scale=0.0, yaw_rate=0.0, yaw_walk=0.5)
    ends = [np.degrees(wrap_angle(yaw_of(fault.apply(path(), RNG(k))[-1]) - 1.5)) for k in range(200)]
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


def test_a_short_run_slips_once():
    assert len(Slip().bursts(3.0, RNG(0))) == 1


def test_gravity_is_off_by_the_stated_angle_and_turns_slowly():
    truth, stamps = path(), np.linspace(0.0, 60.0, 401)
    off = Gravity(error=0.5, period=240.0).apply(truth, stamps, RNG(2))
    np.testing.assert_allclose(leans(off), 0.5, atol=1e-6)
    towards = np.unwrap(np.arctan2(off[:, 1, 2], off[:, 0, 2]))
    assert towards[-1] - towards[0] == pytest.approx(np.pi / 2, abs=1e-6)
    climb = np.abs(off[:, 2, 3]).max()  # level ground rises or falls
    assert 0.1 < climb < 100.0 * np.radians(0.5)
    np.testing.assert_allclose(lengths(off), lengths(truth))


def test_a_run_of_one_frame_has_nothing_to_be_wrong():
    one = path(1)
    for off in (
        Miscalibration().apply(one, RNG(0)),
        Slip().apply(one, RNG(0)),
        Gravity(error=0.0).apply(one, np.zeros(1), RNG(0)),
    ):
        np.testing.assert_allclose(off, one)


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        (Mounting, {"lean": 31.0}),
        (Mounting, {"lever": -0.1}),
        (Miscalibration, {"scale": 0.6}),
        (Slip, {"length": 0.0}),
        (Gravity, {"error": float("nan")}),
    ],
)
def test_settings_out_of_range_are_refused(settings, values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        settings(**values)
