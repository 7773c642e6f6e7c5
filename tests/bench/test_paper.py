"""The first paper's method: ring keys, distances at all shifts, trimmed ICP, its table."""

import numpy as np
import pytest

from bench.accuracy import paper
from bench.accuracy.paper import LocalScan, Reference, consistent, distances, ring_key, trimmed_icp, unit_columns
from coview_stream.geometry.transforms import exp_so3, inverse, pose_from, rot_z, rotation_angle, transform


def test_ring_key_is_the_occupied_share_of_each_ring_at_any_turn():
    descriptor = np.zeros((4, 12), np.float32)
    descriptor[0], descriptor[1, :3], descriptor[3, 5] = 1.0, 2.0, 3.0
    np.testing.assert_allclose(ring_key(descriptor), [1.0, 0.25, 0.0, 1 / 12])
    np.testing.assert_allclose(ring_key(np.roll(descriptor, 5, axis=1)), ring_key(descriptor))


def test_distances_are_one_less_the_mean_cosine_of_columns_and_empty_ones_cost_one():
    rng = np.random.default_rng(1)
    stations, query = rng.random((3, 4, 6), np.float32), rng.random((4, 6), np.float32)
    stations[1, :, 2], query[:, 5] = 0.0, 0.0
    found = distances(unit_columns(stations), unit_columns(query))
    for k in range(3):
        for n in range(6):
            total = 0.0
            for column in range(6):
                a, b = stations[k, :, column], query[:, (column - n) % 6]
                if a.any() and b.any():
                    total += float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
            assert found[k, n] == pytest.approx(1.0 - total / 6, abs=1e-6)


@pytest.mark.slow
def test_a_turned_scan_is_found_at_its_station_and_heading(world_map):
    reference = Reference(world_map)
    T_map_odom = pose_from(rot_z(2.0 * np.pi * 7 / 60), [40.0, -30.0, 2.0])
    centre = transform(inverse(T_map_odom), reference.stations[3][None])[0]
    scan = LocalScan(transform(inverse(T_map_odom), np.array(world_map.points)), centre)
    empty = float((reference.columns[3] == 0).all(axis=0).mean())
    for count in (None, 10):
        distance, T = reference.match(scan, count)
        np.testing.assert_allclose(T, T_map_odom, atol=1e-5)
        assert distance == pytest.approx(empty, abs=0.1)


def test_trimmed_icp_finds_a_motion_in_spite_of_a_third_of_strangers():
    rng = np.random.default_rng(3)
    target = rng.uniform(-10, 10, (3000, 3))
    T = pose_from(exp_so3([0.01, -0.02, 0.03]), [0.1, -0.15, 0.08])
    source = transform(inverse(T), target[:900])
    strangers = rng.uniform(20, 30, (400, 3))
    found = trimmed_icp(np.concatenate([source, strangers]), target, np.eye(4))
    off = inverse(T) @ found
    assert np.linalg.norm(off[:3, 3]) < 1e-6
    assert rotation_angle(off) < 1e-6


def test_too_few_points_leave_the_pose():
    T = pose_from(rot_z(0.3), [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(trimmed_icp(np.zeros((4, 3)), np.ones((50, 3)), T), T)


def test_points_of_a_facade_are_inconsistent_below_a_roof():
    roof = np.array([[1.0, 1.0, 8.2], [1.0, 1.0, 0.1], [9.0, 9.0, 0.0]], np.float32)
    points = np.array([[1.2, 0.8, 8.0], [1.2, 0.8, 4.0], [1.2, 0.8, 0.9], [5.0, 5.0, 0.0], [1.2, 0.8, 50.0]])
    assert consistent(points, roof).tolist() == [True, False, True, False, False]


def test_table_counts_what_is_false_and_has_the_authors_row():
    right = {"success": True, "e_t": 0.5, "e_r": 0.25, "keyframe_ms": 12.0, "seconds": 2.0}
    wrong = right | {"success": False, "e_t": 90.0}
    answers = {way: right if count is None else wrong for way, count in paper.WAYS.items()}
    ours = {"success": True, "false_frames": 0, "e_t": 0.02, "e_r": 0.1, "locate_s": 7.0, "paper": answers}
    text = paper.compared([ours, ours], [{"false_frames": 0}])
    cells = {row[0]: row[1:] for row in ([c.strip() for c in line.split("|")[1:-1]] for line in text.splitlines())}
    assert cells["coview_stream"] == ["2 of 2", "0 of 3", "0.020", "0.100", "-", "7.0"]
    assert cells["the paper"] == ["0 of 2", "3 of 3", "-", "-", "12", "2.0"]
    assert cells["the paper, all stations"] == ["2 of 2", "1 of 3", "0.500", "0.250", "12", "2.0"]
    assert cells[paper.AUTHORS["method"]][0] == "28 of 30"
    assert paper.in_words(answers)["the paper"] == "false"
