"""Scores of a tracked drive: errors, events, coverage of the covariance, protection levels."""

import numpy as np
import pytest
from drives_with_truth import track, way

from bench.accuracy.scores import errors, exposed, losses, rate, recovery, score
from bench.tracking import protection, smoothing, tracking
from bench.tracking.covariance import BAND, figures, judge
from bench.tracking.exposure import counted
from bench.tracking.protection import PARTS, PRODUCT, Sample, beyond_alert_limit, blocks, conformal, misleading
from bench.tracking.tracking import AXES, NOMINAL, coverage, pooled, shares, since_fix, spread, squares
from coview_stream.geometry.protection import protection_level
from coview_stream.geometry.transforms import exp_so3, pose_from, rot_z

C = np.diag([1e-4, 1e-4, 1e-5, 1e-6, 1e-6, 2e-6])


@pytest.fixture(scope="module")
def covariance():
    """Correlated, metres beside radians."""
    mix = np.random.default_rng(1).normal(size=(6, 6))
    sigma = np.array([0.05, 0.1, 0.02, 0.002, 0.002, 0.004])
    return (mix @ mix.T + np.eye(6)) / 6 * np.outer(sigma, sigma)


def covered(covariance, scale=1.0, count=4000):
    """Coverage of poses whose errors are drawn from a covariance, reported with ``scale`` times its sigmas."""
    rng, truth = np.random.default_rng(3), way(count)
    poses = truth.copy()
    twist = rng.multivariate_normal(np.zeros(6), covariance, count)
    poses[:, :3, 3] += twist[:, :3]
    poses[:, :3, :3] = np.stack([exp_so3(t[3:]) @ T[:3, :3] for t, T in zip(twist, truth, strict=True)])
    driven = track(["TRACKING"] * count, poses, covariance=covariance * scale**2)
    return shares(pooled([spread(driven, errors(driven, truth))]))


@pytest.fixture(scope="module")
def honest(covariance):
    return covered(covariance)


def test_an_honest_covariance_covers_its_promise_on_every_axis(honest):
    for name in AXES:
        np.testing.assert_allclose(honest["all"][name]["inside"], NOMINAL, atol=0.025)
    assert [honest[part]["yaw"]["frames"] for part in ("first minute", "later")] == [600, 3400]


@pytest.mark.parametrize(("scale", "one_sigma"), [(0.5, 0.383), (2.0, 0.954)])
def test_a_covariance_of_wrong_size_is_detected(covariance, scale, one_sigma):
    parts = covered(covariance, scale)
    assert parts["all"]["yaw"]["inside"][0] == pytest.approx(one_sigma, abs=0.025)
    assert missed_by([row()], parts) == {"coverage, first minute", "coverage, later"}


def test_a_broken_covariance_covers_nothing():
    broken = np.stack([np.full((6, 6), np.nan), np.diag([1.0, 1, 1, 1, 1, -1]), np.zeros((6, 6)), np.eye(6)])
    squared = squares(np.full((4, 6), 0.1), broken, AXES["pose"])
    np.testing.assert_allclose(squared, [np.inf, np.inf, np.inf, 0.06])
    assert coverage(squared, 6)["inside"][2] == 0.25
    assert coverage(np.zeros(0), 6)["inside"] is None


def test_errors_are_in_map_axes():
    truth = np.stack([pose_from(rot_z(np.pi / 2), [10.0, 0.0, 0.0])])
    poses = np.stack([pose_from(exp_so3(np.array([0.02, 0.0, 0.0])) @ truth[0, :3, :3], [10.1, -0.2, 0.0])])
    error = errors(track(["TRACKING"], poses), truth)
    np.testing.assert_allclose(error.twist, [[0.1, -0.2, 0.0, 0.02, 0.0, 0.0]], atol=1e-12)


def test_false_seconds_last_until_the_next_frame_and_no_longer_than_half_a_second():
    states = ["TRACKING", "TRACKING", "LOST", "TRACKING", "TRACKING"]
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[[1, 3], 0, 3] = 1.2, 40.0
    poses[4, :3, :3] = rot_z(np.radians(5.1))
    drive = track(states, poses, stamps=[0.0, 0.1, 0.3, 0.4, 5.0])
    figures = score(drive, np.tile(np.eye(4), (5, 1, 1)), np.arange(5.0), [])
    assert (figures["false_frames"], figures["losses"]) == (3, 1)
    assert figures["false_s"] == pytest.approx(0.2 + 0.5 + 0.15)  # the last one lasts a median gap
    assert figures["right_percent"] == pytest.approx(20.0)
    assert (figures["false_times"], figures["tracked_m"], figures["tracked_s"]) == (2, 3.0, pytest.approx(0.95))
    silent = score(track(["SEARCHING"] * 3 + ["SKIPPED"]), np.tile(np.eye(4), (4, 1, 1)), np.arange(4.0), [])
    assert (silent["rmse_m"], silent["first_fix_m"], silent["max_m"]) == (None, None, None)


