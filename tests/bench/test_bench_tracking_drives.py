"""The drives that bench.tracking makes of one: kidnapped, carried, covered, and odometry that jumps."""

from __future__ import annotations

import numpy as np
import pytest
from told import way

from bench.tracking.drives import (
    CLOTH,
    DUST,
    carried,
    covered,
    drift_share,
    jumped,
    kidnapped,
    over_the_gap,
    restarted,
    scaled,
    seen,
    start,
)
from bench.tracking.worlds import GAP, in_gap
from coview_stream.geometry.transforms import inverse, tilt_of, yaw_of


def same_steps(a, b):
    """Whether two stretches (N, 4, 4) of odometry differ by where they are and head only."""
    return np.allclose([inverse(T) @ a[-1] for T in a], [inverse(T) @ b[-1] for T in b], atol=1e-9)


def level(odometry):
    return np.allclose([tilt_of(T) for T in odometry], np.radians(1.0), atol=np.radians(0.3))


@pytest.fixture(scope="module")
def drive():
    return start(way(), 0.01, 5)


@pytest.mark.parametrize("share", [0.005, 0.05])
def test_odometry_drifts_as_asked(share):
    truth = way()
    for seed, longer in ((8, 1), (9, -1)):
        odometry = start(truth, share, seed).odometry
        assert drift_share(truth, odometry) == pytest.approx(share, rel=0.02)
        lengths = [np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum() for T in (odometry, truth)]
        assert 0.2 * share < longer * (lengths[0] / lengths[1] - 1.0) < share
    assert drift_share(truth, truth) == pytest.approx(0.0, abs=1e-9)


def test_a_kidnapped_robot_stood_still_by_its_odometry(drive):
    got = kidnapped(drive, 400, 900)
    assert len(got) == 1000
    assert same_steps(got.odometry[400:], drive.odometry[900:])
    assert level(got.odometry)
    np.testing.assert_allclose(got.odometry[400, :3, 3], got.odometry[399, :3, 3])
    assert yaw_of(got.odometry[400]) == pytest.approx(yaw_of(got.odometry[399]))
    np.testing.assert_array_equal(got.frames[[399, 400]], [399, 900])
    np.testing.assert_array_equal(got.truth[400], drive.truth[900])
    assert got.driven[400] == got.driven[399]
    assert np.diff(got.stamps) == pytest.approx(0.1)
    assert [(e.begin, e.end) for e in got.events] == [(400, 400)]


def test_a_carried_robot_sees_but_does_not_drive(drive):
    got = carried(drive, 400, 600)
    np.testing.assert_allclose(np.ptp(got.odometry[399:600, :3, 3], axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose([yaw_of(T) for T in got.odometry[399:600]], yaw_of(got.odometry[399]))
    assert level(got.odometry)
    assert same_steps(got.odometry[600:], drive.odometry[600:])
    assert got.driven[600] == got.driven[399]
    assert got.driven[-1] == pytest.approx(drive.driven[-1] - drive.driven[600] + drive.driven[399])
    np.testing.assert_array_equal(got.truth, drive.truth)
    assert [(e.begin, e.end) for e in got.events] == [(400, 600)]


def test_odometry_jumps_once_and_starts_again_at_zero(drive):
    got = jumped(drive, 500, (3.0, 1.0), 15.0)
    step = inverse(drive.odometry[500]) @ got.odometry[500]
    np.testing.assert_allclose(got.odometry[500, :3, 3] - drive.odometry[500, :3, 3],
                               drive.odometry[500, :3, :3] @ [3.0, 1.0, 0.0], atol=1e-9)  # fmt: skip
    assert yaw_of(step) == pytest.approx(np.radians(15.0), abs=1e-3)
    assert same_steps(got.odometry[500:], drive.odometry[500:])
    again = restarted(drive, 500)
    np.testing.assert_allclose(again.odometry[500, :3, 3], 0.0, atol=1e-9)
    assert yaw_of(again.odometry[500]) == pytest.approx(0.0, abs=1e-9)
    assert same_steps(again.odometry[500:], drive.odometry[500:])
    assert level(again.odometry)
    assert level(got.odometry)


def test_odometry_out_of_scale_drives_further(drive):
    got = scaled(drive, 1.05)
    steps = [np.linalg.norm(np.diff(o[:, :3, 3], axis=0), axis=1) for o in (got.odometry, drive.odometry)]
    np.testing.assert_allclose(steps[0], 1.05 * steps[1])
    np.testing.assert_array_equal(got.odometry[:, :3, :3], drive.odometry[:, :3, :3])


def test_a_cover_leaves_near_returns_or_few():
    rng = np.random.default_rng(0)
    points = (rng.normal(size=(500, 3)) * 20).astype(np.float32)
    cloth = seen(points, CLOTH, 7)
    ranges = np.linalg.norm(cloth, axis=1)
    assert ranges.min() >= 0.499
    assert ranges.max() <= 0.901
    np.testing.assert_allclose(np.cross(cloth, points), 0.0, atol=1e-4)
    dust = seen(points, DUST, 7)
    assert len(dust) == 20
    assert (dust[:, None] == points[None]).all(axis=2).any(axis=1).all()
    np.testing.assert_array_equal(dust, seen(points, DUST, 7))
    assert seen(points, 0, 7) is points


def test_a_cover_lies_over_the_sensor_for_the_time_of_the_event(drive):
    got = covered(drive, 100, 400, CLOTH).until(100.0)
    assert np.flatnonzero(got.cover).tolist() == list(range(100, 400))
    assert [(e.begin, e.end) for e in got.events] == [(100, 400)]
    assert got.driven[-1] == pytest.approx(100.0, abs=0.3)


def test_the_gap_is_a_hundred_metres_of_the_drive(drive):
    got = over_the_gap(drive)
    (event,) = got.events
    assert got.driven[event.begin] == pytest.approx(GAP[0], abs=3.0)
    assert got.driven[event.end] == pytest.approx(GAP[1], abs=3.0)
    middle = got.truth[[got.at(170.0)], :3, 3]
    aside = middle + np.array([0.0, 100.0, 0.0])
    np.testing.assert_array_equal(in_gap(drive.truth, np.concatenate([middle, aside])), [True, False])
