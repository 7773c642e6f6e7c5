"""Registration: finds a known offset through outliers, refuses emptiness, lets a prior decide the rest."""

from __future__ import annotations

import numpy as np
import pytest
from courtyard import courtyard, local_map, parts, plane, source_of
from se3 import exp_se3

import coview_kernels as kernels
from coview_stream.config import MapConfig, RegistrationConfig
from coview_stream.geometry.transforms import inverse, pose_from, rot_z, rotation_angle, transform
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import RegistrationCloud
from coview_stream.localization.registration.register import Prior, register

CONFIG = RegistrationConfig()
TRUTH = pose_from(rot_z(0.7), [2.0, -1.0, 0.4])


@pytest.fixture(scope="module")
def target():
    return local_map(*courtyard())


@pytest.fixture(scope="module")
def scan(target):
    some = np.random.default_rng(1).permutation(len(target.points))[:3000]
    return source_of(target.points[np.sort(some)], TRUTH)


def errors(T, truth=TRUTH):
    gap = inverse(truth) @ T
    return float(np.linalg.norm(gap[:3, 3])), float(np.degrees(rotation_angle(gap)))


def with_outliers(scan, share):
    rng = np.random.default_rng(2)
    n = int(len(scan.points) * share / (1 - share))
    stray = rng.uniform([-12, -12, 0.6], [12, 12, 5], (n, 3)).astype(np.float32)
    return RegistrationCloud(
        np.concatenate([scan.points, stray]),
        np.concatenate([scan.above, np.ones(n, bool)]),
        np.concatenate([scan.height, stray[:, 2]]),
    )


@pytest.mark.parametrize(
    "offset",
    [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0.08, 1.0, -0.8, 0.2],
        [0.02, -0.02, -0.1, -1.2, 0.5, -0.3],
        [-0.03, 0.03, 0.05, 0.3, 1.3, 0.4],
    ],
)
def test_known_six_dof_offset_is_found(target, scan, offset):
    start = TRUTH @ exp_se3(np.array(offset, float))
    found = register(scan, start, target, CONFIG, CONFIG.search)
    metres, degrees = errors(found.T_map_source)
    assert metres < 0.01
    assert degrees < 0.05
    assert found.converged
    assert found.rmse < 0.01
    assert found.pairs > 1000
    assert 0 < found.iterations <= CONFIG.iterations * len(CONFIG.search)


def test_registration_with_forty_percent_outliers(target, scan):
    start = TRUTH @ exp_se3(np.array([0.01, 0.0, 0.06, 0.8, -0.7, 0.1]))
    metres, degrees = errors(register(with_outliers(scan, 0.4), start, target, CONFIG, CONFIG.search).T_map_source)
    assert metres < 0.03
    assert degrees < 0.15


def test_pivot_does_not_change_the_result(target, scan):
    start = TRUTH @ exp_se3(np.array([0.0, 0.0, 0.05, 0.5, -0.5, 0.1]))
    for centre in (None, np.zeros(3), np.array([8.0, -5.0, 1.0])):
        found = register(scan, start, target, CONFIG, CONFIG.search, centre=centre)
        assert errors(found.T_map_source)[0] < 0.01


def test_information_is_symmetric_and_reflects_observability(target, scan):
    corner = register(scan, TRUTH, target, CONFIG, (0.4,))
    np.testing.assert_allclose(corner.information, corner.information.T, rtol=1e-4, atol=1e-2)
    assert np.linalg.eigvalsh(corner.information).min() > 1
    flat = local_map(*parts(plane([-15, -15, 0], [30, 0, 0], [0, 30, 0])))
    floor = register(source_of(flat.points[::7], TRUTH), TRUTH, flat, CONFIG, (0.4,))
    # order (rx, ry, rz, x, y, z): a floor fixes tilt and height, not heading or place
    assert floor.information[[0, 1, 5], [0, 1, 5]].min() > 1e4 * floor.information[[2, 3, 4], [2, 3, 4]].max()


def test_empty_local_map_gives_no_registration(target, scan):
    assert register(scan, pose_from(np.eye(3), [500, 0, 0]), target, CONFIG, (1.0,)) is None
    few = RegistrationCloud(scan.points[:20], scan.above[:20], scan.height[:20])
    assert register(few, TRUTH, target, CONFIG, (1.0,)) is None