def test_recovery_is_counted_from_the_end_of_the_event_to_the_first_right_pose():
    right = np.array([True, True, False, False, False, True])
    driven = np.array([0.0, 1.0, 1.0, 1.0, 3.0, 6.0])
    assert recovery(right, driven, 2) == 5.0
    assert recovery(right, driven, 1) == 0.0
    assert recovery(right[:5], driven, 2) is None
    states = ["SEARCHING", "TRACKING", "LOST", "LOST", "TRACKING", "AMBIGUOUS", "LOST"]
    assert losses(states) == 2


def test_a_fix_ends_with_a_search_but_not_with_a_doubt():
    states = ["SEARCHING", "TRACKING", "AMBIGUOUS", "TRACKING", "LOST", "AMBIGUOUS", "TRACKING"]
    age = since_fix(track(states))
    np.testing.assert_allclose(age, [np.nan, 0.0, np.nan, 0.2, np.nan, np.nan, 0.0])


def missed_by(rows, parts):
    return {row.name.partition("/")[2] for row in tracking.verdicts(rows, parts) if row.holds is False}


def row(**changes):
    out = {
        "plain": True, "rmse_m": 0.05, "rmse_deg": 0.05, "false_frames": 0, "false_s": 0.0, "recoveries_m": [],
        "misleading": 0, "beyond": [], "false_times": 0, "tracked_m": 500.0, "tracked_s": 100.0,
    }  # fmt: skip
    return out | changes


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, set()),
        ({"rmse_m": 0.13}, {"rmse of plain drives, m"}),
        ({"rmse_deg": None}, {"rmse of plain drives, deg"}),
        ({"false_frames": 1, "false_s": 0.1}, {"false frames"}),
        ({"misleading": 2}, {"beyond the alert limit, to the alert"}),
        ({"recoveries_m": [20.1]}, {"recovery, m driven"}),
        ({"recoveries_m": [None]}, {"recovery, m driven"}),
    ],
)
def test_targets_are_judged(honest, changes, missed):
    assert missed_by([row(**changes)], honest) == missed


def drawn(count, factor, freedom, seed=5):
    """A sample whose errors have a known tail."""
    rng = np.random.default_rng(seed)
    scale = factor * np.sqrt(freedom / rng.chisquare(freedom, (count, 2)))
    twist = rng.multivariate_normal(np.zeros(6), C, count) * np.repeat(scale, 3, axis=1)
    norms = [np.linalg.norm(twist[:, part], axis=1) for part in PARTS.values()]
    norms[1] = np.degrees(norms[1])
    one = track(["TRACKING"], covariance=C)
    one = Sample.of(one, errors(one, way(1)), [0])
    ones = np.ones((count, len(PARTS)))
    return Sample(np.column_stack(norms), ones, ones * one.trace, ones * one.axes)


def test_one_pose_counts_of_each_ten_metres_with_its_reported_level():
    level = protection_level(C, doubt=1.2)
    wanted = [level.metres, level.degrees, level.horizontal, level.vertical]
    states = ["SEARCHING"] * 30 + ["TRACKING"] * 170
    drive = track(states, way(200), covariance=C, level=wanted)
    rows = blocks(drive, 0.2 * np.arange(200))  # 40 m, the first six without a pose
    sample = Sample.of(drive, errors(drive, way(200)), rows)
    assert len(sample.error) == 4
    np.testing.assert_allclose(sample.doubt, 1.2)
    np.testing.assert_allclose(sample.level(PRODUCT), [wanted] * 4)
    np.testing.assert_array_equal(Sample.joined([sample.to_json()]).trace, sample.trace)


def test_conformal_factor_covers_further_blocks_of_any_tail():
    above = []
    for seed in range(200):
        factors, held = conformal(drawn(99, 0.7, 2.0, seed), risk=0.05)
        assert held == 0.05
        further = drawn(50, 0.7, 2.0, 1000 + seed)
        tails = [(factor, freedom) for factor, (_, freedom) in zip(factors, PRODUCT, strict=True)]
        above.append((further.error > further.level(tails, 0.05)).mean(axis=0))
    assert (np.mean(above, axis=0) < 0.06).all()
    assert (np.mean(above, axis=0) > 0.03).all()  # and not by being far too wide


