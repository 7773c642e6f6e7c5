"""Drives in forests: statistics, the simulated GNSS and its fusion with odometry, and parts of the method alone."""

from dataclasses import replace

import numpy as np
import pytest
from drives_with_truth import way

from bench.accuracy.scores import Track, errors
from bench.forest.drives import statistics
from bench.forest.variants import ForgetfulGraph, Receiver, fused
from bench.tracking.drives import drifting
from bench.tracking.worlds import World, winding_path
from coview_stream.geometry.transforms import exp_so3, pose_from
from coview_stream.sim.layout import arc_lengths


def test_statistics_are_of_the_finite_values():
    found = statistics(np.array([3.0, np.nan, 0.0, 0.0, 5.0]))
    assert found == pytest.approx({"rmse": np.sqrt(8.5), "median": 1.5, "mean": 2.0, "std": np.sqrt(4.5), "max": 5.0})
    assert set(statistics(np.full(3, np.nan)).values()) == {None}


def test_the_receiver_errs_as_the_measured_ones_did_and_slowly():
    receiver = Receiver()
    error = receiver.errors(20_000, np.random.default_rng(1))
    assert np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()) == pytest.approx(4.2, rel=0.1)
    later = (error[60:] * error[:-60]).mean(axis=0) / (error**2).mean(axis=0)
    np.testing.assert_allclose(later, receiver.slow / np.e, atol=0.1)  # after its memory of 60 s
    same = [receiver.errors(9, np.random.default_rng(seed)) for seed in (2, 2, 3)]
    np.testing.assert_array_equal(same[0], same[1])
    assert (same[0] != same[2]).all()


def test_a_tenth_of_the_fixes_is_missing_in_stretches():
    stamps = np.arange(0.0, 20_000.0, 0.5)
    frames, told = Receiver().fixes(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)), np.random.default_rng(3))
    assert len(frames) == len(told) == pytest.approx(18_000, rel=0.05)
    gaps = np.diff(frames) > 2
    assert np.diff(frames)[gaps].mean() / 2 == pytest.approx(11.0, rel=0.2)  # seconds from fix to fix, on average


@pytest.mark.slow
def test_fusion_bounds_the_drift_of_odometry_and_is_bounded_by_the_receiver():
    truth = way(2000)[::2]  # 4 m a second
    stamps = 0.1 * np.arange(len(truth))
    odometry = drifting(truth, 0.05, 3)
    sharp = replace(Receiver(), horizontal=0.1, slow=0.0)
    alone, exact, under_canopy = (
        errors(Track.of_poses(stamps, poses), truth).metres
        for poses in (
            truth[0] @ np.linalg.inv(odometry[0]) @ odometry,
            fused(stamps, truth, odometry, 5, sharp),
            fused(stamps, truth, drifting(truth, 0.01, 3), 5),
        )
    )
    assert alone[-1] > 5.0
    assert np.median(exact) < 0.3
    assert 0.5 < np.median(under_canopy) < under_canopy.max() < 3.0 * np.linalg.norm(Receiver().sigmas)


def test_without_fusion_a_registration_is_the_pose():
    graph, spread = ForgetfulGraph(), 1e-6 * np.eye(6)
    graph.start(np.eye(4), spread)
    step = pose_from(exp_so3(np.array([0.0, 0.0, 0.1])), [1.0, 0.0, 0.0])
    graph.move(step, spread)
    np.testing.assert_allclose(graph.estimate.T_map_body, step, atol=1e-12)
    measured = pose_from(np.eye(3), [1.2, 0.3, 0.0])
    graph.correct(measured, spread)
    np.testing.assert_allclose(graph.estimate.T_map_body, measured, atol=1e-12)
    assert len(graph) == 1


def test_the_winding_path_is_closed_long_and_can_be_driven():
    layout = winding_path(np.random.default_rng(1), 520.0, 310.0)
    route = layout.route
    assert arc_lengths(route)[-1] > 2000.0
    assert np.linalg.norm(route[0] - route[-1]) < 0.5
    assert np.abs(route).max() < 240.0
    heading = np.unwrap(np.arctan2(*np.diff(route, axis=0).T[::-1]))
    assert np.abs(np.diff(heading)).max() / 0.25 < 1 / 4.0  # no bend of less than 4 m


@pytest.mark.slow
def test_forests_of_the_tables_are_as_dense_as_stated_and_have_changed_since_the_survey():
    scene = World("dense-forest", "vlp16", 1, 80.0, 40.0, 2.0, 0.01).scene()
    before, now = (part.trees for part in scene.parts)
    assert len(before) / (2 * scene.site.half) ** 2 > 0.08
    kept = {tuple(row) for row in now[:, :2]} & {tuple(row) for row in before[:, :2]}
    assert len(kept) / len(before) == pytest.approx(0.9, abs=0.01)