def test_prior_decides_unobserved_directions():
    """On a bare plane heading and place are free: alone they stay, a prior pulls them."""
    flat = local_map(*parts(plane([-15, -15, 0], [30, 0, 0], [0, 30, 0])))
    scan = source_of(flat.points[::7], np.eye(4))
    start = exp_se3(np.array([0.01, -0.01, 0.05, 0.4, -0.3, 0.2]))
    mean = np.eye(4)
    centre = np.zeros(3)
    sigma = np.diag(np.array([0.05, 0.05, 0.01, 0.1, 0.1, 0.5]) ** -2)
    alone = register(scan, start, flat, CONFIG, (0.8, 0.4), centre=centre)
    pulled = register(scan, start, flat, CONFIG, (0.8, 0.4), Prior(mean, sigma), centre)
    assert abs(alone.T_map_source[2, 3]) < 0.01
    assert np.hypot(*(alone.T_map_source[:2, 3] - start[:2, 3])) < 0.05
    assert np.linalg.norm(pulled.T_map_source[:3, 3]) < 0.01
    assert rotation_angle(pulled.T_map_source) < 1e-3


def test_weak_prior_does_not_outweigh_the_map(target, scan):
    wrong = TRUTH @ exp_se3(np.array([0, 0, 0.02, 0.3, 0.3, 0]))
    weak = Prior(wrong, np.diag(np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]) ** -2))
    found = register(scan, wrong, target, CONFIG, CONFIG.search, weak)
    assert errors(found.T_map_source)[0] < 0.02


def test_thinning_keeps_ground_and_structure_points(scan):
    thin = scan.every(3)
    assert len(thin.points) == -(-len(scan.points) // 3)
    assert thin.above.mean() == pytest.approx(scan.above.mean(), abs=0.01)
    np.testing.assert_array_equal(thin.above, thin.height > 0.5)


class FakeMap:
    """A map of one cloud that counts the crops asked for."""

    config = MapConfig()

    def __init__(self, points, normals):
        self.arrays = self
        self.cloud, self.asked = (points, np.rint(127 * normals).astype(np.int8)), []


@pytest.fixture(autouse=True)
def cut_from_the_whole_cloud(monkeypatch):
    def cut_points(fake, tile, cut):
        fake.asked.append(cut)
        return kernels.crop_points(*fake.cloud, [[0, len(fake.cloud[0])]], cut)

    monkeypatch.setattr("coview_stream.localization.registration.local_map.cut_points", cut_points)


def test_local_maps_hold_all_points_within_radius_and_are_cached(target):
    fake = FakeMap(target.points, target.normals)
    maps = LocalMaps(fake, radius=6.0)
    for position in np.random.default_rng(3).uniform(-12, 12, (30, 3)):
        found = maps.around(position)
        wanted = np.hypot(*(target.points[:, :2] - position[:2]).T) < 6.0
        inside = np.hypot(*(found.points[:, :2] - position[:2]).T) < 6.0
        assert inside.sum() == wanted.sum()
        assert len(found.points) == len(found.normals)
    assert len(fake.asked) == len(set(fake.asked)) <= 9


def test_local_map_cache_drops_the_oldest(target):
    fake = FakeMap(target.points, target.normals)
    maps = LocalMaps(fake, radius=6.0)
    for x in range(0, 16 * 40, 16):
        maps.around(np.array([x, 0.0, 0.0]))
    assert len(maps._crops) < 40
    maps.around(np.array([0.0, 0.0, 0.0]))
    assert len(fake.asked) == 41


def test_local_map_without_points_is_none(target):
    maps = LocalMaps(FakeMap(target.points, target.normals), radius=6.0)
    assert maps.around(np.array([900.0, 0.0, 0.0])) is None
    assert maps.around(np.array([901.0, 0.0, 0.0])) is None


def test_T_map_source_maps_scan_points_into_map(target, scan):
    """The scan's points, moved by the truth, are map points: the convention of T_map_source."""
    distance, _ = kernels.nearest(target.grid, transform(TRUTH, scan.points), 1.0)
    assert distance.max() < 1e-3