def test_few_blocks_hold_for_no_less_than_their_number():
    sample = drawn(9, 1.0, 4.0)
    factors, held = conformal(sample)
    assert held == pytest.approx(0.1)
    tails = [(factor, freedom) for factor, (_, freedom) in zip(factors, PRODUCT, strict=True)]
    np.testing.assert_allclose((sample.error / sample.level(tails, held)).max(axis=0), 1.0)
    with pytest.raises(ValueError, match="no block"):
        conformal(Sample.joined([]))


def test_rate_has_its_poisson_bound():
    assert rate(0, 10.0) == "0 (below 0.3)"
    assert rate(3, 2.0) == "1.5 (below 3.9)"
    assert rate(0, 0.0) == "-"
    drives = [row(), row(tracked_m=0.0, tracked_s=0.0)]
    assert exposed("x", "false", 0, drives).text == "0 in 0.50 km and 0.03 h of tracking"


def test_replays_of_one_way_are_no_further_kilometres():
    drives = [row(way=way) | {"false_times": false} for way, false in (("a", 1), ("a", 2), ("b", 0))]
    found = counted("x", drives).details
    assert (found["drives"], found["ways"]) == (3, 2)
    assert found["km_once"] == pytest.approx(2 / 3 * found["km"])
    assert (found["events"], found["events_once"]) == (3, 2)


def test_a_pose_beyond_the_alert_limit_misleads_unless_it_is_withdrawn_in_time():
    truth, poses = np.tile(np.eye(4), (60, 1, 1)), np.tile(np.eye(4), (60, 1, 1))
    poses[10:18, 0, 3] = 1.1  # 0.8 s
    poses[30:, 0, 3] = 1.1  # 2.9 s, to the end
    drive = track(["TRACKING"] * 60, poses)
    error = errors(drive, truth)
    assert misleading(beyond_alert_limit(drive, error, np.zeros(60))) == 1
    assert misleading(beyond_alert_limit(drive, error, 0.3 * np.arange(60))) == 2
    withdrawn = track(["TRACKING"] * 45 + ["LOST"] * 15, poses)
    assert misleading(beyond_alert_limit(withdrawn, errors(withdrawn, truth), np.zeros(60))) == 0


def test_families_share_no_kind_and_no_seed():
    calibrated, reported = (protection.FAMILIES[name] for name in ("calibrated", "reported"))
    assert not set(calibrated.kinds) & set(reported.kinds)
    assert not {w.seed for w, _ in calibrated.worlds(100)} & {w.seed for w, _ in reported.worlds(100)}


def smoothed_run(**figures):
    """Figures of a run, all zero but the given ones and the counts of frames."""
    parts = ("m", "median_m", "max_m", "deg", "median_deg", "max_deg", "beyond", "false")
    zero = {f"{group}_{part}": 0.0 for group in ("live", "smoothed", "only") for part in parts}
    return {"name": "town", "frames": 500, "live": 400, "without": 100, "only": 22} | zero | figures


@pytest.mark.parametrize("key", ["only_false", "smoothed_beyond", "only_beyond"])
def test_smoothed_poses_of_every_kind_have_a_verdict(key):
    assert all(row.holds for row in smoothing.verdicts([smoothed_run()]))
    missed = [row for row in smoothing.verdicts([smoothed_run(), smoothed_run(**{key: 4})]) if not row.holds]
    assert len(missed) == 1
    assert ("without a live one" in missed[0].name) == key.startswith("only")


@pytest.mark.parametrize(("scale", "holds"), [(0.5, False), (1.0, True), (2.0, False)])
def test_a_mean_distance_outside_its_band_does_not_hold(covariance, scale, holds):
    twist = np.random.default_rng(4).multivariate_normal(np.zeros(6), covariance, 2000)
    found = figures(twist, np.tile(covariance * scale**2, (2000, 1, 1)))
    assert found["mean"] == pytest.approx(6.0 / scale**2, rel=0.05)
    assert found["position"] == pytest.approx(3.0 / scale**2, rel=0.1)
    row = judge("run", "held out", "exact", found)
    assert row.holds is holds
    assert (BAND[0] <= row.ours <= BAND[1]) is holds
