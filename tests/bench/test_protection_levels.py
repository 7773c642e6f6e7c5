"""Protection levels against the truth: which poses count, the bound, the tail that fits, and what is misleading."""

from __future__ import annotations

import numpy as np
import pytest
from told import told, way

from bench.harness.trajectory_scores import errors
from bench.tracking import protection
from bench.tracking.levels import PRODUCT, Sample, beyond_alert_limit, level_table, stanford, tail, upper_bound
from coview_stream.geometry.protection import protection_level

C = np.diag([1e-4, 1e-4, 1e-5, 1e-6, 1e-6, 2e-6])


def drawn(count, factor, freedom, seed=5):
    """A sample whose errors have a known tail."""
    rng = np.random.default_rng(seed)
    scale = factor * np.sqrt(freedom / rng.chisquare(freedom, (count, 2)))
    twist = rng.multivariate_normal(np.zeros(6), C, count)
    metres = scale[:, 0] * np.linalg.norm(twist[:, :3], axis=1)
    degrees = np.degrees(scale[:, 1] * np.linalg.norm(twist[:, 3:], axis=1))
    one = Sample.of(told(["TRACKING"], covariance=C), errors(told(["TRACKING"]), way(1)), np.zeros(1))
    ones = np.ones((count, 2))
    return Sample(np.column_stack([metres, degrees]), ones, ones * one.trace, ones * one.axes)


def test_one_pose_counts_of_each_ten_metres_and_its_level_is_the_one_told():
    states = ["SEARCHING"] * 30 + ["TRACKING"] * 170
    level = protection_level(C, doubt=1.2)
    said = told(states, way(200), covariance=C, level=(level.metres, level.degrees))
    sample = Sample.of(said, errors(said, way(200)), 0.2 * np.arange(200))  # 40 m, the first six without a pose
    assert len(sample.error) == 4
    np.testing.assert_allclose(sample.error, 0.0, atol=1e-6)
    np.testing.assert_allclose(sample.doubt, 1.2)
    np.testing.assert_allclose(sample.level(PRODUCT), [[level.metres, level.degrees]] * 4)
    again = Sample.from_json(sample.to_json())
    np.testing.assert_array_equal(again.trace, sample.trace)
    assert len(Sample.joined([sample, again]).error) == 8


@pytest.mark.parametrize(("hits", "of", "bound"), [(0, 2995, 0.001), (0, 299, 0.01), (1, 4742, 0.001), (3, 3, 1.0)])
def test_bound_is_the_exact_binomial_one(hits, of, bound):
    assert upper_bound(hits, of) == pytest.approx(bound, rel=0.01)


@pytest.mark.parametrize(("factor", "freedom"), [(1.0, 4.0), (0.7, 3.0), (1.5, 12.0)])
def test_tail_that_errors_were_drawn_from_is_found(factor, freedom):
    sample = drawn(20_000, factor, freedom)
    for part in (0, 1):
        found = tail(sample, part)
        assert found[0] == pytest.approx(factor, rel=0.05)
        assert found[1] == pytest.approx(freedom, rel=0.2)
    above = sample.above([(factor, freedom)] * 2)
    assert max(above) < 2e-3 * 20_000
    assert sum(sample.above([(factor, 200.0)] * 2)) > sum(above)


def test_a_pose_beyond_the_alert_limit_misleads_unless_it_is_withdrawn_in_time():
    truth, poses = np.tile(np.eye(4), (60, 1, 1)), np.tile(np.eye(4), (60, 1, 1))
    poses[10:18, 0, 3] = 1.1  # 0.8 s
    poses[30:, 0, 3] = 1.1  # 2.9 s, to the end
    said = told(["TRACKING"] * 60, poses)
    error = errors(said, truth)
    assert sum(each.misleading for each in beyond_alert_limit(said, error, np.zeros(60))) == 1
    far = beyond_alert_limit(said, error, 0.3 * np.arange(60))
    assert [each.misleading for each in far] == [True, True]
    assert far[0] == pytest.approx((0.8, 2.4))
    withdrawn = told(["TRACKING"] * 45 + ["LOST"] * 15, poses)
    assert not any(each.misleading for each in beyond_alert_limit(withdrawn, errors(withdrawn, truth), np.zeros(60)))


def test_table_and_picture_of_a_sample_and_of_none(tmp_path):
    sample = drawn(100, 1.0, 4.0)
    text = level_table({"town": sample, "none": sample._replace(**dict.fromkeys(sample._fields, np.empty((0, 2))))})
    assert [line.split("|")[2].strip() for line in text.splitlines()[2:]] == ["100", "0"]
    stanford(sample, tmp_path / "stanford.png", "")
    assert (tmp_path / "stanford.png").stat().st_size > 10_000


def test_families_share_no_kind_and_no_seed():
    fitted, reported = (protection.FAMILIES[name] for name in ("fitted", "reported"))
    assert not set(fitted.kinds) & set(reported.kinds)
    seeds = [{world.seed for world, _ in family.worlds(100)} for family in (fitted, reported)]
    assert not seeds[0] & seeds[1]
    variants = [variant for _, variant in reported.worlds(8)]
    assert variants == ["plain"] * 4 + ["changed"] * 4
